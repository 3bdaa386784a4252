"""benchmarks/gpu.py without a device: its parts at small sizes on the CPU; a part that fails does not stop the others."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
import torch

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
SMALL = {
    "num_levels": 4, "log2_hashmap_size": 11, "finest_resolution": 64, "hidden_dim": 16, "num_layers": 1, "coarse_hidden_dim": 16,
    "coarse_num_layers": 1, "sh_degree": 1, "occupancy_resolution": 24, "num_coarse_samples": 16, "samples_per_pivot": 2, "sample_batch_size": 6144,
    "occupancy_warmup_steps": 20, "occupancy_update_interval": 4, "learning_rate": 3e-2,
}  # fmt: skip


@pytest.fixture(autouse=True)
def benchmarks_on_the_path(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARKS))


def test_an_asset_is_made_without_files() -> None:
    import gpu_asset

    found = gpu_asset.asset_rates("cpu", steps=60, side=32, views=8, resolution=24, pixels=4000, refine_steps=12, rays=512, **SMALL)
    assert found["refine_on"] == "host"
    assert found["refine_waits_in_32_steps"] == {}
    assert 0 < found["voxels_that_show"] < found["voxels"]
    assert found["training_psnr"]["refined"] > found["training_psnr"]["baked"] > 8
    assert found["test_psnr"]["refined"] > found["test_psnr"]["network"]


def test_steps_of_the_papers_rows_are_timed() -> None:
    import gpu_kernels

    few = {
        "hidden_dim": 16, "num_layers": 2, "coarse_hidden_dim": 16, "coarse_num_layers": 2, "num_coarse_samples": 8, "num_importance_samples": 8,
        "max_rays_per_batch": 16, "occupancy_resolution": 16,
    }  # fmt: skip
    found = gpu_kernels.paper_rates("cpu", 4, 16, 3, **few)
    assert list(found) == ["nerf", "uniform", "sh", "light", "valid", "n4"]
    for row in found.values():
        assert row["rays"] == 16
        assert row["samples_per_second"] > 0
        assert row["waits_in_32_steps"] == {}
        assert row["rays_left_out_in_32_steps"] == 0


def test_a_part_that_fails_is_noted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if torch.cuda.is_available():
        pytest.skip("there is a CUDA device, on which nothing fails")
    import gpu

    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    monkeypatch.setattr("torch.cuda.get_device_name", lambda: "none")
    out = tmp_path / "out.json"
    monkeypatch.setattr(sys, "argv", ["gpu.py", "--parts", "kernels,pipeline", "--json", str(out), str(tmp_path)])
    assert gpu.main() == 1
    written = json.loads(out.read_text())
    assert "CUDA" in written["kernels"]["error"]
    assert "exit_code" in written["pipeline"] or "left_out" in written["pipeline"]
