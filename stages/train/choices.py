"""choices.json of the train stage: what training did otherwise than the scene and the settings state, where it learned nothing with them.

What comes after reads the settings among them from the field, and the scene as training used it by `stages.io.refined_cameras.load_scene`.
"""

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from efficientnerf.training.settings import TrainSettings
from pipeline.files import write_json
from stages.artifacts import TrainOutputs
from stages.io.scene import Scene
from stages.io.scene_schema import read_document

FORMAT = 1
REMEDY = "Train again."
NEAR_SHARE = 0.1  # of the cameras' distance from the subject: a near plane that leaves out nothing that could be part of it


@dataclass(frozen=True)
class TrainingChoices:
    # near planes as the scene states them; none farther than their median; or none farther than NEAR_SHARE of the way to the subject
    near: Literal["stated", "median", "off"] = "stated"
    masks: bool = True  # whether the views' masks are used
    min_views: bool = True  # whether `train.min_views` is
    exposure: bool = False  # whether exposure of the photographs is learned although the settings do not say so

    def settings(self, given: TrainSettings) -> TrainSettings:
        """The settings with these choices."""
        changes: dict[str, str] = {} if self.min_views else {"min_views": "off"}
        changes |= {"exposure": "on"} if self.exposure else {}
        return replace(given, **changes)  # type: ignore[arg-type]

    def scene(self, given: Scene) -> Scene:
        """The scene with these choices: its near planes and masks."""
        if self.masks and self.near == "stated":
            return given
        most = {"stated": np.inf, "median": np.median([view.near for view in given.views]), "off": NEAR_SHARE * given.orbit.radius}[self.near]
        views = (replace(view, near=min(view.near, float(most)), mask=view.mask if self.masks else None) for view in given.views)
        return replace(given, views=tuple(views))


class _Document(msgspec.Struct):
    format: Literal[1]
    choices: TrainingChoices


def write(choices: TrainingChoices, path: Path) -> None:
    """Write choices.json."""
    write_json(path, {"format": FORMAT, "choices": asdict(choices)})


def load(train: Path) -> TrainingChoices:
    """The choices of the train stage in a folder; where it made none, those that change nothing. Raises CorruptArtifact."""
    path = TrainOutputs(train).choices
    if not path.is_file():
        return TrainingChoices()
    return read_document(path, _Document, REMEDY).choices
