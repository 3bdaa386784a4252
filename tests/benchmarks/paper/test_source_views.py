"""Fields that look up source views: every piece against a slow loop, values and gradients, and the laws of both networks."""

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from benchmarks.paper.ibrnet import IbrNet, RayAttention, moments, normalised
from benchmarks.paper.mvsnerf import ENCODING, SIDE, MvsNerf, cost_volume
from benchmarks.paper.pretrained import SourceViewNetwork, sweep
from benchmarks.paper.source_view_training import SETTINGS, WHITE, PosedImages, pretrain
from benchmarks.paper.source_views import SourceViews, as_logit, bilinear, look_up, source_views, trilinear
from efficientnerf.geometry.cameras import project, rays
from efficientnerf.geometry.spaces import BoundedSpace
from efficientnerf.model import model
from efficientnerf.rendering.field_renderer import FieldRenderer
from efficientnerf.sampling.occupancy import sweep_cells
from tests.efficientnerf.balls import cameras, picture

BOX = BoundedSpace(np.array([[-1.0, -0.8, -0.9], [1.0, 0.8, 0.9]]))
CAMERAS = cameras(7, 16)


def views() -> SourceViews:
    images = np.random.default_rng(1).random((len(CAMERAS), CAMERAS[0].height, CAMERAS[0].width, 3), np.float32)
    return source_views(BOX, CAMERAS, images)


def bundle(rays_of: int = 5, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Points in grid coordinates, directions and first of rays through the box with uneven numbers of samples; one ray has none."""
    rng = np.random.default_rng(seed)
    counts = [3, 0, 1, 4, 2][:rays_of]
    origins, directions = rng.normal(size=(len(counts), 3)), rng.normal(size=(len(counts), 3))
    origins *= 2.5 / np.linalg.norm(origins, axis=1, keepdims=True)
    directions = rng.uniform(-0.3, 0.3, (len(counts), 3)) - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    points = [origins[r] + (2.0 + 0.3 * n) * directions[r] for r, count in enumerate(counts) for n in range(count)]
    grid = BOX.grid(torch.tensor(np.array(points), dtype=torch.float32))
    return grid, torch.tensor(directions, dtype=torch.float32), torch.tensor([0, *np.cumsum(counts)])


def weighted_gradient(function: Callable[[Tensor], Tensor], at: Tensor) -> tuple[Tensor, Tensor]:
    """Values, and the gradient of a fixed weighted sum of them."""
    at = at.detach().clone().requires_grad_()
    out = function(at)
    (out * torch.linspace(-1, 1, out.numel(), dtype=out.dtype).reshape(out.shape)).sum().backward()
    assert at.grad is not None
    return out.detach(), at.grad


def slow_bilinear(maps: Tensor, view: Tensor, place: Tensor) -> Tensor:
    height, width = maps.shape[1:3]
    rows = []
    for v, (x, y) in zip(view.reshape(-1).tolist(), place.reshape(-1, 2).tolist(), strict=True):
        x, y = min(max(x - 0.5, 0), width - 1), min(max(y - 0.5, 0), height - 1)
        total = torch.zeros(maps.shape[-1], dtype=maps.dtype)
        for j, i in np.ndindex(height, width):
            if (weight := max(0.0, 1 - abs(x - i)) * max(0.0, 1 - abs(y - j))) > 0:
                total = total + weight * maps[v, j, i]
        rows.append(total)
    return torch.stack(rows).reshape(*view.shape, -1)


def test_bilinear_and_trilinear_look_ups_are_those_of_loops() -> None:
    torch.manual_seed(0)
    maps, view, place = torch.randn(2, 3, 4, 2, dtype=torch.float64), torch.randint(2, (5, 3)), torch.rand(5, 3, 2, dtype=torch.float64) * 6 - 1
    for fast, slow in zip(*(weighted_gradient(lambda m, f=f: f(m, view, place), maps) for f in (bilinear, slow_bilinear)), strict=True):  # type: ignore[misc]
        torch.testing.assert_close(fast, slow)

    def slow_trilinear(volume: Tensor, grid: Tensor) -> Tensor:
        rows = []
        for point in (grid * 3 - 0.5).clamp(0, 2):
            total = torch.zeros(2, dtype=volume.dtype)
            for cell in np.ndindex(3, 3, 3):
                if (weight := math.prod(max(0.0, 1 - abs(float(point[k]) - cell[k])) for k in range(3))) > 0:
                    total = total + weight * volume[cell]
            rows.append(total)
        return torch.stack(rows)

    volume, grid = torch.randn(3, 3, 3, 2, dtype=torch.float64), torch.rand(6, 3, dtype=torch.float64) * 1.4 - 0.2
    for fast, slow in zip(*(weighted_gradient(lambda v, f=f: f(v, grid), volume) for f in (trilinear, slow_trilinear)), strict=True):  # type: ignore[misc]
        torch.testing.assert_close(fast, slow)


def test_samples_are_looked_up_where_cameras_project_them_in_the_views_of_least_angle() -> None:
    of, (points, directions, first) = views(), bundle()
    found = look_up(of, points, directions, first, 3)
    world = BOX.world(points).double().numpy()
    np.testing.assert_allclose(found.points, world, atol=1e-5)
    for r in range(len(directions)):
        d, mine = directions[r].double().numpy(), range(int(first[r]), int(first[r + 1]))
        for n in mine:
            middle = world[n] + ((BOX.centre - world[n]) @ d) * d
            cosines = [(middle - c.centre) @ d / np.linalg.norm(middle - c.centre) for c in CAMERAS]
            assert found.view[n].tolist() == np.argsort(-np.array(cosines))[:3].tolist()
            for k, v in enumerate(found.view[n].tolist()):
                camera, towards = CAMERAS[v], world[n] - CAMERAS[v].centre
                towards /= np.linalg.norm(towards)
                np.testing.assert_allclose(found.angles[n, k], [*(d - towards), d @ towards], atol=1e-5)
                pixel, depth = project(camera, world[n][None])
                inside = depth[0] > 0 and bool((pixel >= 0).all() and (pixel <= [camera.width, camera.height]).all())
                assert bool(found.seen[n, k]) == inside
                if inside:
                    np.testing.assert_allclose(found.pixel[n, k], pixel[0], atol=1e-3)


def test_a_ray_does_not_see_its_own_photograph() -> None:
    of = views()
    for v, camera in enumerate(CAMERAS):
        origins, directions = (torch.as_tensor(a, dtype=torch.float32) for a in rays(camera, np.array([[8.2, 7.0], [3.0, 14.0]])))
        found = look_up(of, BOX.grid(origins + 2 * directions), directions, torch.tensor([0, 1, 2]), len(CAMERAS) - 1)
        assert not (found.view == v).any()


def test_moments_are_those_of_a_loop() -> None:
    torch.manual_seed(0)
    values, weight = torch.randn(4, 3, 2, dtype=torch.float64), normalised(torch.rand(4, 3, dtype=torch.float64))

    def slow(values: Tensor) -> Tensor:
        rows = []
        for row, weights in zip(values, weight, strict=True):
            mean = sum(w * v for w, v in zip(weights, row, strict=True))
            rows.append(torch.cat([mean, sum(w * (v - mean) ** 2 for w, v in zip(weights, row, strict=True))]))
        return torch.stack(rows)

    for fast, expected in zip(weighted_gradient(lambda v: moments(v, weight), values), weighted_gradient(slow, values), strict=True):
        torch.testing.assert_close(fast, expected)


def test_attention_is_that_of_a_loop_over_the_samples_of_each_ray() -> None:
    torch.manual_seed(0)
    attention, first = RayAttention(16), bundle()[2]

    def slow(feature: Tensor) -> Tensor:
        rows = []
        for begin, end in zip(first.tolist(), first[1:].tolist(), strict=False):
            for n in range(begin, end):
                heads = []
                for h in range(4):
                    part = slice(4 * h, 4 * h + 4)
                    q, k, v = (attention.queries_keys_values(feature[begin:end])[:, 16 * j : 16 * j + 16][:, part] for j in range(3))
                    heads.append(torch.softmax(k @ q[n - begin] / 2, 0) @ v)
                rows.append(feature[n] + attention.out(torch.cat(heads)))
        return torch.stack(rows)

    feature = torch.randn(int(first[-1]), 16)
    for fast, expected in zip(weighted_gradient(lambda f: attention(f, first), feature), weighted_gradient(slow, feature), strict=True):
        torch.testing.assert_close(fast, expected, atol=1e-5, rtol=1e-4)


def test_the_cost_volume_is_that_of_a_loop_over_voxels() -> None:
    of = views().chosen(torch.tensor([0, 3, 5]))
    torch.manual_seed(0)

    def slow(maps: Tensor) -> Tensor:
        rows = []
        for cell in np.ndindex(3, 3, 3):
            point = BOX.world((torch.tensor(cell) + 0.5) / 3).double().numpy()[None]
            values = []
            for k, v in enumerate((0, 3, 5)):
                pixel, depth = project(CAMERAS[v], point)
                if depth[0] > 0 and (pixel >= 0).all() and (pixel <= [CAMERAS[v].width, CAMERAS[v].height]).all():
                    at = torch.as_tensor(pixel, dtype=torch.float32)
                    view = torch.tensor([k])
                    values.append(torch.cat([slow_bilinear(maps, view, at / 2)[0], slow_bilinear(of.colour, view, at)[0]]))
            mean = sum(values) / max(len(values), 1) if values else torch.zeros(5)
            variance = sum((v - mean) ** 2 for v in values) / max(len(values), 1) if values else torch.zeros(5)
            rows.append(torch.cat([variance, mean[-3:], torch.tensor([len(values) / 3])]))  # type: ignore[list-item, index]
        return torch.stack(rows).reshape(3, 3, 3, -1)

    maps = torch.randn(3, CAMERAS[0].height // 2, CAMERAS[0].width // 2, 2)
    for fast, expected in zip(weighted_gradient(lambda m: cost_volume(of, m, 3), maps), weighted_gradient(slow, maps), strict=True):
        torch.testing.assert_close(fast, expected, atol=1e-4, rtol=1e-3)


@pytest.fixture(params=[IbrNet, MvsNerf])
def network(request: pytest.FixtureRequest) -> SourceViewNetwork:
    torch.manual_seed(0)
    out: SourceViewNetwork = request.param()
    out.observe(views(), torch.tensor([0, 2]))
    return out


def test_rays_do_not_depend_on_the_others_of_their_bundle(network: SourceViewNetwork) -> None:
    points, directions, first = bundle()
    for field in (network.coarse, network.fine):
        whole = field.along_rays(points, directions, first)
        alone = [
            field.along_rays(points[first[r] : first[r + 1]], directions[r : r + 1], torch.tensor([0, int(first[r + 1] - first[r])]))
            for r in range(len(directions))
        ]
        torch.testing.assert_close(whole, torch.cat(alone), atol=1e-4, rtol=1e-3)
        assert field.along_rays(points[:0], directions, torch.zeros_like(first)).shape == (0, 4)


def test_colours_blend_those_of_the_source_views_and_a_colour_survives_its_logit(network: SourceViewNetwork) -> None:
    colour = torch.rand(4, 3)
    torch.testing.assert_close(torch.sigmoid(as_logit(colour)), colour, atol=2e-3, rtol=0)
    points, directions, first = bundle()
    grey = SourceViews(torch.full_like(views().colour, 0.25), *(getattr(views(), n) for n in ("pixels_from_world", "centre", "low", "extent")))
    network.observe(grey, torch.tensor([0]))
    if isinstance(network, IbrNet):  # MVSNeRF's colour is corrected by its network
        found = torch.sigmoid(network.fine.along_rays(points, directions, first)[:, 1:])
        torch.testing.assert_close(found, torch.full((len(points), 3), 0.25), atol=1e-4, rtol=0)


def test_gradients_are_those_of_differences(network: SourceViewNetwork) -> None:
    """Of every parameter that the fine field has or sees, along a random direction."""
    points, directions, first = bundle()
    parameters = [p for name, p in network.named_parameters() if not name.startswith("coarse")]

    def total() -> Tensor:
        network.observe(views(), torch.tensor([0]))
        return network.fine.along_rays(points, directions, first).sum()

    loss = total()
    gradients = torch.autograd.grad(loss, parameters)
    assert all(g.abs().max() > 0 for g in gradients if g.numel() > 1)
    step = [torch.randn_like(p) * (p.abs().mean() + 1e-3) for p in parameters]
    expected = sum((float((g * s).sum().detach()) for g, s in zip(gradients, step, strict=True)), 0.0)
    found = []
    for sign in (1, -1):
        with torch.no_grad():
            for p, s in zip(parameters, step, strict=True):
                p.add_(sign * 2e-3 * s)
            found.append(float(total().detach()))
            for p, s in zip(parameters, step, strict=True):
                p.sub_(sign * 2e-3 * s)
    assert (found[0] - found[1]) / 4e-3 == pytest.approx(expected, rel=0.1, abs=0.1)


def test_a_settled_field_is_a_field_of_a_model_and_renders(network: SourceViewNetwork) -> None:
    network.settle()
    m = model(BOX, SETTINGS, WHITE, fields=(network.coarse, network.fine))
    names = [name for name, _ in m.parameters()]
    assert len(names) == len(set(names))
    assert ("fine.volume" in names) == isinstance(network, MvsNerf)
    assert m.coarse.density(torch.rand(5, 3)).shape == (5,)
    image = FieldRenderer(m, 0.0, 10.0).render(CAMERAS[0]).colour
    assert image.shape == (CAMERAS[0].height, CAMERAS[0].width, 3)
    assert np.isfinite(image).all()
    assert SIDE % 4 == 0


def test_a_sweep_sets_every_voxel_to_the_density_at_a_point_in_it(network: SourceViewNetwork) -> None:
    m = model(BOX, SETTINGS, WHITE, fields=(network.coarse, network.fine))
    _, points = sweep_cells(m.voxels, 0, 1, 3)
    with torch.no_grad():
        expected = m.coarse.density(points)
        nothing = not (expected > m.voxels.threshold).any()
    sweep(m, 3)
    torch.testing.assert_close(m.voxels.values.flatten(), torch.full_like(expected, m.voxels.start) if nothing else expected)


def test_a_voxel_takes_the_encoding_of_the_reference_view_that_is_confident() -> None:
    """Of a network that gives each reference view its own constant encoding and confidence."""
    torch.manual_seed(0)
    net, said = MvsNerf(), iter([(1.0, 0.0), (5.0, 2.0)])
    net.encoder.forward = lambda cost: torch.tensor([*[(of := next(said))[0]] * ENCODING, of[1]]).expand(*cost.shape[:3], -1)  # type: ignore[method-assign]
    net.observe(views(), torch.tensor([0, 2]))
    share = 1 / (1 + math.exp(-2))
    torch.testing.assert_close(net.fine.volume, torch.full((SIDE, SIDE, SIDE, ENCODING), share * 5 + (1 - share)))


def test_source_views_for_a_target_leave_it_out_and_name_the_nearest_of_each_group() -> None:
    images = np.stack([picture(camera) for camera in CAMERAS])
    scene = PosedImages(BoundedSpace(np.array([[-1.0] * 3, [1.0] * 3])), CAMERAS, images)
    for target, elsewhere in ((0, ()), (1, (0, 1, 2))):
        found, references = scene.sources(target, 2, elsewhere)
        centres = [tuple(np.round(c, 4)) for c in found.centre.numpy()]
        assert len(set(centres)) == len(centres)
        assert tuple(np.round(CAMERAS[target].centre.astype(np.float32), 4)) not in centres
        assert len(references) == 1 + len(elsewhere)
        assert references[0] == 0


def test_training_over_scenes_reaches_every_parameter_and_gives_the_same_weights_again(network: SourceViewNetwork) -> None:
    images = np.stack([picture(camera) for camera in CAMERAS])
    scene = PosedImages(BoundedSpace(np.array([[-1.0] * 3, [1.0] * 3])), CAMERAS, images)
    before = {name: p.detach().clone() for name, p in network.named_parameters()}
    torch.manual_seed(0)
    again = type(network)()
    for each in (network, again):
        assert np.isfinite(list(pretrain(each, [scene], 2))).all()
    assert all(torch.equal(p, q) for p, q in zip(network.parameters(), again.parameters(), strict=True))
    assert {name for name, p in network.named_parameters() if (p == before[name]).all()} == set()


def test_source_views_need_a_pinhole_and_a_box() -> None:
    bent = dataclasses.replace(CAMERAS[0], model="SIMPLE_RADIAL", params=(30.0, 12.0, 12.0, 0.1))
    with pytest.raises(ValueError, match="PINHOLE"):
        source_views(BOX, [bent], np.zeros((1, 16, 16, 3), np.float32))
