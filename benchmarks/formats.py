"""Every format of `enerf export --list`, written, read again by programs that are not ours, and compared: benchmarks/results/formats.json.

    python -m benchmarks.formats RUN [--node FOLDER] [--blender-python PATH] [--only .ply:splats,.vdb] [--out FILE.json]

RUN is a finished run. FOLDER has node packages: `npm install @playcanvas/splat-transform three gltf-validator copc`. PATH is an
interpreter with OpenVDB's library, as Blender's module brings it (benchmarks/blender_check.py). What a reader is missing for is said in its row.

A row: the format, its bytes, who read it, and what was compared; `apart` the greatest difference of places over the size of the whole, `colours` and others in
their own unit. `benchmarks.format_readers` has the readers.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import format_readers as readers
from benchmarks.format_readers import Missing
from benchmarks.machine import processor
from efficientnerf.asset.format import load
from efficientnerf.geometry.cameras import Camera
from efficientnerf.splats.gaussians import Gaussians, covariances
from stages.artifacts import BakeOutputs, MeshOutputs, PosesOutputs, SplatsOutputs
from stages.formats.exporters import MESH_EXPORTERS, POINT_EXPORTERS, SPLAT_EXPORTERS, VOLUME_EXPORTERS
from stages.formats.exporters.glb import gltf_from_capture
from stages.formats.exporters.splats.frames import with_y_up
from stages.formats.exporters.writing import SourceFrame, source_frame
from stages.framing.camera_paths import turntable_cameras

ROOT = Path(__file__).resolve().parents[1]
FRAMES, WIDTH, HEIGHT = 3, 320, 240
VIEWS = 5  # of the viewer
FACETS = 100_000  # voxels of a volume that are looked up


@dataclass(frozen=True)
class Case:
    """What is compared.

    run     a finished one
    folder  for the files
    """

    run: Path
    folder: Path
    tools: readers.Tools

    @property
    def tree(self) -> Any:
        return load(BakeOutputs.of_run(self.run).asset)

    @property
    def frame(self) -> SourceFrame:
        return source_frame(self.tree.metadata)

    def export(self, name: str, *options: str) -> Path:
        """A file of `enerf export`."""
        self.enerf("export", str(self.run), "--to", str(self.folder / name), "--force", *options)
        return self.folder / name

    def enerf(self, *arguments: str) -> None:
        done = subprocess.run([sys.executable, "-m", "workflows.cli.main", *arguments, "--quiet"], cwd=ROOT, capture_output=True, text=True, check=False)
        if done.returncode:
            raise SystemExit(f"enerf {' '.join(arguments)}: {done.stderr.strip()}")


Row = dict[str, Any]


def apart(found: np.ndarray, expected: np.ndarray) -> float:
    """The greatest difference of places, over the longest side of what was expected."""
    if found.shape != expected.shape:
        raise SystemExit(f"{len(found)} places, expected {len(expected)}")
    return float(np.abs(found - expected).max() / np.ptp(expected, axis=0).max())


def farthest(found: np.ndarray, expected: np.ndarray) -> float:
    """The same of places in another order or number: the farthest from its neighbour among the others, either way."""
    from scipy.spatial import KDTree

    found, expected = np.asarray(found, np.float64), np.asarray(expected, np.float64)
    off = max(KDTree(expected).query(found)[0].max(), KDTree(found).query(expected)[0].max())
    return float(off / np.ptp(expected, axis=0).max())


def decibels(found: np.ndarray, expected: np.ndarray) -> float:
    """PSNR of pictures from 0 to 1."""
    return float(-10 * np.log10(max(np.mean((found.astype(np.float64) - expected) ** 2), 1e-12)))


# Meshes and points


def mesh_row(case: Case, extension: str) -> Row:
    from stages.mesh.files import read_mesh

    path, expected = case.export(f"mesh{extension}"), read_mesh(MeshOutputs.of_run(case.run))
    found = readers.mesh_by_usd(path) if extension.startswith(".usd") else readers.mesh_by_trimesh(path)
    turn = gltf_from_capture(case.frame.up) if extension in (".glb", ".usdz", ".usdc") else np.eye(3)
    row: Row = {"reader": found.reader, "vertices": len(found.places), "faces": len(found.faces), "apart": farthest(found.places, expected.vertices @ turn.T)}
    row["faces_written"] = len(expected.faces)
    areas = [_area(found.places, found.faces), _area(expected.vertices, expected.faces)]
    row["area"] = areas[0] / areas[1]
    if MESH_EXPORTERS[extension].textures and expected.texture is not None:
        row["texture"] = None if found.texture is None else [*found.texture.shape[:2]]
        row["texture_colours"] = None if found.texture is None else int(np.abs(found.texture[..., :3].astype(int) - expected.texture.colours).max())
    elif MESH_EXPORTERS[extension].coloured and found.colours is not None:
        row["colours"] = float(np.abs(found.colours - expected.colours).max())
    if extension == ".glb":
        row["validator"] = readers.validated(path, case.tools)
    return row


def _area(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def points_row(case: Case, extension: str) -> Row:
    """Against the stage's own points."""
    from stages.artifacts import PointsOutputs

    expected = readers.points_by_trimesh(PointsOutputs.of_run(case.run).ply)
    path = case.export(f"points{extension}", "--points")
    by = {".ply": readers.points_by_trimesh, ".xyz": readers.points_by_numpy}.get(extension)
    found = by(path) if by is not None else readers.points_by_copc(path, case.tools)
    row: Row = {"reader": found.reader, "points": len(found.places), "apart": apart(found.places, expected.places)}
    row["colours"] = float(np.abs(found.colours - expected.colours).max())
    if found.normals is not None and expected.normals is not None:
        row["normals_degrees"] = _degrees(found.normals, expected.normals)
    return row


def _degrees(found: np.ndarray, expected: np.ndarray) -> float:
    sine = np.linalg.norm(np.cross(found, expected), axis=1)
    return float(np.degrees(np.arctan2(sine, (found * expected).sum(axis=1))).max())


# Gaussians


def splats_row(case: Case, extension: str) -> Row:
    from stages.formats.exporters.splats.ply import read_splats

    expected = read_splats(SplatsOutputs.of_run(case.run).ply)
    path = case.export(f"splats{extension}", "--splats")
    if extension != ".ply":
        expected = with_y_up(expected, case.frame)
    found = [readers.splats_by_three(path, case.tools)]
    if extension != ".glb":  # which splat-transform writes alone
        found.append(readers.splats_by_transform(path, case.tools))
    row: Row = {each.reader: {"gaussians": len(each.means), "warnings": each.warnings, **splats_apart(each, expected)} for each in found}
    return row | ({"validator": readers.validated(path, case.tools)} if extension == ".glb" else {})


def splats_apart(found: readers.Splats, expected: Gaussians) -> Row:
    """Of Gaussians in any order: each is compared with the one of the same place."""
    from scipy.spatial import KDTree

    distance, which = KDTree(found.means).query(expected.means)
    wanted = covariances(expected)
    size = np.linalg.norm(wanted, axis=(1, 2))
    row: Row = {
        "apart": float(distance.max() / np.ptp(expected.means, axis=0).max()),
        "covariances_median": float(np.median(np.linalg.norm(found.covariances[which] - wanted, axis=(1, 2)) / size)),
        "opacities": float(np.median(np.abs(found.opacities[which] - expected.opacities))),
        "base_colours": float(np.median(np.abs(found.base[which] - expected.harmonics[:, 0]))),
    }
    if found.harmonics is not None and found.harmonics.shape == expected.harmonics.shape:
        row["harmonics_median"] = float(np.median(np.abs(found.harmonics[which] - expected.harmonics)[:, 1:]))
    return row


# Volumes


def volume_row(case: Case, extension: str) -> Row:
    from stages.formats.exporters.vdb import grids_of
    from stages.framing.restriction import restricted

    path = case.export(f"volume{extension}", "--region", "all")
    grids = grids_of(restricted(case.tree, "all"), case.frame, path)
    rng = np.random.default_rng(0)
    chosen = {grid.name: rng.permutation(len(grid.coordinates))[:FACETS] for grid in grids}
    found = readers.volume_by_openvdb(path, {grid.name: grid.coordinates[chosen[grid.name]] for grid in grids}, case.tools)
    off, places = 0.0, 0.0
    for grid in grids:
        own = chosen[grid.name]
        off = max(off, float(np.abs(found.values[grid.name] - grid.values[own].astype(np.float64)).max()))
        world = grid.coordinates[own] @ grid.matrix[:3, :3].T + grid.matrix[:3, 3]
        places = max(places, apart(found.places[grid.name], world))
    return {
        "reader": found.reader, "grids": [grid.name for grid in grids], "voxels": sum(found.counts.values()),
        "voxels_written": sum(len(grid.coordinates) for grid in grids), "values": off, "apart": places,
    }  # fmt: skip


# The others


def cameras_row(case: Case, extension: str) -> Row:
    from stages.io import scene

    path, expected = case.export(f"cameras{extension}"), scene.load(PosesOutputs.of_run(case.run).folder)
    found = readers.cameras_by_three(path, case.tools)
    off = []
    for view, (place, forward) in zip(expected.views, found.cameras, strict=True):
        pose = view.source_camera.world_from_camera
        off.append(max(np.abs(place - pose[:3, 3]).max(), np.abs(forward - pose[:3, 2]).max()))
    return {"reader": found.reader, "cameras": len(off), "places_and_axes": float(max(off))}


def cameras_of(case: Case) -> list[Camera]:
    return list(turntable_cameras(case.tree, frames=VIEWS, width=WIDTH, height=HEIGHT))


def viewer_row(case: Case, extension: str) -> Row:
    from efficientnerf.asset.rendering import render

    path, tree, cameras = case.export(f"viewer{extension}"), case.tree, cameras_of(case)
    behind = (1.0, 1.0, 1.0) if tree.environment is None else None
    shown = readers.page_in_chromium(path, cameras, behind)
    own = [np.clip(render(tree, camera, background=behind).colour, 0, 1) for camera in cameras]
    quality = [decibels(found / 255, expected) for found, expected in zip(shown.pictures, own, strict=True)]
    return {"reader": shown.reader, "views": VIEWS, "psnr_least": min(quality), "seconds_to_first_picture": shown.seconds, "console": shown.console}


def pictures_row(case: Case, extension: str) -> Row:
    """What `enerf render` writes, against our own renderer's picture, which the reader never saw."""
    from efficientnerf.asset.rendering import render
    from stages.turntable.run import cameras_of as turntable_cameras_of
    from stages.turntable.settings import TurntableSettings

    out, tree, film = case.folder / "frames", case.tree, case.folder / "film.mp4"
    options = {".png": (), ".exr": ("--exr", "all"), ".mp4": ("--video", str(film))}[extension]
    size = ("--frames", str(FRAMES), "--width", str(WIDTH), "--height", str(HEIGHT), "--background", "white", "--region", "all")
    case.enerf("render", str(case.run), "--out", str(out), "--force", *size, *options)
    paths = sorted(out.rglob(f"*{extension}"))
    cameras = turntable_cameras_of(tree, TurntableSettings(frames=FRAMES, width=WIDTH, height=HEIGHT, region="all"))
    white = [np.clip(render(tree, camera, background=(1.0, 1.0, 1.0)).colour, 0, 1) for camera in cameras]
    if extension == ".png":
        found = readers.picture_by_opencv(paths[0])
        return {"reader": found.reader, "pictures": len(paths), "psnr": decibels(found.pixels[..., :3] / 255, white[0])}
    if extension == ".mp4":
        seen = readers.film_by_opencv(film)
        return {"reader": seen.reader, "pictures": len(seen.pictures), "psnr": min(decibels(a / 255, b) for a, b in zip(seen.pictures, white, strict=True))}
    own, linear = render(tree, cameras[0], background=(0.0, 0.0, 0.0)), readers.exr_by_ffmpeg(paths[0])
    pixels = linear.pixels
    straight = pixels[..., :3] / np.maximum(pixels[..., 3:], 1e-6)
    srgb = np.where(straight <= 0.0031308, straight * 12.92, 1.055 * np.maximum(straight, 1e-9) ** (1 / 2.4) - 0.055)
    covered = own.opacity > 0.5
    return {
        "reader": linear.reader, "pictures": len(paths), "opacity": float(np.abs(pixels[..., 3] - own.opacity).max()),
        "psnr_where_covered": decibels(srgb[covered], own.colour[covered] / own.opacity[covered][:, None]) if covered.any() else None,
        "not_by_others": "depth, normals and positions: by OpenEXR's library alone, which writes them",
    }  # fmt: skip


def asset_row(case: Case, extension: str) -> Row:
    path = case.folder / f"asset{extension}"
    case.enerf("convert", str(case.run), str(path), "--layout", "full32", "--force")
    tree, found = case.tree, readers.tensors_by_safetensors(path)
    written, read = (np.sort(each[each > 0].ravel()) for each in (tree.density_values, found.tensors["brick.density"]))
    same = len(written) == len(read) and float(np.abs(read / written - 1).max())
    return {"reader": found.reader, "tensors": {name: list(array.shape) for name, array in found.tensors.items()}, "densities": same}


ROWS: dict[tuple[str, str], Callable[[Case, str], Row]] = {
    **{("mesh", extension): mesh_row for extension in MESH_EXPORTERS},
    **{("points", extension): points_row for extension in POINT_EXPORTERS},
    **{("splats", extension): splats_row for extension in SPLAT_EXPORTERS},
    **{("volume", extension): volume_row for extension in VOLUME_EXPORTERS},
    ("cameras", ".json"): cameras_row, ("viewer", ".html"): viewer_row, ("asset", ".nerftree"): asset_row,
    **{("pictures", extension): pictures_row for extension in (".png", ".exr", ".mp4")},
}  # fmt: skip


def main() -> None:
    from workflows.exporting import formats

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--node", type=Path, help="folder with node_modules")
    parser.add_argument("--blender-python", type=Path)
    parser.add_argument("--only", default="")
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks/results/formats.json")
    given = parser.parse_args()
    chosen, rows = [each for each in given.only.split(",") if each], []
    with tempfile.TemporaryDirectory() as folder:
        case = Case(given.run, Path(folder), readers.Tools(given.node, given.blender_python))
        for each in formats():
            name = f"{each['extension']}:{each['of']}"
            if chosen and name not in chosen and each["extension"] not in chosen:
                continue
            row: Row = {"extension": each["extension"], "of": each["of"]}
            try:
                row |= ROWS[each["of"], each["extension"]](case, each["extension"])
            except Missing as error:
                row["missing"] = str(error)
            written = case.folder / f"{'mesh' if each['of'] == 'mesh' else each['of']}{each['extension']}"
            row |= {"bytes": written.stat().st_size} if written.is_file() else {}
            rows.append(row)
            print(json.dumps(row), flush=True)
    machine = {"processor": processor(), "cores": os.cpu_count(), "load": round(os.getloadavg()[0], 1)}
    facts = {"date": datetime.datetime.now(datetime.UTC).date().isoformat(), "machine": machine, "run": given.run.name, "formats": rows}
    given.out.write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
