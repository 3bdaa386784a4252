"""Exports of a run: what its stage `mesh` has made is taken, and made again only where something else is wanted."""

import base64
import os
import re
import zlib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from efficientnerf.asset import format
from efficientnerf.geometry.cameras import Similarity
from efficientnerf.surface.mesh import Texture
from pipeline.errors import CorruptArtifact, UsageError
from pipeline.run import Run
from pipeline.stage import Job, settings_dict
from stages.artifacts import BakeOutputs, MeshOutputs, PointsOutputs, PosesOutputs
from stages.formats.exporters import MESH_EXPORTERS
from stages.formats.exporters.ply import VERTEX
from stages.formats.exporters.writing import source_frame
from stages.framing.true_frame import AS_CAPTURED, Ground, TrueFrame, save_frame
from stages.mesh.files import read_vertices
from stages.mesh.settings import MeshSettings
from stages.points import run as points
from stages.points.settings import PointsSettings
from tests.stages.io.meshes import accessor, block, glb_document
from tests.workflows.assets import write_block
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
    write_block(BakeOutputs.of_run(path).asset, metadata=METADATA)
    rng = np.random.default_rng(0)
    mesh = replace(block(), texture=Texture(rng.random((12, 3, 2)), rng.integers(0, 256, (16, 16, 3), dtype=np.uint8)))
    outputs = MeshOutputs.of_run(path)
    outputs.folder.mkdir()
    for file in (outputs.ply, outputs.glb, outputs.obj):
        MESH_EXPORTERS[file.suffix](mesh, file, source_frame(METADATA))
    fresh = SimpleNamespace(fresh=True, manifest=SimpleNamespace(request=SimpleNamespace(settings=settings_dict(MADE))))
    monkeypatch.setattr("workflows.exporting.decide", lambda stage, run: fresh)
    monkeypatch.setattr(exporting, "_meshed", lambda export, tree, border, frame, wanted, progress: pytest.fail(f"made again, with {wanted}"))
    return path


def make_cameras(run: Path) -> None:
    PosesOutputs.of_run(run).folder.mkdir()
    PosesOutputs.of_run(run).scene.write_text("{}", encoding="utf-8")


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


def test_what_the_stage_has_made_is_written_in_the_frame_that_was_found_since(run: Path) -> None:
    make_cameras(run)
    save_frame(TrueFrame(Similarity(3.0, np.eye(3), np.zeros(3)), 0.01, ()), run)
    export(run, "mesh.obj", "mesh.ply", "mesh.glb")
    before, after = (read_vertices(SimpleNamespace(ply=path))[0] for path in (MeshOutputs.of_run(run).ply, run.parent / "mesh.ply"))  # type: ignore[arg-type]
    np.testing.assert_allclose(after, 3 * before, rtol=1e-6)
    assert b"unit metre" in (run.parent / "mesh.obj").read_bytes()[:200]


def test_what_the_stage_has_made_is_written_upright_where_up_was_set(run: Path) -> None:
    make_cameras(run)
    up = np.array([0.48, -0.6, -0.64])
    save_frame(AS_CAPTURED.with_ground(Ground(tuple(up.tolist()), 0.5, [])), run)
    export(run, "mesh.ply", "mesh.glb")
    before, after = (read_vertices(SimpleNamespace(ply=path))[0] for path in (MeshOutputs.of_run(run).ply, run.parent / "mesh.ply"))  # type: ignore[arg-type]
    np.testing.assert_allclose(after[:, 2], before @ up - 0.5, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(after - after[0], axis=1), np.linalg.norm(before - before[0], axis=1), rtol=1e-5)
    assert b"up 0 0 1; unit metre" in (run.parent / "mesh.ply").read_bytes()[:200]
    document, blob = glb_document(run.parent / "mesh.glb")
    heights = accessor(document, blob, document["meshes"][0]["primitives"][0]["attributes"]["POSITION"])[:, 1]
    np.testing.assert_allclose([heights.min(), heights.max()], [after[:, 2].min(), after[:, 2].max()], atol=1e-5)
    assert document["nodes"][0]["extras"]["source_frame"]["capture_up"] == [0, 0, 1]


def test_a_texture_may_be_left_out_of_it(run: Path) -> None:
    (entry,) = export(run, "mesh.glb", texture="off")
    assert "texels a side" not in entry
    assert b"COLOR_0" in (run.parent / "mesh.glb").read_bytes()
    (shape,) = export(run, "mesh.stl", chosen=settings(texture="asset", texture_size=512))
    assert shape["faces"] == 12, "a texture that no file shows is not asked for"


def test_points_are_those_of_the_stage_on_its_mesh(run: Path, tmp_path: Path) -> None:
    """In its frame, or in the one that was found since; settings of the mesh count."""
    inputs = {"bake": BakeOutputs.of_run(run).folder, "mesh": MeshOutputs.of_run(run).folder}
    points.run(Job(settings=PointsSettings(), inputs=inputs, out=tmp_path / "points", work=tmp_path / "work"))
    stage = PointsOutputs(tmp_path / "points").ply.read_bytes()
    assert export(run, "a.ply", "a.xyz", as_points=True)[0]["points"] == PointsSettings.num_points
    assert (run.parent / "a.ply").read_bytes() == stage
    with pytest.raises(pytest.fail.Exception, match=r"made again, with .*max_faces=200000"):
        export(run, "b.ply", as_points=True, chosen=settings(max_faces=400))
    make_cameras(run)
    save_frame(TrueFrame(Similarity(3.0, np.eye(3), np.zeros(3)), 0.01, ()), run)
    export(run, "c.ply", as_points=True)
    before, after = (np.frombuffer(data.split(b"end_header\n", 1)[1], VERTEX) for data in (stage, (run.parent / "c.ply").read_bytes()))
    for name in "xyz":
        np.testing.assert_allclose(after[name], 3 * before[name], rtol=1e-5)


@pytest.mark.parametrize(
    ("change", "more"),
    [({"max_faces": 400}, {}), ({"texture_size": 512}, {}), ({}, {"texture": "asset"}), ({}, {"region": "all"}), ({"smoothing_iterations": 3}, {}),
     ({}, {"crop": (-1.0, -1.0, -1.0, 1.0, 1.0, 1.0)}), ({}, {})],
)  # fmt: skip
def test_anything_else_is_made_anew(run: Path, change: dict[str, Any], more: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    if not change and not more:  # what the stage has made is stale
        monkeypatch.setattr("workflows.exporting.decide", lambda stage, run: SimpleNamespace(fresh=False, manifest=None))
    with pytest.raises(pytest.fail.Exception, match="made again"):
        export(run, "mesh.glb", chosen=settings(**change), **more)


def test_a_format_whose_package_is_missing_is_refused_before_any_is_written(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stages.formats.exporters.find_spec", lambda name: None)
    with pytest.raises(UsageError, match=r"pip install 'efficientnerf\[usd\]'"):
        export(run, "b.glb", "b.usdz")
    assert not (run.parent / "b.glb").exists()


def test_colours_of_vertices_are_asked_of_photographs_where_there_are_any(run: Path) -> None:
    """A texture is made for a PLY, too: of a run that has photographs."""
    other = settings(texture="photographs")
    (without,) = export(run, "a.ply", chosen=other)
    assert without["faces"] == 12
    make_cameras(run)
    with pytest.raises(pytest.fail.Exception, match=r"made again, with .*texture='photographs'"):
        export(run, "b.ply", chosen=other)
    with pytest.raises(UsageError, match="keeps a texture"):
        export(run, "b.stl", texture="photographs")
    with pytest.raises(UsageError, match="keeps a texture"):
        export(run, "b.ply", picture="jpeg")


@pytest.mark.parametrize("failing", [0, 1, 2])
def test_a_full_disk_leaves_no_part_of_an_obj(run: Path, monkeypatch: pytest.MonkeyPatch, failing: int) -> None:
    calls, real = iter(range(100)), os.fsync

    def full(descriptor: int) -> None:
        if next(calls) == failing:
            raise OSError(28, "No space left on device")
        real(descriptor)

    monkeypatch.setattr(os, "fsync", full)
    before = sorted(run.parent.iterdir())
    with pytest.raises(Exception, match=r"mesh\.obj"):
        export(run, "mesh.obj")
    assert sorted(run.parent.iterdir()) == before


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
