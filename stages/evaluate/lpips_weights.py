"""Finding the weights of LPIPS: in a given folder, in torch's cache of downloads, and, for the heads, in the package torchmetrics."""

import os
from importlib.util import find_spec
from pathlib import Path

from pipeline.errors import UsageError

BACKBONES = {"alex": "alexnet-owt-7be5be79.pth", "vgg": "vgg16-397923af.pth"}
SITE = "https://download.pytorch.org/models/"


def find_weights(network: str, folder: str | None) -> tuple[Path, Path]:
    """The files of the network, "alex" or "vgg", and of the heads; `folder` is searched first. UsageError says what is missing and where to get it."""
    places = [Path(folder)] if folder else []
    hub = Path(os.environ.get("TORCH_HOME", Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")) / "torch")).expanduser() / "hub" / "checkpoints"
    backbone = _found(BACKBONES[network], [*places, hub], f"Download {SITE}{BACKBONES[network]} into one of them, or name its folder: evaluate.lpips_weights.")
    spec = find_spec("torchmetrics")  # which is not imported
    brought = [Path(place) / "functional/image/lpips_models" for place in (spec.submodule_search_locations or [])] if spec is not None else []
    heads = _found(f"{network}.pth", [*places, *brought], "Install the extra that brings it: pip install 'efficientnerf[lpips]'.")
    return backbone, heads


def _found(name: str, places: list[Path], remedy: str) -> Path:
    for place in places:
        if (place / name).is_file():
            return place / name
    searched = ", ".join(str(place) for place in places) or "nowhere"
    raise UsageError(f"evaluate.lpips: the weights {name} were not found (searched: {searched}). {remedy} Or leave it out: evaluate.lpips=off.")
