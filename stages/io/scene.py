"""The scene: what the poses stage writes and every later stage reads.

    scene.json           cameras, splits, bounds, the similarity to the capture's frame, the orbit (this module)
    images/, masks/      at working size, 8 bits, sRGB; masks are 0 or 255, 255 = use
    points.safetensors   sparse points in the training frame, where there are any

Format 2 adds the space of the field and the forward-facing scene; format 1 is read, too.

Training frame: right-handed, z up, origin at the centre of the box, the largest half extent of the box 1.
"""

import contextlib
import itertools
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import to_builtins
from safetensors import SafetensorError
from safetensors.numpy import load_file
from safetensors.numpy import save as tensor_bytes

from efficientnerf.capture.forward_facing import SPACES, ForwardFacing
from efficientnerf.geometry.cameras import Camera, Similarity
from efficientnerf.geometry.ndc import Ndc
from efficientnerf.geometry.orbit import Orbit
from pipeline.errors import BadInput, CorruptArtifact
from pipeline.files import is_safe_name, write_json
from pipeline.text import printable
from stages.artifacts import PosesOutputs
from stages.io.capture import SparsePoints
from stages.io.pictures import UnreadableImage, grey_of, opened, read_header, rgb_and_alpha
from stages.io.scene_schema import CameraDocument, SceneDocument, ViewDocument, decoded, json_of_run
from stages.reports import poses_report

FORMAT = 2
SPLITS = ("train", "val", "test")
REMEDY = "Run the poses stage again."
WORKING_FORMATS = ("PNG", "JPEG")  # of images/; masks/ hold PNG


@dataclass(frozen=True, eq=False)
class View:
    """One image of the scene."""

    # image, mask: paths relative to the folder of the scene; mask: 0/255 PNG of the image's size, 255 = use, or None
    image: str
    mask: str | None
    split: str
    camera: Camera  # in the training frame, at the size of `image`
    source_camera: Camera  # in the capture's frame, at the size of the source image after EXIF rotation
    # near, far: world units, along the view axis
    near: float
    far: float

    @property
    def name(self) -> str:
        return self.camera.name


@dataclass(frozen=True, eq=False)
class Scene:
    """All views of a capture in the training frame."""

    kind: str  # the kind of the capture ("photographs", "blender", ...)
    views: tuple[View, ...]
    bounds: np.ndarray  # (2, 3) scene bounds
    background: tuple[float, float, float] | None  # constant sRGB colour (0-1) that the RGBA images are composited on, in bounded scenes; None: unbounded
    world_from_capture: Similarity
    orbit: Orbit
    points: bool = False  # whether points.safetensors lies next to scene.json
    metric: bool = False  # whether a unit of the capture's frame is a metre
    space: str = "auto"  # of the field: "box" (bounded), "contracted", "ndc", or "auto": contracted without a background, else box
    forward: ForwardFacing | None = None  # the forward-facing scene, for ndc alone

    def __post_init__(self) -> None:
        if self.space not in SPACES or (self.space == "ndc") != (self.forward is not None):
            raise ValueError(f"space {self.space!r} with {'no' if self.forward is None else 'a'} reference camera; expected one of {', '.join(SPACES)}")

    @property
    def contracted(self) -> bool:
        """Whether the field's space is contracted."""
        return self.space == "contracted" or (self.space == "auto" and self.background is None)


def views_of(scene: Scene, split: str) -> tuple[View, ...]:
    """The views of one split, in order; "report" gives test, or val where there is no test."""
    if split == "report":
        return views_of(scene, "test") or views_of(scene, "val")
    return tuple(view for view in scene.views if view.split == split)


def save(scene: Scene, folder: Path) -> None:
    """Write scene.json."""
    views = [
        {name: getattr(view, name) for name in ("image", "mask", "split", "near", "far")}
        | {"camera": camera_to_json(view.camera), "source_camera": camera_to_json(view.source_camera)}
        for view in scene.views
    ]
    forward = None
    if (found := scene.forward) is not None:
        facts = {"bounds": found.bounds.tolist(), "far": found.far, "radii": list(found.radii), "focus": found.focus}
        forward = {**found.ndc.to_json(), **facts, "tangents": list(found.tangents)}
    document = {
        "format": FORMAT,
        "kind": scene.kind,
        "up": [0.0, 0.0, 1.0],  # the poses stage rotates the capture so
        "bounds": scene.bounds.tolist(),
        "background": scene.background,
        "world_from_capture": similarity_to_json(scene.world_from_capture),
        "orbit": asdict(scene.orbit),
        "points": scene.points,
        "metric": scene.metric,
        "space": scene.space,
        "forward": forward,
        "views": views,
    }
    write_json(PosesOutputs(folder).scene, document)


def load(folder: Path) -> Scene:
    """Read and check scene.json. Raises CorruptArtifact; BadInput where there is none."""
    path = PosesOutputs(folder).scene
    if not path.is_file():
        raise BadInput(f"{printable(path)}: no such file. Run the poses stage first.")
    found = json_of_run(path, REMEDY)
    version = found.get("format") if isinstance(found, dict) else None
    if type(version) is int and version > FORMAT:
        newer = str(version) if version < 10**6 else "of many digits"
        raise CorruptArtifact(f"{printable(path)}: format version {newer}; this build reads 1 to {FORMAT}. Upgrade efficientnerf. {REMEDY}")
    try:
        return _scene_from(decoded(found, SceneDocument, path, REMEDY))
    except ValueError as error:
        raise CorruptArtifact(f"{printable(path)}: {printable(error, 400)}. {REMEDY}") from error


def _scene_from(document: SceneDocument) -> Scene:
    """The scene; ValueError for what no scene can be."""
    if document.format < 1 or (document.format > 1 and document.space is None):
        raise ValueError(f"format version {document.format} without all that belongs to it")
    transform, bounds = document.world_from_capture, np.array(document.bounds, np.float64)
    if not (bounds[0] < bounds[1]).all():
        raise ValueError(f"bounds are empty ({bounds.tolist()})")
    rotation = np.array(transform.rotation, np.float64)
    if not _is_rotation(rotation):
        raise ValueError("world_from_capture is not a similarity")
    return Scene(
        kind=printable(document.kind),
        views=tuple(_view_from(view, f"views[{index}]") for index, view in enumerate(document.views)),
        bounds=bounds,
        background=document.background,
        world_from_capture=Similarity(transform.scale, rotation, np.array(transform.translation, np.float64)),
        orbit=document.orbit,
        points=document.points,
        metric=document.metric,
        space="auto" if document.format == 1 else str(document.space),
        forward=None if document.format == 1 else _forward_from(document),
    )


def read_image(folder: Path, view: View) -> np.ndarray:
    """The working image, uint8 sRGB (H, W, 3), or (H, W, 4) with straight alpha. Raises CorruptArtifact."""
    path = folder / view.image
    try:
        with opened(path, WORKING_FORMATS) as image:
            rgb, alpha = rgb_and_alpha(image)
    except UnreadableImage as error:
        raise CorruptArtifact(f"{printable(path)}: missing or {error}. {REMEDY}") from error
    if rgb.shape[:2] != (view.camera.height, view.camera.width):
        found = f"{rgb.dtype} {rgb.shape[1]}x{rgb.shape[0]}"
        raise CorruptArtifact(f"{printable(path)}: {found}; expected an 8-bit image of {view.camera.width}x{view.camera.height}. {REMEDY}")
    return np.ascontiguousarray(rgb if alpha is None else np.dstack([rgb, alpha]))


def has_alpha(folder: Path, view: View) -> bool:
    """Whether the working image has an alpha channel; only its header is read."""
    try:
        return read_header(folder / view.image).alpha
    except UnreadableImage:
        return False  # read_image says what is wrong


def read_mask(folder: Path, view: View) -> np.ndarray | None:
    """bool (H, W), True = use; None where every pixel counts. Raises CorruptArtifact."""
    if view.mask is None:
        return None
    path, pixels = folder / view.mask, None
    with contextlib.suppress(UnreadableImage), opened(path, WORKING_FORMATS) as image:
        pixels = grey_of(image)
    if pixels is None or pixels.shape != (view.camera.height, view.camera.width):
        raise CorruptArtifact(f"{printable(path)}: missing, unreadable or not {view.camera.width}x{view.camera.height}. {REMEDY}")
    return pixels >= 128


def save_points(points: SparsePoints, folder: Path) -> None:
    """Write folder/points.safetensors; `points` in the training frame, tracks as indices into the scene's views."""
    counts = np.fromiter(map(len, points.tracks), np.int64, len(points.tracks))
    tensors = {
        "xyz": np.ascontiguousarray(points.xyz, np.float64),
        "rgb": np.ascontiguousarray(points.rgb, np.uint8),
        "error": np.ascontiguousarray(points.error, np.float64),
        "observer_counts": counts,
        "observers": np.fromiter(itertools.chain.from_iterable(points.tracks), np.int64, int(counts.sum())),
    }
    PosesOutputs(folder).points.write_bytes(tensor_bytes(tensors))  # save_file() would leave it to its owner alone, whatever the umask


def read_points(folder: Path) -> SparsePoints:
    """The sparse points in the training frame; tracks are indices into the scene's views. Raises CorruptArtifact."""
    xyz, rgb, error, counts, observers = _point_arrays(folder)
    tracks = np.split(observers, np.cumsum(counts)[:-1]) if len(counts) else []
    return SparsePoints(xyz, rgb, error, tuple(tuple(track.tolist()) for track in tracks))


def read_observations(folder: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of the sparse points their places (P, 3), how many views observe each (P,), and these views (O,) point by point. Raises CorruptArtifact."""
    xyz, _, _, counts, observers = _point_arrays(folder)
    return xyz, counts, observers


def _point_arrays(folder: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    path = PosesOutputs(folder).points
    try:
        tensors = load_file(path)
        xyz, rgb, error, counts, observers = (tensors[name] for name in ("xyz", "rgb", "error", "observer_counts", "observers"))
    except (OSError, SafetensorError, KeyError, ValueError, TypeError, AttributeError) as reason:
        raise CorruptArtifact(f"{printable(path)}: not readable as sparse points ({printable(reason, 80)}). {REMEDY}") from reason
    count = len(counts) if counts.ndim == 1 else 0
    shapes = [array.shape for array in (xyz, rgb, error, counts)] == [(count, 3), (count, 3), (count,), (count,)]
    types = [array.dtype for array in (xyz, rgb, error, counts, observers)] == [np.float64, np.uint8, np.float64, np.int64, np.int64]
    if not shapes or not types or (counts < 0).any() or (counts > observers.size).any() or observers.shape != (counts.sum(),) or (observers < 0).any():
        raise CorruptArtifact(f"{printable(path)}: sparse points whose shapes, types or counts do not agree. {REMEDY}")
    if not np.isfinite(xyz).all():
        raise CorruptArtifact(f"{printable(path)}: sparse points that are not finite. {REMEDY}")
    return xyz, rgb, error, counts, observers


def describe(folder: Path) -> dict[str, Any]:
    """What `enerf inspect RUN/poses` prints: the source's cameras in the capture's frame, and the facts of the scene."""
    scene = load(folder)
    cameras = [
        described_camera(view.source_camera, view.split) | {"name": view.name, "working_size": [view.camera.width, view.camera.height]} for view in scene.views
    ]
    corners = np.stack(np.meshgrid(*scene.bounds.T, indexing="ij"), -1).reshape(-1, 3)
    in_capture = scene.world_from_capture.inverse().points(corners)
    return {
        "what": "scene",
        "kind": scene.kind,
        "count": len(scene.views),
        "splits": {split: len(views_of(scene, split)) for split in SPLITS},
        "resolution": sorted({(view.source_camera.width, view.source_camera.height) for view in scene.views}),
        "models": sorted({view.source_camera.model for view in scene.views}),
        "bounds": scene.bounds.tolist(),
        "bounds_in_capture": [in_capture.min(0).tolist(), in_capture.max(0).tolist()],
        "background": scene.background,
        "space": scene.space,
        "masks": sum(view.mask is not None for view in scene.views),
        "points": len(read_observations(folder)[0]) if scene.points else 0,
        "metric": scene.metric,
        "world_from_capture": similarity_to_json(scene.world_from_capture),
        "warnings": [printable(sentence, 1000) for sentence in poses_report(folder).warnings or ()],
        "cameras": cameras,
    }


def _forward_from(document: SceneDocument) -> ForwardFacing | None:
    found = document.forward
    if document.space not in SPACES or (document.space == "ndc") != (found is not None):
        raise ValueError(f"space {document.space!r:.40}; expected one of {', '.join(SPACES)}, and ndc with a forward-facing scene")
    if found is None:
        return None
    forward = ForwardFacing(Ndc.from_json(to_builtins(found)), np.array(found.bounds, np.float64), found.far, found.radii, found.focus, found.tangents)
    if min([forward.far - forward.ndc.near, forward.focus, *forward.tangents, *(forward.bounds[1] - forward.bounds[0])]) <= 0:
        raise ValueError("forward: no box before the reference camera")
    return forward


def similarity_to_json(similarity: Similarity) -> dict[str, Any]:
    """A similarity as JSON holds it."""
    return {"scale": float(similarity.scale), "rotation": similarity.rotation.tolist(), "translation": similarity.translation.tolist()}


def camera_to_json(camera: Camera) -> dict[str, Any]:
    """A camera as JSON holds it."""
    return {**vars(camera), "params": list(camera.params), "world_from_camera": camera.world_from_camera.tolist()}


def described_camera(camera: Camera, split: str | None) -> dict[str, Any]:
    """A camera in the capture's frame, as `enerf inspect` prints it."""
    facts = {name: getattr(camera, name) for name in ("name", "width", "height", "model")}
    return facts | {"params": list(camera.params), "split": split, "capture_from_camera": camera.world_from_camera.tolist()}


def camera_from(data: CameraDocument, where: str) -> Camera:
    """The camera of a document; ValueError, which begins with `where`, for what no camera can be."""
    pose = np.array(data.world_from_camera, np.float64)
    if not _is_rotation(pose[:3, :3]) or (pose[3] != (0, 0, 0, 1)).any():
        raise ValueError(f"{where}.world_from_camera is not a rigid motion")
    camera = Camera(printable(data.name), data.width, data.height, data.model, tuple(data.params), pose)
    if min(camera.intrinsics["fx"], camera.intrinsics["fy"]) <= 0:
        raise ValueError(f"{where}: focal length that is not positive")
    return camera


def _view_from(data: ViewDocument, where: str) -> View:
    if data.split not in SPLITS or not 0 <= data.near < data.far:
        expected = f"one of {', '.join(SPLITS)} and 0 <= near < far"
        raise ValueError(f"{where}: split {data.split!r:.40}, near {data.near}, far {data.far}; expected {expected}")
    for relative in (data.image, data.mask):
        if relative is not None and not is_safe_name(relative):
            raise ValueError(f"{where}: {printable(relative, 100)} lies outside of the scene's folder")
    camera, source_camera = camera_from(data.camera, f"{where}.camera"), camera_from(data.source_camera, f"{where}.source_camera")
    return View(data.image, data.mask, data.split, camera, source_camera, data.near, data.far)


def _is_rotation(matrix: np.ndarray) -> bool:
    return bool(np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-5) and np.linalg.det(matrix) > 0)
