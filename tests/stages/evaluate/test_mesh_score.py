"""The mesh's figures: a mesh as good as its asset is as good as that, a worse one is not, and what lies round it is the asset's own."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from efficientnerf.asset import region
from efficientnerf.asset.rendering import Rendering
from efficientnerf.asset.tree import Region
from efficientnerf.geometry.cameras import Camera
from stages.evaluate.mesh import mesh_image
from stages.io.scene import load
from tests.efficientnerf.trees import random_cascades
from tests.fakes import WHITE, BallField
from tests.stages.evaluate.balls import BALL_MESH, TREE, figures_of, job_in, make_scene, measure, settings


def test_the_true_surface_is_about_as_good_as_the_asset(tmp_path: Path) -> None:
    """The ball's rim is soft in the photographs, and the mesh has one."""
    job = job_in(tmp_path, make_scene(tmp_path / "poses", "rtt"), settings(field_views=1))
    measure(TREE, lambda: BallField(TREE, background=WHITE), job)
    found = figures_of(job)
    mesh = found["mesh"]
    assert mesh["psnr"] > 28
    assert mesh["ssim"] > 0.9
    assert mesh["psnr_covered"] > 25
    assert mesh["asset_psnr_covered"] > mesh["psnr_covered"]
    assert (mesh["faces"], mesh["vertices"], mesh["texture_size"], mesh["views"]) == (1280, 642, None, 2)
    assert mesh["psnr_vertex_colours"] == mesh["psnr"], "it has no texture"
    assert mesh["covered"] == pytest.approx(np.pi * (0.6 * 70 / np.sqrt(3**2 - 0.6**2)) ** 2 / (60 * 44), rel=0.05)
    assert mesh["psnr"] == pytest.approx(np.mean([view["mesh"]["psnr"] for view in found["views"]]))


def flat(colour: tuple[float, float, float], depth: float):  # type: ignore[no-untyped-def]
    def render(camera: Camera, *, background: tuple[float, float, float] | None = None, normals: bool = True) -> Rendering:
        size = (camera.height, camera.width)
        return Rendering(np.full((*size, 3), colour, np.float32), np.ones(size, np.float32), np.full(size, depth, np.float32), np.zeros((*size, 3)))

    return render


@pytest.mark.parametrize(("depth", "shown"), [(2.0, False), (6.0, True)], ids=["before it", "behind it"])
def test_surroundings_that_are_nearer_hide_the_mesh(tmp_path: Path, depth: float, shown: bool) -> None:
    """The cameras are three away from the middle of the ball."""
    scene = load(make_scene(tmp_path / "poses", "t"))
    around = replace(BALL_MESH, surroundings=flat((0.0, 1.0, 0.0), depth))
    image, plain, covered, _ = mesh_image(around, scene.views[0].camera, WHITE)
    middle = image[22, 30]
    np.testing.assert_allclose(image[0, 0], [0, 1, 0])
    assert (covered[22, 30], bool(abs(middle - [0, 1, 0]).max() > 0.2)) == (float(shown), shown)
    np.testing.assert_array_equal(image, plain)


def test_foreground_and_surroundings_make_up_the_whole() -> None:
    """Voxel by voxel the opacities of the two sum to the tree's; the environment belongs to the surroundings."""
    tree = random_cascades(3)
    middle, size = (tree.bounds_min + tree.bounds_max) / 2, tree.bounds_max - tree.bounds_min
    tree = replace(tree, region=Region(np.stack([middle - 0.3 * size, middle + 0.3 * size]), 0.0, 0.2 * float(size.min())))
    share = region.inside_share(tree.region, region.voxel_centres(tree))
    front, rest = region.foreground(tree), region.surroundings(tree)
    assert ((share > 0) & (share < 1)).any()
    assert len(front.density_values) == (share > 0).sum()
    assert len(rest.density_values) == (share < 1).sum()
    side = region.voxel_sides(tree)

    def alpha(part: object, kept: np.ndarray) -> np.ndarray:
        out = np.zeros(len(share))
        out[kept] = -np.expm1(-side[kept] * part.density_values)  # type: ignore[attr-defined]
        return out

    np.testing.assert_allclose(alpha(front, share > 0) + alpha(rest, share < 1), alpha(tree, np.ones(len(share), bool)), atol=1e-5)
    assert front.environment is None
    assert rest.environment is tree.environment
    assert rest.region is None
    alone = region.surroundings(tree, all_is_foreground=True)
    assert len(alone.density_values) == 0
    assert alone.environment is tree.environment
