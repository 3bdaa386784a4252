"""Whether a bake fits into memory, checked before it begins."""

from __future__ import annotations

import os

COPIES = 3  # of every voxel's values at the same time: as baked, in the tree, and in the refinement


def needed(voxels: int, harmonics: int) -> int:
    """Bytes that density and K harmonics of so many voxels take while they are baked and refined, in float32."""
    return COPIES * 4 * (1 + 3 * harmonics) * voxels


def needed_on_device(voxels: int, harmonics: int, bricks: int, cells: int, brick: int) -> int:
    """Bytes that such a tree takes on a device while it is refined there (`efficientnerf.asset.refinement.device`): values and means of squares in
    float32, visits and stamps, sums of gradients in 64 bits; of bricks their voxels with a border; of the grid's cells three numbers while it is sent."""
    return (28 + 36 * harmonics) * voxels + 4 * (brick + 2) ** 3 * bricks + 12 * cells


def free_on_device(device: str) -> int:
    """Bytes available on a CUDA device: free ones, and those that this process has reserved but not allocated."""
    import torch

    return torch.cuda.mem_get_info(device)[0] + torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)


def installed() -> int | None:
    """Bytes of memory that the machine has, or that its control group allows; None where that is unknown."""
    try:
        found = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):
        return None
    try:
        with open("/sys/fs/cgroup/memory.max", encoding="ascii") as file:
            found = min(found, int(file.read()))
    except (OSError, ValueError):  # no control group, or no limit ("max")
        pass
    return found


def refuse_more_than_fits(voxels: int, harmonics: int, resolution: int, max_mib: int) -> None:
    """UsageError where the voxels would take more memory than there is."""
    from pipeline.errors import UsageError

    there, bytes_ = installed(), needed(voxels, harmonics)
    if there is not None and bytes_ > there:
        raise UsageError(
            f"bake: {voxels:,} voxels with {harmonics} harmonics need about {bytes_ / 2**30:.0f} GiB of memory; there are {there / 2**30:.0f}."
            f" Lower bake.max_mib ({max_mib}) or bake.resolution ({resolution})."
        )
