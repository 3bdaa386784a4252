"""A fully fused ReLU MLP on the CPU (numba, all cores): forward, and the gradients of weights and inputs.

All layers of a block of samples are evaluated before the next block (Mueller et al. 2021, "Real-time neural radiance caching", whose activations stay in a
GPU's shared memory): activations stay in a core's caches and sums in registers (`efficientnerf.backends.numba.vector.products`).

Samples are split into the same chunks and blocks on any number of threads, and sums over chunks are taken in order: results do not depend on the number of
threads.

Inside, numbers are float32, or bfloat16 with float32 accumulators; weights, inputs, outputs and gradients are float32. Widths are padded with zeros to whole
vectors: I inputs, L hidden layers of H, and O outputs become K, W and V columns. N samples.
"""

from typing import NamedTuple

import numpy as np

from efficientnerf.backends.numba.runtime import PRANGE, numba
from efficientnerf.backends.numba.vector.memory import hold, pointer
from efficientnerf.backends.numba.vector.products import (
    LANES,
    ROWS,
    Matrix,
    Rows,
    copy16,
    copy_rows,
    pack_row_pairs,
    product,
    product_added,
    product_masked,
    product_relu,
    transpose16,
)

BLOCK = 64  # samples that pass all layers together: 8 KiB of bfloat16 for a layer of 64
CHUNK = 2048  # samples per partial sum of the weights' gradients, at least
MAX_CHUNKS = 32  # bounds the memory of the partial sums


class PackedWeights(NamedTuple):
    """Weights in the layouts that `product` reads: the dimension of the sum along rows, as int32 pairs where numbers are bfloat16."""

    # first, middle, last: (K', W), (L - 1, W', W), (W', V) for the forward pass; K' = K / elements per word, and so on
    first: np.ndarray
    middle: np.ndarray
    last: np.ndarray
    # first_back, middle_back, last_back: (W', K), (L - 1, W', W), (V', W) for the backward pass
    first_back: np.ndarray
    middle_back: np.ndarray
    last_back: np.ndarray


def _round_up(count: int, step: int = LANES) -> int:
    return -(-count // step) * step


@numba.njit(cache=True, error_model="numpy")
def _pack_weight(weight, per_word, forward, back):
    """weight (O, I) into the layouts of both passes."""
    outputs, inputs = weight.shape
    padded = np.zeros((per_word * len(back), back.shape[1]), np.float32)
    transposed = np.zeros((per_word * len(forward), forward.shape[1]), np.float32)
    for o in range(outputs):  # assignments to slices take seconds to compile
        for i in range(inputs):
            padded[o, i] = transposed[i, o] = weight[o, i]
    pack_row_pairs(Rows(pointer(padded), 0, back.shape[1]), back.shape[1], pointer(back), len(back), back.shape[1])
    pack_row_pairs(Rows(pointer(transposed), 0, forward.shape[1]), forward.shape[1], pointer(forward), len(forward), forward.shape[1])
    hold((padded, transposed))


def pack_weights(weights: list[np.ndarray], bfloat16: bool) -> PackedWeights:
    """Packed weights of layers (O, I) float32, of which there are at least two."""
    word, per_word = (np.int32, 2) if bfloat16 else (np.float32, 1)
    inputs, hidden, outputs = weights[0].shape[1], len(weights[0]), len(weights[-1])
    k, w, v, middle = _round_up(inputs), _round_up(hidden, LANES * per_word), _round_up(outputs), len(weights) - 2
    shapes = (
        (_round_up(inputs, 2) // per_word, w), (middle, w // per_word, w), (w // per_word, v),
        (w // per_word, k), (middle, w // per_word, w), (v // per_word, w),
    )  # fmt: skip
    packed = PackedWeights(*(np.empty(shape, word) for shape in shapes))
    _pack_weight(weights[0], per_word, packed.first, packed.first_back)
    for weight, forward, back in zip(weights[1:-1], packed.middle, packed.middle_back, strict=True):
        _pack_weight(weight, per_word, forward, back)
    _pack_weight(weights[-1], per_word, packed.last, packed.last_back)
    return packed


@numba.njit(cache=True, error_model="numpy")
def _copy_block(x, row, column, height, width, out):
    """x[row : row + height, column : column + width] into the top left of out; zeros elsewhere."""
    out[:] = 0
    for i in range(height):
        for j in range(width):
            out[i, j] = x[row + i, column + j]


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def _forward(inputs, first, middle, last, offset, element, chunk, activations, out):
    """activations  (L, N rounded up to blocks, W) of the hidden layers, for the backward pass; (L, 0, W) keeps none
    element      an empty array of the activations' type
    """
    (features, samples), outputs = inputs.shape, out.shape[1]
    layers, width, padded_outputs = len(middle) + 1, first.shape[1], last.shape[1]
    per_word = 2 if element.itemsize == 2 else 1
    input_words, words, keep = len(first), len(last), activations.shape[1] > 0
    p_inputs, p_first, p_middle, p_last, p_out = pointer(inputs), pointer(first), pointer(middle), pointer(last), pointer(out)
    for task in numba.prange((samples + chunk - 1) // chunk):
        block_inputs, x = np.empty((input_words * per_word, BLOCK), np.float32), np.empty((input_words, BLOCK), first.dtype)
        scratch, block_out = np.empty((2, BLOCK, width), element.dtype), np.empty((BLOCK, padded_outputs), np.float32)
        p_block_inputs, p_x, p_block_out = pointer(block_inputs), pointer(x), pointer(block_out)
        p_y = pointer(activations) if keep else pointer(scratch)
        for begin in range(task * chunk, min(samples, (task + 1) * chunk), BLOCK):
            count = min(BLOCK, samples - begin)
            if count == BLOCK and features == input_words * per_word:
                pack_row_pairs(Rows(p_inputs, begin, samples), BLOCK, p_x, input_words, BLOCK)
            else:
                _copy_block(inputs, 0, begin, features, count, block_inputs)
                pack_row_pairs(Rows(p_block_inputs, 0, BLOCK), BLOCK, p_x, input_words, BLOCK)
            at = begin * width if keep else 0
            product_relu(Matrix(p_x, 0, 1, BLOCK), Rows(p_first, 0, width), Rows(p_y, at, width), input_words, BLOCK, width)
            for layer in range(layers - 1):
                to = at + activations.shape[1] * width if keep else BLOCK * width - at
                weight = Rows(p_middle, layer * words * width, width)
                product_relu(Matrix(p_y, at // per_word, words, 1), weight, Rows(p_y, to, width), words, BLOCK, width)
                at = to
            last_rows, out_rows = Rows(p_last, 0, padded_outputs), Rows(p_block_out, 0, padded_outputs)
            product(Matrix(p_y, at // per_word, words, 1), last_rows, out_rows, words, BLOCK, padded_outputs)
            # Whole vectors reach into the next row, which is written after this one if it belongs to the block.
            for n in range(count):
                block_out[n, 0] += offset
            for n in range(count - padded_outputs // outputs):
                for column in range(0, padded_outputs, LANES):
                    copy16(p_block_out, n * padded_outputs + column, LANES, p_out, (begin + n) * outputs + column)
            for n in range(max(0, count - padded_outputs // outputs), count):
                for column in range(outputs):
                    out[begin + n, column] = block_out[n, column]
        hold((block_inputs, x, scratch, block_out))


@numba.njit(cache=True, error_model="numpy")
def _layer_backward(grad_out, grad_out_pairs, activations, activation_pairs, weight, grad_weight, grad_in, per_word):
    """Adds the gradient of a layer's weights to `grad_weight`, and writes that of its inputs, the ReLU's `activations`, to `grad_in`.

    All are Rows, but grad_out_pairs and activation_pairs: pointers to the gradient of the outputs as pairs of samples, and to scratch.
    """
    pairs, outputs, width = BLOCK // per_word, grad_out.row, grad_in.row
    words = outputs // per_word
    pack_row_pairs(activations, width, activation_pairs, pairs, width)
    product_added(Matrix(grad_out_pairs, 0, 1, outputs), Rows(activation_pairs, 0, width), grad_weight, pairs, outputs, width)
    grad_words = Matrix(grad_out.data, grad_out.start // per_word, words, 1)
    product_masked(grad_words, weight, grad_in, words, BLOCK, width, activations.data, activations.start)


@numba.njit(cache=True, error_model="numpy")
def _grad_inputs(grad, words, transposed, weight, out, features):
    """Gradient of the inputs, by feature, from that of the first layer's outputs, by sample; `transposed` is scratch."""
    for i in range(0, words, LANES):
        for n in range(0, BLOCK, LANES):
            transpose16(grad.data, grad.start + n * words + i, words, transposed, i * BLOCK + n, BLOCK)
    product(Matrix(weight.data, weight.start, 1, weight.row), Rows(transposed, 0, BLOCK), out, words, features, BLOCK)


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def _backward(grad, inputs, first_back, middle_back, last_back, element, chunk, activations, grad_first, grad_middle, grad_last, grad_inputs):
    """grad_first (C, I rounded up to ROWS, W), grad_middle (C, L - 1, W, W), grad_last (C, V, W): of the weights for each chunk, the first transposed."""
    (features, samples), outputs = inputs.shape, grad.shape[1]
    layers, width, padded_outputs, padded_inputs = len(middle_back) + 1, last_back.shape[1], grad_last.shape[1], first_back.shape[1]
    per_word = 2 if element.itemsize == 2 else 1
    words, pairs, rows, layer_stride = width // per_word, BLOCK // per_word, grad_first.shape[1], activations.shape[1] * width
    p_grad, p_inputs, p_activations, p_grad_inputs = pointer(grad), pointer(inputs), pointer(activations), pointer(grad_inputs)
    p_first, p_middle, p_last = pointer(first_back), pointer(middle_back), pointer(last_back)
    p_grad_first, p_grad_middle, p_grad_last = pointer(grad_first), pointer(grad_middle), pointer(grad_last)
    for task in numba.prange((samples + chunk - 1) // chunk):
        block_inputs, x = np.empty((rows, BLOCK), np.float32), np.empty((rows, BLOCK), element.dtype)
        block_grad, out_grad = np.empty((BLOCK, padded_outputs), np.float32), np.empty((BLOCK, padded_outputs), element.dtype)
        out_grad_pairs = np.empty((pairs, padded_outputs), first_back.dtype)
        hidden_grad, transposed = np.empty((2, BLOCK, width), element.dtype), np.empty((words, BLOCK), first_back.dtype)
        hidden_grad_pairs, activation_pairs = np.empty((pairs, width), first_back.dtype), np.empty((pairs, width), first_back.dtype)
        p_block_inputs, p_x, p_block_grad, p_out_grad = pointer(block_inputs), pointer(x), pointer(block_grad), pointer(out_grad)
        p_out_grad_pairs, p_hidden, p_transposed = pointer(out_grad_pairs), pointer(hidden_grad), pointer(transposed)
        p_hidden_pairs, p_activation_pairs = pointer(hidden_grad_pairs), pointer(activation_pairs)
        grad_first[task], grad_middle[task], grad_last[task] = 0, 0, 0
        for begin in range(task * chunk, min(samples, (task + 1) * chunk), BLOCK):
            count = min(BLOCK, samples - begin)
            # Whole vectors reach beyond a row of the gradient, and beyond the last one nothing may be read.
            grad_rows = Rows(p_grad, begin * outputs, outputs)
            if begin + BLOCK + padded_outputs // outputs >= samples:
                _copy_block(grad, begin, 0, count, outputs, block_grad)
                grad_rows = Rows(p_block_grad, 0, padded_outputs)
            copy_rows(grad_rows, outputs, p_out_grad, BLOCK, padded_outputs)
            pack_row_pairs(grad_rows, outputs, p_out_grad_pairs, pairs, padded_outputs)
            at = 0
            _layer_backward(
                Rows(p_out_grad, 0, padded_outputs), p_out_grad_pairs, Rows(p_activations, (layers - 1) * layer_stride + begin * width, width),
                p_activation_pairs, Rows(p_last, 0, width), Rows(p_grad_last, task * padded_outputs * width, width), Rows(p_hidden, at, width), per_word,
            )  # fmt: skip
            pack_row_pairs(Rows(p_hidden, at, width), width, p_hidden_pairs, pairs, width)
            for layer in range(layers - 2, -1, -1):
                to = BLOCK * width - at
                _layer_backward(
                    Rows(p_hidden, at, width), p_hidden_pairs, Rows(p_activations, layer * layer_stride + begin * width, width), p_activation_pairs,
                    Rows(p_middle, layer * words * width, width), Rows(p_grad_middle, (task * (layers - 1) + layer) * width * width, width),
                    Rows(p_hidden, to, width), per_word,
                )  # fmt: skip
                at = to
                pack_row_pairs(Rows(p_hidden, at, width), width, p_hidden_pairs, pairs, width)
            input_rows = Rows(p_inputs, begin, samples)
            whole = count == BLOCK and features == rows
            if not whole:
                _copy_block(inputs, 0, begin, features, count, block_inputs)
                input_rows = Rows(p_block_inputs, 0, BLOCK)
            copy_rows(input_rows, BLOCK, p_x, rows, BLOCK)
            product_added(Matrix(p_x, 0, pairs, 1), Rows(p_hidden_pairs, 0, width), Rows(p_grad_first, task * rows * width, width), pairs, rows, width)
            hidden_words, first_rows = Rows(p_hidden, at // per_word, words), Rows(p_first, 0, padded_inputs)
            if whole:
                _grad_inputs(hidden_words, words, p_transposed, first_rows, Rows(p_grad_inputs, begin, samples), rows)
                continue
            _grad_inputs(hidden_words, words, p_transposed, first_rows, Rows(p_block_inputs, 0, BLOCK), rows)
            for i in range(features):
                for n in range(count):
                    grad_inputs[i, begin + n] = block_inputs[i, n]
        hold((block_inputs, x, block_grad, out_grad, out_grad_pairs, hidden_grad, transposed, hidden_grad_pairs, activation_pairs))


def _chunk(samples: int) -> int:
    return _round_up(max(CHUNK, -(-samples // MAX_CHUNKS)), BLOCK)


def forward(inputs: np.ndarray, weights: PackedWeights, offset: float, out: np.ndarray, *, keep: bool) -> np.ndarray:
    """Outputs of the last layer for inputs (I, N) float32, into out (N, O).

    offset   added to the first output
    keep     whether `backward` follows
    returns  the activations that `backward` needs; empty without `keep`
    """
    element = np.empty(0, np.int16 if weights.first.dtype == np.int32 else np.float32)
    samples = inputs.shape[1]
    activations = np.empty((len(weights.middle) + 1, _round_up(samples, BLOCK) if keep else 0, weights.first.shape[1]), element.dtype)
    _forward(inputs, weights.first, weights.middle, weights.last, np.float32(offset), element, _chunk(samples), activations, out)
    return activations


def backward(
    grad: np.ndarray, inputs: np.ndarray, weights: PackedWeights, activations: np.ndarray, shapes: list[tuple[int, int]]
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Gradients of the inputs (I, N) and of the weights, of `shapes` (O, I), from that of the outputs (N, O)."""
    element = np.empty(0, activations.dtype)
    samples, chunk = inputs.shape[1], _chunk(inputs.shape[1])
    chunks, width = -(-samples // chunk), activations.shape[2]
    grad_first = np.empty((chunks, _round_up(len(inputs), ROWS), width), np.float32)
    grad_middle = np.empty((chunks, len(weights.middle), width, width), np.float32)
    grad_last = np.empty((chunks, weights.last.shape[1], width), np.float32)
    grad_inputs = np.empty_like(inputs)
    back = weights.first_back, weights.middle_back, weights.last_back
    _backward(grad, inputs, *back, element, chunk, activations, grad_first, grad_middle, grad_last, grad_inputs)
    sums = [grad_first.sum(axis=0).T, *grad_middle.sum(axis=0), grad_last.sum(axis=0)]
    return grad_inputs, [np.ascontiguousarray(total[:outputs, :columns]) for total, (outputs, columns) in zip(sums, shapes, strict=True)]
