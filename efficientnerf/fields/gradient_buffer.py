"""A gradient that backward passes add to in place."""

import torch
from torch import Tensor


class GradientBuffer:
    """The gradient of a table, summed over the backward passes of a step.

    A step encodes points several times. Autograd would allocate a gradient of the full table each time and add them up, which costs as much as
    the encoding. Backward passes add to this buffer instead, and autograd gets no gradient of the table. The optimiser reads the buffer, and clears it
    for the next step.
    """

    def __init__(self) -> None:
        self.values: Tensor | None = None  # like the table, zero while `filled` is False; None before the first backward pass
        self.filled = False  # whether a backward pass has added to it since it was cleared

    def accumulator(self, table: Tensor) -> Tensor:
        """The values, for a backward pass to add to."""
        if self.values is None:
            self.values = torch.zeros_like(table)
        self.filled = True
        return self.values
