"""Table 7 of the paper: memory, caching and query times of dense voxels, a sparse tensor, an octree and NerfTree on the same voxels.

The structures take turns within each repetition, so that other load on the machine affects all of them equally.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from statistics import median
from typing import Any

import numpy as np
import torch

from benchmarks.paper.result import PAPER, Request, Result
from benchmarks.paper.structures import BrickTree, DenseVoxels, FullBricks, HashMap, Octree, Structure
from benchmarks.paper.voxels import Voxels, clustered, random_points, ray_points, scattered
from pipeline.errors import StageFailed
from stages.cores import use_all_cores

KINDS: dict[str, type[Structure]] = {
    "dense voxels": DenseVoxels,
    "sparse tensor (hash map)": HashMap,
    "octree (svox)": Octree,
    "NerfTree, full bricks as printed": FullBricks,
    "NerfTree": BrickTree,
}
DENSE = "dense voxels"
# Of the paper: memory / GB, caching / ms, query along rays / ms.
PRINTED = {
    DENSE: (16.0, 16.55, 13.64), "sparse tensor (hash map)": (2.1, 24720.0, 121.21), "octree (svox)": (2.6, 14510.0, 18.84), "NerfTree": (2.8, 22.43, 15.39)
}  # fmt: skip
COLUMNS = (
    "voxels", "structure", "memory / MiB", "memory of dense", "memory of dense" + PAPER, "caching / ms", "caching / ms" + PAPER, "random query / ms",
    "random of dense", "query along rays / ms", "rays of dense", "rays of dense" + PAPER,
)  # fmt: skip
SIDES, POINTS = (256, 512), 1 << 21
CACHINGS, QUERIES = 5, 9  # timings, of which medians are reported
SEED = 7


@dataclass(frozen=True)
class Case:
    """A set of voxels: clustered or scattered, and their fraction of the grid."""

    side: int
    share: float
    scattered: bool = False

    @property
    def name(self) -> str:
        return f"{self.side}³, {self.share:.0%} {'scattered' if self.scattered else 'clustered'}"

    def voxels(self) -> Voxels:
        return (scattered if self.scattered else clustered)(self.side, self.share, SEED)


def structures(request: Request) -> Result:
    """Measure table 7; `scale` shortens the sides of the grids, and the number of points with them."""
    cuda = request.device == "cuda"
    sides = [max(round(side * request.scale / 16) * 16, 16) for side in ((1024,) if cuda else SIDES)]
    cases = [Case(side, share, scattered=scattered) for side in sides for scattered in (False, True) for share in ((0.2,) if cuda else (0.2, 0.05))]
    points = max(round(POINTS * request.scale * (8 if cuda else 1)), 1000)
    use_all_cores()
    rows: list[dict[str, Any]] = []
    notes = _explained(points, request.device)
    for case in cases:
        request.say(f"table 7: {case.name}")
        measured, note = _measure(case, points, request.device)
        rows += measured
        notes.append(note)
    return Result(COLUMNS, rows, notes)


def _measure(case: Case, points: int, device: str) -> tuple[list[dict[str, Any]], str]:
    """All structures in turn, repetition by repetition: a row for each, and a note on the voxels."""
    voxels = case.voxels()
    coordinates, packed = torch.from_numpy(voxels.coordinates).to(device), torch.from_numpy(voxels.packed).to(device)
    made = {"random": random_points(case.side, points, SEED), "rays": ray_points(case.side, points, SEED)}
    sets = {what: torch.from_numpy(each).to(device) for what, each in made.items()}
    took: dict[tuple[str, str], list[float]] = {}
    built: dict[str, Structure] = {}

    def timed(name: str, what: str, work: Callable[[], Any]) -> Any:
        wait()
        start = time.perf_counter()
        result = work()
        wait()
        took.setdefault((name, what), []).append(1e3 * (time.perf_counter() - start))
        return result

    def wait() -> None:
        if device == "cuda":
            torch.cuda.synchronize()

    for _ in range(CACHINGS):
        for name, kind in KINDS.items():
            built.pop(name, None)  # one of each at a time: the largest grid takes gigabytes
            try:
                built[name] = timed(name, "caching", lambda kind=kind: kind.cache(case.side, coordinates, packed))  # type: ignore[misc]
            except torch.OutOfMemoryError as error:
                raise StageFailed(f"table 7: {name} of {case.side}³ voxels: the device has too little memory. Give --scale 0.5.") from error
    for _ in range(QUERIES):
        for name, structure in built.items():
            for what, each in sets.items():
                timed(name, what, lambda structure=structure, each=each: structure.query(each))  # type: ignore[misc]
    middle = {key: median(times) for key, times in took.items()}
    size = {name: sum(tensor.nbytes for tensor in structure.tensors.values()) for name, structure in built.items()}
    printed = case.share == 0.2 and not case.scattered
    rows = [_row(case, name, size, middle, PRINTED.get(name) if printed else None) for name in KINDS]
    bricks = _brick_share(voxels)
    note = (
        f"{case.name}: {len(voxels.packed):,} voxels in {bricks:.1%} of the bricks of 4³; points: "
        f"{len(sets['random']):,} at random, {len(sets['rays']):,} along rays."
    )
    return rows, note


def _row(case: Case, name: str, size: Mapping[str, int], middle: Mapping[tuple[str, str], float], paper: tuple[float, float, float] | None) -> dict[str, Any]:
    dense = PRINTED[DENSE]
    return {
        "voxels": case.name,
        "structure": name,
        "memory / MiB": size[name] / 2**20,
        "memory of dense": size[name] / size[DENSE],
        "memory of dense" + PAPER: paper and paper[0] / dense[0],
        "caching / ms": middle[name, "caching"],
        "caching / ms" + PAPER: paper and paper[1],
        "random query / ms": middle[name, "random"],
        "random of dense": middle[name, "random"] / middle[DENSE, "random"],
        "query along rays / ms": middle[name, "rays"],
        "rays of dense": middle[name, "rays"] / middle[DENSE, "rays"],
        "rays of dense" + PAPER: paper and paper[2] / dense[2],
    }


def _brick_share(voxels: Voxels) -> float:
    side = -(-voxels.side // 4)
    occupied = np.zeros((side, side, side), bool)
    occupied[tuple((voxels.coordinates >> 2).T)] = True
    return float(occupied.mean())


def _explained(points: int, device: str) -> list[str]:
    threads = "" if device == "cuda" else f" Threads: {torch.get_num_threads()}."
    return [
        f"Each voxel has four half-precision values, copied as one 64-bit word by every structure. A query looks up about {points:,} points: at random, "
        "and along the rays of cameras around the grid, in the order in which a renderer marches them. Caching builds from a list of voxels in the order "
        f"of the grid, memory taken and cleared included. Medians of {CACHINGS} cachings and {QUERIES} queries, the structures in turn.{threads}",
        "The paper: 1024³, 20 % valid, four values of probably four bytes, all points of the grid in one query, on one RTX 3090; it does not say how the "
        "voxels lie. Its sparse tensor and NerfTree take less than 20 % of dense voxels, not possible where each value is stored once in the same type.",
    ]
