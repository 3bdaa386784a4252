"""Plain regions: where they are, and a loss that is nothing on a plane and fills what lies between opaque ends."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from efficientnerf.backends import transfer
from efficientnerf.geometry.cameras import Camera, rays
from efficientnerf.model import render_rays
from efficientnerf.training import plain_regions
from efficientnerf.training.loop import state_of, train, trainer
from efficientnerf.training.pixels import Pixels
from efficientnerf.training.plain_regions import PlainTriples, drawn_triples, plain_discs, plain_loss, plain_weight
from tests.efficientnerf.balls import BOUNDS, cameras, pose, untrained

WIDTH, HEIGHT, BEGIN = 96, 64, 24


def _camera() -> Camera:
    return Camera("wall.png", WIDTH, HEIGHT, "SIMPLE_PINHOLE", (80.0, WIDTH / 2, HEIGHT / 2), pose(0.7, 0.3))


def _pixels(image: np.ndarray, mask: np.ndarray | None = None) -> Pixels:
    return Pixels([_camera()], [image], [mask], np.full(1, 1.0), np.full(1, 5.0))


def _plain_from(column: int) -> np.ndarray:
    """Noise on the left, a slow slope of colour on the right."""
    image = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
    image[:, column:] = (120 + np.arange(WIDTH - column) // 2)[None, :, None]
    return image


def test_discs_and_their_triples_lie_in_what_is_plain() -> None:
    pixels = _pixels(_plain_from(BEGIN))
    discs = plain_discs(pixels)
    assert discs is not None
    assert len(discs.pixel) > 500
    y, x = np.divmod(discs.pixel, WIDTH)
    clear = np.minimum.reduce([x - BEGIN, WIDTH - x, y + 1, HEIGHT - y])
    assert (discs.radius <= clear).all()
    assert discs.radius.max() == pytest.approx(plain_regions.MOST_RADIUS * WIDTH)
    pixel, triples = drawn_triples(discs, pixels, 400, np.random.default_rng(1))
    assert triples.forward.shape == (1200, 3)
    (ay, by, cy), (ax, bx, cx) = (part.reshape(3, -1) for part in np.divmod(pixel, WIDTH))
    assert ((ax + cx == 2 * bx) & (ay + cy == 2 * by) & (np.hypot(ax - bx, ay - by) > 1)).all()
    assert np.minimum(ax, cx).min() >= BEGIN


def test_there_are_none_in_noise_in_masks_and_behind_alpha() -> None:
    image = _plain_from(BEGIN)
    masked = np.ones((HEIGHT, WIDTH), bool)
    masked[:, BEGIN:] = False
    assert plain_discs(_pixels(_plain_from(WIDTH))) is None
    assert plain_discs(_pixels(image, masked)) is None
    assert plain_discs(_pixels(np.concatenate([image, np.full((HEIGHT, WIDTH, 1), 255, np.uint8)], axis=2))) is None


def test_a_large_capture_keeps_a_share_of_its_discs(monkeypatch: pytest.MonkeyPatch) -> None:
    every = plain_discs(_pixels(_plain_from(BEGIN)))
    assert every is not None
    monkeypatch.setattr(plain_regions, "MOST_DISCS", len(every.pixel) // 4)
    some = plain_discs(_pixels(_plain_from(BEGIN)))
    assert some is not None
    assert np.isin(some.pixel, every.pixel).all()
    assert len(some.pixel) == pytest.approx(len(every.pixel) / 4, rel=0.1)


def test_discs_of_a_large_photograph_are_looked_for_in_a_small_one(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = plain_discs(_pixels(_plain_from(BEGIN)))
    monkeypatch.setattr(plain_regions, "LONGEST", WIDTH // 3)
    small = plain_discs(_pixels(_plain_from(BEGIN)))
    assert whole is not None
    assert small is not None
    at = dict(zip(whole.pixel.tolist(), whole.radius.tolist(), strict=True))
    assert len(small.pixel) > len(whole.pixel) / 30
    assert all(at[pixel] >= radius - 1 for pixel, radius in zip(small.pixel.tolist(), small.radius.tolist(), strict=True))


def _triples(distance: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Origins, directions and view axes of triples, and the distances along them to a slanted plane."""
    pixels, camera = _pixels(np.full((HEIGHT, WIDTH, 3), 90, np.uint8)), _camera()
    discs = plain_discs(pixels)
    assert discs is not None
    pixel, triples = drawn_triples(discs, pixels, 50, np.random.default_rng(2))
    y, x = np.divmod(pixel, WIDTH)
    origins, directions = rays(camera, np.stack([x + 0.5, y + 0.5], axis=-1))
    normal = camera.forward + 0.4 * camera.up
    return origins, directions, triples.forward, distance * (normal @ camera.forward) / (directions @ normal)


def _loss(distance: float, opacity: Any, moved: Any = 0.0) -> tuple[float, torch.Tensor, torch.Tensor]:
    """The loss of surfaces of such opacities (3,) on a plane, those of the middles moved away, and its gradients by opacity and place (3, K)."""
    origins, directions, forward, depth = (torch.from_numpy(np.asarray(part, np.float32)) for part in _triples(distance))
    count = len(depth)
    weight = torch.as_tensor(opacity, dtype=torch.float32).repeat_interleave(count // 3).requires_grad_()
    at = (depth + torch.tensor([0, moved, 0]).repeat_interleave(count // 3)).requires_grad_()
    samples = SimpleNamespace(start=at, extent=torch.zeros(count), first=torch.arange(count + 1))
    outputs: Any = SimpleNamespace(coarse=samples, fine=samples, coarse_weight=weight, fine_weight=weight)
    loss = plain_loss(untrained(contracted=True), outputs, origins, directions, PlainTriples(forward), None)
    by_weight, by_place = torch.autograd.grad(loss, [weight, at], allow_unused=True)
    return float(loss.detach()), by_weight.view(3, -1), by_place.view(3, -1)


def test_a_plane_costs_nothing_whichever_way_it_slants() -> None:
    assert _loss(3.0, [1.0, 1.0, 1.0])[0] < 1e-6


@pytest.mark.parametrize("moved", [0.3, -0.3])
def test_a_dent_costs_and_its_middle_is_drawn_back(moved: float) -> None:
    loss, _, by_place = _loss(3.0, [1.0, 1.0, 1.0], moved)
    assert loss > 0.02
    assert (by_place[1] * moved > 0).all()
    assert _loss(3.0, [1.0, 1.0, 1.0], moved / 3)[0] < loss


def test_a_gap_between_opaque_ends_is_filled_and_ends_stay() -> None:
    loss, by_weight, _ = _loss(3.0, [0.95, 0.4, 0.97])
    assert loss == pytest.approx(2 * 0.55, rel=1e-3)
    assert (by_weight[1] < 0).all()
    assert by_weight[[0, 2]].abs().max() < 1e-4


@pytest.mark.parametrize("opacity", [[0.95, 0.4, 0.6], [0.1, 0.0, 0.1]])
def test_nothing_is_filled_where_an_end_is_not_opaque(opacity: list[float]) -> None:
    assert _loss(3.0, opacity)[0] < 1e-3


def test_what_is_far_away_may_be_sky() -> None:
    farthest = plain_regions.FARTHEST * (3 + np.linalg.norm(BOUNDS[1] - BOUNDS[0]) / 2)
    assert _loss(1.5 * farthest, [1.0, 0.3, 1.0])[0] == 0
    assert _loss(0.7 * farthest, [1.0, 0.3, 1.0])[0] > 1


def test_rays_without_all_of_their_samples_do_not_count() -> None:
    origins, directions, forward, depth = (torch.from_numpy(np.asarray(part, np.float32)) for part in _triples(3.0))
    count = len(depth)
    weight = torch.tensor([1.0, 0.2, 1.0]).repeat_interleave(count // 3)
    samples = SimpleNamespace(start=depth, extent=torch.zeros(count), first=torch.arange(count + 1))
    outputs: Any = SimpleNamespace(coarse=samples, fine=samples, coarse_weight=weight, fine_weight=weight)
    complete = torch.ones(count + 7, dtype=torch.bool)
    m, triples = untrained(contracted=True), PlainTriples(forward)
    assert float(plain_loss(m, outputs, origins, directions, triples, complete)) == pytest.approx(1.6, rel=1e-3)
    complete[: count // 3] = False
    assert float(plain_loss(m, outputs, origins, directions, triples, complete)) == 0


def test_on_a_device_the_samples_of_all_rays_are_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rays after the triples change nothing, and loss and gradient are the same."""
    m, rng, (origins, directions, forward, _) = untrained(contracted=True), np.random.default_rng(3), _triples(3.0)
    rays_of = [torch.from_numpy(np.asarray(part, np.float32)) for part in (origins, directions)]
    near, far, offset = torch.full((150,), 0.5), torch.full((150,), 9.0), torch.from_numpy(rng.random(150, np.float32))

    def found(rays: int) -> tuple[float, torch.Tensor]:
        bundle = [part[:rays] for part in (*rays_of, near, far, offset, torch.zeros(150, 3))]
        outputs = render_rays(m, *bundle, prune=False)
        loss = plain_loss(m, outputs, *bundle[:2], PlainTriples(torch.from_numpy(forward[:120])), None)
        (gradient,) = torch.autograd.grad(loss, m.fine.weights[-1])
        return float(loss.detach()), gradient

    monkeypatch.setattr(plain_regions, "OPAQUE", 0.0)
    alone, gradient = found(120)
    assert alone > 0.001
    for on_device in (False, True):
        monkeypatch.setattr(transfer, "is_on_device", lambda values, on_device=on_device: on_device)
        loss, other = found(150)
        assert loss == pytest.approx(alone, rel=1e-5)
        torch.testing.assert_close(other, gradient, rtol=1e-3, atol=1e-7)


def test_the_weight_rises_and_stays() -> None:
    weights = [plain_weight(0.01, fraction) for fraction in (0, plain_regions.RAMP / 2, plain_regions.RAMP, 1)]
    assert weights == pytest.approx([0, 0.005, 0.01, 0.01])


def test_unbounded_scenes_are_trained_with_it_where_asked_and_objects_are_not() -> None:
    made = cameras(4, 48)
    plain = [np.full((48, 48, 3), 60 + 30 * n, np.uint8) for n in range(4)]

    def state(weight: float, contracted: bool) -> bytes:
        t = trainer(untrained(contracted=contracted, iterations=6, plain_loss_weight=weight))
        list(train(t, Pixels(made, plain, [None] * 4, np.full(4, 1.0), np.full(4, 50.0))))
        return b"".join(tensor.numpy().tobytes() for name, tensor in sorted(state_of(t).items()))

    assert state(0.0, contracted=True) != state(0.01, contracted=True)
    assert state(0.01, contracted=True) == state(0.01, contracted=True)
    assert state(0.0, contracted=False) == state(0.01, contracted=False)
