"""Where the tests of the CUDA kernels run: on the device, or on the CPU through Triton's interpreter. Imported before the kernels are."""

import os

import pytest
import torch

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
if DEVICE == "cpu":
    os.environ["TRITON_INTERPRET"] = "1"  # read when a kernel is defined
    pytest.importorskip("triton", reason="Triton is not installed: pip install triton (Linux, x86-64)")
