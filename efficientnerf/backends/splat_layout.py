"""What the rasterisers of numba and of Triton agree on: rows of numbers, limits, and structures that both take. Imports nothing heavy."""

from typing import NamedTuple

import numpy as np

MEAN, SCALE, ROTATION, OPACITY, HARMONICS = 0, 3, 6, 10, 11  # of a Gaussian's values: logarithms of scales, logit of the opacity; harmonics by coefficient
X, Y, CONIC_A, CONIC_B, CONIC_C, ALPHA, RED, WIDTH, HEIGHT, DEPTH, REACH = 0, 1, 2, 3, 4, 5, 6, 9, 10, 11, 12  # of a projected Gaussian
RECORD = 16  # numbers of one
SUMS = 16  # numbers that gradients follow from, see `efficientnerf.backends.numba.splats.raster`
ERROR = 9  # of them: the squared error where the Gaussian shows, times its weight
PARTS = 6  # mean, scales, rotation, opacity, base colour, other harmonics
VISITS, SQUARES, GRADIENTS = 0, 1, 1 + PARTS  # of a Gaussian's moments: steps taken; running means of squares; running means of gradients
TILE = 16  # pixels along a side of one
LANES = 16  # Gaussians of a group
DRAWS = 2**16  # numbers of noise that are drawn at once; those of a step begin at any of them
LOW_PASS = np.float32(0.3)  # square pixels that covariances in the image grow by
LEAST_ALPHA, MOST_ALPHA = np.float32(1 / 255), np.float32(0.99)
LEAST_TRANSMITTANCE = np.float32(1e-4)
MOST_LOG_SCALE = np.float32(40)
# ln o <= 8 (o^(1/8) - 1): beyond REACH_255 + 16 (o^(1/8) - 1) squared standard deviations alpha is below LEAST_ALPHA
REACH_255 = np.float32(2 * 5.5412637)


class Lens(NamedTuple):
    """A camera as kernels take it; width and height are those of its picture."""

    turn: np.ndarray  # (9,) float32, rows of the rotation from the world to the camera
    centre: np.ndarray  # (3,) float32
    # (16,) float32: fx fy cx cy; k1 k2 k3 k4 over k4 k5 k6 (of a fisheye k1..k4 over nothing); p1 p2; squared radius at which the lens folds back, on the
    # undistorted plane; nearest depth; 0
    numbers: np.ndarray
    limits: np.ndarray  # (4,) float32: least and greatest u, least and greatest v on the undistorted plane at which derivatives are taken
    fisheye: bool  # whether the undistorted plane is that of angles
    width: int
    height: int


class Picture(NamedTuple):
    """What an image is compared with: pixels (H, W, 4) uint8, straight alpha, and mask (H, W) uint8, 0 where a pixel does not count."""

    pixels: np.ndarray
    mask: np.ndarray
    over_all: bool  # whether it is compared over all backgrounds at once, as a picture with alpha; else over `background` (3,) float32, and alpha is not read
    background: np.ndarray
    # weight of 1 - SSIM in the error of a pixel's channel, over grey or `background`; of windows of SSIM_WINDOW x SSIM_WINDOW pixels that all count, next to
    # each other from the corner on (`efficientnerf.backends.layout`)
    structure: np.float32
    # Of a pixel whose channels have the squared error e, delta^2 (sqrt(1 + e / delta^2) - 1) is minimised, the pseudo-Huber loss; infinite: half of e
    huber_delta: np.float32


class Rates(NamedTuple):
    """Of a step."""

    # (PARTS,) float32 learning rates: of means, in standard deviations along the longest axis; of logarithms of scales; of quaternions; of logits; of
    # colours' base and of their other harmonics
    rates: np.ndarray
    # momentum, decay: of the running means of gradients and of their squares
    momentum: np.float32
    decay: np.float32
    epsilon: np.float32  # added to the root of the latter
    # of_mean, of_square: (V,) float32: 1 / (1 - momentum^n) and 1 / (1 - decay^n) after n steps, the last for all beyond
    of_mean: np.ndarray
    of_square: np.ndarray
    # What 3DGS-MCMC calls regularisers: `fade` is taken from the logits of what is in the image; its means are moved by normal noise, in longest standard
    # deviations `noise` large: three times LANES numbers for a group, of `draws` (DRAWS + 3 LANES,) float32, from `shift` on
    fade: np.float32
    noise: np.float32
    draws: np.ndarray
    shift: int
    # least, greatest: logarithms of the scales
    least: np.float32
    greatest: np.float32


class SplatState(NamedTuple):
    """Gaussians that are fitted, on the host, float32."""

    rows: np.ndarray  # (N, 11 + 3 K) values
    moments: np.ndarray  # (N, GRADIENTS + 11 + 3 K)
    errors: np.ndarray  # (N,) the squared errors of all steps where each shows, times its weight
