"""Terms that steps of tree training minimise besides the losses of rays, and the harmonics that they move."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from efficientnerf.backends.layout import Hyperparameters

DECAY, EPSILON = 0.99, 1e-10  # of RMSprop


@dataclass(frozen=True)
class Rule:
    """The formulas are those of `efficientnerf.backends.numba.tree_training.steps`; a weight of 0 leaves a term out.

    total_variation  share, of the density's learning rate, of the differences between the logarithms of a voxel's and its neighbours' optical thickness
    sparsity         weight of the sum of the opacities of voxels
    entropy          weight of the entropy of these opacities
    error_map        share of the rays that are drawn by the errors of earlier ones, below 1
    min_weight       weight below which samples of a ray absorb, and have neither a colour nor a gradient
    degree           highest degree of the harmonics that a step, by its number, moves; None: all
    """

    total_variation: float = 0.0
    sparsity: float = 0.0
    entropy: float = 0.0
    error_map: float = 0.9
    min_weight: float = 0.0
    degree: Callable[[int], int] | None = None

    def terms(self, step: int, most: int) -> int:
        """Coefficients of a channel that a step moves, at most `most`."""
        return most if self.degree is None else min(most, (self.degree(step) + 1) ** 2)

    def hyperparameters(self, step: int, most: int, *, density_lr: float, sh_lr: float, view_share: float) -> Hyperparameters:
        """Those of a step, for a tree of so many coefficients of a channel, at its own learning rates."""
        return Hyperparameters(
            density_lr, sh_lr, view_share, DECAY, EPSILON, total_variation=self.total_variation, sparsity=self.sparsity, entropy=self.entropy,
            terms=self.terms(step, most),
        )  # fmt: skip


PLAIN = Rule()
