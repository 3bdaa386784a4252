"""Random weights of a small network, and the passes of the CPU kernels through it."""

import numpy as np

from efficientnerf.backends.numba import mlp


def weights_of(inputs: int, width: int, layers: int, outputs: int, rng: np.random.Generator) -> list[np.ndarray]:
    shapes = [(width, inputs), *[(width, width)] * (layers - 1), (outputs, width)]
    return [(rng.normal(size=shape) * np.sqrt(2 / shape[1])).astype(np.float32) for shape in shapes]


def passes(features: np.ndarray, weights: list[np.ndarray], grad: np.ndarray, bfloat16: bool, offset: float = 0.0) -> list[np.ndarray]:
    packed = mlp.pack_weights(weights, bfloat16)
    out = np.full((features.shape[1], len(weights[-1])), np.nan, np.float32)
    activations = mlp.forward(features, packed, offset, out, keep=True)
    grad_inputs, grad_weights = mlp.backward(grad, features, packed, activations, [w.shape for w in weights])
    return [out, grad_inputs, *grad_weights]
