"""Every CUDA kernel is built to machine code, for three generations of devices: Triton needs no device for that, and the interpreter accepts more
than the compiler does.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("triton", reason="Triton is not installed: pip install triton (Linux, x86-64)")


@pytest.mark.slow
@pytest.mark.first
@pytest.mark.timeout(900)  # two minutes of one core, on a machine that may be busy
def test_all_kernels_build_without_spilling(tmp_path: Path) -> None:
    """In a process of its own: kernels that were defined for the interpreter cannot be compiled."""
    environment = {**os.environ, "TRITON_CACHE_DIR": str(tmp_path)}
    environment.pop("TRITON_INTERPRET", None)
    done = subprocess.run([sys.executable, "-m", "tests.efficientnerf.build_kernels"], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    lines = done.stdout.splitlines()
    assert len(lines) >= 40
    assert not [line for line in lines if not line.endswith(" spilled 0")]
