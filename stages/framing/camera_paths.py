"""Where the README of 0.1.0 had `turntable_cameras`: `efficientnerf.turntable_cameras` since 0.2. Goes with 0.3."""

import warnings

import efficientnerf


def __getattr__(name: str) -> object:
    if name != "turntable_cameras":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    warnings.warn(f"{__name__}.turntable_cameras is efficientnerf.turntable_cameras; this name goes with 0.3", DeprecationWarning, stacklevel=2)
    return efficientnerf.turntable_cameras
