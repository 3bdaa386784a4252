"""What a step of tree training is given, on the CPU and on CUDA. Imports nothing heavy."""

from __future__ import annotations

from typing import NamedTuple


class Hyperparameters(NamedTuple):
    """Of a step.

    density_rate     learning rate of the logarithm of the optical thickness
    sh_rate          learning rate of the harmonics
    view_share       of that for harmonics of degree 1 and above
    decay            of the running mean of the squared gradient
    epsilon          added to its root
    momentum         of the running mean of the gradient; 0: RMSprop
    total_variation  weights of the terms of `efficientnerf.backends.numba.tree_training.steps`
    sparsity
    entropy
    terms            coefficients that have gradients, of each channel: the first ones; those beyond stay as they are
    """

    density_rate: float
    sh_rate: float
    view_share: float
    decay: float
    epsilon: float
    momentum: float = 0.0
    total_variation: float = 0.0
    sparsity: float = 0.0
    entropy: float = 0.0
    terms: int = 25
