"""Baking in normalised device coordinates: voxels deeper than wide, and a budget that follows the pixels."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from efficientnerf.asset import format
from efficientnerf.asset.rendering import render
from efficientnerf.asset.tree import NerfTree
from efficientnerf.geometry.spaces import NdcSpace
from stages.artifacts import BakeOutputs
from stages.bake import run as bake
from stages.bake.pruning import RAYS_PER_VOXEL
from stages.bake.settings import BakeSettings
from stages.io.field_file import load_renderer
from stages.io.scene import load
from stages.train import run as train
from tests.efficientnerf.balls import settings
from tests.stages.balls import job
from tests.stages.forward_facing import painted_wall

QUICK: dict[str, Any] = {"resolution": 64, "visibility_rays": 4000, "weight_threshold": 0.0, "max_mib": 8, "samples_per_voxel": 4, "refine_steps": 0}


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A painted wall before nine cameras, and a network that has seen a little of it."""
    folder = tmp_path_factory.mktemp("ndc")
    painted_wall(folder / "poses")
    train.run(job(folder / "train", settings(iterations=80, sample_batch_size=4096, occupancy_warmup_steps=10), poses=folder / "poses"))
    return {"poses": folder / "poses", "train": folder / "train" / "out"}


def baked(folder: Path, inputs: dict[str, Path], told: list[dict[str, Any]] | None = None, **changes: Any) -> NerfTree:
    made = job(folder, BakeSettings(**{**QUICK, **changes}), events=told, **inputs)
    bake.run(made)
    return format.load(made.out / BakeOutputs.asset)


def test_deep_voxels_show_what_cubes_do(inputs: dict[str, Path], tmp_path: Path) -> None:
    cubes, deep = baked(tmp_path / "cubes", inputs, ndc_voxel_depth=1.0), baked(tmp_path / "deep", inputs)
    space = load_renderer(inputs["train"], "cpu").model.space
    assert cubes.ndc.to_json() == space.ndc.to_json()
    assert deep.ndc.slopes == pytest.approx(tuple(NdcSpace.voxel_depth * slope for slope in space.ndc.slopes))
    # As many voxels across, half as many in depth.
    assert deep.resolution[:2] == cubes.resolution[:2]
    assert deep.resolution[2] == pytest.approx(cubes.resolution[2] / NdcSpace.voxel_depth, abs=4)
    view = load(inputs["poses"]).views[0]
    one, other = (render(tree, view.camera, background=(0.5, 0.5, 0.5)) for tree in (cubes, deep))
    assert one.colour.std() > 0.1
    assert np.abs(one.colour - other.colour).mean() < 0.01
    hit = np.isfinite(one.depth) & np.isfinite(other.depth)
    assert hit.mean() > 0.9
    assert np.median(np.abs(other.depth[hit] / one.depth[hit] - 1)) < 0.05


def test_the_fit_takes_deep_voxels_to_the_photographs(inputs: dict[str, Path], tmp_path: Path) -> None:
    import json

    told: list[dict[str, Any]] = []
    baked(tmp_path, inputs, told, refine_steps=20, refine_rays_per_batch=2048, visibility_rays=1000)
    fitted = json.loads((tmp_path / "out" / "report.json").read_text())["optimisation"]
    assert fitted["psnr_after"] > fitted["psnr_before"] + 0.5
    looked = {event["total"] for event in told if event.get("text") == "rendering for voxel weights"}
    assert looked == {min(int(RAYS_PER_VOXEL["ndc"] * fitted["voxels_baked"]), 4 * 8 * 32 * 24)}
    assert max(looked) > 1000
    assert not [event for event in told if event["event"] == "warning"]
