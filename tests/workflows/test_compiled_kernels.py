"""A run that compiles its kernels and one that finds them compiled make the same artifacts; what is compiled in the background is what runs need.

It begins before other tests: on a new machine these load what was compiled for it, instead of each worker compiling the same again. Where kernels of
the same sources are kept from before, it compiles a share of them again.
"""

import hashlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.torture import sources
from benchmarks.torture.comparison import digests
from efficientnerf.backends import kernel_cache
from workflows.asset import WORKFLOW
from workflows.cli.resolve import Settings, table_of
from workflows.precompilation.start import small_settings

ROOT = Path(__file__).resolve().parents[2]


def hand_on(compiled: Path, place: Path, folders: str = "*/*") -> None:
    """Copy the compiled forms of functions that have none in `place` yet, their index last: whoever finds that finds what it names."""
    for index in sorted(compiled.glob(f"{folders}/*.nbi")):
        folder = place / index.parent.relative_to(compiled)
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not (folder / index.name).exists():
            for file in (*index.parent.glob(f"{index.stem}.*.nbc"), index):
                shutil.copyfile(file, folder / f"{file.name}.new")
                os.replace(folder / f"{file.name}.new", folder / file.name)


def lend(kept: Path, cache: Path) -> None:
    """Copy what was compiled of these sources, but for a share of the modules, another one for each state of the sources. What changed is not there to copy."""
    state = kernel_cache.key_of_kernels()
    for module in kernel_cache.SOURCES.modules_below(kernel_cache.KERNELS):
        if hashlib.sha256(f"{state} {module}".encode()).digest()[0] % ANEW:
            hand_on(kept, cache, f"{module}/{kernel_cache.SOURCES.key([module])}")


PRECOMPILES = """
import json, sys
from pathlib import Path
from workflows.precompilation.run import precompile
precompile(json.loads(sys.argv[1]), Path(sys.argv[2]))
"""
FEW = 3  # kernels that only some scenes need
ANEW = 5  # of modules that were compiled before, one in so many is compiled anew


@pytest.mark.slow
@pytest.mark.first
@pytest.mark.timeout(900)
def test_compiled_or_loaded_the_artifacts_are_the_same(tmp_path: Path) -> None:
    """numba keeps copies of what a kernel calls; the process that compiles uses other ones than those which load. And a run finds what was precompiled."""
    source = sources.make("llff", tmp_path / "source")
    cache = tmp_path / "cache"
    environment = {**os.environ, "ENERF_CACHE_DIR": str(cache), "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    environment.pop("NUMBA_CACHE_DIR", None)
    built = Settings(WORKFLOW.settings)
    for setting in sources.SETTINGS:
        built.put_option(setting)
    small = json.dumps(small_settings(table_of(built.resolved())))
    made, kernels = [], []
    compiled, place = cache / "kernels" / kernel_cache.key(), kernel_cache.folder()
    lend(place, compiled)
    lent = set(cache.rglob("*.nbc"))
    for name in ("compiles", "loads"):
        command = [sys.executable, "-c", PRECOMPILES, small, str(tmp_path / name)]
        subprocess.run(command, cwd=ROOT, env=environment, check=True, capture_output=True)
        made.append(digests(tmp_path / name / "run"))
        kernels.append(set(cache.rglob("*.nbc")))
    assert None not in made[0].values()
    assert made[0] == made[1]
    assert kernels[0] == kernels[1]
    assert len(kernels[0]) > 20
    assert kernels[0] - lent
    command = [sys.executable, "-m", "workflows.cli.main", *source.arguments(tmp_path / "run")]
    subprocess.run(command, cwd=ROOT, env=environment, check=True, capture_output=True)
    assert len(set(cache.rglob("*.nbc")) - kernels[0]) <= FEW
    hand_on(compiled, place)
    assert all((place / index.relative_to(compiled)).stat().st_size > 0 for index in compiled.rglob("*.nbi"))
