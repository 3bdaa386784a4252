"""Adam over the parameters of a model."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from efficientnerf.backends import dispatch
from efficientnerf.fields.gradient_buffer import GradientBuffer
from efficientnerf.model import Model

BETA1 = 0.9


@dataclass(frozen=True)
class ParameterGroup:
    """Parameters, by name, that are treated alike."""

    parameters: Mapping[str, nn.Parameter]
    sparse: bool = False  # entries whose gradient is zero are left alone, their moments too, as in hash tables (Mueller et al. 2022)
    buffers: Mapping[str, GradientBuffer] = field(default_factory=dict)  # where the gradients of some of them are summed instead of in `grad`

    def gradient(self, name: str) -> Tensor | None:
        """The gradient of this step; None where no backward pass has reached the parameter."""
        buffer = self.buffers.get(name)
        return buffer.values if buffer is not None and buffer.filled else self.parameters[name].grad


def parameter_groups(m: Model) -> list[ParameterGroup]:
    """The model's networks, and its hash tables, whose updates are sparse."""
    buffers = m.gradient_buffers()
    dense = {name: p for name, p in m.parameters() if name not in buffers}
    return [ParameterGroup(dense), ParameterGroup({name: p for name, p in m.parameters() if name in buffers}, sparse=True, buffers=buffers)]


class StepSize(NamedTuple):
    """Of a step of Adam: floats, or tensors () on the device of the parameters."""

    learning_rate: Any
    # 1 - beta^step of the first and the second moments
    correction1: Any
    correction2: Any


class Adam:
    """Kingma and Ba's Adam."""

    def __init__(self, groups: list[ParameterGroup], beta2: float = 0.99, epsilon: float = 1e-15) -> None:
        self.groups, self.beta2, self.epsilon = groups, beta2, epsilon
        self.moments = {name: (torch.zeros_like(p), torch.zeros_like(p)) for group in groups for name, p in group.parameters.items()}

    @property
    def parameters(self) -> list[nn.Parameter]:
        return [p for group in self.groups for p in group.parameters.values()]

    def step_size(self, number: int, learning_rate: float) -> StepSize:
        """Of the `number`-th step, from 1."""
        return StepSize(learning_rate, 1 - BETA1**number, 1 - self.beta2**number)

    def step(self, size: StepSize) -> None:
        """A step; clears the gradients."""
        for group in self.groups:
            for name, p in group.parameters.items():
                grad = group.gradient(name)
                if grad is None:
                    continue
                numbers = (size.learning_rate, BETA1, self.beta2, size.correction1, size.correction2, self.epsilon)
                # numba's kernel, the only one that fills gradient buffers, clears the gradient, too.
                dispatch.adam(p.detach(), grad, *self.moments[name], *numbers, skip_zeros=group.sparse)
                if grad is p.grad:
                    p.grad = None
                else:
                    group.buffers[name].filled = False
