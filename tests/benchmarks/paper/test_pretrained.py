"""IBRNet and MVSNeRF finetuned: the curve, a finetuning from end to end, and the picture that networks are compared with."""

from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.paper import pretrained
from benchmarks.paper.pretrained import BOTH, CHECKS, Finetuned, SourceViewNetwork, finetuned
from benchmarks.paper.pretraining import warped
from benchmarks.paper.result import Request
from benchmarks.paper.runs import Row, settings_of
from benchmarks.paper.source_views import source_views
from efficientnerf.geometry.spaces import BoundedSpace
from tests.benchmarks.paper.scenes import ball
from tests.efficientnerf.balls import cameras


def test_the_curve_says_when_a_level_is_reached() -> None:
    curve = Finetuned(0.1, 1.0, 1.0, 1.0, [1.0, 3.0, 5.0], [10.0, 20.0, 18.0])
    assert (curve.seconds_to(9.0), curve.seconds_to(15.0), curve.seconds_to(20.0)) == (1.0, 2.0, 3.0)
    with pytest.raises(ValueError, match="never"):
        curve.seconds_to(21.0)


def test_the_weights_of_this_package_load_and_are_small() -> None:
    for method in pretrained.NETWORKS:
        assert not any(torch.isnan(p).any() for p in pretrained.pretrained_network(method).parameters())
    assert sum(pretrained.weights_of(method).stat().st_size for method in pretrained.NETWORKS) < 2 * 2**20


@pytest.mark.parametrize("method", list(pretrained.NETWORKS))
def test_a_finetuning_is_measured_once(method: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def untrained(method: str) -> SourceViewNetwork:
        torch.manual_seed(0)
        return pretrained.NETWORKS[method]()

    monkeypatch.setattr(pretrained, "pretrained_network", untrained)
    monkeypatch.setattr(pretrained, "UNIFORM", 16)
    data, said = ball(tmp_path / "ball"), list[str]()
    request = Request(data, tmp_path / "out", 0.001, say=said.append)
    settings = settings_of(Row("pretrained"), 1e-5)
    found = [finetuned(request, data, method, sampling, settings, 0) for sampling in BOTH]
    assert len(said) == 2
    assert finetuned(request, data, method, "uniform", settings, 0) == found[0]
    assert len(said) == 2
    uniform, ours = found
    assert uniform.coarse == 0 < ours.coarse
    assert len(uniform.psnr) == len(uniform.seconds) == len(CHECKS)
    assert ours.begun > 0
    assert sorted(ours.seconds) == ours.seconds


def test_a_view_warped_to_its_own_camera_is_itself() -> None:
    some = cameras(2, 12)
    images = np.random.default_rng(0).random((1, 12, 12, 3), np.float32)
    sources = source_views(BoundedSpace(np.array([[-1.0] * 3, [1.0] * 3])), some[:1], images)
    np.testing.assert_allclose(warped(sources, some[0]), images[0], atol=1e-3)
    assert warped(sources, some[1]).shape == (12, 12, 3)
