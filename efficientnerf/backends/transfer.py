"""Copies between the host and a device that do not make the host wait."""

import functools
from typing import Any

import numpy as np
import torch
from torch import Tensor


def to_device(values: Tensor, device: torch.device) -> Tensor:
    """A tensor of the host on `device`. Through pinned memory, which a device reads on its own; for other memory the host would wait."""
    if device.type != "cuda":
        return values.to(device)
    return values.pin_memory().to(device, non_blocking=True)


def sent(values: Any, device: torch.device) -> Any:
    """Arrays of the host as tensors on `device`, and tuples of them, of the same type; tensors and None stay."""
    if isinstance(values, tuple):
        parts = [sent(each, device) for each in values]
        return type(values)(*parts) if hasattr(values, "_fields") else tuple(parts)
    return to_device(torch.from_numpy(values), device) if isinstance(values, np.ndarray) else values


def is_on_device(values: Tensor) -> bool:
    """Whether reading one of these values on the host waits for a device."""
    return values.is_cuda


def to_host_async(values: Tensor) -> tuple[Tensor, Any]:
    """A copy of a device's tensor on the host, and the event after which it is complete; of a host's tensor itself, and None."""
    if not values.is_cuda:
        return values, None
    host = torch.empty(values.shape, dtype=values.dtype, pin_memory=True)
    host.copy_(values, non_blocking=True)
    arrived = torch.cuda.Event()
    arrived.record()
    return host, arrived


def constant(values: np.ndarray, like: Tensor) -> Tensor:
    """An array in the type and on the device of `like`, sent once and cached by its values. Not to be changed in place."""
    exact = np.ascontiguousarray(values, np.float64)
    return _constant(exact.tobytes(), exact.shape, like.dtype, like.device)


@functools.lru_cache(maxsize=256)
def _constant(values: bytes, shape: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    return torch.from_numpy(np.frombuffer(values, np.float64).reshape(shape).copy()).to(dtype).to(device)
