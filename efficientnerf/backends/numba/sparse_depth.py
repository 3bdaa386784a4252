"""What the sparse depth loss is a mean of, on the CPU (numba, all cores): forward and backward; the reference is `efficientnerf.backends.torch.sparse_depth`.

The operations and their order are the reference's, so that both give the same bytes. R rays, A of them aimed at sparse points, N samples.
"""

import numpy as np

from efficientnerf.backends.numba.runtime import PRANGE, numba
from efficientnerf.backends.torch.sparse_depth import LEAST_LIGHT

BLOCK = 64  # rays per task


@numba.njit(cache=True, inline="always", error_model="numpy")
def _past(n, start, extent, distance, width):
    """How far behind the point the middle of sample n lies, in widths."""
    return (start[n] + extent[n] / np.float32(2) - distance) / max(width * extent[n], np.float32(1e-12))


@numba.njit(cache=True, inline="always", error_model="numpy")
def _light(begin, end, weight, start, extent, distance, width):
    """Of a ray's samples: the light that reaches the point, and the weight that ends at it."""
    before = ending = np.float32(0)
    for n in range(begin, end):
        past = _past(n, start, extent, distance, width)
        if past <= np.float32(-1):
            before += weight[n]
        elif abs(past) < np.float32(1):
            ending += weight[n]
    return np.float32(1) - before, ending


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def sparse_depth_errors(weight, start, extent, first, distance, on_support, width, out):
    """`efficientnerf.backends.torch.sparse_depth.sparse_depth_errors` into out (A,)."""
    zero, one, rays, before = np.float32(0), np.float32(1), len(distance), len(first) - 1 - len(distance)
    for block in numba.prange((rays + BLOCK - 1) // BLOCK):
        for a in range(block * BLOCK, min(rays, (block + 1) * BLOCK)):
            begin, end = first[before + a], first[before + a + 1]
            if on_support[a]:
                reaching, ending = _light(begin, end, weight, start, extent, distance[a], width)
                out[a] = max(reaching, zero) * (one - ending / max(reaching, np.float32(LEAST_LIGHT)))
                continue
            near = zero
            for n in range(begin, end):
                near += weight[n] * max(one - abs(_past(n, start, extent, distance[a], width)), zero)
            out[a] = one - near


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def sparse_depth_errors_backward(grad, weight, start, extent, first, distance, on_support, width, grad_weight):
    """Gradient of the weights (N,), zero before, from grad (A,)."""
    zero, one, least, rays, before = np.float32(0), np.float32(1), np.float32(LEAST_LIGHT), len(distance), len(first) - 1 - len(distance)
    for block in numba.prange((rays + BLOCK - 1) // BLOCK):
        for a in range(block * BLOCK, min(rays, (block + 1) * BLOCK)):
            begin, end = first[before + a], first[before + a + 1]
            if on_support[a]:
                reaching, ending = _light(begin, end, weight, start, extent, distance[a], width)
                light, share = max(reaching, least), -(grad[a] * max(reaching, zero))
                of_ending, of_before = share / light, share * ((ending / light) / light) if reaching >= least else zero
                for n in range(begin, end):
                    past = _past(n, start, extent, distance[a], width)
                    grad_weight[n] = of_before if past <= -one else (of_ending if abs(past) < one else zero)
                continue
            for n in range(begin, end):
                grad_weight[n] = -grad[a] * max(one - abs(_past(n, start, extent, distance[a], width)), zero)
