"""What the figures of an evaluation say in plain words, where they are poor: what it means, and what to do."""

from __future__ import annotations

POOR_GAP = -0.5  # decibels
POOR_HOLES = 0.01  # share of the pixels
POOR_FLOATERS = 0.02  # share of the asset's opacity, more than the network's own


SHORT = 0.5  # of the steps that are usual: a refinement with fewer comes before other causes


def findings(
    gap: float | None, holes: float | None, floaters: float | None = None, holes_excess_error: float | None = None, floaters_excess_error: float | None = None,
    *, network_floaters: float | None = None, steps: int | None = None, usual_steps: int | None = None,
) -> list[str]:
    """A sentence or two for each figure that is poor; where the refinement was short, that in place of other advice.

    gap       PSNR of the asset minus that of the network, decibels
    holes     share of the pixels
    floaters  share of the asset's opacity; network_floaters: the network's own
    holes_excess_error, floaters_excess_error  of the asset over the network's, against the photographs: they are named only where it is above 0 or not known
    steps     of the refinement; usual_steps: of one of so many voxels where nothing is stated
    """
    short = steps is not None and usual_steps is not None and steps < SHORT * usual_steps
    found = []
    if gap is not None and gap < POOR_GAP:
        found.append(
            (f"the asset is {-gap:.2f} dB behind its network on the same pixels: it has lost detail that the network had.",
             "Give it more voxels (bake.max_mib), or more steps to fit them (bake.refine_steps).")
        )  # fmt: skip
    if holes is not None and holes > POOR_HOLES and (holes_excess_error is None or holes_excess_error > 0):
        found.append(
            (f"the asset has holes: {100 * holes:.1f} % of the pixels show through where the network shows something solid.",
             "Keep more voxels (a lower bake.weight_threshold, more bake.visibility_rays), or give them more room (bake.max_mib).")
        )  # fmt: skip
    more = floaters is not None and floaters - (network_floaters or 0.0) > POOR_FLOATERS
    if floaters is not None and more and (floaters_excess_error is None or floaters_excess_error > 0):
        found.append(
            (f"the asset has floaters: {100 * floaters:.1f} % of what it shows hangs before the network's surfaces (in the network itself "
             f"{100 * (network_floaters or 0.0):.1f} %).",
             "Drop faint voxels (a higher bake.weight_threshold) or small pieces (a higher bake.min_component).")
        )  # fmt: skip
    if not found or not short:
        return [f"{fact} {remedy}" for fact, remedy in found]
    cause = (
        f"the asset's refinement had {steps:,} step{'' if steps == 1 else 's'}, where {usual_steps:,} are usual, which may explain this: before other "
        "settings, give it more time (--budget, bake.time_budget) or steps (bake.refine_steps), fewer voxels (bake.max_mib), or a machine without other work."
    )
    return [*(fact for fact, _ in found), cause]
