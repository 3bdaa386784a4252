"""The state of a refinement: a tree whose values are being fitted, and RMSprop's moments. N voxels, K harmonics."""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from efficientnerf.asset.cascades import cascade_sides, voxel_cascades
from efficientnerf.asset.tree import NerfTree

MAX_INITIAL_THICKNESS = 2.0  # optical thickness of a voxel at the beginning: networks give hundreds, which would block all gradients behind


class DeviceState(Protocol):
    def to_host(self) -> dict[str, np.ndarray]: ...


@dataclass
class RefinementState:
    """A tree whose values are being fitted, in place: harmonics are most of the memory, and are held once.

    square_*      (N,) running means of the squared gradients by the logarithm of a voxel's optical thickness, and by its harmonics
    visits        (N,) number of steps in which a voxel had a gradient
    errors        of the error map (`efficientnerf.asset.refinement.error_map.ErrorMap`); None before the first step
    device_state  the arrays on the device where steps are taken; `fetch` copies them here
    """

    tree: NerfTree
    square_density: np.ndarray
    square_sh: np.ndarray
    visits: np.ndarray
    step: int = 0
    errors: np.ndarray | None = None
    device_state: DeviceState | None = None

    def fetch(self) -> None:
        """Copy the arrays of the last step from the device, if steps are taken there."""
        if self.device_state is not None:
            found = self.device_state.to_host()
            self.tree = replace(self.tree, density_values=found["density"], harmonics=found["sh"].reshape(self.tree.sh.shape))
            for name in MOMENTS:
                setattr(self, name, found[name])

    def to_host(self) -> None:
        """Copy the arrays of the last step from the device and free them there."""
        self.fetch()
        self.device_state = None

    @property
    def density(self) -> np.ndarray:
        """(N,) float32, the tree's own."""
        return self.tree.density_values

    @property
    def sh(self) -> np.ndarray:
        """(N, 3 K) float32, the tree's own."""
        return self.tree.sh.reshape(len(self.tree.sh), self.tree.harmonics_count * 3)

    def result(self) -> NerfTree:
        """The tree as it is now."""
        self.fetch()
        return replace(self.tree, density_values=self.density.copy(), harmonics=self.tree.sh.copy())


MOMENTS = ("square_density", "square_sh", "visits")
STATE = ("density", "sh", *MOMENTS)


def initial_state(tree: NerfTree, max_thickness: float = np.inf) -> RefinementState:
    """The state before the first step, of a copy. Optical thickness is limited to `max_thickness`, so that voxels behind a floater have a gradient from
    the first step on."""
    most = (max_thickness / cascade_sides(tree)).astype(np.float32)
    density = np.minimum(tree.density_values, most[voxel_cascades(tree)] if tree.outer else most)
    tree = replace(tree, density_values=density, harmonics=np.array(tree.sh, np.float32))
    return RefinementState(tree, np.zeros_like(density), np.zeros_like(density), np.zeros(len(density), np.int32))


def subset_state(state: RefinementState, keep: np.ndarray, tree: NerfTree) -> RefinementState:
    """The state of `tree`, which is `state.tree` after `to_host` with the voxels `keep`, (N,) bool, alone, in their order."""
    return RefinementState(tree, **{name: getattr(state, name)[keep] for name in MOMENTS}, step=state.step, errors=state.errors)
