"""LPIPS against its formula with made-up weights, from files; and what is said where they are missing."""

from pathlib import Path

import numpy as np
import pytest
import torch

from efficientnerf.evaluation.lpips import CHANNELS, SHIFT, TAPS, _layers
from pipeline.errors import BadInput
from stages.evaluate.comparison import load_lpips
from stages.evaluate.lpips_weights import BACKBONES


@pytest.fixture(autouse=True)
def nowhere_else(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "home"))


def made_up(network: str) -> tuple[dict[str, torch.Tensor], dict[str, torch.Tensor]]:
    generator = torch.Generator().manual_seed(len(network))
    own = _layers(network).state_dict()
    features = {f"features.{name}": torch.randn(t.shape, generator=generator) * (2 / max(1, t[0].numel())) ** 0.5 for name, t in own.items()}
    features["classifier.6.weight"] = torch.zeros(3)  # the rest of the network is not looked at
    heads = {f"lin{n}.model.1.weight": torch.rand(1, c, 1, 1, generator=generator) for n, c in enumerate(CHANNELS[network])}
    return features, heads


def written(folder: Path, network: str) -> str:
    folder.mkdir(exist_ok=True)
    features, heads = made_up(network)
    torch.save(features, folder / BACKBONES[network])
    torch.save(heads, folder / f"{network}.pth")
    return str(folder)


def images(side: int = 70) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return rng.random((side, side + 9, 3)), rng.random((side, side + 9, 3))


@pytest.mark.parametrize("network", ["alex", "vgg"])
def test_it_is_the_formula(network: str, tmp_path: Path) -> None:
    metric = load_lpips(network, written(tmp_path / "weights", network))
    image, truth = images()
    features, heads = made_up(network)
    inputs = [((2 * a - 1 - np.array(SHIFT)) / np.array([0.458, 0.448, 0.450])).transpose(2, 0, 1)[None] for a in (image, truth)]
    x, y = (torch.tensor(a, dtype=torch.float32) for a in inputs)
    expected, tap = 0.0, 0
    layers = _layers(network)
    layers.load_state_dict({name.removeprefix("features."): t for name, t in features.items() if name.startswith("features.")})
    with torch.no_grad():
        for n, layer in enumerate(layers):
            x, y = layer(x), layer(y)
            if n in TAPS[network]:
                assert isinstance(layer, torch.nn.ReLU)
                assert x.shape[1] == CHANNELS[network][tap]
                one, other = (f / f.norm(dim=1, keepdim=True).clamp(min=1e-4) for f in (x, y))
                head = heads[f"lin{tap}.model.1.weight"][0, :, 0, 0].numpy()
                expected += np.einsum("chw,c->hw", ((one - other) ** 2)[0].numpy(), head).mean()
                tap += 1
    assert tap == 5
    assert metric(image, truth) == pytest.approx(expected, rel=1e-3)
    assert metric(truth, image) == pytest.approx(metric(image, truth), rel=1e-5)
    assert metric(truth, truth) == 0
    assert metric(0.9 * truth + 0.1 * image, truth) < metric(image, truth)


def test_damaged_and_wrong_weights_are_refused(tmp_path: Path) -> None:
    folder = Path(written(tmp_path / "weights", "alex"))
    torch.save({"lin0.model.1.weight": torch.zeros(1, 3, 1, 1)}, folder / "alex.pth")
    with pytest.raises(BadInput, match=r"lin0.*expected \(1, 64, 1, 1\)"):
        load_lpips("alex", str(folder))
    (folder / "alex.pth").write_bytes(b"not weights")
    with pytest.raises(BadInput):
        load_lpips("alex", str(folder))
