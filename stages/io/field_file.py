"""The trained field on disk: field.safetensors, read strictly and written whole or not at all."""

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from efficientnerf.fields.hash import FEATURES, grids, level_sizes
from efficientnerf.geometry.ndc import Ndc
from efficientnerf.geometry.spaces import Space, space_from
from efficientnerf.model import Model, model, restore, state_of
from efficientnerf.rendering.field_renderer import FieldRenderer
from efficientnerf.settings import resolved
from efficientnerf.training.exposure.model import Exposure
from efficientnerf.training.schedule import Schedule
from efficientnerf.training.settings import TrainSettings
from pipeline.errors import CorruptArtifact, UsageError
from pipeline.files import json_value, write_atomically
from pipeline.stage import settings_from
from pipeline.text import printable
from stages.artifacts import TrainOutputs
from stages.io.json_file import shown
from stages.io.scene import Scene
from stages.scratch import opened

FORMAT = 1

Point = tuple[float, float, float]


class _About(msgspec.Struct):
    """What a field file says of the field."""

    settings: dict[str, Any]
    bounds: tuple[Point, Point]
    contracted: bool
    near: float
    far: float
    background: Point | None = None
    ndc: dict[str, Any] | None = None


def write_tensors(tensors: dict[str, Tensor], about: dict[str, Any], path: Path) -> None:
    """A safetensors file with one metadata entry, "field", a JSON text with a digest of the tensors: the same input gives the same bytes."""
    plain = {name: t.detach().cpu().contiguous() for name, t in tensors.items()}
    text = json.dumps({"format": FORMAT, **about, "sha256": digest_of(plain)}, sort_keys=True)
    data = save(plain, metadata={"field": text})
    write_atomically(path, data)


def digest_of(tensors: dict[str, Tensor]) -> str:
    """SHA-256 over names, types, shapes and bytes, in the order of the names. The format itself has no check: a flipped bit would be trained on."""
    digest = hashlib.sha256()
    for name, t in sorted(tensors.items()):
        digest.update(f"{name} {t.dtype} {tuple(t.shape)}\n".encode())
        digest.update(t.numpy().tobytes())
    return digest.hexdigest()


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """The tensors and the metadata of a file of `write_tensors`; CorruptArtifact where it is damaged."""
    try:
        with opened(path), safe_open(path, framework="pt", device="cpu") as file:
            about = json_value((file.metadata() or {}).get("field", "null").encode())
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
    except (SafetensorError, ValueError, OSError, TypeError, AttributeError) as error:  # the last two: types that NumPy or torch lack
        raise CorruptArtifact(f"{printable(path)}: not a readable field file ({printable(error, 80)}). Train again.") from None
    if not isinstance(about, dict) or about.get("format") != FORMAT:
        found = shown(about.get("format")) if isinstance(about, dict) else None
        raise CorruptArtifact(f"{printable(path)}: field file of format {found}; this build reads {FORMAT}.")
    if digest_of(tensors) != about.get("sha256"):
        raise CorruptArtifact(f"{path}: damaged field file: its tensors are not those that its SHA-256 was made of. Train again.")
    return tensors, about


def space_of(s: Scene) -> Space:
    """The space that a scene's field lives in."""
    return space_from(s.bounds, contracted=s.contracted) if s.forward is None else space_from(s.forward.bounds, ndc=s.forward.ndc)


EXPOSURE = ("exposure.photographs", "exposure.cameras", "exposure.camera_of")


def save_model(
    m: Model, near: float, far: float, path: Path, exposure: tuple[list[str], Exposure] | None = None, schedule: Schedule | None = None
) -> None:
    """
    exposure  images of photographs, and what was learned of them, where it was
    schedule  that the model was trained with, which gives it again to the byte
    """
    trained = {} if schedule is None else {"iterations": schedule.iterations}
    about: dict[str, Any] = {
        "settings": dataclasses.asdict(m.settings) | trained,
        "bounds": m.space.bounds.tolist(),
        "contracted": m.space.contracted,
        "ndc": None if m.space.ndc is None else m.space.ndc.to_json(),
        "background": m.background,
        "schedule": None if schedule is None else schedule.state(),
        "near": near,
        "far": far,
    }
    tensors = state_of(m)
    if exposure is not None:
        about["exposed"], e = exposure
        tensors |= dict(zip(EXPOSURE, (e.photographs, e.cameras, e.camera_of), strict=True))
    write_tensors(tensors, about, path)


def load_exposure(folder: Path) -> tuple[list[str], Exposure] | None:
    """What `save_model` was given; None where exposure was not learned. Raises CorruptArtifact."""
    path = TrainOutputs(folder).field
    if not _names_exposure(path):
        return None
    tensors, about = read_tensors(path)
    names = about.get("exposed", [])
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise CorruptArtifact(f"{printable(path)}: 'exposed' is {shown(names)}; expected a list of names. Train again.")
    cameras = tuple(tensors[EXPOSURE[1]].shape) if EXPOSURE[1] in tensors else ()
    count = cameras[0] if len(cameras) == 2 else 0
    for name, shape in zip(EXPOSURE, ((len(names), 3), (count, 4), (len(names),)), strict=True):
        found = tuple(tensors[name].shape) if name in tensors else None
        if found != shape or not count:
            raise CorruptArtifact(f"{path}: '{name}' is {found}; expected {shape}. Train again.")
    photographs, per_camera, camera_of = (tensors[name] for name in EXPOSURE)
    if not (photographs.isfinite().all() and per_camera.isfinite().all() and ((camera_of >= 0) & (camera_of < count)).all()):
        raise CorruptArtifact(f"{path}: an exposure that no photograph has. Train again.")
    return names, Exposure(photographs.float(), per_camera.float(), camera_of.long())


def _names_exposure(path: Path) -> bool:
    """Whether a field file has it, by its header alone, without reading the rest. A file that cannot be read has none: it is
    refused where the field is needed."""
    try:
        with opened(path), safe_open(path, framework="pt", device="cpu") as file:
            return bool(set(EXPOSURE) & set(file.keys())) or '"exposed"' in (file.metadata() or {}).get("field", "")
    except (SafetensorError, ValueError, OSError, TypeError):
        return False


def load_renderer(folder: Path, device: str = "cpu") -> FieldRenderer:
    """The trained model in the folder of the train stage, ready to draw."""
    path = TrainOutputs(folder).field
    tensors, found = read_tensors(path)
    try:
        about = msgspec.convert(found, _About)
        ndc = None if about.ndc is None else Ndc.from_json(about.ndc)
        space = space_from(np.asarray(about.bounds, np.float64), contracted=about.contracted, ndc=ndc)
        settings = settings_from(TrainSettings, about.settings)
        _check_sizes(tensors, settings, space)
        m = model(space, settings, about.background, device, (about.near, about.far))
        restore(m, tensors)
        return FieldRenderer(m, about.near, about.far)
    except (UsageError, KeyError, TypeError, ValueError, OverflowError, RecursionError, RuntimeError) as error:  # the last: torch's, of shapes
        raise CorruptArtifact(f"{printable(path)}: {printable(error, 300)}. Train again.") from None


def _check_sizes(tensors: dict[str, Tensor], settings: TrainSettings, space: Space) -> None:
    """ValueError where the large tensors are not of the sizes that the settings state: the model would take that memory before it is filled."""
    side = resolved(settings.occupancy_resolution) or space.occupancy_resolution
    expected: dict[str, tuple[int, ...]] = {"voxels": (side, side, side)}
    if settings.field == "hash":
        for name, grid in zip(("coarse", "fine"), grids(settings), strict=True):
            expected[f"{name}.table"] = sum(level_sizes(**grid)[1]), FEATURES
    for name, shape in expected.items():
        if name not in tensors or tuple(tensors[name].shape) != shape:
            found = f"{tensors[name].dtype} {tuple(tensors[name].shape)}" if name in tensors else "missing"
            raise ValueError(f"tensor '{name}' is {found}; expected {shape}")
