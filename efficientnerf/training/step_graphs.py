"""Steps of training as CUDA graphs: a step is hundreds of small operations, which take a device less time than a host needs to launch them one by one.

A step that does not wait for the device (`efficientnerf.training.readback`) is recorded, and later replayed as a whole with other inputs. What is recorded
has a shape: numbers of rays and of samples stay for many steps, and are then rounded anew. CUDA graphs: Nguyen et al. 2021, "Accelerating PyTorch with CUDA
Graphs"; nothing is recorded where that fails, and steps are launched one operation at a time.
"""

import warnings
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from efficientnerf.backends import Notice
from efficientnerf.backends.transfer import sent
from efficientnerf.training.optimiser import StepSize
from efficientnerf.training.step import StepInputs, StepNumbers

KEPT = 8  # graphs
NUMBERS = 6  # of StepNumbers
HELD = 0.06  # share by which the number of rays may be off from the wanted one
Body = Callable[[StepInputs, StepNumbers], Tensor]


class Recorded(NamedTuple):
    """A step that can be replayed: the tensors that it reads, and what does it and returns its result."""

    inputs: StepInputs
    numbers: Tensor
    replay: Callable[[], Tensor]


class StepGraphs:
    """Runs steps on a device: the first of a kind operation by operation, further ones by replay.

    Graphs need a stream of their own: `ordered` orders it with the current one.
    """

    def __init__(self, device: torch.device, parameters: Sequence[nn.Parameter]) -> None:
        """parameters: those that steps change."""
        self.device, self.parameters, self.usable = device, parameters, can_record(device)
        self.stream = torch.cuda.Stream(device) if device.type == "cuda" else None
        self.recorded: OrderedDict[Any, Recorded] = OrderedDict()
        self.known: set[Any] = set()
        self.pool: Any = torch.cuda.graph_pool_handle() if device.type == "cuda" else None  # of memory, shared: one graph runs at a time
        self.count = 0

    @contextmanager
    def ordered(self) -> Iterator[None]:
        """Steps within follow what was launched before, and come before what is launched after."""
        if self.stream is None:
            yield
            return
        outside = torch.cuda.current_stream(self.device)
        self.stream.wait_stream(outside)
        with torch.cuda.stream(self.stream):
            yield
        outside.wait_stream(self.stream)

    def rays(self, wanted: int) -> int:
        """A number of rays close to the wanted one, that of the last step where that is."""
        if not (1 - HELD) * wanted <= self.count <= (1 + HELD) * wanted:
            self.count = wanted
        return self.count

    def take(self, plan: Any, inputs: StepInputs, numbers: StepNumbers, body: Body) -> Tensor:
        """The result of `body` of inputs and numbers, which are the host's, but for tensors."""
        kind = plan, _shapes(inputs)
        if self.usable and kind in self.known:
            found = self.recorded.pop(kind, None) or self._record(inputs, numbers, body)
            if found is not None:
                self.recorded[kind] = found
                if len(self.recorded) > KEPT:
                    self.recorded.popitem(last=False)
                _copy(found.inputs, inputs)
                _fill(found.numbers, numbers)
                return found.replay()
        self.known.add(kind)  # what it needs is compiled and loaded now, as it cannot be while a step is recorded
        return self.launch(inputs, numbers, body)

    def launch(self, inputs: StepInputs, numbers: StepNumbers, body: Body) -> Tensor:
        """The same, operation by operation."""
        if not self.usable:
            return body(sent(inputs, self.device), numbers)
        values = torch.empty(NUMBERS, device=self.device)
        _fill(values, numbers)
        return body(sent(inputs, self.device), _numbers(values))

    def _record(self, inputs: StepInputs, numbers: StepNumbers, body: Body) -> Recorded | None:
        """None where it cannot be recorded."""
        places, values = sent(inputs, self.device), torch.empty(NUMBERS, device=self.device)
        try:
            replay = record(lambda: body(places, _numbers(values)), self.pool)
        except RuntimeError as error:
            self.usable = False
            for p in self.parameters:
                p.grad = None  # of a recording that broke off
            reason = str(error).strip().splitlines() or [type(error).__name__]
            warnings.warn(f"Steps cannot be recorded as CUDA graphs ({reason[0][:200]}); training goes on, several times slower.", Notice, stacklevel=2)
            return None
        return Recorded(places, values, replay)


def can_record(device: torch.device) -> bool:
    return device.type == "cuda"


def record(run: Callable[[], Tensor], pool: Any) -> Callable[[], Tensor]:
    """What replays `run`, which is recorded on the current stream, with memory of a pool, and not run."""
    graph = torch.cuda.CUDAGraph()
    graph.capture_begin(pool=pool, capture_error_mode="thread_local")
    try:
        result = run()
    finally:
        graph.capture_end()

    def replay() -> Tensor:
        graph.replay()
        return result

    return replay


def _shapes(values: Any) -> Any:
    if isinstance(values, tuple):
        return tuple(_shapes(each) for each in values)
    return None if values is None else tuple(values.shape)


def _copy(places: Any, values: Any) -> None:
    """Values into tensors of the same shapes; nothing waits."""
    if isinstance(places, tuple):
        for place, value in zip(places, values, strict=True):
            _copy(place, value)
    elif places is not None:
        value = torch.from_numpy(values) if isinstance(values, np.ndarray) else values
        places.copy_(value.pin_memory() if places.is_cuda and not value.is_cuda else value, non_blocking=True)


def _numbers(values: Tensor) -> StepNumbers:
    """Views of what `_fill` fills (6,)."""
    rate, correction1, correction2, *weights = values.unbind()
    return StepNumbers(StepSize(rate, correction1, correction2), *weights)


def _fill(place: Tensor, numbers: StepNumbers) -> None:
    _copy(place, np.array([*numbers.size, *numbers[1:]], np.float32))
