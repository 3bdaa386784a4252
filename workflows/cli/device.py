"""Whether torch can use CUDA, found out without importing torch, which takes seconds."""

import ctypes
import importlib.util
import os
from pathlib import Path

from pipeline.errors import UsageError


def torch_has_cuda() -> bool:
    """Whether the installed torch was built for CUDA: read from torch/version.py."""
    spec = importlib.util.find_spec("torch")
    if spec is None or spec.origin is None:
        return False
    try:
        text = (Path(spec.origin).parent / "version.py").read_text(encoding="utf-8")
    except OSError:
        return False
    values = [line.partition("=")[2].strip() for line in text.splitlines() if line.startswith("cuda")]
    return bool(values) and values[-1] != "None"


def cuda_device_count() -> int:
    """Number of CUDA devices that the driver's management library lists and CUDA_VISIBLE_DEVICES does not hide."""
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    if visible is not None and visible.strip() in ("", "-1"):
        return 0
    try:
        # Unlike the driver itself, this library leaves the process fit for forking.
        library = ctypes.CDLL("libnvidia-ml.so.1")
        if library.nvmlInit_v2() != 0:
            return 0
        count = ctypes.c_uint(0)
        found = library.nvmlDeviceGetCount_v2(ctypes.byref(count))
        library.nvmlShutdown()
    except (OSError, AttributeError):
        return 0
    return int(count.value) if found == 0 else 0


def has_cuda() -> bool:
    return cuda_device_count() > 0 and torch_has_cuda()


def resolve_device(wanted: str) -> str:
    """`auto`, `cpu` or `cuda` as `cpu` or `cuda`; UsageError where cuda is requested and there is none."""
    if wanted == "cpu":
        return "cpu"
    if has_cuda():
        return "cuda"
    if wanted == "cuda":
        if torch_has_cuda():
            import torch  # takes seconds

            if torch.cuda.is_available():  # the management library may be missing, or hidden from the loader, where the driver is not
                return "cuda"
        why = "torch was built without CUDA" if cuda_device_count() else "no CUDA device was found"
        raise UsageError(f"--device cuda: {why}. Use --device cpu, or auto.")
    return "cpu"
