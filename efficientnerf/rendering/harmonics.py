"""Real spherical harmonics up to degree 4: the directions' only way into a colour, which is what makes baking possible.

Constants and signs are PlenOctree's (Yu et al. 2021), ordered l = 0, m = 0; l = 1, m = -1, 0, 1; ...
With them the basis is orthonormal over the unit sphere. Colour = sigmoid(sum_k c_k Y_k(d)).
K harmonics = (degree + 1)^2.
"""

import math

import numpy as np
import torch
from torch import Tensor

MAX_DEGREE = 4

C0 = 0.5 * math.sqrt(1 / math.pi)
C1 = math.sqrt(3 / (4 * math.pi))
C2 = (
    0.5 * math.sqrt(15 / math.pi),
    -0.5 * math.sqrt(15 / math.pi),
    0.25 * math.sqrt(5 / math.pi),
    -0.5 * math.sqrt(15 / math.pi),
    0.25 * math.sqrt(15 / math.pi),
)
C3 = (
    -0.25 * math.sqrt(35 / (2 * math.pi)),
    0.5 * math.sqrt(105 / math.pi),
    -0.25 * math.sqrt(21 / (2 * math.pi)),
    0.25 * math.sqrt(7 / math.pi),
    -0.25 * math.sqrt(21 / (2 * math.pi)),
    0.25 * math.sqrt(105 / math.pi),
    -0.25 * math.sqrt(35 / (2 * math.pi)),
)
C4 = (
    0.75 * math.sqrt(35 / math.pi),
    -0.75 * math.sqrt(35 / (2 * math.pi)),
    0.75 * math.sqrt(5 / math.pi),
    -0.75 * math.sqrt(5 / (2 * math.pi)),
    3 / 16 * math.sqrt(1 / math.pi),
    -0.75 * math.sqrt(5 / (2 * math.pi)),
    3 / 8 * math.sqrt(5 / math.pi),
    -0.75 * math.sqrt(35 / (2 * math.pi)),
    3 / 16 * math.sqrt(35 / math.pi),
)


def harmonics_count(degree: int) -> int:
    """K, how many harmonics there are up to `degree` (0 to 4)."""
    if not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"spherical harmonics of degree {degree}: expected 0 to {MAX_DEGREE}")
    return (degree + 1) ** 2


def _terms(x, y, z, degree: int) -> list:  # type: ignore[no-untyped-def]
    """The K polynomials at a unit direction; works on tensors and on arrays alike."""
    out = [C0 + 0 * x]
    if degree > 0:
        out += [-C1 * y, C1 * z, -C1 * x]
    if degree > 1:
        xx, yy, zz = x * x, y * y, z * z
        out += [C2[0] * x * y, C2[1] * y * z, C2[2] * (2 * zz - xx - yy), C2[3] * x * z, C2[4] * (xx - yy)]
    if degree > 2:
        out += [
            C3[0] * y * (3 * xx - yy),
            C3[1] * x * y * z,
            C3[2] * y * (4 * zz - xx - yy),
            C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
            C3[4] * x * (4 * zz - xx - yy),
            C3[5] * z * (xx - yy),
            C3[6] * x * (xx - 3 * yy),
        ]
    if degree > 3:
        out += [
            C4[0] * x * y * (xx - yy),
            C4[1] * y * z * (3 * xx - yy),
            C4[2] * x * y * (7 * zz - 1),
            C4[3] * y * z * (7 * zz - 3),
            C4[4] * (zz * (35 * zz - 30) + 3),
            C4[5] * x * z * (7 * zz - 3),
            C4[6] * (xx - yy) * (7 * zz - 1),
            C4[7] * x * z * (xx - 3 * yy),
            C4[8] * (xx * (xx - 3 * yy) - yy * (3 * xx - yy)),
        ]
    return out


def basis(directions: Tensor, degree: int) -> Tensor:
    """The harmonics at unit directions.

    directions (R, 3) unit vectors
    returns    (R, K)
    """
    harmonics_count(degree)
    x, y, z = directions.unbind(-1)
    return torch.stack(_terms(x, y, z, degree), dim=-1)


def basis_numpy(directions: np.ndarray, degree: int) -> np.ndarray:
    """`basis` for arrays: (R, 3) to (R, K), same dtype."""
    harmonics_count(degree)
    return np.stack(_terms(directions[..., 0], directions[..., 1], directions[..., 2], degree), axis=-1)


def squared_slopes(degree: int) -> np.ndarray:
    """(K,) mean over the sphere of the square of what Y_k changes per radian that a direction moves, for moves to any side: l (l + 1) / (8 pi)."""
    return np.array([band * (band + 1) / (8 * np.pi) for band in range(degree + 1) for _ in range(2 * band + 1)])
