"""Sub-models merged: the matches between them, and the photographs that are in both, place one in the frame of the other.

A feature that has a point in each of two models, in a photograph of both or by a match, is a shared point. A similarity is sought that takes most
shared points of each to where the other's photographs see them; then all is triangulated and adjusted anew. docs/experiments/sfm.md
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from efficientnerf.geometry.cameras import Similarity, closest_similarity, rays
from pipeline.files import SafePoint, remove
from stages.sfm import mapping
from stages.sfm.added.markers import tie_markers
from stages.sfm.colmap import every_image_read, quiet_pycolmap
from stages.sfm.database import WorkImage, database_path, images_of, inlier_counts, mapper_database

MIN_SHARED, MIN_SHARE = 30, 0.4  # shared points that must fit, and of all that are shared
MAX_MISS = 8.0  # px at working size, within which a shared point fits: sub-models have drifted apart
MIN_MATCHES = 15  # of a pair, from which they are used, as in the mapper
HYPOTHESES, MAX_SHARED = 500, 5000  # similarities that are tried; shared points that they are tried on
REFINEMENTS = 5  # times that the best is fitted to all that fit it
ROUNDS = 2  # of triangulating and adjusting: the second finds more points that go through both


@dataclass(frozen=True, eq=False)
class Sights:
    """Points of a model and the rays by which a photograph each saw them, in the model's frame."""

    # xyz, centre, direction: (N, 3)
    xyz: np.ndarray
    centre: np.ndarray
    direction: np.ndarray
    focal: np.ndarray  # (N,) px

    def only(self, which: np.ndarray) -> Sights:
        return Sights(self.xyz[which], self.centre[which], self.direction[which], self.focal[which])

    def moved(self, similarity: Similarity) -> Sights:
        return Sights(similarity.points(self.xyz), similarity.points(self.centre), self.direction @ similarity.rotation.T, self.focal)

    def see(self, xyz: np.ndarray) -> np.ndarray:
        """(N,) whether points (N, 3) lie within MAX_MISS of the rays."""
        towards = xyz - self.centre
        distance = np.maximum(np.linalg.norm(towards, axis=1), 1e-12)
        off = np.linalg.norm(np.cross(towards, self.direction), axis=1) / distance
        return np.asarray((off * self.focal < MAX_MISS) & ((towards * self.direction).sum(1) > 0))


def merged(work: Path, images: Sequence[WorkImage], models: Sequence[Any], seed: int, safe_point: SafePoint) -> list[Any]:
    """The first of the sub-models with all others that have a place in it, triangulated and adjusted anew, and those that have none. Empty where all have none.

    work  the scratch folder whose database they are of
    """
    parts = [_features(model) for model in models]
    placed = {0: Similarity.identity()}
    left = list(range(1, len(models)))
    while left:
        safe_point()
        found = next(((k, place) for k in left if (place := _placed(work, parts, placed, k, seed)) is not None), None)
        if found is None:
            break
        placed[found[0]] = found[1]
        left.remove(found[0])
    if len(placed) == 1:
        return []
    return [triangulated(work, images, models, placed, seed, safe_point), *(models[number] for number in left)]


def _placed(work: Path, parts: Sequence[Mapping[int, Any]], placed: Mapping[int, Similarity], number: int, seed: int) -> Similarity | None:
    """The place of a sub-model in the frame of the first, by all placed already."""
    shared = [(ours.moved(place), theirs) for k, place in placed.items() for ours, theirs in _shared(work, parts[k], parts[number])]
    if not shared:
        return None
    return similarity_of(_joined([ours for ours, _ in shared]), _joined([theirs for _, theirs in shared]), seed)


def similarity_of(ours: Sights, theirs: Sights, seed: int) -> Similarity | None:
    """The similarity that takes most of (N,) shared points of one model to where the photographs of the other see them, and back; None where too few agree on
    one."""
    count = len(ours.xyz)
    if count < MIN_SHARED:
        return None
    some = np.arange(0, count, -(-count // MAX_SHARED))
    few_ours, few_theirs = ours.only(some), theirs.only(some)
    rng = np.random.Generator(np.random.PCG64(seed))
    best, most = None, 0
    for _ in range(HYPOTHESES):
        three = rng.choice(len(some), 3, replace=False)
        guess = closest_similarity(few_theirs.xyz[three], few_ours.xyz[three])
        number = int(_fitting(guess, few_ours, few_theirs).sum())
        if number > most:
            best, most = guess, number
    if best is None:
        return None
    fitting = _fitting(best, ours, theirs)
    for _ in range(REFINEMENTS):
        if fitting.sum() < MIN_SHARED:
            return None
        near = np.linalg.norm(ours.xyz - ours.centre, axis=1)[fitting]  # what is far away is known less well
        best = closest_similarity(theirs.xyz[fitting], ours.xyz[fitting], near**-2.0)
        fitting = _fitting(best, ours, theirs)
    return best if fitting.sum() >= max(MIN_SHARED, MIN_SHARE * count) else None


def _fitting(similarity: Similarity, ours: Sights, theirs: Sights) -> np.ndarray:
    if not (np.isfinite(similarity.scale) and similarity.scale > 0):
        return np.zeros(len(ours.xyz), bool)
    return ours.see(similarity.points(theirs.xyz)) & theirs.see(similarity.inverse().points(ours.xyz))


# ------------------------------------------------------------------------------------------------------ shared points


def _features(model: Any) -> dict[int, tuple[np.ndarray, Sights]]:
    """Of each registered photograph, by COLMAP's id: the numbers of the features that have a point, ascending, and these points."""
    found = {}
    for image_id in sorted(model.reg_image_ids()):
        image = model.images[image_id]
        numbers = np.array(image.get_observation_point2D_idxs(), np.int64)
        if not len(numbers):
            continue
        seen = [image.points2D[int(number)] for number in numbers]
        camera = mapping.camera_of(model, image)
        centre, direction = rays(camera, np.array([point.xy for point in seen]))
        xyz = np.array([model.points3D[point.point3D_id].xyz for point in seen])
        order = np.argsort(numbers)
        found[image_id] = numbers[order], Sights(xyz, centre, direction, np.full(len(seen), camera.intrinsics["fx"])).only(order)
    return found


def _shared(work: Path, ours: Mapping[int, Any], theirs: Mapping[int, Any]) -> Iterator[tuple[Sights, Sights]]:
    """The points that two models share: in each photograph of both, and of each pair with matches of which one is in each."""
    for image in sorted(set(ours) & set(theirs)):
        numbers = np.intersect1d(ours[image][0], theirs[image][0])
        yield _sights(ours[image], numbers), _sights(theirs[image], numbers)
    with quiet_pycolmap() as pycolmap, pycolmap.Database.open(database_path(work)) as database:
        for (first, second), count in inlier_counts(database_path(work)).items():
            for a, b in ((first, second), (second, first)):
                if count < MIN_MATCHES or a not in ours or b not in theirs or a in theirs or b in ours:
                    continue
                matches = np.asarray(database.read_two_view_geometry(first, second).inlier_matches, np.int64).reshape(-1, 2)
                matches = matches if a == first else matches[:, ::-1]
                matches = matches[np.isin(matches[:, 0], ours[a][0]) & np.isin(matches[:, 1], theirs[b][0])]
                yield _sights(ours[a], matches[:, 0]), _sights(theirs[b], matches[:, 1])


def _sights(features: tuple[np.ndarray, Sights], numbers: np.ndarray) -> Sights:
    return features[1].only(np.searchsorted(features[0], numbers))


def _joined(parts: Sequence[Sights]) -> Sights:
    xyz, centre, direction, focal = (np.concatenate([getattr(part, name) for part in parts]) for name in ("xyz", "centre", "direction", "focal"))
    return Sights(xyz, centre, direction, focal)


# ----------------------------------------------------------------------------------------------------------- one model


def triangulated(work: Path, images: Sequence[WorkImage], models: Sequence[Any], placed: Mapping[int, Similarity], seed: int, safe_point: SafePoint) -> Any:
    """A model of the photographs of all that are placed; one that is in several has its pose of the first."""
    tie_markers(work, seed, safe_point)
    with quiet_pycolmap() as pycolmap:
        whole = pycolmap.Reconstruction()
        with pycolmap.Database.open(mapper_database(work)) as database:
            whole.load(pycolmap.DatabaseCache.create(database, pycolmap.DatabaseCacheOptions()))
        lenses: set[int] = set()
        for number, place in placed.items():
            model = models[number]
            for image_id in sorted(model.reg_image_ids()):
                image, target = model.images[image_id], whole.images[image_id]
                if image.camera_id not in lenses:
                    lenses.add(image.camera_id)
                    whole.cameras[image.camera_id].model = model.cameras[image.camera_id].model
                    whole.cameras[image.camera_id].params = model.cameras[image.camera_id].params
                if not target.has_pose:
                    whole.frames[target.frame_id].rig_from_world = pycolmap.Rigid3d(_pose_in(place, image.cam_from_world().matrix()))
                    whole.register_frame(target.frame_id)
        options, output = mapping.pipeline_options(pycolmap, seed, mapping.DEFAULTS), work / "merged"
        for _ in range(ROUNDS):
            safe_point()
            remove(output)
            output.mkdir()
            with every_image_read(pycolmap, work):
                whole = pycolmap.triangulate_points(whole, mapper_database(work), images_of(work), output, True, options)
            safe_point()
            mapping.bundle_adjust(pycolmap, whole, mapping.cameras_with_fixed_focal(images, whole))
        remove(output)
    return whole


def _pose_in(place: Similarity, camera_from_world: np.ndarray) -> np.ndarray:
    """(3, 4) of the camera in the frame that the similarity leads to; distances are in its units."""
    rotation = camera_from_world[:, :3] @ place.rotation.T
    centre = place.points(-camera_from_world[:, :3].T @ camera_from_world[:, 3])
    return np.concatenate([rotation, -(rotation @ centre)[:, None]], 1)
