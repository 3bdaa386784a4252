"""Benchmarks of a device, at small sizes on the CPU: what breaks them is found before one is at hand."""

import importlib
from pathlib import Path
from types import ModuleType

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


def load(name: str, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """As `benchmarks/gpu.py` does: its modules import each other by their last names."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module(name)


def test_training_is_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = {"sample_batch_size": 1024, "max_rays_per_batch": 256, "num_levels": 4, "log2_hashmap_size": 10, "finest_resolution": 32}
    figures = load("gpu_kernels", monkeypatch).training_rates("cpu", 4, 16, 4, **sizes)
    assert figures["steps_per_second"] > 0
    assert 5 < figures["psnr"] < 30
    assert figures["rays"] > 0


def test_an_asset_is_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = {"steps": 60, "side": 24, "views": 6, "resolution": 24, "pixels": 2000, "refine_steps": 4, "rays": 1024, "sample_batch_size": 4096}
    figures = load("gpu_asset", monkeypatch).asset_rates("cpu", **sizes)
    assert figures["refine_steps_per_second"] > 0
    assert figures["training_psnr"]["refined"] > figures["training_psnr"]["baked"] > 10
