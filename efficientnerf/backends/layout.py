"""What the kernels of numba and of Triton agree on: structures that both take, and limits that both keep. Imports nothing heavy.

A field that says Any is an array on the CPU, a tensor on a device.
"""

from typing import Any, NamedTuple

EARLY_STOP = 1e-3  # transmittance at which a ray may end
MIN_THICKNESS, MAX_THICKNESS = 1e-7, 150.0  # optical thickness of a voxel: invisible, and opaque
MAX_VISITS = 60000  # steps that met a voxel, counted up to here
SSIM_WINDOW = 4  # pixels along a side of the windows of SSIM in losses
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2  # its constants; Wang et al. 2004
MOST_VARIATION = 1 / 8  # share of the differences to six neighbours that a step takes away, at most: with more than a sixth they would grow


class RayBundle(NamedTuple):
    """Rays that are sampled: origins and directions (R, 3); near, far and offset (R,)."""

    origins: Any
    directions: Any
    near: Any
    far: Any
    offset: Any


class SampleColumns(NamedTuple):
    """start, extent, length (N,) and point (N, 3) of Samples."""

    start: Any
    extent: Any
    length: Any
    point: Any


class PixelTables(NamedTuple):
    """What the rays of pixels are made of; C views, their pixels end to end, row by row."""

    lookup: Any  # (K, 3) unit directions in the camera at every `stride`-th pixel, the tables of all lenses end to end
    lens: Any  # (C,) first entry of each view in `lookup`
    knots: Any  # (C,) entries of a row
    offsets: Any  # (C + 1,) first pixel of each view
    width: Any  # (C,) pixels of a row
    rotation: Any  # (C, 3, 3) camera to world
    centre: Any  # (C, 3)
    near: Any  # (C,) along the view axis
    far: Any


class RayTargets(NamedTuple):
    """Supervision of rays. With c and a the premultiplied colour and the opacity that the tree gives a ray, its loss is

        sum over channels of (transmittance (c + (1 - a) background) - colour)^2  +  opacity_weight (a - opacity)^2

    Gradients are of this and, for each ray and channel of a full patch of SSIM_WINDOW x SSIM_WINDOW rays, of  structure (1 - SSIM)  of the patch.
    """

    colour: Any  # (R, 3) of the photograph, less the colour of what lies in front of the box
    background: Any  # (R, 3) colour of what lies behind the box
    transmittance: Any  # (R,)   of what lies in front of the box
    opacity: Any  # (R,)   of the photograph
    opacity_weight: float  # of the opacity's error
    structure: float = 0.0  # weight of 1 - SSIM


class Moments(NamedTuple):
    """Running means of the squared gradients by the logarithm of the optical thickness (N,) and by the coefficients (N,), and the number of steps that met a
    voxel (N,) int32."""

    square_density: Any
    square_sh: Any
    visits: Any


class Hyperparameters(NamedTuple):
    """Of a step."""

    density_rate: float  # learning rate of the logarithm of the optical thickness
    sh_rate: float  # learning rate of the harmonics
    view_share: float  # of that for harmonics of degree 1 and above
    decay: float = 0.99  # of the running mean of the squared gradient
    epsilon: float = 1e-10  # added to its root
    total_variation: float = 0.0  # weight of this term of `efficientnerf.backends.numba.tree_training.steps`
