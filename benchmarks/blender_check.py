"""Exports of a run's mesh in Blender against our own images of it: bounds, orientation, colours.

    python benchmarks/blender_check.py RUN --blender-python PATH [--views 3] [--to glb --to usdz] [--out FILE.json] [--picture FILE.png] [--sides FILE.png]

PATH is an interpreter with Blender as a module: `python3.11 -m venv blender && blender/bin/pip install 'bpy==4.5.*'`, about 1 GB; no dependency of the project.
Each file is written by the project's exporters, imported with Blender's defaults and rendered by Cycles from test cameras (without their distortion); so it is
by `efficientnerf.surface.shading`. Both are laid over grey. `apart`: greatest difference of the bounds, over the size of the mesh. `psnr`: of the views.
`same`: intersection over union of what they show.

--picture shows photographs, ours, and Blender's of each file; --sides the first file in Blender from six sides, below the photographs taken nearest to these.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from efficientnerf.geometry.cameras import Camera, Similarity, opengl_from_pose
from efficientnerf.surface.mesh import Mesh, moved
from efficientnerf.surface.shading import Shader
from stages.artifacts import BakeOutputs, MeshOutputs
from stages.evaluate.views import evaluation_views, evenly_spaced, ground_truth
from stages.formats.exporters import MESH_EXPORTERS
from stages.formats.exporters.glb import gltf_from_capture
from stages.formats.exporters.writing import SourceFrame, source_frame
from stages.framing.camera_paths import pose_on_sphere
from stages.io.pictures import opened, rgb_and_alpha
from stages.io.refined_cameras import load_scene
from stages.mesh.files import read_mesh

GREY = 0.5
BLENDER_FROM_GLTF = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
CHILD = Path(__file__).with_name("blender_render.py")


def pinhole(camera: Camera, width: int) -> Camera:
    """The camera without distortion, its axis in the middle of the image, at another width."""
    height = round(camera.height * width / camera.width)
    focal = camera.intrinsics["fx"] * width / camera.width
    return Camera(camera.name, width, height, "SIMPLE_PINHOLE", (focal, width / 2, height / 2), camera.world_from_camera)


def over_grey(colour: np.ndarray, opacity: np.ndarray) -> np.ndarray:
    return np.asarray(colour + (1 - opacity[..., None]) * GREY)


def in_blender(python: Path, path: Path, cameras: list[Camera], turn: np.ndarray, folder: Path, samples: int) -> tuple[dict[str, Any], list[np.ndarray]]:
    """What Blender says of a file, and its images (H, W, 4) uint8 from cameras of the capture's frame, which `turn` takes to Blender's."""
    views = []
    for n, camera in enumerate(cameras):
        pose = opengl_from_pose(Similarity(1.0, turn, np.zeros(3)).pose(camera.world_from_camera)).tolist()
        out = folder / f"{path.suffix[1:]}_{n}.png"
        views.append({"out": str(out), "width": camera.width, "height": camera.height, "focal": camera.intrinsics["fx"], "pose": pose})
    wanted, report = folder / "wanted.json", folder / "report.json"
    wanted.write_text(json.dumps({"mesh": str(path), "views": views, "samples": samples, "report": str(report)}))
    done = subprocess.run([str(python), str(CHILD), str(wanted)], capture_output=True, text=True, check=False)
    if done.returncode != 0 or not report.is_file():
        raise SystemExit(f"Blender failed on {path.name}:\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}")
    return json.loads(report.read_text()), [_rgba(Path(view["out"])) for view in views]


def _rgba(path: Path) -> np.ndarray:
    """(H, W, 4) uint8 with straight alpha."""
    with opened(path, ("PNG",)) as image:
        rgb, alpha = rgb_and_alpha(image)
    return np.dstack([rgb, np.full(rgb.shape[:2], 255, np.uint8) if alpha is None else alpha])


def compared(own: tuple[np.ndarray, np.ndarray], other: np.ndarray) -> tuple[float, float]:
    """PSNR of two images over grey, and intersection over union of what they show."""
    straight = other.astype(np.float64) / 255
    theirs = over_grey(straight[..., :3] * straight[..., 3:], straight[..., 3])
    error = ((over_grey(*own) - theirs) ** 2).mean()
    a, b = own[1] > 0.5, straight[..., 3] > 0.5
    return float(-10 * np.log10(max(error, 1e-10))), float((a & b).sum() / max((a | b).sum(), 1))


def bounds_in_blender(mesh: Mesh, turn: np.ndarray) -> np.ndarray:
    at = mesh.vertices @ turn.T
    return np.stack([at.min(0), at.max(0)])


def six_sides(mesh: Mesh, size: int) -> list[Camera]:
    """Cameras round the training frame's mesh: four sides, from above and from below."""
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    centre, reach = (low + high) / 2, float(np.linalg.norm(high - low))
    angles = [(0.0, 15.0), (90.0, 15.0), (180.0, 15.0), (270.0, 15.0), (45.0, 70.0), (225.0, -35.0)]
    return [Camera(f"side {n}", size, size, "SIMPLE_PINHOLE", (2.2 * size, size / 2, size / 2), pose_on_sphere(tuple(centre), 2.4 * reach, *angle))
            for n, angle in enumerate(angles)]  # fmt: skip


def shown(image: np.ndarray) -> np.ndarray:
    """(H, W, 4) or (H, W, 3) uint8, over grey."""
    if image.shape[2] == 3:
        return image
    values = image / 255.0
    return np.asarray(np.round(255 * over_grey(values[..., :3] * values[..., 3:], values[..., 3]))).astype(np.uint8)


def photograph(run: Path, view: Any, background: Any, size: tuple[int, int]) -> np.ndarray:
    pixels = np.round(255 * ground_truth(run / "poses", view, background).colour).astype(np.uint8)
    image = Image.fromarray(pixels)
    image.thumbnail(size)
    out = np.full((size[1], size[0], 3), 128, np.uint8)
    out[: image.height, : image.width] = np.asarray(image)
    return out


def sides_picture(run: Path, mesh: Mesh, scene: Any, python: Path, path: Path, frame: SourceFrame, turn: np.ndarray, folder: Path, samples: int) -> np.ndarray:
    """`mesh` is of the training frame, the file at `path` of the capture's."""
    cameras = six_sides(mesh, 320)
    _, images = in_blender(python, path, [frame.world_from_capture.inverse().camera(each) for each in cameras], turn, folder, samples)
    nearest = []
    for camera in cameras[:4]:
        along = [float(view.camera.forward @ camera.forward) for view in scene.views]
        nearest.append(photograph(run, scene.views[int(np.argmax(along))], scene.background, (320, 320)))
    nearest += [np.full((320, 320, 3), 128, np.uint8)] * (len(cameras) - len(nearest))
    return np.concatenate([np.concatenate(nearest, 1), np.concatenate([shown(image) for image in images], 1)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--blender-python", type=Path, required=True)
    parser.add_argument("--to", action="append", choices=["glb", "usdz", "obj"], help="default: glb and usdz")
    parser.add_argument("--views", type=int, default=3)
    parser.add_argument("--width", type=int, default=480)
    parser.add_argument("--samples", type=int, default=16)
    for name in ("--out", "--picture", "--sides"):
        parser.add_argument(name, type=Path)
    given = parser.parse_args()
    scene = load_scene(given.run / "poses", given.run / "train")
    tree_facts = asset_facts(given.run)
    frame = source_frame(tree_facts)
    mesh = read_mesh(MeshOutputs.of_run(given.run))
    turn = BLENDER_FROM_GLTF @ gltf_from_capture(frame.up)
    views = evaluation_views(scene)[0]
    chosen = [views[k] for k in evenly_spaced(len(views), given.views)]
    back = frame.world_from_capture.inverse()
    cameras = [back.camera(pinhole(view.camera, given.width)) for view in chosen]
    ours = [Shader(mesh).images(camera, samples=4)[0] for camera in cameras]
    columns = [[photograph(given.run, view, scene.background, (camera.width, camera.height)) for view, camera in zip(chosen, cameras, strict=True)],
               [np.round(255 * over_grey(each.colour, each.covered)).astype(np.uint8) for each in ours]]  # fmt: skip
    result: dict[str, Any] = {"run": given.run.name, "faces": len(mesh.faces), "views": [view.name for view in chosen], "width": given.width, "files": {}}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        kinds = given.to or ["glb", "usdz"]
        for kind in kinds:
            path = folder / f"mesh.{kind}"
            MESH_EXPORTERS[path.suffix](mesh, path, frame)
            own_turn = np.eye(3) if kind == "obj" else turn  # our OBJ is in the capture's frame, and imported as it is
            report, images = in_blender(given.blender_python, path, cameras, own_turn, folder, given.samples)
            expected = bounds_in_blender(mesh, own_turn)
            apart = float(np.abs(np.array(report["bounds"]) - expected).max() / np.ptp(expected, 0).max())
            figures = [compared((each.colour, each.covered), image) for each, image in zip(ours, images, strict=True)]
            result["files"][kind] = {
                "bytes": path.stat().st_size, "apart": float(f"{apart:.3g}"),
                "psnr": [round(a, 2) for a, _ in figures], "same": [round(b, 4) for _, b in figures],
                **{key: report[key] for key in ("faces", "nodes", "images", "blender")},
            }  # fmt: skip
            columns.append([shown(image) for image in images])
        if given.sides:
            world = frame.world_from_capture
            trained = moved(replace(mesh), world.scale, world.rotation, world.translation)
            picture = sides_picture(given.run, trained, scene, given.blender_python, folder / f"mesh.{kinds[0]}", frame, turn, folder, given.samples)
            Image.fromarray(picture).save(given.sides)
    print(json.dumps(result, indent=1))
    if given.out:
        given.out.write_text(json.dumps(result, indent=1) + "\n")
    if given.picture:
        Image.fromarray(np.concatenate([np.concatenate(column) for column in columns], 1)).save(given.picture)


def asset_facts(run: Path) -> dict[str, Any]:
    from efficientnerf.asset.format import describe

    return describe(BakeOutputs.of_run(run).asset)


if __name__ == "__main__":
    main()
