"""The trained field on disk: field.safetensors, read strictly and written whole or not at all."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from efficientnerf.settings import given
from efficientnerf.training.settings import TrainSettings
from pipeline.errors import CorruptArtifact, UsageError
from pipeline.files import write_atomically
from pipeline.stage import settings_from
from pipeline.text import printable
from stages.artifacts import TrainOutputs
from stages.io.json_file import shown
from stages.renamed_settings import updated
from stages.scratch import opened

if TYPE_CHECKING:
    from torch import Tensor

    from efficientnerf.geometry.spaces import Space
    from efficientnerf.model import Model
    from efficientnerf.rendering.field_renderer import FieldRenderer
    from efficientnerf.training.schedule import Schedule
    from stages.io.scene import Scene, View

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
    from safetensors.torch import save

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
    from safetensors import SafetensorError, safe_open

    try:
        with opened(path), safe_open(path, framework="pt", device="cpu") as file:
            about = json.loads((file.metadata() or {}).get("field", "null"), parse_constant=_refused)
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
    except (SafetensorError, ValueError, OSError, RecursionError, TypeError, AttributeError) as error:  # the last two: types that NumPy or torch lack
        raise CorruptArtifact(f"{printable(path)}: not a readable field file ({printable(error, 80)}). Train again.") from None
    if not isinstance(about, dict) or about.get("format") != FORMAT:
        found = shown(about.get("format")) if isinstance(about, dict) else None
        raise CorruptArtifact(f"{printable(path)}: field file of format {found}; this build reads {FORMAT}.")
    if digest_of(tensors) != about.get("sha256"):
        raise CorruptArtifact(f"{path}: damaged field file: its tensors are not those that its SHA-256 was made of. Train again.")
    return tensors, about


def _refused(name: str) -> Any:
    raise ValueError(f"{name} is no number")


def space_of(s: Scene) -> Space:
    """The space that a scene's field lives in."""
    from efficientnerf.geometry.spaces import space_from

    return space_from(s.bounds, contracted=s.contracted) if s.forward is None else space_from(s.forward.bounds, ndc=s.forward.ndc)


GAINS = "exposure.gains"


def save_model(m: Model, near: float, far: float, path: Path, gains: dict[str, np.ndarray] | None = None, schedule: Schedule | None = None) -> None:
    """
    gains     of each training view by the name of its image, (3,) the gains from the scene's colours to the photograph's, where they were learned
    schedule  that the model was trained with, which gives it again to the byte
    """
    import torch

    from efficientnerf.model import state_of

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
    if gains:
        tensors[GAINS] = torch.from_numpy(np.stack([gains[name] for name in sorted(gains)]).astype(np.float32))  # (C, 3)
        about["exposed"] = sorted(gains)
    write_tensors(tensors, about, path)


def load_gains(folder: Path) -> dict[str, np.ndarray]:
    """What `save_model` was given: the factors (3,) of each training view; none where exposure was not learned."""
    path = TrainOutputs(folder).field
    if not _names_gains(path):
        return {}
    tensors, about = read_tensors(path)
    names = about.get("exposed", [])
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise CorruptArtifact(f"{printable(path)}: 'exposed' is {shown(names)}; expected a list of names. Train again.")
    if not names and GAINS not in tensors:
        return {}
    if GAINS not in tensors or tuple(tensors[GAINS].shape) != (len(names), 3):
        found = tuple(tensors[GAINS].shape) if GAINS in tensors else None
        raise CorruptArtifact(f"{path}: '{GAINS}' is {found}; expected {(len(names), 3)}. Train again.")
    return dict(zip(names, tensors[GAINS].numpy(), strict=True))


def _names_gains(path: Path) -> bool:
    """Whether a field file has gains, by its head alone: where exposure was not learned, nobody waits for the rest. One that cannot be read has none: it is
    refused where the field is needed."""
    from safetensors import SafetensorError, safe_open

    try:
        with opened(path), safe_open(path, framework="pt", device="cpu") as file:
            return GAINS in file.keys() or '"exposed"' in (file.metadata() or {}).get("field", "")  # noqa: SIM118 (not a dict)
    except (SafetensorError, ValueError, OSError, TypeError):
        return False


def gains_of_views(folder: Path, views: Sequence[View]) -> np.ndarray | None:
    """(C, 3) the gains of views from the scene's colours to the photograph's, as the train stage in `folder` learned them, 1 for others; None: none were."""
    known = load_gains(folder)
    return np.stack([known.get(view.image, np.ones(3, np.float32)) for view in views]) if known else None


def load_renderer(folder: Path, device: str = "cpu") -> FieldRenderer:
    """The trained model in the folder of the train stage, ready to draw."""
    from efficientnerf.geometry.ndc import Ndc
    from efficientnerf.geometry.spaces import space_from
    from efficientnerf.model import model, restore
    from efficientnerf.rendering.field_renderer import FieldRenderer

    path = TrainOutputs(folder).field
    tensors, found = read_tensors(path)
    try:
        about = msgspec.convert(found, _About)
        ndc = None if about.ndc is None else Ndc.from_json(about.ndc)
        space = space_from(np.asarray(about.bounds, np.float64), contracted=about.contracted, ndc=ndc)
        settings = settings_from(TrainSettings, updated("train", TrainSettings, about.settings))
        _check_sizes(tensors, settings, space)
        m = model(space, settings, about.background, device, (about.near, about.far))
        restore(m, tensors)
        return FieldRenderer(m, about.near, about.far)
    except (UsageError, KeyError, TypeError, ValueError, OverflowError, RecursionError, RuntimeError) as error:  # the last: torch's, of shapes
        raise CorruptArtifact(f"{printable(path)}: {printable(error, 300)}. Train again.") from None


def _check_sizes(tensors: dict[str, Tensor], settings: TrainSettings, space: Space) -> None:
    """ValueError where the large tensors are not of the sizes that the settings state: the model would take that memory before it is filled."""
    side = given(settings.occupancy_resolution) or space.occupancy_resolution
    expected: dict[str, tuple[int, ...]] = {"voxels": (side, side, side)}
    if settings.field == "hash":
        from efficientnerf.fields.hash import FEATURES, grids, level_sizes

        for name, grid in zip(("coarse", "fine"), grids(settings), strict=True):
            expected[f"{name}.table"] = sum(level_sizes(**grid)[1]), FEATURES
    for name, shape in expected.items():
        if name not in tensors or tuple(tensors[name].shape) != shape:
            found = f"{tensors[name].dtype} {tuple(tensors[name].shape)}" if name in tensors else "missing"
            raise ValueError(f"tensor '{name}' is {found}; expected {shape}")
