"""The kernels give the same bytes on one thread, on two and on 64, whichever way these are kept busy; a thread takes little memory."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba.core import codegen

from efficientnerf.backends.numba.runtime import PRANGE, WRAPPERS, numba

ROOT = Path(__file__).resolve().parents[3]
PROGRAM = """
import hashlib
import re
from pathlib import Path

import numba
import numpy as np

from efficientnerf.asset.queries import colour_at, density_at, normal_at
from efficientnerf.asset.rendering import render_rays
from efficientnerf.splats.merging import merged
from efficientnerf.splats.refit import View, refitted
from efficientnerf.training.loop import state_of, train, trainer
from tests.efficientnerf.balls import pixels, untrained
from tests.efficientnerf.networks import passes, weights_of
from tests.efficientnerf.trees import looking, random_tree, rays_at

print(numba.get_num_threads())
t = trainer(untrained(contracted=True, iterations=5, occupancy_warmup_steps=2))
list(train(t, pixels()))
for name, tensor in sorted(state_of(t).items()):
    print(name, hashlib.sha256(tensor.numpy().tobytes()).hexdigest())
rng = np.random.default_rng(2)
weights = weights_of(24, 64, 2, 28, rng)
features, grad = rng.normal(size=(24, 9001)).astype(np.float32), rng.normal(size=(9001, 28)).astype(np.float32)
for bfloat16 in (False, True):
    for values in passes(features, weights, grad, bfloat16):
        print(hashlib.sha256(values.tobytes()).hexdigest())
tree = random_tree()
seen = render_rays(tree, *rays_at(tree, 3000))
points = np.random.default_rng(0).uniform(tree.bounds_min, tree.bounds_max, (5000, 3))
for values in (seen.colour, seen.opacity, seen.depth, seen.normal, density_at(tree, points), normal_at(tree, points), colour_at(tree, points, None)):
    print(hashlib.sha256(np.ascontiguousarray(values).tobytes()).hexdigest())
view = View(looking(tree, 40), rng.integers(0, 256, (43, 40, 4), dtype=np.uint8))
for values in vars(refitted(merged(tree, [view.camera], 300, 1), [view], 6, most=400)).values():
    print(hashlib.sha256(values.tobytes()).hexdigest())
status = Path("/proc/self/status")
print(re.search(r"VmHWM:\\s+(\\d+)", status.read_text())[1] if status.exists() else 0)
"""
A_THREAD = 2048  # KiB


def lines(threads: int, layer: str = "default") -> list[str]:
    environment = {**os.environ, "NUMBA_NUM_THREADS": str(threads), "NUMBA_THREADING_LAYER": layer}
    done = subprocess.run([sys.executable, "-c", PROGRAM], cwd=ROOT, env=environment, capture_output=True, text=True, check=True)
    return done.stdout.splitlines()


@pytest.mark.slow
def test_the_number_of_threads_changes_no_byte() -> None:
    (one, *alone, small), (two, *together, _), (queued, *in_queue, _), (many, *crowded, large) = lines(1), lines(2), lines(2, "workqueue"), lines(64)
    assert (one, two, queued, many) == ("1", "2", "2", "64")
    assert len(alone) > 10
    assert alone == together == in_queue == crowded
    assert int(large) - int(small) < 64 * A_THREAD


def test_wrappers_of_parallel_loops_are_compiled_within_their_function_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those that are called themselves, as of a parallel ufunc of another program, are compiled all the same."""
    finished: list[str] = []
    finish = codegen.JITCodeLibrary.finalize

    def finalize(library: Any) -> None:
        finished.append(library.name)
        finish(library)

    monkeypatch.setattr(codegen.JITCodeLibrary, "finalize", finalize)

    @numba.njit(parallel=PRANGE)
    def add_numbers(x):  # type: ignore[no-untyped-def]
        room = np.zeros(len(x))  # no parallel loop
        for i in numba.prange(len(x)):
            room[i] = x[i] + i
        return room.sum()

    assert add_numbers(np.ones(10)) == 55
    assert not [name for name in finished if name.startswith(WRAPPERS)]
    assert len([name for name in finished if name.startswith("__numba_parfor_gufunc")]) == 1
    doubled = numba.vectorize(["float64(float64)"], target="parallel")(lambda a: 2 * a)
    assert doubled(np.ones(1000)).sum() == 2000
    assert [name for name in finished if name.startswith(WRAPPERS)]
