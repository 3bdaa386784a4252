"""Textures from the asset alone: its colours where no photograph shows any, or where there are none."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from efficientnerf.asset.tree import NerfTree
from efficientnerf.surface.colours import CHUNK, surface_colours
from efficientnerf.surface.isosurface import Progress
from efficientnerf.surface.mesh import Mesh, Texture, vertex_normals
from efficientnerf.surface.texturing.atlas import Atlas, atlas_of
from efficientnerf.surface.texturing.filling import texture_from
from efficientnerf.surface.volume import volume_of

TEXELS_PER_VOXEL = 1.5


def texture_of_asset(tree: NerfTree, mesh: Mesh, *, largest: int, progress: Progress) -> Mesh:
    """The mesh with a texture that shows the colours of the tree that it was made of, and facts on that.

    mesh     in the training frame, as `efficientnerf.surface.nested.scene_surface` gives it; turn and scale it afterwards (`surface.mesh.moved`)
    largest  texels along a side, at most: about one and a half for each voxel where that is enough
    """
    atlas = atlas_of(mesh.vertices, mesh.faces, TEXELS_PER_VOXEL / float(tree.voxel), largest)
    texture = texture_from(atlas, asset_colours(tree, mesh, atlas, progress))
    facts = {"texture": "asset", "texture_size": atlas.size, "texture_charts": int(atlas.chart.max(initial=-1)) + 1}
    return replace(mesh, texture=Texture(atlas.coordinates, texture), facts=mesh.facts | facts)


def asset_colours(tree: NerfTree, mesh: Mesh, atlas: Atlas, progress: Progress) -> np.ndarray:
    """(T, 3) uint8 sRGB of the tree at the texels of a mesh of the training frame."""
    volume, texels = volume_of(tree), atlas.texels
    vertices = tree.frame.points(mesh.vertices)
    normals = mesh.normals if tree.ndc is None else vertex_normals(vertices, mesh.faces)
    out = np.empty((len(texels.place), 3), np.uint8)
    for start in range(0, len(out), CHUNK):
        part = slice(start, start + CHUNK)
        progress(start, len(out), "texture")
        normal = texels.values(normals, mesh.faces, part)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        at = texels.values(vertices, mesh.faces, part)
        found = surface_colours(volume, at, normal)
        out[part] = np.round(found * 255).astype(np.uint8)
    progress(len(out), len(out), "texture")
    return out


def interpolated(mesh: Mesh, atlas: Atlas, tick: Callable[[], None] = lambda: None) -> np.ndarray:
    """(T, 3) uint8 the colours of the mesh's vertices, which are those of the tree, at the texels."""
    out = np.empty((len(atlas.texels.place), 3), np.uint8)
    for start in range(0, len(out), CHUNK):
        part = slice(start, start + CHUNK)
        tick()
        out[part] = np.round(np.clip(atlas.texels.values(mesh.colours, mesh.faces, part), 0, 1) * 255).astype(np.uint8)
    return out
