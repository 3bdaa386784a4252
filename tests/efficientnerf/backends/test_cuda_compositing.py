"""Compositing by the CUDA kernels where samples are opaque, or padding; other values and gradients are in test_operations.py."""

import numpy as np
import pytest
import torch

from efficientnerf.rendering import compositing
from tests.efficientnerf.bundles import Bundle, bundle, in_float32
from tests.efficientnerf.device import DEVICE

cuda = pytest.importorskip("efficientnerf.backends.triton.compositing")


def there(b: Bundle) -> Bundle:
    return Bundle(*(t.to(DEVICE) for t in in_float32(b)))


def outcome(composite: object, b: Bundle, activation: str) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    """All results, and the gradients of a random mixture of them."""
    rng = np.random.default_rng(9)
    raw, background = b.raw.clone().requires_grad_(), b.background.clone().requires_grad_()
    out = composite(raw, b.length, b.first, b.harmonics, background, activation)  # type: ignore[operator]
    pull = [torch.from_numpy(rng.normal(size=tuple(t.shape))).to(t) for t in out[:4]]
    torch.autograd.backward([(t * p).sum() for t, p in zip(out[:4], pull, strict=True)])
    assert raw.grad is not None
    assert background.grad is not None
    return [t.detach() for t in out], [raw.grad, background.grad]


@pytest.mark.parametrize("activation", ["exp", "softplus"])
def test_a_wall_hides_what_lies_behind_it_and_is_fully_seen(activation: str) -> None:
    """Thin samples, then one of e^15 or so: their sum in float32 would lose the thin ones."""
    raw = torch.zeros(40, 4)
    raw[:, 0] = -3.0
    raw[20, 0] = 40.0 if activation == "exp" else 1e6
    b = Bundle(raw, torch.full((40,), 0.1), torch.tensor([0, 40]), torch.full((1, 1), 0.28), torch.ones(1, 3))
    values, grads = outcome(cuda.composite, there(b), activation)
    expected, expected_grads = outcome(compositing.composite, Bundle(*(t.double() if t.is_floating_point() else t for t in b)), activation)
    for ours, theirs in zip(values + grads, expected + expected_grads, strict=True):
        torch.testing.assert_close(ours.cpu().double(), theirs, rtol=1e-4, atol=3e-6)
    assert values[3][21:].max() < 1e-9


def test_padding_has_neither_weight_nor_gradient() -> None:
    b = there(bundle(1))
    padded = b._replace(raw=torch.cat([b.raw, torch.full_like(b.raw, 5.0)]), length=torch.cat([b.length, b.length]))
    (values, grads), (whole, expected) = (outcome(cuda.composite, x, "exp") for x in (b, padded))
    samples = len(b.raw)
    for a, c in zip(values[:3], whole[:3], strict=True):
        assert torch.equal(a, c)
    assert torch.equal(values[3], whole[3][:samples])
    assert not whole[3][samples:].any()
    assert not expected[0][samples:].any()
    assert grads[0].shape == b.raw.shape
