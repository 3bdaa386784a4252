"""The mesh against the photographs: drawn from the held-back cameras in its own colours, unlit, before what of the asset is not in it.

Behind the mesh is what is behind the asset in its own figures: a constant background, or the asset without its foreground region (nearer parts of it hide
the mesh). So `psnr` is of whole photographs, as the asset's own.

psnr_covered        over the pixels that the mesh covers by half or more; asset_psnr_covered: the asset's on the same
covered             their share of the pixels that count
roughness           `efficientnerf.surface.roughness`
..._vertex_colours  the same of the mesh in the colours of its vertices
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from efficientnerf.asset.region import surroundings
from efficientnerf.asset.rendering import render
from efficientnerf.asset.tree import NerfTree
from efficientnerf.geometry.cameras import Camera
from efficientnerf.surface.mesh import Mesh, moved
from efficientnerf.surface.roughness import roughness
from efficientnerf.surface.shading import ColouredImage, Shader
from stages.artifacts import MeshOutputs
from stages.evaluate.asset import RenderTree
from stages.evaluate.views import GroundTruth
from stages.formats.exporters.writing import source_frame
from stages.mesh.files import read_mesh

FIGURES = ("psnr", "ssim", "psnr_covered", "psnr_vertex_colours", "ssim_vertex_colours", "asset_psnr_covered", "covered", "roughness")
MARGIN = 0.03  # of the depth, that surroundings have to be nearer to hide the mesh: it ends where they begin


@dataclass(frozen=True, eq=False)
class EvaluatedMesh:
    """A mesh to be measured."""

    shader: Shader  # of the mesh in the training frame
    surroundings: RenderTree | None  # what of the asset is not in it, as `EvaluatedAsset.render`; None: nothing
    facts: dict[str, Any]  # that metrics.json repeats


def evaluated_mesh(mesh: Mesh, surroundings: RenderTree | None) -> EvaluatedMesh:
    """A mesh of the training frame."""
    size = None if mesh.texture is None else max(mesh.texture.colours.shape[:2])
    return EvaluatedMesh(Shader(mesh), surroundings, {"faces": len(mesh.faces), "vertices": len(mesh.vertices), "texture_size": size})


def load_mesh(outputs: MeshOutputs, tree: NerfTree, region: str) -> EvaluatedMesh:
    """The mesh of a run, made of this asset, or of its foreground where `region` says so. Raises CorruptArtifact."""
    to_world = source_frame(tree.metadata).world_from_capture
    mesh = moved(read_mesh(outputs), to_world.scale, to_world.rotation, to_world.translation)
    with_surroundings = tree.ndc is None and (tree.environment is not None or (tree.region is not None and region == "foreground"))
    around = partial(render, surroundings(tree, all_is_foreground=region == "all").to(tree.device)) if with_surroundings else None
    return evaluated_mesh(mesh, around)


def mesh_image(mesh: EvaluatedMesh, camera: Camera, background: tuple[float, float, float] | None) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The image of a camera (H, W, 3) with the mesh in its texture, that with it in the colours of its vertices, the mesh's share of each pixel (H, W), and
    its depth along the view axis (H, W), infinite where it is not seen.

    background  constant, behind the asset; None: its surroundings
    """
    textured, plain = mesh.shader.images(camera)
    around = None if mesh.surroundings is None else mesh.surroundings(camera, background=background, normals=False)
    size = (camera.height, camera.width, 3)
    rest = np.broadcast_to(np.asarray(background or (0.0, 0.0, 0.0), np.float32), size) if around is None else around.colour
    hidden = np.zeros(size[:2], bool) if around is None else around.depth < (1 - MARGIN) * textured.depth

    def image(drawn: ColouredImage) -> np.ndarray:
        return np.asarray(np.where(hidden[..., None], rest, drawn.colour + (1 - drawn.covered[..., None]) * rest), np.float32)

    return image(textured), image(plain), np.where(hidden, 0, textured.covered), np.where(hidden, np.inf, textured.depth)


def mesh_metrics(
    image: np.ndarray, plain: np.ndarray, covered: np.ndarray, depth: np.ndarray, asset: np.ndarray, truth: GroundTruth, camera: Camera
) -> dict[str, float | None]:
    """FIGURES of a view; None where nothing can be compared.

    image, plain, covered, depth  of `mesh_image`, the images clipped
    asset                         its image of the view, clipped
    """
    on_mesh = covered >= 0.5
    return {
        "psnr": truth.psnr(image),
        "ssim": truth.ssim(image),
        "psnr_covered": truth.psnr(image, on_mesh),
        "psnr_vertex_colours": truth.psnr(plain),
        "ssim_vertex_colours": truth.ssim(plain),
        "asset_psnr_covered": truth.psnr(asset, on_mesh),
        "covered": float((truth.used & on_mesh).sum() / truth.used.sum()) if truth.used.any() else None,
        "roughness": roughness(truth.colour, np.where(truth.used, depth, np.inf), camera),
    }
