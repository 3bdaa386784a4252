"""Which device is taken, and that asking does not import torch."""

import subprocess
import sys

import pytest
import torch

from pipeline.errors import UsageError
from workflows.cli import device


@pytest.mark.parametrize(
    ("devices", "built", "wanted", "taken"),
    [(1, True, "auto", "cuda"), (1, False, "auto", "cpu"), (0, True, "auto", "cpu"), (1, True, "cpu", "cpu")],
)
def test_the_device_that_is_taken(monkeypatch: pytest.MonkeyPatch, devices: int, built: bool, wanted: str, taken: str) -> None:
    monkeypatch.setattr(device, "cuda_device_count", lambda: devices)
    monkeypatch.setattr(device, "torch_has_cuda", lambda: built)
    assert device.resolve_device(wanted) == taken


@pytest.mark.parametrize(("devices", "built"), [(1, False), (0, True)])
def test_cuda_that_is_not_there_is_refused(monkeypatch: pytest.MonkeyPatch, devices: int, built: bool) -> None:
    monkeypatch.setattr(device, "cuda_device_count", lambda: devices)
    monkeypatch.setattr(device, "torch_has_cuda", lambda: built)
    with pytest.raises(UsageError, match="CUDA"):
        device.resolve_device("cuda")


def test_torch_has_the_last_word_where_cuda_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device, "cuda_device_count", lambda: 0)
    monkeypatch.setattr(device, "torch_has_cuda", lambda: True)
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    assert device.resolve_device("cuda") == "cuda"
    assert device.resolve_device("auto") == "cpu"


def test_it_agrees_with_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    assert device.torch_has_cuda() == (torch.version.cuda is not None)
    assert device.has_cuda() == torch.cuda.is_available()
    for hidden in ("", "-1"):
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", hidden)
        assert device.cuda_device_count() == 0


def test_asking_does_not_import_torch() -> None:
    program = "import sys; from workflows.cli.device import has_cuda; has_cuda(); sys.exit('torch' in sys.modules)"
    subprocess.run([sys.executable, "-c", program], check=True)
