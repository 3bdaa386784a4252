"""Benchmarks of a device, at small sizes on the CPU: what breaks them is found before one is at hand."""

import importlib
import sys
from pathlib import Path
from types import ModuleType

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture
def benchmark(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Loaded as `benchmarks/gpu.py` does, next to each other."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    for name in ("gpu_kernels", "gpu_asset"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return importlib.import_module(request.param)


@pytest.mark.parametrize("benchmark", ["gpu_kernels"], indirect=True)
def test_training_is_timed(benchmark: ModuleType) -> None:
    sizes = {"sample_batch_size": 1024, "max_rays_per_batch": 256, "num_levels": 4, "log2_hashmap_size": 10, "finest_resolution": 32}
    figures = benchmark.training_rates("cpu", 4, 16, 4, **sizes)
    assert figures["steps_per_second"] > 0
    assert 5 < figures["psnr"] < 30
    assert figures["rays"] > 0


@pytest.mark.parametrize("benchmark", ["gpu_asset"], indirect=True)
def test_an_asset_is_timed(benchmark: ModuleType) -> None:
    figures = benchmark.asset_rates(
        "cpu", steps=60, side=24, views=6, resolution=24, pixels=2000, refine_steps=4, rays=1024, sample_batch_size=4096
    )  # fmt: skip
    assert figures["refine_steps_per_second"] > 0
    assert figures["training_psnr"]["refined"] > figures["training_psnr"]["baked"] > 10
