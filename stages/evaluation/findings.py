"""What the figures of an evaluation say in plain words, where they are poor: what it means, and what to do."""

from __future__ import annotations

POOR_GAP = -0.5  # decibels
POOR_HOLES = 0.01  # share of the pixels
POOR_FLOATERS = 0.02  # share of the asset's opacity, more than the network's own


def findings(gap: float | None, holes: float | None, floaters: float | None = None, network_floaters: float | None = None) -> list[str]:
    """A sentence or two for each figure that is poor.

    gap       PSNR of the asset minus that of the network, decibels
    holes     share of the pixels
    floaters  share of the asset's opacity; network_floaters: the network's own
    """
    found = []
    if gap is not None and gap < POOR_GAP:
        found.append(
            f"the asset is {-gap:.2f} dB behind its network on the same pixels: it has lost detail that the network had. Give it more voxels "
            "(bake.max_mib), or more steps to fit them (bake.refine_steps)."
        )
    if holes is not None and holes > POOR_HOLES:
        found.append(
            f"the asset has holes: {100 * holes:.1f} % of the pixels show through where the network shows something solid. Keep more voxels (a lower "
            "bake.weight_threshold, more bake.visibility_rays), or give them more room (bake.max_mib)."
        )
    if floaters is not None and floaters - (network_floaters or 0.0) > POOR_FLOATERS:
        found.append(
            f"the asset has floaters: {100 * floaters:.1f} % of what it shows hangs before the network's surfaces (in the network itself "
            f"{100 * (network_floaters or 0.0):.1f} %). Drop faint voxels (a higher bake.weight_threshold) or small pieces (a higher bake.min_component)."
        )
    return found
