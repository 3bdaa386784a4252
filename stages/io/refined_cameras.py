"""cameras.json of the train stage: the training cameras as training left them, and the views that it left out, where it replaced or left out any.

This is the one place that says what views, with what cameras, a field was trained on: what comes after uses `load_scene`.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from msgspec import Struct

from efficientnerf.geometry.cameras import Camera
from pipeline.errors import CorruptArtifact
from pipeline.files import write_json
from pipeline.text import printable
from stages.artifacts import TrainOutputs
from stages.io import scene
from stages.io.scene import Scene, View, camera_from, camera_to_json
from stages.io.scene_schema import CameraDocument, read_document
from stages.train import choices

FORMAT = 1
REMEDY = "Train again."
LEFT_OUT = "left out"  # the split of a training view that was not trained on in the end


class RefinedDocument(Struct):
    format: int
    cameras: dict[str, CameraDocument]  # by the image of the view
    left_out: list[str] = []  # images


def write(views: Sequence[View], cameras: Sequence[Camera], path: Path, left_out: Sequence[str] = ()) -> None:
    """The cameras of some views, in their order, and the images of the views that were left out."""
    document = {"format": FORMAT, "cameras": {view.image: camera_to_json(camera) for view, camera in zip(views, cameras, strict=True)}}
    write_json(path, document | ({"left_out": list(left_out)} if left_out else {}))


def load_scene(poses: Path, train: Path) -> Scene:
    """The scene in the artifact of the poses stage as that of the train stage used it: with its choices and its training cameras; what that left out is in no
    split that others use. Raises as `scene.load`."""
    found, path = choices.load(train).scene(scene.load(poses)), TrainOutputs(train).cameras
    if not path.is_file():
        return found
    document = read_document(path, RefinedDocument, REMEDY)
    known = {view.image: view for view in found.views}
    if not known.keys() >= set(document.left_out):
        raise CorruptArtifact(f"{printable(path)}: views are left out that this scene has not. {REMEDY}")
    for image, camera in document.cameras.items():
        view = known.get(image)
        size = None if view is None else (view.camera.width, view.camera.height, view.camera.model)
        if document.format != FORMAT or size != (camera.width, camera.height, camera.model):
            raise CorruptArtifact(f"{printable(path)}: '{printable(image, 100)}' is no such view of this scene, or the format is another one. {REMEDY}")
    try:
        cameras = {image: camera_from(camera, image) for image, camera in document.cameras.items()}
    except ValueError as error:
        raise CorruptArtifact(f"{printable(path)}: {printable(error, 300)}. {REMEDY}") from error
    return as_trained(found, cameras, document.left_out)


def as_trained(s: Scene, cameras: Mapping[str, Camera], left_out: Collection[str]) -> Scene:
    """The scene with other cameras for some views, by their images, and without those in training that were left out."""
    views = []
    for view in s.views:
        if (camera := cameras.get(view.image)) is not None:
            pose = s.world_from_capture.inverse().pose(camera.world_from_camera)
            view = replace(view, camera=replace(camera, name=view.camera.name), source_camera=replace(view.source_camera, world_from_camera=pose))
        views.append(replace(view, split=LEFT_OUT) if view.image in left_out else view)
    return replace(s, views=tuple(views))
