"""How many cores a stage computes on."""

from __future__ import annotations

import os


def use_all_cores() -> None:
    """Let torch compute on all cores that this process may use (`OMP_NUM_THREADS`, or its affinity): results repeat with the same number alone."""
    import torch

    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", 0)) or len(os.sched_getaffinity(0)))
