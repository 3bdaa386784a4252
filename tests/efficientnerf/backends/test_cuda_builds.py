"""Every CUDA kernel is built to machine code, for three generations of devices: Triton needs no device for that, and the interpreter accepts more
than the compiler does.
"""

import os
import subprocess
import sys

import pytest

pytest.importorskip("triton", reason="Triton is not installed: pip install triton (Linux, x86-64)")


@pytest.mark.slow
@pytest.mark.first
@pytest.mark.timeout(900)  # two minutes of one core, on a machine that may be busy
def test_all_kernels_build_without_spilling() -> None:
    """In a process of its own: kernels that were defined for the interpreter cannot be compiled. Triton keeps what it built of the same sources."""
    environment = {name: value for name, value in os.environ.items() if name != "TRITON_INTERPRET"}
    done = subprocess.run([sys.executable, "-m", "tests.efficientnerf.build_kernels"], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    lines = done.stdout.splitlines()
    assert len(lines) >= 40
    assert not [line for line in lines if not line.endswith(" spilled 0")]
