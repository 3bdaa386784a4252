"""What scene.json may hold, by msgspec: types, shapes and bounds of every number. `stages.io.scene` gives it its meaning."""

from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec
from msgspec import Meta, Struct

from efficientnerf.geometry.orbit import LARGEST, Number, Orbit, Vector
from pipeline.errors import BadInput, CorruptArtifact
from pipeline.text import printable
from stages.io.json_file import read_json

Positive = Annotated[float, Meta(gt=0, le=LARGEST)]
Side = Annotated[int, Meta(ge=1, le=65536)]
Row = tuple[Number, Number, Number, Number]
Matrix = tuple[Row, Row, Row, Row]
Rotation = tuple[Vector, Vector, Vector]
Box = tuple[Vector, Vector]


class CameraDocument(Struct):
    name: str
    width: Side
    height: Side
    model: str
    params: Annotated[list[Number], Meta(max_length=16)]
    world_from_camera: Matrix


class ViewDocument(Struct):
    image: str
    split: str
    near: Number
    far: Number
    camera: CameraDocument
    source_camera: CameraDocument
    mask: str | None = None


class SimilarityDocument(Struct):
    scale: Positive
    rotation: Rotation
    translation: Vector


class ForwardDocument(Struct):
    world_from_camera: Matrix
    focal: Positive
    width: Annotated[float, Meta(gt=0, le=65536)]
    height: Annotated[float, Meta(gt=0, le=65536)]
    near: Positive
    bounds: Box
    far: Number
    radii: Vector
    focus: Number
    tangents: tuple[Number, Number]


class SceneDocument(Struct):
    format: int
    kind: str
    bounds: Box
    world_from_capture: SimilarityDocument
    orbit: Orbit
    points: bool
    metric: bool
    views: list[ViewDocument]
    background: tuple[Number, Number, Number] | None = None
    space: str | None = None  # format 1 has none
    forward: ForwardDocument | None = None


T = TypeVar("T")


def json_of_run(path: Path, remedy: str) -> Any:
    """The value in a file that a stage wrote; CorruptArtifact where it is damaged."""
    try:
        return read_json(path, remedy)
    except BadInput as error:
        raise CorruptArtifact(str(error)) from error


def read_document(path: Path, kind: type[T], remedy: str) -> T:
    """The file that a stage wrote, as `kind`. Raises CorruptArtifact."""
    return decoded(json_of_run(path, remedy), kind, path, remedy)


def decoded(document: Any, kind: type[T], path: Path, remedy: str) -> T:
    """`document`, out of a JSON file, as `kind`; CorruptArtifact names the place that does not fit."""
    try:
        return msgspec.convert(document, kind)
    except (msgspec.ValidationError, UnicodeEncodeError, RecursionError) as error:
        raise CorruptArtifact(f"{printable(path)}: {printable(error, 400)}. {remedy}") from error
