"""The phases of a refinement: how many steps each takes, and what becomes of the tree at its end. Imports nothing heavy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Literal

Operation = Literal["none", "prune"]


@dataclass(frozen=True)
class Phase:
    """Some steps with the same voxels.

    name   of the phase, as it is shown
    share  of all steps; the shares of all phases sum to 1
    after  what is done to the tree after the last of its steps: "prune" drops voxels that do not show
    """

    name: str
    share: float
    after: Operation = "none"


PHASES = (Phase("all voxels", 0.5, "prune"), Phase("voxels that show", 0.5))


def phase_ends(phases: Sequence[Phase], steps: int) -> list[int]:
    """The last step of each phase, of so many in all."""
    return [int(round(share, 9) * steps) for share in accumulate(phase.share for phase in phases)]
