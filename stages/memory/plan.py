"""What a stage will take at its peak, before it begins: by the same terms by which the stage itself finds whether it fits.

A fleet admits stages by it. It is what a stage takes with its pixels in memory and on all of its cores; one that is given less works with less. Of assets the
header alone is read. How many voxels are baked is not known before: at most as many as the asset may hold.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from efficientnerf.settings import given
from stages.artifacts import (
    BakeInputs,
    BakeOutputs,
    EvaluateInputs,
    MeshInputs,
    PointsInputs,
    PosesOutputs,
    SplatsInputs,
    TrainInputs,
    TrainOutputs,
    TurntableInputs,
    inputs_of,
    needs_of,
)
from stages.cores import count_cores
from stages.io.capture import FOREGROUND
from stages.memory.disk import files_below
from stages.memory.need import Need

HEADERS = 150  # of photographs that are read, evenly spaced


def memory_needed(stage: str, run: Path, sources: Sequence[Path], settings: Mapping[str, Any], device: str = "cpu") -> int | None:
    """Bytes that a stage of this name takes; None where an artifact that it needs is not there.

    settings  of each stage by its name, dataclasses
    """
    if stage == "poses":
        return _poses(settings["poses"], sources).total
    known = _NEEDS.get(stage)
    if known is None or not all((run / name).is_dir() for name in needs_of(known[0])):
        return None
    return known[1](run, settings, device).total


def _poses(own: Any, sources: Sequence[Path]) -> Need:
    """As if no cameras were known: of a set with cameras less is taken."""
    from stages.formats.importers.source import IMAGE_SUFFIXES
    from stages.io.pictures import UnreadableImage, read_header
    from stages.masking.first_training import FIRST, RAYS, SIDE
    from stages.poses.memory import features_needed, video_needed
    from stages.sfm.ladder import features_for
    from stages.train.memory import first_training_needed
    from stages.video.reading import UnreadableVideo, opened

    files = [path for source in sources for path in files_below(source)]
    pictures = [path for path in files if path.suffix.lower() in IMAGE_SUFFIXES]
    sizes: list[tuple[int, int]] = []
    for path in pictures[:: -(-len(pictures) // HEADERS) or 1]:
        with contextlib.suppress(UnreadableImage):  # the stage says so
            sizes.append(read_header(path).size)
    films = []
    for path in files if not pictures else ():
        with contextlib.suppress(UnreadableVideo), opened(path) as video:
            films.append(video.stored)
    count = len(pictures) or own.frames
    largest = max([*sizes, *films], key=lambda size: size[0] * size[1], default=(0, 0))
    most, networks = given(own.max_features) or features_for(count), own.features_model != "off"
    finding = features_needed([largest] * count, own.feature_image_size, most, count_cores(), networks=networks)
    needs = [finding, video_needed(films)]
    if own.mask_from == FOREGROUND:
        needs.append(first_training_needed(count, SIDE, FIRST, RAYS))
    return max(needs, key=lambda need: need.total)


def _train(run: Path, settings: Mapping[str, Any], device: str) -> Need:
    from stages.io.field_file import space_of
    from stages.io.scene import load, views_of
    from stages.train.data import count_pixels
    from stages.train.hash_resolution import with_auto_sizes
    from stages.train.memory import training_needed

    folder = PosesOutputs.of_run(run).folder
    s = load(folder)
    views = views_of(s, "train")
    return training_needed(folder, views, with_auto_sizes(settings["train"], s, count_pixels(views)), space_of(s), stored=False, device=device)


def _bake(run: Path, settings: Mapping[str, Any], device: str) -> Need:
    from efficientnerf.asset.refinement import schedule
    from stages.bake.memory import Trained, most_needed
    from stages.bake.resolution import size_limits
    from stages.evaluate.views import constant_background
    from stages.io.field_file import space_of
    from stages.io.refined_cameras import load_scene
    from stages.io.scene import views_of
    from stages.train.data import channels_of, count_pixels
    from stages.train.hash_resolution import with_auto_sizes

    own, folder = settings["bake"], PosesOutputs.of_run(run).folder
    s = load_scene(folder, TrainOutputs.of_run(run).folder)
    views, whole = views_of(s, "train"), constant_background(s) is None
    trained = with_auto_sizes(settings["train"], s, count_pixels(views))
    mib = size_limits(own, s, device, count_cores(), whole=whole, discretise=given(trained.discretise))[1]
    splits = schedule.count_splits(schedule.PHASES)
    known = Trained(trained, space_of(s), trained.sh_degree)
    _, voxels, at_most = most_needed(own, known, s, views, channels_of(folder, views), mib, splits, whole, device)
    return at_most(voxels, stored=False)


def _mesh(run: Path, settings: Mapping[str, Any], _: str) -> Need:
    from stages.mesh import run as mesh

    return mesh.needed(_asset(run), settings["mesh"], inputs_of(MeshInputs, _folders(MeshInputs, run)))


def _splats(run: Path, settings: Mapping[str, Any], _: str) -> Need:
    from stages.memory.need import libraries
    from stages.splats import run as splats

    own = settings["splats"]
    if own.make == "off":
        return Need({"libraries": libraries()})
    return splats.needed(_asset(run), own, (PosesOutputs.of_run(run).folder, TrainOutputs.of_run(run).folder))


def _evaluate(run: Path, settings: Mapping[str, Any], device: str) -> Need:
    from stages.evaluate import run as evaluate

    return evaluate.needed(_asset(run), settings["evaluate"], inputs_of(EvaluateInputs, _folders(EvaluateInputs, run)), device)


def _turntable(run: Path, settings: Mapping[str, Any], device: str) -> Need:
    from stages.memory.rendering import frames_needed

    return frames_needed(_asset(run), settings["turntable"].width * settings["turntable"].height, device)


def _points(run: Path, settings: Mapping[str, Any], _: str) -> Need:
    from stages.mesh.memory import surface_needed

    return surface_needed(_asset(run), settings["points"].num_points)


def _asset(run: Path) -> Any:
    from efficientnerf.asset.format import outline

    return outline(BakeOutputs.of_run(run).asset)


def _folders(kind: Any, run: Path) -> dict[str, Path]:
    return {name: run / name for name in needs_of(kind)}


# Stage -> the artifacts without which nothing can be told, and what then is.
_NEEDS: dict[str, tuple[type, Callable[[Path, Mapping[str, Any], str], Need]]] = {
    "train": (TrainInputs, _train),
    "bake": (BakeInputs, _bake),
    "mesh": (MeshInputs, _mesh),
    "splats": (SplatsInputs, _splats),
    "evaluate": (EvaluateInputs, _evaluate),
    "turntable": (TurntableInputs, _turntable),
    "points": (PointsInputs, _points),
}
