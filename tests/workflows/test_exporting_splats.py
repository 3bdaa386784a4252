"""3D Gaussians of a run: those of its stage `splats` are taken, and made again only where something else is wanted."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pipeline.run import Run
from pipeline.stage import settings_dict
from stages.artifacts import BakeOutputs, SplatsOutputs
from stages.formats.exporters import SPLAT_EXPORTERS
from stages.formats.exporters.writing import source_frame
from stages.splats.settings import SplatsSettings
from tests.stages.formats.gaussians import read_spz, scattered
from tests.workflows.assets import write_block
from workflows import exporting_splats
from workflows.cli.resolve import Settings, table_of
from workflows.exporting import Export

METADATA = {"world_from_capture": {"scale": 0.5, "rotation": [[1, 0, 0], [0, 0, 1], [0, -1, 0]], "translation": [0, 0, 0]}, "metric": True}
MADE = SplatsSettings(make="on", count=77)


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run whose stage `splats` is fresh, made with MADE."""
    path = tmp_path / "run"
    Run.create(path, Path("/photographs"), {"splats": settings_dict(MADE)})
    write_block(BakeOutputs.of_run(path).asset, metadata=METADATA)
    SplatsOutputs.of_run(path).folder.mkdir()
    SPLAT_EXPORTERS[".ply"](scattered(), SplatsOutputs.of_run(path).ply, source_frame(METADATA))
    fresh = SimpleNamespace(fresh=True, manifest=SimpleNamespace(request=SimpleNamespace(settings=settings_dict(MADE))))
    monkeypatch.setattr("workflows.exporting.decide", lambda stage, run: fresh)
    monkeypatch.setattr(exporting_splats, "_made", lambda export, wanted, progress: pytest.fail(f"made again, with {wanted}"))
    return path


def export(run: Path, *names: str, chosen: SplatsSettings = MADE, **more: Any) -> list[dict[str, Any]]:
    settings = Settings({"splats": SplatsSettings})
    settings.put_recorded(table_of({"splats": chosen}))
    return exporting_splats.export_splats(Export(run, tuple(run.parent / name for name in names), as_splats=True, **more), settings, lambda *_: None)


def test_what_the_stage_has_made_is_written_as_it_made_it(run: Path) -> None:
    entries = export(run, "a.ply", "a.spz", chosen=replace(MADE, make="off"))
    assert [entry["Gaussians"] for entry in entries] == [50, 50]
    found = (run.parent / "a.ply").read_bytes()
    made = SplatsOutputs.of_run(run).ply.read_bytes()
    assert found[: found.index(b"end_header")] == made[: made.index(b"end_header")]
    start = found.index(b"end_header\n") + 11
    np.testing.assert_allclose(np.frombuffer(found[start:], "<f4"), np.frombuffer(made[start:], "<f4"), atol=1e-4)
    assert read_spz(run.parent / "a.spz")[0].count == 50


@pytest.mark.parametrize(
    ("change", "more"),
    [({"count": 78}, {}), ({"sh_degree": 1}, {}), ({"pictures": "asset"}, {}), ({}, {"region": "foreground"}),
     ({}, {"crop": (-1.0, -1.0, -1.0, 1.0, 1.0, 1.0)})],
)  # fmt: skip
def test_anything_else_is_made_anew(run: Path, change: dict[str, Any], more: dict[str, Any]) -> None:
    with pytest.raises(pytest.fail.Exception, match="made again"):
        export(run, "a.ply", chosen=replace(MADE, **change), **more)
