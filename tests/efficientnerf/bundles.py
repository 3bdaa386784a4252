"""Rays with random samples for compositing."""

from typing import NamedTuple

import numpy as np
import torch

from efficientnerf.rendering.harmonics import basis


class Bundle(NamedTuple):
    """What `composite` is handed, float64; ray 2 has no samples and ray 4 begins with an opaque one."""

    raw: torch.Tensor
    length: torch.Tensor
    first: torch.Tensor
    harmonics: torch.Tensor
    background: torch.Tensor


def bundle(degree: int, counts: tuple[int, ...] = (5, 1, 0, 9, 7, 3)) -> Bundle:
    rng = np.random.default_rng(degree)
    n, k = sum(counts), (degree + 1) ** 2
    first = torch.tensor([0, *np.cumsum(counts)])
    raw = torch.from_numpy(rng.normal(size=(n, 1 + 3 * k)) * 1.5)
    if len(counts) > 4:
        raw[first[4], 0] = 9.0
    directions = rng.normal(size=(len(counts), 3))
    directions = torch.from_numpy(directions / np.linalg.norm(directions, axis=1, keepdims=True))
    return Bundle(raw, torch.from_numpy(rng.uniform(0.02, 0.3, n)), first, basis(directions, degree), torch.from_numpy(rng.random((len(counts), 3))))


def in_float32(b: Bundle) -> Bundle:
    return Bundle(*(t.float() if t.dtype == torch.float64 else t for t in b))
