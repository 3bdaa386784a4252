"""Baked radiance fields: what programs that use the library may rely on (docs/api.md). The rest of the package may change at any time.

    import efficientnerf as en

    tree = en.load("asset.nerftree")
    picture = en.render(tree, en.turntable_cameras(tree, frames=1, width=640, height=480)[0])

Names are imported when they are first used; `__init__.pyi` has them for type checkers.
"""

import os
import time
from importlib import import_module

# Before any other module of this package was read: `efficientnerf.backends.numba.runtime`. Files carry the time of the last clock tick, up to 10 ms ago.
BEGAN = time.time() - 0.02

# onnxruntime, wherever it is imported, else keeps an identifier of the device in the user's cache and sends to its maker what it is used for.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

_PLACES = {
    "asset.camera_paths": ("turntable_cameras",),
    "asset.captured": ("MetadataError",),
    "asset.format": ("FormatError", "load", "save"),
    "asset.rendering": ("Rendering", "render", "render_rays"),
    "asset.tree": ("NerfTree",),
    "geometry.cameras": ("Camera",),
}
_PUBLIC = {name: place for place, names in _PLACES.items() for name in names}
__all__ = sorted([*_PUBLIC, "__version__"])


def __getattr__(name: str) -> object:
    if name == "__version__":
        return import_module("importlib.metadata").version("efficientnerf")
    if name not in _PUBLIC:
        raise AttributeError(f"module 'efficientnerf' has no attribute '{name}'")
    return getattr(import_module(f"efficientnerf.{_PUBLIC[name]}"), name)


def __dir__() -> list[str]:
    return [*globals(), *__all__]
