"""What stages take and write, predicted: fleets admit them by it. Of memory it is what the stage itself says once it begins."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from efficientnerf.geometry.cameras import Camera
from pipeline.errors import TooLittleMemory
from pipeline.executors.memory import Limit
from pipeline.fleet.forecast import RESERVE
from stages.bake import run as bake
from stages.bake.settings import BakeSettings
from stages.evaluate import run as evaluate
from stages.formats.exporters.exr import write_exr
from stages.io.png import write_png
from stages.memory.forecast import MIN_SPACE, Known, memory_needed, sizes_below, space_needed
from stages.mesh import run as mesh
from stages.points import run as points
from stages.splats import run as splats
from stages.train import run as train
from stages.turntable import run as turntable
from stages.turntable.memory import space_needed as frames_written
from tests.efficientnerf.balls import settings
from tests.stages.balls import job, poses
from tests.stages.captures import HEIGHT, WIDTH, cameras, nerfstudio
from workflows.asset import STAGES

GIB = 2**30
DEFAULTS: dict[str, Any] = {stage.name: stage.settings() for stage in STAGES}
QUICK = {"iterations": 4, "checkpoint_every": 2, "sample_batch_size": 1024, "occupancy_warmup_steps": 2, "preview_every": 2, "initial_density": 10.0}
OWN: dict[str, Any] = {
    **DEFAULTS,
    "train": settings(**QUICK),
    "bake": BakeSettings(resolution=16, samples_per_voxel=1, refine_steps=2, weight_threshold=0.0, max_mib=1.0),
    "mesh": replace(DEFAULTS["mesh"], texture_size=256, max_faces=1000),
    "splats": replace(DEFAULTS["splats"], make="on", iterations=2, pictures="asset"),
    "evaluate": replace(DEFAULTS["evaluate"], captured_path_frames=6),
    "turntable": replace(DEFAULTS["turntable"], frames=4, width=96, height=72),
    "points": replace(DEFAULTS["points"], num_points=2000),
}
STAGE_OF = {stage.name: stage for stage in STAGES}
MODULES = {"train": train, "bake": bake, "mesh": mesh, "splats": splats, "evaluate": evaluate, "turntable": turntable, "points": points}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, int], dict[str, int]]:
    """A run of a ball; what each stage said that it took of memory, and the bytes that it left in scratch and artifact."""
    folder = tmp_path_factory.mktemp("plan")
    place, said, written = folder / "run", {}, {}
    place.mkdir()
    shutil.copytree(poses(folder / "poses"), place / "poses")
    for name, module in MODULES.items():
        made = job(folder / name, OWN[name], **{need: place / need for need in STAGE_OF[name].needs})
        made.stage = name
        module.run(made)
        shutil.copytree(made.out, place / name)
        said[name], written[name] = made.facts["memory"]["needed"], sum(sizes_below([made.out, made.work]))
    return place, said, written


@pytest.mark.parametrize("stage", ["mesh", "splats", "evaluate", "turntable", "points"])
def test_it_is_what_the_stage_says_that_it_needs(run: tuple[Path, dict[str, int], Any], stage: str, tmp_path: Path) -> None:
    place = run[0]
    assert memory_needed(stage, place, (), OWN) == run[1][stage]
    short = job(tmp_path, OWN[stage], **{need: place / need for need in STAGE_OF[stage].needs})
    short.stage, short.memory = stage, Limit(1, "--memory")
    with pytest.raises(TooLittleMemory) as caught:
        MODULES[stage].run(short)
    assert memory_needed(stage, place, (), OWN) == caught.value.needed
    assert not list(short.out.iterdir())


def test_training_and_baking_take_no_more_than_was_predicted(run: tuple[Path, dict[str, int], Any]) -> None:
    place, said, _ = run
    assert memory_needed("train", place, (), OWN) == said["train"]
    at_most = memory_needed("bake", place, (), OWN)
    assert said["bake"] <= at_most < said["bake"] + GIB
    larger = {**OWN, "bake": replace(OWN["bake"], resolution=512, max_mib=64.0)}
    assert memory_needed("bake", place, (), larger) > at_most + GIB


@pytest.mark.parametrize("stage", MODULES)
def test_a_stage_writes_what_was_predicted_and_no_less_than_half(run: tuple[Path, Any, dict[str, int]], stage: str) -> None:
    """But for logs and pictures whose size does not follow from the scene's."""
    predicted, written = space_needed(stage, run[0], (), OWN), run[2][stage]
    assert written <= predicted <= 2 * written + 3 * MIN_SPACE


def test_small_pictures_with_cameras_need_little_room(tmp_path: Path) -> None:
    """No features are looked for, and none of the pictures is enlarged: a fleet of such scenes fits on a disk of 60 MB."""
    nerfstudio(tmp_path / "source", cameras(8))
    needed = space_needed("poses", tmp_path / "run", (tmp_path / "source",), DEFAULTS)
    pixels = 8 * WIDTH * HEIGHT
    assert pixels < needed - MIN_SPACE < 4 * pixels
    taken = {**DEFAULTS, "poses": replace(DEFAULTS["poses"], format="photographs", max_features=512)}
    assert space_needed("poses", tmp_path / "run", (tmp_path / "source",), taken) >= needed + 8 * 512 * 300, "asked to find the cameras it looks for features"
    assert 2 * needed + RESERVE <= 60 * 10**6


def test_pixels_that_do_not_fit_into_memory_and_checkpoints_are_written(run: tuple[Path, Any, Any]) -> None:
    roomy, tight = (space_needed("train", run[0], (), OWN, memory) for memory in (None, 1000))
    assert tight - roomy == 4 * 7 * 16 * 16
    one, three = (space_needed("train", run[0], (), {**OWN, "train": replace(OWN["train"], checkpoint_every=every)}) - MIN_SPACE for every in (1000, 1))
    assert 1.5 * one < three < 3 * one, "a checkpoint that no step reaches is predicted for an interruption alone"


@pytest.mark.parametrize(("background", "channels"), [("auto", 3), ("transparent", 4)])
@pytest.mark.parametrize(("exr", "deep"), [("off", 0), ("first", 1), ("all", 3)])
def test_a_turntables_frames_of_noise_fit_into_what_was_predicted(background: str, channels: int, exr: str, deep: int, tmp_path: Path) -> None:
    """Nothing is harder to compress; and what is predicted, in scratch and artifact, is no more than a sixth above."""
    own = replace(DEFAULTS["turntable"], frames=3, width=512, height=384, background=background, exr=exr)
    random = np.random.default_rng(0)
    camera = Camera("noise", own.width, own.height, "SIMPLE_PINHOLE", (400.0, own.width / 2, own.height / 2), np.eye(4))
    for number in range(own.frames):
        write_png(random.integers(0, 256, (own.height, own.width, channels), np.uint8), tmp_path / f"{number}.png")
        if number < deep:
            colour, normal = random.random((2, own.height, own.width, 3), np.float32)
            opacity, depth = random.random((2, own.height, own.width), np.float32)
            write_exr(tmp_path / f"{number}.exr", colour=colour, opacity=opacity, depth=depth, normal=normal, camera=camera)
    written = 2 * sum(sizes_below([tmp_path]))
    assert written < frames_written(Known(tmp_path, (), {"turntable": own})) < 7 / 6 * written * 1.001
