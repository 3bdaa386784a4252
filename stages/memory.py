"""Whether what is to be baked fits into memory: said before hours are spent, rather than found out when the system kills the process."""

from __future__ import annotations

import os

COPIES = 3  # of every voxel's values at the same time: as baked, in the tree, and with the optimiser


def needed(voxels: int, harmonics: int) -> int:
    """Bytes that density and K harmonics of so many voxels take while they are baked and fitted, in float32."""
    return COPIES * 4 * (1 + 3 * harmonics) * voxels


def installed() -> int | None:
    """Bytes of memory that the machine has, or that its control group allows; None where that can't be told."""
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
