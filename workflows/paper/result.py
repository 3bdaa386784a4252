"""Request and result of a table of the paper (`workflows.paper.document`)."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

PAPER = " (paper)"


@dataclass(frozen=True)
class Request:
    """What a table is measured on.

    data    folder of a scene, or of scenes
    out     where tables and runs go
    scale   1: as in the paper; less: iterations, resolution, networks and grids shrunk together
    device  "cpu" or "cuda"
    say     takes sentences for the user
    report  takes the events of the stages; None: they are dropped
    """

    data: Path | None
    out: Path
    scale: float = 1.0
    device: str = "cpu"
    say: Callable[[str], None] = print
    report: Callable[[dict[str, Any]], None] | None = None


@dataclass(frozen=True)
class Result:
    """A measured table.

    columns  in order; those that end in PAPER are the paper's figures
    rows     column -> text, number or None
    notes    conditions under which the figures hold
    curves   name -> (seconds of training, PSNR in decibels), for the plot
    """

    columns: Sequence[str]
    rows: Sequence[Mapping[str, Any]]
    notes: Sequence[str] = ()
    curves: Mapping[str, tuple[Sequence[float], Sequence[float]]] = field(default_factory=dict)


@dataclass(frozen=True)
class Table:
    """title as in the paper; `needs_data`: whether it is measured on scenes; measure does the work."""

    title: str
    needs_data: bool
    measure: Callable[[Request], Result]
