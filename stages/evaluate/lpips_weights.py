"""Finding the weights of LPIPS: in a given folder, in torch's cache of downloads, and, for the heads, in the package torchmetrics."""

from __future__ import annotations

import os
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.errors import BadInput, UsageError

if TYPE_CHECKING:
    from efficientnerf.evaluation.lpips import Lpips

BACKBONES = {"alex": "alexnet-owt-7be5be79.pth", "vgg": "vgg16-397923af.pth"}
SITE = "https://download.pytorch.org/models/"


def load_lpips(network: str, folder: str | None, *, bundled: Sequence[Path] | None = None) -> Lpips:
    """The metric by "alex" or "vgg".

    folder   searched first, for the network and for the heads
    bundled  folders that are searched for the heads then; None: that of the package torchmetrics

    Raises UsageError, which names what is missing and where to get it.
    """
    from efficientnerf.evaluation.lpips import Lpips

    backbone, heads = find_weights(network, folder, bundled=bundled)
    try:
        return Lpips(network, _state(backbone), _state(heads))
    except ValueError as error:
        raise BadInput(f"LPIPS, {backbone.name} with {heads}: {error}. Get the files again.") from None


def find_weights(network: str, folder: str | None, *, bundled: Sequence[Path] | None = None) -> tuple[Path, Path]:
    """The files of the network and of the heads; as `load_lpips`, without opening them."""
    places = [Path(folder)] if folder else []
    hub = Path(os.environ.get("TORCH_HOME", Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")) / "torch")).expanduser() / "hub" / "checkpoints"
    backbone = _found(BACKBONES[network], [*places, hub], f"Download {SITE}{BACKBONES[network]} into one of them, or name its folder: evaluate.lpips_weights.")
    folders = [*places, *(in_torchmetrics() if bundled is None else bundled)]
    heads = _found(f"{network}.pth", folders, "Install the extra that brings it: pip install 'efficientnerf[lpips]'.")
    return backbone, heads


def in_torchmetrics() -> list[Path]:
    """The folder of the heads in torchmetrics, which is not imported."""
    spec = find_spec("torchmetrics")
    return [Path(place) / "functional" / "image" / "lpips_models" for place in (spec.submodule_search_locations or [])] if spec is not None else []


def _found(name: str, places: list[Path], remedy: str) -> Path:
    for place in places:
        if (place / name).is_file():
            return place / name
    searched = ", ".join(str(place) for place in places) or "nowhere"
    raise UsageError(f"evaluate.lpips: the weights {name} were not found (searched: {searched}). {remedy} Or leave it out: evaluate.lpips=off.")


def _state(path: Path) -> dict[str, Any]:
    """Tensors of a file of torch's, read without executing anything in it."""
    import torch

    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch.load does not document what it raises for a damaged file
        raise BadInput(f"{path}: not a readable file of weights ({str(error).splitlines()[0][:80] if str(error) else type(error).__name__}).") from None
    if not isinstance(state, dict):
        raise BadInput(f"{path}: holds {type(state).__name__}; expected named tensors.")
    return state
