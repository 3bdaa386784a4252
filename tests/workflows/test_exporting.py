"""Exports of a run: what its stage `mesh` has made is taken, and made again only where something else is wanted."""

from __future__ import annotations

import base64
import re
import zlib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from efficientnerf.asset import format
from efficientnerf.asset.tree import tree_from_voxels
from efficientnerf.surface.mesh import Texture
from pipeline.errors import CorruptArtifact, UsageError
from pipeline.run import Run
from pipeline.stage import settings_dict
from stages.artifacts import BakeOutputs, MeshOutputs
from stages.formats.exporters import MESH_EXPORTERS
from stages.formats.exporters.writing import source_frame
from stages.mesh.settings import MeshSettings
from stages.points.settings import PointsSettings
from tests.stages.io.meshes import block
from workflows import exporting
from workflows.cli.resolve import Settings, table_of
from workflows.exporting import Export

METADATA = {"world_from_capture": {"scale": 0.5, "rotation": [[1, 0, 0], [0, 0, 1], [0, -1, 0]], "translation": [0, 0, 0]}, "metric": True}
MADE = MeshSettings(max_faces=500, texture_size=256)


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run whose stage `mesh` is fresh, made with MADE: a block with a texture."""
    path = tmp_path / "run"
    Run.create(path, Path("/photographs"), {"mesh": settings_dict(MADE)})
    for outputs in (BakeOutputs.of_run(path), MeshOutputs.of_run(path)):
        outputs.folder.mkdir()
    index = np.argwhere(np.ones((4, 4, 4), bool))
    tree = tree_from_voxels((1, 1, 1), 0.5, np.full(3, -1.0), index, np.full(64, 50.0), np.zeros((64, 1, 3), np.float32), brick=4, metadata=METADATA)
    format.save(tree, BakeOutputs.of_run(path).asset)
    rng = np.random.default_rng(0)
    mesh = replace(block(), texture=Texture(rng.random((12, 3, 2)), rng.integers(0, 256, (16, 16, 3), dtype=np.uint8)))
    outputs = MeshOutputs.of_run(path)
    for file in (outputs.ply, outputs.glb, outputs.obj):
        MESH_EXPORTERS[file.suffix](mesh, file, source_frame(METADATA))
    fresh = SimpleNamespace(fresh=True, manifest=SimpleNamespace(request=SimpleNamespace(settings=settings_dict(MADE))))
    monkeypatch.setattr("workflows.exporting.decide", lambda stage, run: fresh)
    monkeypatch.setattr(exporting, "_meshed", lambda export, tree, border, frame, wanted, progress: pytest.fail(f"made again, with {wanted}"))
    return path


def settings(**mesh: Any) -> Settings:
    found = Settings({"mesh": MeshSettings, "points": PointsSettings})
    found.put_recorded(table_of({"mesh": replace(MADE, **mesh)}))
    return found


def export(run: Path, *names: str, chosen: Settings | None = None, **more: Any) -> list[dict[str, Any]]:
    asked = Export(run, tuple(run.parent / name for name in names), **more)
    exporting.check(asked)
    return exporting.export_surface(asked, chosen or settings(), lambda *_: None)


def test_what_the_stage_has_made_is_written_as_it_made_it(run: Path) -> None:
    made = export(run, "mesh.glb", "mesh.obj", "mesh.ply")
    assert [entry["faces"] for entry in made] == [12, 12, 12]
    outputs = MeshOutputs.of_run(run)
    for path in (outputs.glb, outputs.ply, outputs.texture, outputs.material):
        assert (run.parent / path.name).read_bytes() == path.read_bytes(), path.name


@pytest.mark.parametrize(
    ("change", "more"),
    [({"max_faces": 400}, {}), ({"texture_size": 512}, {}), ({}, {"texture": "asset"}), ({}, {"region": "all"}), ({"smoothing_iterations": 3}, {}),
     ({"normal_map": True}, {}), ({}, {"normal_map": True}), ({}, {"crop": (-1.0, -1.0, -1.0, 1.0, 1.0, 1.0)}), ({}, {})],
)  # fmt: skip
def test_anything_else_is_made_anew(run: Path, change: dict[str, Any], more: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    if not change and not more:  # what the stage has made is stale
        monkeypatch.setattr("workflows.exporting.decide", lambda stage, run: SimpleNamespace(fresh=False, manifest=None))
    with pytest.raises(pytest.fail.Exception, match="made again"):
        export(run, "mesh.glb", chosen=settings(**change), **more)


def test_a_page_for_browsers_holds_the_asset_or_what_is_asked_for_of_it(run: Path, tmp_path: Path) -> None:
    def carried(path: Path) -> format.NerfTree:
        parts = re.findall(r"data-part>([A-Za-z0-9+/=]*)<", path.read_text(encoding="utf-8"))
        path.with_suffix(".nerftree").write_bytes(zlib.decompress(b"".join(base64.b64decode(part) for part in parts), -15))
        return format.load(path.with_suffix(".nerftree"))

    (entry,) = exporting.export_viewers(Export(run, (tmp_path / "a.html",)))
    assert entry == {"path": str(tmp_path / "a.html"), "bytes": (tmp_path / "a.html").stat().st_size}
    assert len(carried(tmp_path / "a.html").density_values) == 64
    exporting.export_viewers(Export(BakeOutputs.of_run(run).asset, (tmp_path / "b.html",), crop=(-2.1, -2.1, -2.1, -0.1, 2.1, 2.1)))
    assert len(carried(tmp_path / "b.html").density_values) == 32
    exporting.check(Export(run, (tmp_path / "c.html",)))
    with pytest.raises(UsageError, match="exists"):
        exporting.check(Export(run, (tmp_path / "a.html",)))
    BakeOutputs.of_run(run).asset.write_bytes(b"no asset")
    with pytest.raises(CorruptArtifact, match="NerfTree"):
        exporting.export_viewers(Export(run, (tmp_path / "c.html",)))
    assert not (tmp_path / "c.html").exists()
