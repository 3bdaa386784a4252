"""Request and result of a table of the paper (`benchmarks.paper.document`)."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

PAPER = " (paper)"


@dataclass(frozen=True)
class Request:
    """What a table is measured on."""

    data: Path | None  # folder of a scene, or of scenes
    out: Path  # where tables and runs go
    scale: float = 1.0  # 1: as in the paper; less: iterations, resolution, networks and grids shrunk together
    device: str = "cpu"  # "cpu" or "cuda"
    say: Callable[[str], None] = print  # takes sentences for the user
    report: Callable[[dict[str, Any]], None] | None = None  # takes the events of the stages; None: they are dropped


@dataclass(frozen=True)
class Result:
    """A measured table."""

    columns: Sequence[str]  # in order; those that end in PAPER are the paper's figures
    rows: Sequence[Mapping[str, Any]]  # column -> text, number or None
    notes: Sequence[str] = ()  # conditions under which the figures hold
    curves: Mapping[str, tuple[Sequence[float], Sequence[float]]] = field(default_factory=dict)  # name -> (seconds of training, PSNR in decibels), for the plot


@dataclass(frozen=True)
class Table:
    """title as in the paper; `needs_data`: whether it is measured on scenes; measure does the work."""

    title: str
    needs_data: bool
    measure: Callable[[Request], Result]
