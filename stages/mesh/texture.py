"""The texture of a mesh: from the training photographs, one in memory at a time, or from the asset. Test and validation views are left for scores."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from efficientnerf.asset.tree import NerfTree
from efficientnerf.surface.mesh import Mesh, Texture
from efficientnerf.surface.shading import vertex_colours
from efficientnerf.surface.texturing.asset import texture_of_asset
from efficientnerf.surface.texturing.atlas import TooManyCharts, atlas_of
from efficientnerf.surface.texturing.filling import texture_from
from efficientnerf.surface.texturing.photographs import Photograph, PhotographTexture, exposed_alike, photograph, survey, texels_wanted
from pipeline.errors import UsageError
from stages.io.refined_cameras import load_scene
from stages.io.scene import View, load, views_of
from stages.train.averaged import averaged_views

Progress = Callable[[int, int, str], None]


def textured(mesh: Mesh, tree: NerfTree, captured: tuple[Path, Path], choice: str, largest: int, progress: Progress) -> Mesh:
    """A mesh of the training frame with a texture, vertex colours from it, and further facts.

    captured  folders of the stages poses and train
    choice    "photographs", "asset", "off", or "auto": photographs where the training views show any of the mesh, else the asset
    largest   texels along a side, at most
    progress  is called often; what it raises stops the work
    """
    if choice == "off":
        return mesh
    try:
        found = None if choice == "asset" else _from_photographs(mesh, captured, largest, progress)
        if found is None or (choice != "photographs" and not found.facts["texture_observed"]):
            found = texture_of_asset(tree, mesh, largest=largest, progress=progress)
    except TooManyCharts as error:
        raise UsageError(f"mesh: {error}. Raise mesh.texture_size, or lower mesh.max_faces.") from error
    return replace(found, colours=vertex_colours(found))  # docs/experiments/vertex-colours.md


def _from_photographs(mesh: Mesh, captured: tuple[Path, Path], largest: int, progress: Progress) -> Mesh | None:
    """Textured by the training photographs; None where there are none."""
    views = views_of(load_scene(*captured), "train")
    if not views:
        return None
    surveys, steps = [], 2 * len(views)
    for number, photo in enumerate(photographs(*captured, views)):
        progress(number, steps, "texture")
        surveys.append(survey(mesh.vertices, mesh.faces, mesh.normals, mesh.colours, photo, partial(progress, number, steps, "texture")))
    surveys = exposed_alike(surveys)
    density = np.max([each.density for each in surveys], axis=0)
    atlas = atlas_of(mesh.vertices, mesh.faces, texels_wanted(mesh.vertices, mesh.faces, density), largest)
    sharpness = float(np.median([each.sharpness for each in surveys]))
    progress(len(views), steps, "charts")
    texels = PhotographTexture(mesh.vertices, mesh.faces, mesh.normals, atlas, density, sharpness)
    for number, photo in enumerate(photographs(*captured, views)):
        progress(len(views) + number, steps, "texture")
        texels.look(photo, surveys[number], partial(progress, len(views) + number, steps, "texture"))
    colours, known = texels.finished(mesh, partial(progress, steps, steps, "texture"))
    progress(steps, steps, "texture")
    facts = {
        "texture": "photographs",
        "texture_size": atlas.size,
        "texture_charts": int(atlas.chart.max(initial=-1)) + 1,
        "texture_observed": float(f"{(known >= 0.5).mean() if len(known) else 0.0:.4g}"),
        "texels_per_pixel": texels.texels_per_pixel(),
    }
    return replace(mesh, texture=Texture(atlas.coordinates, texture_from(atlas, colours)), facts=mesh.facts | facts)


def largest_photograph(poses: Path, choice: str) -> int:
    """Pixels of the largest photograph that a texture is made of; none where it is not made of any."""
    if choice in ("off", "asset"):
        return 0
    return max((view.camera.width * view.camera.height for view in views_of(load(poses), "train")), default=0)


def photographs(poses: Path, train: Path, views: tuple[View, ...]) -> Iterator[Photograph]:
    """The photographs of views, read when they are asked for; where training learned their exposure, as if all had been exposed alike."""
    read = averaged_views(poses, train)
    for view in views:
        yield photograph(view.camera, *read(view))


def facts_of(report: dict[str, Any]) -> str:
    """A few words on the texture for the user; none where there is none."""
    if "texture_size" not in report:
        return ""
    side = report["texture_size"]
    seen = f", {100 * report['texture_observed']:.0f} % of it from photographs" if "texture_observed" in report else ", from the asset"
    return f", with a texture of {side}x{side}{seen}"
