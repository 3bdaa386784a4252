"""Programs of others that read what `enerf export` and `enerf render` write, for benchmarks/formats.py: nothing here comes from the writers."""

from __future__ import annotations

import json
import subprocess
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from efficientnerf.geometry.cameras import Camera

SCRIPT = Path(__file__).with_name("format_readers.mjs")
OPENVDB = """
import sys
try:
    import openvdb
except ImportError:
    import bpy, glob, os
    sys.path += glob.glob(os.path.join(bpy.utils.system_resource("SCRIPTS"), "..", "python", "lib", "python*", "site-packages"))
    import openvdb
import numpy
grids, _ = openvdb.readAll(sys.argv[1])
out = {"version": ".".join(map(str, openvdb.LIBRARY_VERSION))}
where = numpy.load(sys.argv[2])
for grid in grids:
    look, places = grid.getConstAccessor(), [tuple(int(c) for c in row) for row in where[grid.name]]
    out["value " + grid.name] = numpy.array([look.getValue(place) for place in places])
    out["place " + grid.name] = numpy.array([grid.transform.indexToWorld(tuple(map(float, place))) for place in places])
    out["count " + grid.name] = grid.activeVoxelCount()
numpy.savez(sys.argv[3], **out)
"""


class Missing(Exception):
    """A reader is not installed; the text says what it takes."""


@dataclass(frozen=True)
class Tools:
    """Where programs are that Python's packages do not have."""

    node: Path | None
    blender_python: Path | None


def _node(tools: Tools, reader: str, path: Path, out: Path) -> str:
    """Let the script's reader write what it finds to a folder; returns its name and version."""
    if tools.node is None:
        raise Missing("node packages (--node)")
    copied = tools.node / SCRIPT.name  # modules are looked for beside the script
    copied.write_bytes(SCRIPT.read_bytes())
    done = subprocess.run(["node", str(copied), reader, str(path), str(out)], cwd=tools.node, capture_output=True, text=True, check=False)
    if done.returncode:
        why = next((line for line in done.stderr.splitlines() if "Error" in line), str(done.returncode))
        raise Missing(f"{reader}: {why}")
    return done.stdout.strip().splitlines()[-1]


def _arrays(folder: Path) -> dict[str, np.ndarray]:
    about = json.loads((folder / "about.json").read_text())
    return {name: np.fromfile(folder / name, entry["type"]).reshape(entry["shape"]) for name, entry in about.items()}


@dataclass(frozen=True, eq=False)
class Surface:
    """places (V, 3), faces (F, 3); colours (V, 3) sRGB from 0 to 1 and texture (H, W, 3 or 4) uint8, where there are any."""

    reader: str
    places: np.ndarray
    faces: np.ndarray
    colours: np.ndarray | None = None
    texture: np.ndarray | None = None


def mesh_by_trimesh(path: Path) -> Surface:
    import trimesh

    found = trimesh.load(path, process=False, maintain_order=True, force="mesh")
    texture = colours = None
    if found.visual.kind == "texture":
        material = found.visual.material
        image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
        texture = None if image is None else np.asarray(image)
    elif found.visual.kind == "vertex":
        colours = found.visual.vertex_colors[:, :3] / 255
    return Surface(f"trimesh {version('trimesh')}", np.asarray(found.vertices), np.asarray(found.faces), colours, texture)


def mesh_by_usd(path: Path) -> Surface:
    try:
        from pxr import Usd, UsdGeom, UsdShade
    except ImportError as error:
        raise Missing("usd-core") from error
    from PIL import Image
    from pxr import Ar

    stage = Usd.Stage.Open(str(path))
    prim = next(each for each in stage.Traverse() if each.IsA(UsdGeom.Mesh))
    shape = UsdGeom.Mesh(prim)
    corners = np.array(shape.GetFaceVertexIndicesAttr().Get())
    texture = None
    for each in stage.Traverse():
        shader = UsdShade.Shader(each)
        if shader and shader.GetIdAttr().Get() == "UsdUVTexture" and texture is None:
            asset = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(shader.GetInput("file").Get().resolvedPath))
            if asset:
                import io

                with Image.open(io.BytesIO(bytes(asset.GetBuffer()))) as image:
                    texture = np.asarray(image)
    return Surface(f"usd-core {version('usd-core')}", np.array(shape.GetPointsAttr().Get()), corners.reshape(-1, 3), None, texture)


@dataclass(frozen=True, eq=False)
class Cloud:
    """places (N, 3), colours (N, 3) sRGB from 0 to 1, normals (N, 3)."""

    reader: str
    places: np.ndarray
    colours: np.ndarray
    normals: np.ndarray | None


def points_by_trimesh(path: Path) -> Cloud:
    import trimesh

    found = trimesh.load(path, process=False)
    rows = found.metadata["_ply_raw"]["vertex"]["data"]
    normals = np.stack([rows[name] for name in ("nx", "ny", "nz")], axis=1)
    return Cloud(f"trimesh {version('trimesh')}", np.asarray(found.vertices), found.colors[:, :3] / 255, normals)


def points_by_numpy(path: Path) -> Cloud:
    rows = np.loadtxt(path)
    return Cloud(f"numpy.loadtxt {version('numpy')}", rows[:, :3], rows[:, 3:6] / 255, rows[:, 6:9])


def points_by_copc(path: Path, tools: Tools) -> Cloud:
    """By copc.js and its laz-perf, which are neither laspy nor lazrs, that wrote the file."""
    with tempfile.TemporaryDirectory() as folder:
        reader = _node(tools, "las", path, Path(folder))
        found = _arrays(Path(folder))
    return Cloud(reader, found["places"], found["colours"] / 65535, found["normals"])


@dataclass(frozen=True, eq=False)
class Splats:
    """means (N, 3), covariances (N, 3, 3), opacities (N,), base (N, 3) the first coefficient of colours, harmonics (N, K, 3) all of them, where read."""

    reader: str
    means: np.ndarray
    covariances: np.ndarray
    opacities: np.ndarray
    base: np.ndarray
    harmonics: np.ndarray | None = None
    warnings: list[str] = field(default_factory=list)


def splats_by_transform(path: Path, tools: Tools) -> Splats:
    """By PlayCanvas' splat-transform, which writes what it has read as a table."""
    if tools.node is None or not (tools.node / "node_modules/.bin/splat-transform").exists():
        raise Missing("npm install @playcanvas/splat-transform (--node)")
    program = str(tools.node / "node_modules/.bin/splat-transform")
    with tempfile.TemporaryDirectory() as folder:
        table = Path(folder) / "a.csv"
        done = subprocess.run([program, str(path), str(table)], capture_output=True, text=True, check=False)
        if done.returncode:
            raise SystemExit(f"splat-transform: {done.stderr.strip()}")
        warnings = [line for line in (done.stdout + done.stderr).splitlines() if "warn" in line.lower()]
        with open(table, encoding="utf-8") as file:
            names = file.readline().strip().split(",")
        rows = np.loadtxt(table, delimiter=",", skiprows=1)
    of = {name: rows[:, k] for k, name in enumerate(names)}
    about = json.loads((tools.node / "node_modules/@playcanvas/splat-transform/package.json").read_text())["version"]
    rotation = np.stack([of[f"rot_{k}"] for k in range(4)], axis=1)
    scales = np.exp(np.stack([of[f"scale_{k}"] for k in range(3)], axis=1))
    base = np.stack([of[f"f_dc_{k}"] for k in range(3)], axis=1)
    rest = np.stack([of[name] for name in sorted((n for n in names if n.startswith("f_rest_")), key=lambda n: int(n[7:]))] or [base[:, 0][:0]], axis=-1)
    harmonics = None
    if len(rest) == len(base):
        harmonics = np.concatenate([base[:, None], rest.reshape(len(base), 3, -1).transpose(0, 2, 1)], axis=1)
    means = np.stack([of[axis] for axis in "xyz"], axis=1)
    return Splats(f"splat-transform {about}", means, _spread(rotation, scales), 1 / (1 + np.exp(-of["opacity"])), base, harmonics, warnings)


def _spread(quaternions: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """Covariances (N, 3, 3) of quaternions w x y z and standard deviations."""
    from scipy.spatial.transform import Rotation

    axes = Rotation.from_quat(quaternions[:, [1, 2, 3, 0]]).as_matrix() * scales[:, None]
    return np.asarray(np.einsum("nij,nkj->nik", axes, axes))


def splats_by_three(path: Path, tools: Tools) -> Splats:
    """By three.js' loaders of PLY, SPZ and KHR_gaussian_splatting, which keep 8 bits of colours and opacities."""
    with tempfile.TemporaryDirectory() as folder:
        reader = _node(tools, "splats", path, Path(folder))
        found = _arrays(Path(folder))
    six = found["covariances"].astype(np.float64)  # xx xy xz yy yz zz
    spread = six[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    base = (found["colours"][:, :3] / 255 - 0.5) / 0.28209479177387814
    return Splats(reader, found["places"], spread, found["colours"][:, 3] / 255, base)


def validated(path: Path, tools: Tools) -> Any:
    """Khronos' validator: numbers of messages by severity, and codes."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            reader = _node(tools, "validate", path, Path(folder))
        except Missing as error:
            return f"missing: {error}"
        return {"reader": reader, **json.loads((Path(folder) / "report.json").read_text())}


@dataclass(frozen=True, eq=False)
class Volume:
    """values and places of the voxels asked for, and the number of all that are active, by grid."""

    reader: str
    values: dict[str, np.ndarray]
    places: dict[str, np.ndarray]
    counts: dict[str, int]


def volume_by_openvdb(path: Path, where: dict[str, np.ndarray], tools: Tools) -> Volume:
    if tools.blender_python is None:
        raise Missing("an interpreter with OpenVDB's library (--blender-python)")
    with tempfile.TemporaryDirectory() as folder:
        asked, out = Path(folder) / "at.npz", Path(folder) / "out.npz"
        np.savez(asked, **where)
        done = subprocess.run([str(tools.blender_python), "-c", OPENVDB, str(path), str(asked), str(out)], capture_output=True, text=True, check=False)
        if not out.is_file():  # Blender's library may end with complaints of its own
            raise Missing(f"OpenVDB: {done.stderr.strip()[-200:]}")
        found = dict(np.load(out))
    parts = [{name: found[f"{kind} {name}"] for name in where} for kind in ("value", "place", "count")]
    return Volume(f"OpenVDB {found['version']}", parts[0], parts[1], {name: int(count) for name, count in parts[2].items()})


@dataclass(frozen=True, eq=False)
class Cameras:
    """Place and viewing direction of each camera."""

    reader: str
    cameras: list[tuple[np.ndarray, np.ndarray]]


def cameras_by_three(path: Path, tools: Tools) -> Cameras:
    """By three.js' camera, whose axes are OpenGL's as nerfstudio's are; no program but nerfstudio reads the file itself."""
    with tempfile.TemporaryDirectory() as folder:
        reader = _node(tools, "cameras", path, Path(folder))
        found = _arrays(Path(folder))
    return Cameras(f"{reader} (its matrices)", list(zip(found["places"], found["forward"], strict=True)))


@dataclass(frozen=True, eq=False)
class Pictures:
    """pictures (H, W, 3) uint8; seconds to the first, and lines of the console."""

    reader: str
    pictures: list[np.ndarray]
    seconds: float = 0.0
    console: list[str] = field(default_factory=list)


def page_in_chromium(path: Path, cameras: Sequence[Camera], behind: tuple[float, float, float] | None) -> Pictures:
    """The viewer's page at some cameras, before a colour or the scene's own surroundings."""
    from tests.stages.viewer import browser

    why = browser.missing()
    if why is not None:
        raise Missing(why)
    with browser.chromium() as chromium:
        begin = time.perf_counter()
        with browser.opened(chromium, path) as page:
            page.ready()
            seconds = time.perf_counter() - begin
            pictures = [page.rendered(camera, background=behind or (0, 0, 0), surroundings=behind is None) for camera in cameras]
            return Pictures(f"Chromium {chromium.version}", pictures, round(seconds, 2), page.console)


@dataclass(frozen=True, eq=False)
class Picture:
    """pixels (H, W, C)."""

    reader: str
    pixels: np.ndarray


def picture_by_opencv(path: Path) -> Picture:
    import cv2

    found = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    return Picture(f"OpenCV {cv2.__version__}", found[..., [2, 1, 0, *range(3, found.shape[2])]])


def film_by_opencv(path: Path) -> Pictures:
    import cv2

    film, frames = cv2.VideoCapture(str(path)), []
    while True:
        there, frame = film.read()
        if not there:
            return Pictures(f"OpenCV {cv2.__version__} (FFmpeg)", frames)
        frames.append(frame[..., ::-1])


def exr_by_ffmpeg(path: Path) -> Picture:
    """By libavcodec's own decoder of EXR."""
    import av

    with av.open(str(path)) as container:
        frame = next(container.decode(video=0))
        planes = [np.frombuffer(plane, np.float32).reshape(plane.height, -1)[:, : frame.width] for plane in frame.planes]
        if frame.format.name not in ("gbrapf32le", "gbrpf32le"):
            raise SystemExit(f"{path}: FFmpeg found {frame.format.name}")
    green, blue, red, *alpha = planes
    return Picture(f"FFmpeg by PyAV {version('av')}", np.stack([red, green, blue, *alpha], axis=-1))


@dataclass(frozen=True, eq=False)
class Tensors:
    """By name."""

    reader: str
    tensors: dict[str, np.ndarray]


def tensors_by_safetensors(path: Path) -> Tensors:
    from safetensors.numpy import load_file

    return Tensors(f"safetensors {version('safetensors')}", load_file(path))
