"""The bake stage: the same bytes whatever happened on the way, and an asset that needs no run."""

import dataclasses
import hashlib
import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from efficientnerf.asset import bake as baking
from efficientnerf.asset import format
from efficientnerf.asset.cascades import voxel_coordinates
from efficientnerf.asset.file import serialisation
from efficientnerf.asset.refinement.schedule import stated_schedule
from efficientnerf.asset.tree import tree_from_voxels
from efficientnerf.rendering.compositing import activate
from pipeline.errors import Interrupted, StageFailed, UsageError
from pipeline.executors.memory import Limit
from pipeline.stage import Job
from stages.artifacts import BakeOutputs, PosesOutputs, TrainOutputs
from stages.bake import resolution
from stages.bake import run as bake
from stages.bake.refine import checkpoint
from stages.bake.settings import BakeSettings
from stages.io.field_file import load_renderer, save_model
from stages.io.scene import load
from stages.train import run as train
from tests.efficientnerf.balls import settings
from tests.stages.balls import ORBIT, SIMILARITY, StopAt, job
from tests.stages.spoilers import SPOILERS

TWELVE = stated_schedule(12)
QUICK = BakeSettings(resolution=24, samples_per_voxel=4, licence="CC0-1.0", refine_steps=12, refine_rays_per_batch=512, lr_final_ratio=0.3)


@pytest.fixture(scope="module", autouse=True)
def small_blocks() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(baking, "POINTS_PER_BLOCK", 8192)
        patch.setattr(baking, "RAYS_PER_BLOCK", 512)
        yield


def run(made: Job) -> str:
    bake.run(made)
    return hashlib.sha256((made.out / BakeOutputs.asset).read_bytes() + (made.out / "report.json").read_bytes()).hexdigest()


@pytest.fixture(scope="module")
def undisturbed(inputs: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Job, int]:
    """The digest, the job, and how often it could have been stopped."""
    never = StopAt()
    made = job(tmp_path_factory.mktemp("undisturbed"), QUICK, stop=never, **inputs)
    return run(made), made, never.count


def test_more_voxels_than_fit_into_memory_are_refused_before_they_are_baked(inputs: dict[str, Path], tmp_path: Path) -> None:
    made = job(tmp_path, QUICK, **inputs)
    bake.run(made)
    needed = made.facts["memory"]["needed"]
    short = job(tmp_path / "short", QUICK, **inputs)
    short.memory = Limit(needed - 50_000, "--memory")  # more than the pixels, which would go to a file
    with pytest.raises(UsageError, match=r"bake\.max_mib \(\d+\) or bake\.resolution \(24\)"):
        bake.run(short)
    assert not list(short.work.glob("block_*.npy"))


def test_stopped_anywhere_it_ends_in_the_same_bytes(inputs: dict[str, Path], tmp_path: Path, undisturbed: tuple[str, Job, int]) -> None:
    digest, _, calls = undisturbed
    assert calls > 6
    for k, call in enumerate((1, calls // 2, calls)):
        stop = StopAt(call)
        with pytest.raises(Interrupted):
            run(job(tmp_path / str(k), QUICK, stop=stop, **inputs))
        stop.count = 0
        before = len(list((tmp_path / str(k) / "work").glob("block_*.npy")))
        stop.calls = set()
        assert run(job(tmp_path / str(k), QUICK, stop=stop, **inputs)) == digest
        baked_again = len(list((tmp_path / str(k) / "work").glob("block_*.npy"))) - before
        if before:
            # Neither the voxels nor the blocks nor the steps that were there are made anew.
            assert stop.count - baked_again <= calls - call + 1


@pytest.fixture(scope="module")
def stopped(inputs: dict[str, Path], tmp_path_factory: pytest.TempPathFactory, undisturbed: tuple[str, Job, int]) -> Path:
    """The scratch of a bake that was stopped at its last safe point."""
    folder = tmp_path_factory.mktemp("stopped")
    with pytest.raises(Interrupted):
        run(job(folder, QUICK, stop=StopAt(undisturbed[2]), **inputs))
    return folder / "work"


@pytest.mark.parametrize("how", ["cut", "zero", "link"])
def test_every_scratch_file_may_be_damaged(inputs: dict[str, Path], tmp_path: Path, undisturbed: tuple[str, Job, int], stopped: Path, how: str) -> None:
    shutil.copytree(stopped, tmp_path / "work")
    kinds = {path.name.partition("_")[0] for path in stopped.iterdir()}
    assert kinds == {"block", "visibility.json", "visibility", "refinement.safetensors", "log.jsonl", "preview"}
    (tmp_path / "work" / ".block_000000_values.npy.123.part").write_bytes(b"half")
    for path in stopped.iterdir():
        SPOILERS[how](tmp_path / "work" / path.name)
    events: list[dict[str, Any]] = []
    assert run(job(tmp_path, QUICK, events=events, **inputs)) == undisturbed[0]
    warned = [event["text"].partition(" ")[0] for event in events if event["event"] == "warning"]
    assert set(warned) - {path.name for path in stopped.glob("preview_*.png")} == {"visibility.json", "block_000000.json", "refinement.safetensors"}


@pytest.mark.parametrize("pattern", ["visibility_greatest.npy", "block_000001_values.npy"])
def test_an_array_that_is_zero_is_not_taken_for_whole(
    inputs: dict[str, Path], tmp_path: Path, undisturbed: tuple[str, Job, int], stopped: Path, pattern: str
) -> None:
    shutil.copytree(stopped, tmp_path / "work")
    (tmp_path / "work" / "refinement.safetensors").unlink()
    path = tmp_path / "work" / pattern
    size = path.stat().st_size
    path.write_bytes(path.read_bytes()[:128] + bytes(size - 128))  # as after a power cut: the right name, type and size
    assert run(job(tmp_path, QUICK, **inputs)) == undisturbed[0]


def about(step: int, phase: int, **changes: Any) -> np.ndarray:
    """What a checkpoint says of itself."""
    pruned = {"without": 0.0, "restored": 0.0, "voxels": 0} if phase else None
    said = {"step": step, "phase": phase, "pruned": pruned, "schedule": TWELVE.state(), "seconds": 0.0, "began": 0.0, "allotted": 0.0}
    return np.frombuffer(json.dumps(said | changes).encode(), np.uint8)


def said(step: int, phase: int = 0, **changes: Any) -> Callable[[dict[str, np.ndarray]], None]:
    def change(tensors: dict[str, np.ndarray]) -> None:
        tensors["about"] = about(step, phase, **changes)

    return change


def replaced(name: str, values: Callable[[np.ndarray], np.ndarray]) -> Callable[[dict[str, np.ndarray]], None]:
    def change(tensors: dict[str, np.ndarray]) -> None:
        tensors[name] = np.ascontiguousarray(values(tensors[name]))

    return change


CHANGES: list[Callable[[dict[str, np.ndarray]], object]] = [
    said(-1), said(10**9), said(7), said(2, 1), said(3, 7), said(8, 1, pruned=None),
    said(3, pruned=3), said(3, schedule=[]), said(3, more=1), said(3, seconds=-1.0),
    replaced("square_sh", lambda v: v[:-1]), replaced("visits", lambda v: v.astype(np.float32)),
    replaced("kept", lambda v: v[:-1]), replaced("kept", lambda v: v.astype(np.uint8)), replaced("kept", lambda v: 0 * v > 0),
    replaced("kept", lambda v: np.arange(len(v)) != 0), replaced("kept", lambda v: (2 * v.view(np.uint8)).view(bool)),
    replaced("sh", lambda v: v[:, :-3]), replaced("density", lambda v: v[..., None]),
    lambda tensors: tensors.pop("about"), replaced("about", lambda v: v[:-1]), replaced("about", lambda v: v.astype(np.int8)),
]  # fmt: skip


@pytest.mark.parametrize("pruned", [0, 1])
def test_a_state_of_another_refinement_is_told(pruned: int) -> None:
    indices = np.stack(np.meshgrid(*[np.arange(2, 6)] * 3, indexing="ij"), -1).reshape(-1, 3)
    tree = tree_from_voxels((2, 2, 2), 0.25, np.full(3, -1.0), indices, np.full(64, 40.0), np.zeros((64, 1, 3)), background=(1.0, 1.0, 1.0))
    kept = np.arange(64) % (1 + pruned) == 0
    count = int(kept.sum())
    tensors = {name: np.zeros(count, np.float32) for name in ("density", "square_density", "square_sh")}
    tensors |= {"sh": np.zeros((count, 3), np.float32), "visits": np.zeros(count, np.int32), "kept": kept}
    tensors["about"] = about(7 if pruned else 3, pruned)
    checkpoint.check(tensors, tree, TWELVE)
    for change in CHANGES:
        changed = {name: values.copy() for name, values in tensors.items()}
        change(changed)
        with pytest.raises(ValueError, match=r"step|voxels|missing|dropped|\$|unknown field|truncated"):
            checkpoint.check(changed, tree, TWELVE)


def test_the_asset_is_enough_by_itself(inputs: dict[str, Path], undisturbed: tuple[str, Job, int]) -> None:
    made = undisturbed[1]
    tree = format.load(made.out / BakeOutputs.asset)
    about = tree.metadata
    assert about["world_from_capture"] == {"scale": SIMILARITY.scale, "rotation": SIMILARITY.rotation.tolist(), "translation": SIMILARITY.translation.tolist()}
    assert about["orbit"] == {**dataclasses.asdict(ORBIT), "centre": list(ORBIT.centre)}
    assert about["metric"] is True
    assert about["licence"] == "CC0-1.0"
    assert about["provenance"]["kind"] == "ball"
    assert about["provenance"]["training_views"] == 7
    assert about["provenance"]["iterations"] == 30
    field = hashlib.sha256((inputs["train"] / TrainOutputs.field).read_bytes()).hexdigest()
    assert about["provenance"]["sources"] == {
        PosesOutputs.scene: hashlib.sha256(PosesOutputs(inputs["poses"]).scene.read_bytes()).hexdigest(),
        TrainOutputs.field: field,
    }
    assert 5 < about["provenance"]["metrics"]["training_psnr"] <= 100
    assert tree.background == (1.0, 1.0, 1.0)
    assert tree.resolution == (24, 24, 24)
    assert tree.degree == 1
    np.testing.assert_allclose(tree.bounds_min, -1)
    report = json.loads((made.out / "report.json").read_text())
    fitted = report.pop("optimisation")
    assert fitted["steps"] == 12
    assert fitted["psnr_after"] > fitted["psnr_before"] > 10
    assert fitted["voxels_baked"] >= len(tree.density_values)
    assert report == {
        "resolution": [24, 24, 24],
        "voxels_along_longest_side": 24,
        "resolution_decided_by": "bake.resolution",
        "max_mib": 38,
        "voxels": len(tree.density_values),
        "bricks": len(tree.voxel_index),
        "bytes": (made.out / BakeOutputs.asset).stat().st_size,
    }


def test_an_empty_field_says_so(inputs: dict[str, Path], tmp_path: Path) -> None:
    m = load_renderer(inputs["train"]).model
    m.voxels.values.fill_(-1.0)
    (tmp_path / "train").mkdir()
    save_model(m, 1.0, 5.0, tmp_path / "train" / TrainOutputs.field)
    with pytest.raises(StageFailed, match="empty"):
        run(job(tmp_path, QUICK, poses=inputs["poses"], train=tmp_path / "train"))


def test_a_size_without_room_for_a_voxel_is_refused_early(
    inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(baking, "visible_voxels", lambda *_: pytest.fail("the field was rendered"))
    for number, changes in enumerate([{"resolution": 1024, "max_mib": 2.0}, {"resolution": "auto", "max_mib": 0.02}]):
        with pytest.raises(UsageError, match=rf"bake\.max_mib={changes['max_mib']:g}"):
            run(job(tmp_path / str(number), dataclasses.replace(QUICK, **changes), **inputs))


def test_a_chosen_resolution_is_that_of_the_pixels_or_of_the_budget(inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where there is room the pixels decide, else the room."""
    fitted = dataclasses.replace(QUICK, resolution=0, samples_per_voxel=1, refine_steps=2, weight_threshold=0.0)
    monkeypatch.setattr(resolution, "VOXEL_PIXELS", 0.2)
    sizes = {}
    for room in (10**7, 20_000):
        monkeypatch.setattr(serialisation, "most_voxels", lambda *asked, room=room, **beside: room)
        made = job(tmp_path / str(room), fitted, **inputs)
        run(made)
        report = json.loads((made.out / "report.json").read_text())
        sizes[room] = report["voxels_along_longest_side"], report["optimisation"]["voxels_baked"], report["voxels"]
        assert max(report["resolution"]) >= report["voxels_along_longest_side"] > max(report["resolution"]) - 4
    assert sizes[10**7][0] == resolution.finest_resolution(load(inputs["poses"])).resolution > sizes[20_000][0] >= 32
    assert 10_000 < sizes[20_000][1] <= 2 * 20_000
    assert sizes[20_000][2] <= 20_000 < sizes[10**7][2]


@pytest.mark.parametrize(("layout", "most"), [("compact", 1), ("sparse", 1), ("compact", 64)])
def test_the_asset_keeps_to_its_size_and_to_the_voxels_that_weigh_most(inputs: dict[str, Path], tmp_path: Path, layout: str, most: int) -> None:
    chosen = BakeSettings(resolution=80, samples_per_voxel=1, weight_threshold=0.0, max_mib=most, layout=layout, refine_steps=2, refine_rays_per_batch=512)
    made = job(tmp_path, chosen, **inputs)
    run(made)
    size = (made.out / BakeOutputs.asset).stat().st_size
    assert (2**16 < size <= 2**20) if most == 1 else (size > 2**20)
    assert format.describe(made.out / BakeOutputs.asset)["layout"] == layout


def test_a_field_trained_on_voxel_centres_is_baked_for_nearest_lookup(tmp_path: Path, inputs: dict[str, Path]) -> None:
    scene = inputs["poses"]
    train.run(job(tmp_path / "train", settings(iterations=30, sample_batch_size=4096, occupancy_warmup_steps=10, discretise=20), poses=scene))
    given = {"poses": scene, "train": tmp_path / "train" / "out"}
    near = dataclasses.replace(QUICK, resolution=0, lookup="nearest", layout="sparse", refine_steps=0)
    made = job(tmp_path / "raw", near, **given)
    run(made)
    tree = format.load(made.out / BakeOutputs.asset)
    assert tree.lookup == "nearest"
    assert tree.resolution == (20, 20, 20)  # train.discretise
    m = load_renderer(given["train"]).model
    centre = tree.bounds_min + (voxel_coordinates(tree) + 0.5) * tree.voxel
    with torch.no_grad():
        raw = m.fine(m.space.grid(torch.from_numpy(centre).float()))[:, 0]
    said = activate(raw, m.fine.activation).numpy()
    lit = tree.density_values > 0
    assert lit.any()
    np.testing.assert_allclose(tree.density_values[lit], np.minimum(said[lit], 65000), rtol=2e-3)
    fitted = job(tmp_path / "fitted", dataclasses.replace(near, refine_steps=12), **given)
    run(fitted)
    assert format.load(fitted.out / BakeOutputs.asset).lookup == "nearest"
    facts = json.loads((fitted.out / "report.json").read_text())["optimisation"]
    assert facts["psnr_after"] > facts["psnr_before"] > 10
