"""Between the host and a device without waiting for it."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import torch
from torch import Tensor


def to_device(values: Tensor, device: torch.device) -> Tensor:
    """A tensor of the host on `device`. Through pinned memory, from where a device fetches on its own; from other memory the host waits for it."""
    if device.type != "cuda":
        return values.to(device)
    return values.pin_memory().to(device, non_blocking=True)


def remote(values: Tensor) -> bool:
    """Whether a host that asks for one of these values has to wait: they are a device's."""
    return values.is_cuda


def to_host_async(values: Tensor) -> tuple[Tensor, Any]:
    """A tensor of a device on its way to the host, and the event at whose end it has arrived; None where there is nothing to wait for."""
    if not values.is_cuda:
        return values, None
    host = torch.empty(values.shape, dtype=values.dtype, pin_memory=True)
    host.copy_(values, non_blocking=True)
    arrived = torch.cuda.Event()
    arrived.record()
    return host, arrived


def constant(values: np.ndarray, like: Tensor) -> Tensor:
    """An array that does not change, in the type and on the device of `like`: sent once, whoever asks. Not to be changed."""
    exact = np.ascontiguousarray(values, np.float64)
    return _constant(exact.tobytes(), exact.shape, like.dtype, like.device)


@functools.lru_cache(maxsize=256)
def _constant(values: bytes, shape: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    return torch.from_numpy(np.frombuffer(values, np.float64).reshape(shape).copy()).to(dtype).to(device)
