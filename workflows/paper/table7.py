"""Table 7 of the paper: memory, caching and query times of dense voxels, a sparse tensor, an octree and NerfTree on the same voxels.

On the CPU the kernels of `workflows.paper.structures`, on CUDA their plain torch versions. The structures take turns within each repetition, so that
other load on the machine affects all of them equally.
"""

from __future__ import annotations

import platform
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from statistics import median
from typing import Any

import numpy as np
import torch

from efficientnerf.backends.numba.runtime import numba
from pipeline.errors import StageFailed
from workflows.paper.result import PAPER, Repetitions, Request, Result
from workflows.paper.structures import torch_structures
from workflows.paper.structures.bits import fill, gather
from workflows.paper.structures.bricks import BrickTree, FullBricks
from workflows.paper.structures.dense import DenseVoxels
from workflows.paper.structures.hashing import HashMap
from workflows.paper.structures.octree import Octree
from workflows.paper.structures.synthetic import clustered, random_points, ray_points, scattered, shuffled
from workflows.paper.structures.voxels import Voxels

NAMES = {
    "DenseVoxels": "dense voxels",
    "HashMap": "sparse tensor (hash map)",
    "Octree": "octree (svox)",
    "FullBricks": "NerfTree, full bricks as printed",
    "BrickTree": "NerfTree",
}
PRINTED = {"DenseVoxels": (16.0, 16.55, 13.64), "HashMap": (2.1, 24720.0, 121.21), "Octree": (2.6, 14510.0, 18.84), "BrickTree": (2.8, 22.43, 15.39)}
COLUMNS = (
    "voxels", "structure", "memory / MiB", "memory of dense", "memory of dense" + PAPER, "caching / ms", "caching / ms" + PAPER, "random query / ms",
    "random of dense", "query along rays / ms", "rays of dense", "rays of dense" + PAPER,
)  # fmt: skip
SIDES, POINTS = (256, 512), 1 << 21
SEED = 7


@dataclass(frozen=True)
class Case:
    """A set of voxels: clustered or scattered, their fraction of the grid, and whether they are listed in the order of the grid."""

    side: int
    share: float
    scattered: bool = False
    shuffled: bool = False

    @property
    def name(self) -> str:
        how = "scattered" if self.scattered else "clustered"
        return f"{self.side}³, {self.share:.0%} {how}{', listed at random' if self.shuffled else ''}"

    def voxels(self) -> Voxels:
        made = (scattered if self.scattered else clustered)(self.side, self.share, SEED)
        return shuffled(made, SEED) if self.shuffled else made


@dataclass(frozen=True)
class Backend:
    """How structures are built and queried on a device.

    prepare  (voxels, sets of points by name) -> build(name of a structure), query(structure, name of a set), wait for the device
    size     bytes of a structure
    """

    prepare: Callable[[Voxels, Mapping[str, np.ndarray]], tuple[Callable[[str], Any], Callable[[Any, str], None], Callable[[], None]]]
    size: Callable[[Any], int]


def structures(request: Request) -> Result:
    """Measure table 7; `scale` shortens the sides of the grids, and the number of points with them."""
    cuda = request.device == "cuda"
    sides = [max(round(side * request.scale / 16) * 16, 16) for side in ((1024,) if cuda else SIDES)]
    cases = [Case(side, share, scattered=scattered) for side in sides for scattered in (False, True) for share in ((0.2,) if cuda else (0.2, 0.05))]
    if not cuda:
        cases.append(Case(sides[0], 0.2, shuffled=True))
    points = max(round(POINTS * request.scale * (8 if cuda else 1)), 1000)
    backend = _in_torch(request.device) if cuda else _in_numba()
    rows: list[dict[str, Any]] = []
    notes: list[str] = []
    for case in cases:
        request.say(f"table 7: {case.name}")
        measured, note = _measure(case, points, backend, request.timings)
        rows += measured
        notes.append(note)
    return Result(COLUMNS, rows, [*_explained(points, request.timings), *notes, *([] if cuda else [_machine()])])


def _measure(case: Case, points: int, backend: Backend, timings: Repetitions) -> tuple[list[dict[str, Any]], str]:
    """All structures in turn, repetition by repetition: a row for each, and a note on the voxels."""
    voxels = case.voxels()
    sets = {"random": random_points(case.side, points, SEED), "rays": ray_points(case.side, points, SEED)}
    cache, query, wait = backend.prepare(voxels, sets)
    took: dict[tuple[str, str], list[float]] = {}
    built: dict[str, Any] = {}

    def timed(name: str, what: str, work: Callable[[], Any]) -> Any:
        wait()
        start = time.perf_counter()
        result = work()
        wait()
        took.setdefault((name, what), []).append(1e3 * (time.perf_counter() - start))
        return result

    for _ in range(timings.cachings):
        for name in NAMES:
            built.pop(name, None)  # one of each at a time: the largest grid takes gigabytes
            built[name] = timed(name, "caching", lambda name=name: cache(name))  # type: ignore[misc]
    for _ in range(timings.queries):
        for name in NAMES:
            for what in sets:
                timed(name, what, lambda name=name, what=what: query(built[name], what))  # type: ignore[misc]
    middle = {key: median(times) for key, times in took.items()}
    size = {name: backend.size(built[name]) for name in NAMES}
    printed = case.share == 0.2 and not case.scattered and not case.shuffled
    rows = [_row(case, name, size, middle, PRINTED.get(name) if printed else None) for name in NAMES]
    bricks = _brick_share(voxels)
    note = (
        f"{case.name}: {len(voxels.packed):,} voxels in {bricks:.1%} of the bricks of 4³; points: "
        f"{len(sets['random']):,} at random, {len(sets['rays']):,} along rays."
    )
    return rows, note


def _row(case: Case, name: str, size: Mapping[str, int], middle: Mapping[tuple[str, str], float], paper: tuple[float, float, float] | None) -> dict[str, Any]:
    dense = PRINTED["DenseVoxels"]
    return {
        "voxels": case.name,
        "structure": NAMES[name],
        "memory / MiB": size[name] / 2**20,
        "memory of dense": size[name] / size["DenseVoxels"],
        "memory of dense" + PAPER: paper and paper[0] / dense[0],
        "caching / ms": middle[name, "caching"],
        "caching / ms" + PAPER: paper and paper[1],
        "random query / ms": middle[name, "random"],
        "random of dense": middle[name, "random"] / middle["DenseVoxels", "random"],
        "query along rays / ms": middle[name, "rays"],
        "rays of dense": middle[name, "rays"] / middle["DenseVoxels", "rays"],
        "rays of dense" + PAPER: paper and paper[2] / dense[2],
    }


def _in_numba() -> Backend:
    kinds: dict[str, Any] = {kind.__name__: kind for kind in (DenseVoxels, HashMap, Octree, FullBricks, BrickTree)}
    for kind in kinds.values():  # compiles
        kind.cache(scattered(16, 0.2, SEED)).query(np.zeros((1, 3), np.float32), np.empty(1, np.uint64), np.empty(1, bool))

    def prepare(voxels: Voxels, sets: Mapping[str, np.ndarray]) -> tuple[Callable[[str], Any], Callable[[Any, str], None], Callable[[], None]]:
        longest = max(len(points) for points in sets.values())
        packed, occupied = np.zeros(longest, np.uint64), np.zeros(longest, bool)

        def query(structure: Any, what: str) -> None:
            structure.query(sets[what], packed[: len(sets[what])], occupied[: len(sets[what])])

        return lambda name: kinds[name].cache(voxels), query, lambda: None

    return Backend(prepare, lambda structure: sum(array.nbytes for array in structure.arrays.values()))


def _in_torch(device: str) -> Backend:
    def prepare(voxels: Voxels, sets: Mapping[str, np.ndarray]) -> tuple[Callable[[str], Any], Callable[[Any, str], None], Callable[[], None]]:
        coordinates, packed = torch.from_numpy(voxels.coordinates).to(device), torch.from_numpy(voxels.packed.view(np.int64)).to(device)
        points = {what: torch.from_numpy(array).to(device) for what, array in sets.items()}

        def cache(name: str) -> Any:
            try:
                return getattr(torch_structures, name).cache(voxels.side, coordinates, packed)
            except torch.OutOfMemoryError as error:
                raise StageFailed(f"table 7: {NAMES[name]} of {voxels.side}³ voxels: the device has too little memory. Give --scale 0.5.") from error

        return cache, lambda structure, what: structure.query(points[what]), torch.cuda.synchronize if device == "cuda" else lambda: None

    return Backend(prepare, lambda structure: sum(tensor.nbytes for tensor in structure.tensors.values()))


def _brick_share(voxels: Voxels) -> float:
    side = -(-voxels.side // 4)
    occupied = np.zeros((side, side, side), bool)
    occupied[tuple((voxels.coordinates >> 2).T)] = True
    return float(occupied.mean())


def _explained(points: int, timings: Repetitions) -> list[str]:
    return [
        f"Each voxel has four half-precision values, copied as one 64-bit word by every structure. A query looks up about {points:,} points: at random, "
        "and along the rays of cameras around the grid, in the order in which a renderer marches them. Caching builds from a list of voxels in the order "
        f"of the grid, memory taken and cleared included. Medians of {timings.cachings} cachings and {timings.queries} queries, the structures in turn.",
        "The paper: 1024³, 20 % valid, four values of probably four bytes, all points of the grid in one query, on one RTX 3090; it does not say how the "
        "voxels lie. Its sparse tensor and NerfTree take less than 20 % of dense voxels, not possible where each value is stored once in the same type.",
    ]


def _machine() -> str:
    """Threads, and memory bandwidth: random reads and sequential writes."""
    table = np.empty(1 << 27, np.uint64)
    where = np.random.default_rng(SEED).integers(0, len(table), 1 << 21, np.uint64)
    out = np.empty(len(where), np.uint64)
    fill(table, np.uint64(0))
    gather(table, where, out)

    def best(work: Callable[[], Any]) -> float:
        times = []
        for _ in range(5):
            start = time.perf_counter()
            work()
            times.append(time.perf_counter() - start)
        return min(times)

    reads, writes = len(where) / best(lambda: gather(table, where, out)), table.nbytes / best(lambda: fill(table, np.uint64(1)))
    return (
        f"{numba.get_num_threads()} threads, {platform.system()}; memory: {reads / 1e6:.0f} million words a second at random places of 1 GiB, "
        f"{writes / 1e9:.1f} GB/s written in a row."
    )
