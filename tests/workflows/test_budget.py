"""--budget is shared by the stages that train, and --target-mib is the asset's size."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from efficientnerf.backends import kernel_cache
from pipeline.executors.memory import parse_size
from workflows.asset import WORKFLOW
from workflows.budget import FEW_PIXELS_TRAIN_SHARE, MIN_BAKE, MIN_TRAIN, TRAIN_SHARE, share_budget
from workflows.cli.request import Options, plan_run
from workflows.fleet.program import WorkflowProgram


@pytest.fixture
def source(tmp_path: Path) -> Path:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.png").write_bytes(b"")
    return tmp_path / "photos"


@pytest.mark.parametrize("splats", [True, False])
@pytest.mark.parametrize("share", [FEW_PIXELS_TRAIN_SHARE, TRAIN_SHARE])
def test_the_parts_make_up_the_budget(share: float, splats: bool) -> None:
    former = {"train": 0.0, "bake": 0.0} | ({"splats": 0.0} if splats else {})
    for seconds in (0.5, 10.0, MIN_TRAIN + MIN_BAKE, 36.0, 60.0, 240.0, 600.0, 1e5):
        parts = share_budget(seconds, share, splats=splats)
        assert parts.keys() == former.keys()
        assert sum(parts.values()) == pytest.approx(seconds)
        assert all(parts[stage] >= former[stage] > -1 for stage in former), "a longer budget shortens no part"
        both = parts["train"] + parts["bake"]
        if both >= MIN_TRAIN + MIN_BAKE:
            assert parts["train"] >= MIN_TRAIN - 1e-9
            assert parts["bake"] >= MIN_BAKE - 1e-9
        if splats:
            assert parts["splats"] == pytest.approx({1e5: 600.0}.get(seconds, seconds * {240.0: 0.175, 600.0: 0.25}.get(seconds, 0.15)))
        if seconds >= 240:
            assert parts["train"] == pytest.approx(share * both)
        former = parts


def test_runs_that_make_no_gaussians_keep_no_time_for_them(source: Path, tmp_path: Path) -> None:
    def budgets(**options: object) -> dict[str, object]:
        settings = plan_run(tmp_path / "run", WORKFLOW, Options(source=source, preset="preview", budget="10m", **options)).run.settings  # type: ignore[arg-type]
        return {stage: settings[stage]["time_budget"] for stage in ("train", "bake", "splats")}

    assert sum(budgets().values()) == pytest.approx(600)  # type: ignore[arg-type]
    assert budgets(until="splats") == budgets()
    for options in ({"until": "bake"}, {"sets": ("splats.make=off",)}):
        found = budgets(**options)
        assert found["splats"] == "off"
        assert found["train"] + found["bake"] == pytest.approx(600)  # type: ignore[operator]


def test_the_share_follows_the_pixels_of_the_source(source: Path, tmp_path: Path) -> None:
    """Objects and forward-facing captures have one share. A source that is no data set is refused where it is read, not here."""
    posed = tmp_path / "posed"
    (posed / "train").mkdir(parents=True)
    frame = {"file_path": "./train/r_0", "transform_matrix": np.eye(4).tolist()}
    (posed / "transforms_train.json").write_text(json.dumps({"camera_angle_x": 1.0, "frames": [frame]}), encoding="utf-8")
    (tmp_path / "empty" / "nothing").mkdir(parents=True)
    clips = tmp_path / "clips"
    clips.mkdir()
    (clips / "a.mp4").write_bytes(b"")
    many = _photographs(tmp_path / "many" / "images", 20, (4000, 2000))

    def share(folder: Path, *sets: str, **more: object) -> float:
        planned = plan_run(tmp_path / "run", WORKFLOW, Options(source=folder, preset="tiny", budget="10m", sets=sets, until="bake", **more))  # type: ignore[arg-type]
        return float(planned.run.settings["train"]["time_budget"]) / 600

    assert share(source) == share(tmp_path / "empty") == FEW_PIXELS_TRAIN_SHARE
    assert share(posed) == share(source, format="llff") == share(many, format="llff") == TRAIN_SHARE
    assert share(clips) == share(clips / "a.mp4") == TRAIN_SHARE
    few, enough = (share(many.parent, f"poses.max_image_size={longest}") for longest in (1260, 1270))  # 20 photographs of 2 : 1
    assert (few, enough) == (FEW_PIXELS_TRAIN_SHARE, TRAIN_SHARE)
    assert share(many, "poses.max_image_size=9000") == TRAIN_SHARE, "photographs are not enlarged"
    assert share(many, also=(_photographs(tmp_path / "more", 5, (4000, 2000)),)) == FEW_PIXELS_TRAIN_SHARE
    assert share(many, "poses.max_image_size=1200", also=(tmp_path / "more",)) == TRAIN_SHARE, "those of all sources count"


def _photographs(folder: Path, number: int, size: tuple[int, int]) -> Path:
    folder.mkdir(parents=True)
    for index in range(number):
        Image.new("L", size).save(folder / f"{index:02}.png")
    return folder


@pytest.mark.parametrize(("memory", "compiled", "expected"), [("700m", False, 1), ("700m", True, 0), ("150m", False, 2), ("150m", True, 1), ("2g", False, 0)])
def test_what_a_run_takes_whatever_its_limit_is_said_as_it_begins(
    memory: str, compiled: bool, expected: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Compiling kernels, and writing pages."""
    source = tmp_path / "source"
    source.mkdir()
    (source / "a.jpg").write_bytes(b"x")
    adam = f"{kernel_cache.KERNELS}.adam"
    cache = tmp_path / "cache" / "kernels" / kernel_cache.key() / adam / kernel_cache.SOURCES.key([adam])
    cache.mkdir(parents=True)
    for number in range(kernel_cache.USUAL if compiled else 3):
        (cache / f"{number}.nbi").touch()
    (cache.parent / "0123456789abcdef").mkdir()
    for number in range(kernel_cache.USUAL):  # of other sources
        (cache.parent / "0123456789abcdef" / f"{number}.nbi").touch()
    monkeypatch.setenv("ENERF_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr("pipeline.executors.memory.usable_memory", lambda *_: None)
    assert len(plan_run(tmp_path / "run", WORKFLOW, Options(source=source, preset="tiny", memory=memory)).warnings) == expected
    scene = {"sources": [str(source)], "settings": {}, "preset": "tiny", "seed": None}
    warnings = WorkflowProgram(WORKFLOW).prepare(tmp_path / "fleet" / "run", scene, parse_size(memory))
    assert len([text for text in warnings if "its share of the worker's memory" in text]) == expected, "a fleet's scene, too"
