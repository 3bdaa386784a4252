"""A small ReLU network on the CPU, all layers of a block of samples in one go (numba, all cores): forward, and the gradients of weights and features.

Mueller et al. 2021, "Real-time neural radiance caching", keep a block's activations in a GPU's shared memory; here they stay in a core's own caches, and
sums of products in its registers (`efficientnerf.backends.numba.tiles`). What torch would do with the same layers one after the other goes through memory
between any two, and its threads wait for each other after each.

Samples are cut into the same chunks and blocks however many threads there are, and sums over chunks are taken in their order: the bytes do not depend on
the number of threads.

Numbers inside are float32, or bfloat16 with sums in float32; weights, gradients and whatever comes in or goes out are float32. Widths are filled up with
zeros to whole vectors: I inputs, L layers of H, and O outputs have K, W and V columns.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.simd import pointer
from efficientnerf.backends.numba.tiles import LANES, ROWS, narrowed, pairs_of_rows, product, product_added, product_masked, product_relu, put_narrowed, turn

BLOCK = 64  # samples that go through all layers together: 8 KiB of bfloat16 a layer of 64
CHUNK = 2048  # samples, at least, that share sums of gradients
CHUNKS = 32  # at most, so that sums of gradients stay small beside the activations


class Weights(NamedTuple):
    """Of a network, as `product` wants them: what stands along the sum in rows, in pairs where numbers are bfloat16.

    first, middle, last                 (K', W), (L - 1, W', W), (W', V) for the way forward
    first_back, middle_back, last_back  (W', K), (L - 1, W', W), (V', W) for the way back
    """

    first: np.ndarray
    middle: np.ndarray
    last: np.ndarray
    first_back: np.ndarray
    middle_back: np.ndarray
    last_back: np.ndarray


def _up(count: int, step: int = LANES) -> int:
    return -(-count // step) * step


@numba.njit(cache=True, error_model="numpy")
def _put_weight(weight, per, forward, back):  # type: ignore[no-untyped-def]
    """weight (O, I) for both ways; `per` numbers are in a word."""
    outputs, inputs = weight.shape
    filled = np.zeros((per * len(back), back.shape[1]), np.float32)
    filled[:outputs, :inputs] = weight
    pairs_of_rows(pointer(filled), 0, back.shape[1], back.shape[1], pointer(back), len(back), back.shape[1])
    turned = np.zeros((per * len(forward), forward.shape[1]), np.float32)
    turned[:inputs, :outputs] = weight.T
    pairs_of_rows(pointer(turned), 0, forward.shape[1], forward.shape[1], pointer(forward), len(forward), forward.shape[1])


def pack_weights(weights: list[np.ndarray], bfloat16: bool) -> Weights:
    """Weights (O, I) float32 of all layers, of which there are two at least."""
    word, per = (np.int32, 2) if bfloat16 else (np.float32, 1)
    inputs, hidden, outputs = weights[0].shape[1], len(weights[0]), len(weights[-1])
    k, w, v, middle = _up(inputs), _up(hidden, LANES * per), _up(outputs), len(weights) - 2
    shapes = ((_up(inputs, 2) // per, w), (middle, w // per, w), (w // per, v), (w // per, k), (middle, w // per, w), (v // per, w))
    made = Weights(*(np.empty(shape, word) for shape in shapes))
    _put_weight(weights[0], per, made.first, made.first_back)
    for weight, forward, back in zip(weights[1:-1], made.middle, made.middle_back, strict=True):
        _put_weight(weight, per, forward, back)
    _put_weight(weights[-1], per, made.last, made.last_back)
    return made


@numba.njit(cache=True, error_model="numpy")
def _corner(x, row, column, height, width, out):  # type: ignore[no-untyped-def]
    """x[row : row + height, column : column + width], the top left of out; the rest zeros."""
    out[:] = 0
    for i in range(height):
        for j in range(width):
            out[i, j] = x[row + i, column + j]


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _forward(features, first, middle, last, offset, half, chunk, kept, out):  # type: ignore[no-untyped-def]
    """kept  (L, N up to whole blocks, W) for the way back; (L, 0, W) keeps nothing."""
    (inputs, samples), outputs = features.shape, out.shape[1]
    layers, width, wide = len(middle) + 1, first.shape[1], last.shape[1]
    per = 2 if half.itemsize == 2 else 1
    filled, words, keep = len(first), len(last), kept.shape[1] > 0
    p_features, p_first, p_middle, p_last, p_out = pointer(features), pointer(first), pointer(middle), pointer(last), pointer(out)
    for task in numba.prange((samples + chunk - 1) // chunk):
        columns, x = np.empty((filled * per, BLOCK), np.float32), np.empty((filled, BLOCK), first.dtype)
        scratch, shown = np.empty((2, BLOCK, width), half.dtype), np.empty((BLOCK, wide), np.float32)
        p_columns, p_x, p_shown, p_y = pointer(columns), pointer(x), pointer(shown), pointer(kept) if keep else pointer(scratch)
        for begin in range(task * chunk, min(samples, (task + 1) * chunk), BLOCK):
            count = min(BLOCK, samples - begin)
            if count == BLOCK and inputs == filled * per:
                pairs_of_rows(p_features, begin, samples, BLOCK, p_x, filled, BLOCK)
            else:
                _corner(features, 0, begin, inputs, count, columns)
                pairs_of_rows(p_columns, 0, BLOCK, BLOCK, p_x, filled, BLOCK)
            at = begin * width if keep else 0
            product_relu(p_x, 0, 1, BLOCK, p_first, 0, width, filled, p_y, at, width, BLOCK, width)
            for layer in range(layers - 1):
                to = at + kept.shape[1] * width if keep else BLOCK * width - at
                product_relu(p_y, at // per, words, 1, p_middle, layer * words * width, width, words, p_y, to, width, BLOCK, width)
                at = to
            product(p_y, at // per, words, 1, p_last, 0, wide, words, p_shown, 0, wide, BLOCK, wide)
            # Whole vectors reach into the next row, which is written next, if it is one of this block's.
            for n in range(count):
                shown[n, 0] += offset
            for n in range(count - wide // outputs):
                for column in range(0, wide, LANES):
                    put_narrowed(p_shown, n * wide + column, LANES, p_out, (begin + n) * outputs + column)
            for n in range(max(0, count - wide // outputs), count):
                for column in range(outputs):
                    out[begin + n, column] = shown[n, column]


@numba.njit(cache=True, error_model="numpy")
def _through(p_above, at, p_above_pairs, outputs, p_kept, there, p_below_pairs, p_weight, weight, p_of_weight, place, p_pull, to, width, per):  # type: ignore[no-untyped-def]
    """Back through a layer of `width` inputs: adds to the gradient of its weights, and hands on the pull on what the ReLU below it gave."""
    pairs, words = BLOCK // per, outputs // per
    pairs_of_rows(p_kept, there, width, width, p_below_pairs, pairs, width)
    product_added(p_above_pairs, 0, 1, outputs, p_below_pairs, 0, width, pairs, p_of_weight, place, width, outputs, width)
    product_masked(p_above, at // per, words, 1, p_weight, weight, width, words, p_pull, to, width, BLOCK, width, p_kept, there)


@numba.njit(cache=True, error_model="numpy")
def _to_features(p_pull, at, words, p_across, p_first, deep, p_to, place, row, inputs):  # type: ignore[no-untyped-def]
    """The pull on features, whose samples are neighbours, from that on the first layer's outputs, whose outputs are."""
    for i in range(0, words, LANES):
        for n in range(0, BLOCK, LANES):
            turn(p_pull, at + n * words + i, words, p_across, i * BLOCK + n, BLOCK)
    product(p_first, 0, 1, deep, p_across, 0, BLOCK, words, p_to, place, row, inputs, BLOCK)


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _backward(grad, features, first_back, middle_back, last_back, half, chunk, kept, of_first, of_middle, of_last, of_features):  # type: ignore[no-untyped-def]
    """of_first (C, I up to ROWS, W), of_middle (C, L - 1, W, W), of_last (C, V, W): of the weights, turned in the first, for each chunk."""
    (inputs, samples), outputs = features.shape, grad.shape[1]
    layers, width, wide, deep = len(middle_back) + 1, last_back.shape[1], of_last.shape[1], first_back.shape[1]
    per = 2 if half.itemsize == 2 else 1
    words, pairs, filled, ahead = width // per, BLOCK // per, of_first.shape[1], kept.shape[1] * width
    p_grad, p_features, p_kept, p_to = pointer(grad), pointer(features), pointer(kept), pointer(of_features)
    p_first, p_middle, p_last = pointer(first_back), pointer(middle_back), pointer(last_back)
    p_of_first, p_of_middle, p_of_last = pointer(of_first), pointer(of_middle), pointer(of_last)
    for task in numba.prange((samples + chunk - 1) // chunk):
        columns, x = np.empty((filled, BLOCK), np.float32), np.empty((filled, BLOCK), half.dtype)
        given, above, above_pairs = np.empty((BLOCK, wide), np.float32), np.empty((BLOCK, wide), half.dtype), np.empty((pairs, wide), first_back.dtype)
        pull, across = np.empty((2, BLOCK, width), half.dtype), np.empty((words, BLOCK), first_back.dtype)
        pull_pairs, layer_pairs = np.empty((pairs, width), first_back.dtype), np.empty((pairs, width), first_back.dtype)
        p_columns, p_x, p_given, p_above, p_pull, p_across = pointer(columns), pointer(x), pointer(given), pointer(above), pointer(pull), pointer(across)
        p_above_pairs, p_pairs, p_layer = pointer(above_pairs), pointer(pull_pairs), pointer(layer_pairs)
        of_first[task], of_middle[task], of_last[task] = 0, 0, 0
        for begin in range(task * chunk, min(samples, (task + 1) * chunk), BLOCK):
            count = min(BLOCK, samples - begin)
            # Whole vectors reach beyond a row of the gradient, and beyond the last one there is nothing to be read.
            p_from, start, row = p_grad, begin * outputs, outputs
            if begin + BLOCK + wide // outputs >= samples:
                _corner(grad, begin, 0, count, outputs, given)
                p_from, start, row = p_given, 0, wide
            narrowed(p_from, start, row, outputs, p_above, BLOCK, wide)
            pairs_of_rows(p_from, start, row, outputs, p_above_pairs, pairs, wide)
            there, at, place = (layers - 1) * ahead + begin * width, 0, task * wide * width
            _through(p_above, 0, p_above_pairs, wide, p_kept, there, p_layer, p_last, 0, p_of_last, place, p_pull, at, width, per)
            pairs_of_rows(p_pull, at, width, width, p_pairs, pairs, width)
            for layer in range(layers - 2, -1, -1):
                there, to = layer * ahead + begin * width, BLOCK * width - at
                place, weight = (task * (layers - 1) + layer) * width * width, layer * words * width
                _through(p_pull, at, p_pairs, width, p_kept, there, p_layer, p_middle, weight, p_of_middle, place, p_pull, to, width, per)
                at = to
                pairs_of_rows(p_pull, at, width, width, p_pairs, pairs, width)
            p_from, start, row = p_features, begin, samples
            whole = count == BLOCK and inputs == filled
            if not whole:
                _corner(features, 0, begin, inputs, count, columns)
                p_from, start, row = p_columns, 0, BLOCK
            narrowed(p_from, start, row, BLOCK, p_x, filled, BLOCK)
            product_added(p_x, 0, pairs, 1, p_pairs, 0, width, pairs, p_of_first, task * filled * width, width, filled, width)
            if whole:
                _to_features(p_pull, at // per, words, p_across, p_first, deep, p_to, begin, samples, filled)
                continue
            _to_features(p_pull, at // per, words, p_across, p_first, deep, p_columns, 0, BLOCK, filled)
            for i in range(inputs):
                for n in range(count):
                    of_features[i, begin + n] = columns[i, n]


def _chunk(samples: int) -> int:
    return _up(max(CHUNK, -(-samples // CHUNKS)), BLOCK)


def forward(features: np.ndarray, weights: Weights, offset: float, out: np.ndarray, *, keep: bool) -> np.ndarray:
    """out (N, O): the last layer's outputs for features (I, N), `offset` added to the first; returns what `backward` needs, if that is kept."""
    half = np.empty(0, np.int16 if weights.first.dtype == np.int32 else np.float32)
    samples = features.shape[1]
    kept = np.empty((len(weights.middle) + 1, _up(samples, BLOCK) if keep else 0, weights.first.shape[1]), half.dtype)
    _forward(features, weights.first, weights.middle, weights.last, np.float32(offset), half, _chunk(samples), kept, out)
    return kept


def backward(grad: np.ndarray, features: np.ndarray, weights: Weights, kept: np.ndarray, shapes: list[tuple[int, int]]) -> tuple[np.ndarray, list[np.ndarray]]:
    """Gradients of features (I, N) and of weights (O, I) from that of the outputs (N, O)."""
    half = np.empty(0, kept.dtype)
    samples, chunk = features.shape[1], _chunk(features.shape[1])
    chunks, width = -(-samples // chunk), kept.shape[2]
    of_first = np.empty((chunks, _up(len(features), ROWS), width), np.float32)
    of_middle = np.empty((chunks, len(weights.middle), width, width), np.float32)
    of_last = np.empty((chunks, weights.last.shape[1], width), np.float32)
    of_features = np.empty_like(features)
    back = weights.first_back, weights.middle_back, weights.last_back
    _backward(grad, features, *back, half, chunk, kept, of_first, of_middle, of_last, of_features)
    sums = [of_first.sum(axis=0).T, *of_middle.sum(axis=0), of_last.sum(axis=0)]
    return of_features, [np.ascontiguousarray(total[:outputs, :inputs]) for total, (outputs, inputs) in zip(sums, shapes, strict=True)]
