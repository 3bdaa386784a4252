"""How many cores a stage computes on."""

from __future__ import annotations

import os


def use_all_cores() -> None:
    """Let torch compute on all cores that this process may use (`OMP_NUM_THREADS`, or its affinity): results repeat with the same number alone."""
    import torch

    torch.set_num_threads(count_cores())


def count_cores() -> int:
    """`OMP_NUM_THREADS`, or the cores of this process's affinity."""
    return int(os.environ.get("OMP_NUM_THREADS", 0)) or len(os.sched_getaffinity(0))
