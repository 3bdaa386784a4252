"""Packed samples of a bundle of rays.

A ray is cut into intervals. In the box an interval is `step` long; beyond it, it grows with the square of the distance, which is the same
length in contracted space. A random offset in [0, 1), one per ray and shared by both stages, says where in its interval a sample lies.
Coarse sample i lies in interval i; a pivotal interval is cut into N_s parts with one fine sample each, so that no point is evaluated twice
and neighbouring pivots do not overlap (the paper's equation 11 read literally gives overlapping neighbourhoods; see the authors' release).

The number of samples of a bundle depends on values, and a host that asks a device for it waits. Functions that are given a `capacity` make arrays of
at most that many entries instead: `first` says how far they are filled, the rest is padding of length zero that belongs to no ray, and where a bundle
has more samples than fit its last rays lose theirs (`Samples.complete`).

R rays, N samples.
"""

from typing import NamedTuple

from torch import Tensor


class Samples(NamedTuple):
    """Packed samples of a bundle of rays."""

    first: Tensor  # (R + 1,) int64 offsets: ray r owns samples first[r] to first[r + 1]
    start: Tensor  # (N,) where the sample's interval begins, distance along the ray
    extent: Tensor  # (N,) its length, world units
    length: Tensor  # (N,) its length in the field's units: the world's in the box, contracted beyond
    point: Tensor  # (N, 3) grid coordinates of the sample
    tried: int  # how many samples there would have been without the density voxels
    complete: Tensor | None = None  # (R,) bool, rays all of whose samples fit; None: all rays


class SampleCapacity(NamedTuple):
    """The most samples that fit in each stage."""

    coarse: int
    fine: int


def complete_rays(coarse: Samples, fine: Samples) -> Tensor | None:
    """(R,) bool: rays all of whose samples fit in both stages; None: all rays."""
    if coarse.complete is None or fine.complete is None:
        return fine.complete if coarse.complete is None else coarse.complete
    return coarse.complete & fine.complete
