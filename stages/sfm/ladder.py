"""From features to cameras in steps. A step is tried where those before left photographs without a camera; its result is kept where it is better.

    1  the matches of the pairs that are worth comparing, and COLMAP's mapper
    2  its sub-models are merged where the points that they share fit; after 4 once more
    3  the mapper goes on from there with fewer matches to a photograph; where it has not half of the photographs, as of a way straight ahead, it begins anew
       from another pair, with smaller angles
    4  photographs without a camera are matched again, with more of the others, and along the geometry of the first matches
    5  more features are detected in them, of less contrast
    6  the mapper begins anew as in 3, with the matches of 4 and 5
    7  photographs without a camera are matched by networks, where the user has given them (`stages.sfm.learned.matches`)
    8  each photograph gets a focal length of its own, where matches disagree with the cameras, or where single photographs would have another
    9  else each gets a principal point of its own, where single photographs would have another, as where they were cropped

Steps 4, 5, 7, 8 and 9 work in scratch folders of their own, made anew: leftovers of a killed call would change the steps before.
docs/experiments/sfm.md
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from efficientnerf.geometry.cameras import Similarity
from pipeline.files import SafePoint, remove
from stages.sfm import mapping, matches, merging, pairs
from stages.sfm.database import FEATURES, PAIRS, copy_database, copy_with_own_cameras, database_path, forget, inlier_counts, pair_id_of
from stages.sfm.images import Progress, WorkImage
from stages.sfm.intrinsics import zoom
from stages.sfm.learned.matches import add_matches, pairs_of
from stages.verdict.verdict import DOUBTFUL

MAX_EXHAUSTIVE = 60  # photographs; of more, not every pair is matched: that would take longer than the rest of the stage
OF_FEW, OF_MANY = 4096, 2048  # features of a photograph, at most: OF_MANY of more than MAX_EXHAUSTIVE photographs
OVERLAPPING = 30  # verified matches, from which two photographs count as overlapping
FEW_NEIGHBOURS = 3  # photographs that one overlaps with; of fewer, more are looked for
WIDER = 48  # photographs that are most like one, which it is compared with then
ENOUGH = 0.9  # of the photographs with a camera, from which the costlier steps are not tried; and
AGREEING = 0.8  # of the verified matches, that agree with the cameras
BETTER = 1.005  # times the score, from which a later step is better than an earlier one
MORE_FEATURES, LESS_CONTRAST = 2, 0.35
EACH, CROPPED, MERGED = "a focal length each", "a principal point each", "merged sub-models"
NETWORK, NETWORK_ANEW = "matches by a network", "another beginning with matches by a network"
KEPT = 0.02  # of the matches, that fewer may agree when sub-models are merged: a false place contradicts the matches between them
SPREAD = 1.08  # between the focal lengths of single photographs, from which they may have been zoomed
APART = 0.009  # of the longest side, between the principal points of single photographs, from which they may have been cropped
CLOSER, SAME = 0.85, 0.995  # times the reprojection error, to which principal points of their own must lower it; and the score, which is hardly lower then
MAX_STILL_DISAGREEING = 0.5  # of the matches that disagreed, that may disagree with a focal length each: more parameters fit anything a little better


@dataclass(frozen=True)
class Found:
    """
    models  sub-models, largest first
    work    the scratch folder whose database they are of
    rungs   what was tried: its name, the number of photographs that had a camera then, and the share of matches that agreed
    rung    the name of the step that found them
    """

    models: list[Any]
    work: Path
    rungs: list[dict[str, object]]
    rung: str = ""


class _Climb:
    """The steps so far, and the best of them: by the number of registered photographs times the share of the matches that agree."""

    def __init__(self, work: Path, images: Sequence[WorkImage]) -> None:
        self.images = images
        self.found = Found([], work, [])
        self._score = 0.0
        self.agreement = 0.0

    def tried(self, rung: str, work: Path, models: list[Any], *, least: float = 0.0, better: float = BETTER) -> None:
        """Keep a step's result where its score is `better` times the best, and at least the share `least` of the matches agrees."""
        agreement = mapping.match_agreement(work, self.images, models[0]) if models else 0.0
        rungs = [*self.found.rungs, {"rung": rung, "registered": mapping.num_registered(models), "agreeing": round(agreement, 4)}]
        score = mapping.num_registered(models) * agreement
        if score > better * self._score and agreement >= least:
            self._score, self.agreement = score, agreement
            self.found = Found(models, work, rungs, rung)
        else:
            self.found = replace(self.found, rungs=rungs)

    def missing(self) -> list[int]:
        """The positions of the photographs without a camera."""
        there = {image.name for image in self.found.models[0].images.values() if image.has_pose} if self.found.models else set()
        return [position for position, image in enumerate(self.images) if image.file not in there]

    def is_enough(self) -> bool:
        return mapping.num_registered(self.found.models) >= ENOUGH * len(self.images) and self.agreement >= AGREEING


def find_models(
    work: Path,
    images: Sequence[WorkImage],
    how: str,
    *,
    features: int,
    seed: int,
    threads: int,
    networks: tuple[Path, Path] | None = None,
    progress: Progress,
    safe_point: SafePoint,
) -> Found:
    """The best result of the steps; the features are detected already.

    how       pairs that are matched, as `match` takes it
    threads   on which features are detected, and processes in which pairs are matched
    networks  files of a detector and a matcher, for photographs that are left without a camera
    """
    quiet: dict[str, Any] = {"progress": progress, "safe_point": safe_point}
    match(work, images, how, seed=seed, workers=threads, **quiet)
    climb = _Climb(work, images)
    climb.tried(how, work, mapping.sub_models(work, images, seed, mapping.DEFAULTS, **quiet))
    others = _try_merged(climb, work, climb.found.models[1:], seed, safe_point)
    if climb.missing() and climb.found.models:
        climb.tried("fewer matches", work, mapping.continued(work, images, climb.found.models[0], seed, mapping.RELAXED, **quiet))
    begun = len(climb.missing()) > len(images) / 2
    if begun:
        _begin_anew(climb, work, seed, **quiet)
    place = work / "rungs"
    remove(place)
    if climb.missing():
        place.mkdir()
        copy_database(work, place)
        for rung, more in (("wider matching", False), ("more features", True)):
            weak = climb.missing()
            if not weak or (more and climb.is_enough()):
                break
            if more:
                _detect_more(place, images, weak, features=features, threads=threads, **quiet)
            _match_again(place, images, weak, rung, seed=seed, workers=threads, **quiet)
            if climb.found.models:
                models = mapping.continued(place, images, climb.found.models[0], seed, mapping.RELAXED, **quiet)
            else:
                models = mapping.sub_models(place, images, seed, mapping.RELAXED, **quiet)
            climb.tried(rung, place, models)
            if not more:  # else features of the other sub-models' photographs were detected anew
                others = _try_merged(climb, place, others, seed, safe_point)
    if place.is_dir() or not begun:  # where all have a camera, and matches disagree, nothing was matched again
        _begin_anew(climb, place if place.is_dir() else work, seed, **quiet)
    if networks is not None and climb.missing():
        _try_networks(climb, work / "networks", networks, seed=seed, threads=threads, **quiet)
    if climb.found.models:
        _try_own_cameras(climb, work / "own_cameras", seed, **quiet)
    return climb.found


def _begin_anew(climb: _Climb, work: Path, seed: int, **quiet: Any) -> None:
    """The steps in which the mapper begins from another pair."""
    for rung, options in (("another beginning", mapping.RELAXED), ("small angles", mapping.FORWARD)):
        if not climb.is_enough():
            climb.tried(rung, work, mapping.sub_models(work, climb.images, seed, options, **quiet))


def _try_merged(climb: _Climb, work: Path, others: Sequence[Any], seed: int, safe_point: SafePoint) -> list[Any]:
    """The step that merges other sub-models with the best one, as far as they have photographs that it lacks; returns those that remain.

    work  the scratch folder whose matches are used; the features are the same in all
    """
    lacking = {climb.images[position].file for position in climb.missing()}
    others = [model for model in others if any(image.name in lacking for image in model.images.values() if image.has_pose)]
    if others and climb.found.models:
        models = merging.merged(work, climb.images, [climb.found.models[0], *others], seed, safe_point)
        climb.tried(MERGED, work, models, least=climb.agreement - KEPT)
        if models and climb.found.models[0] is models[0]:
            return models[1:]
    return others


def _try_own_cameras(climb: _Climb, place: Path, seed: int, **quiet: Any) -> None:
    """The steps in which each photograph has a camera of its own, where there is reason to."""
    remove(place)
    best = climb.found.models[0]
    zoomed = climb.agreement < DOUBTFUL or zoom.focal_length_spread(best) > SPREAD
    cropped = _of_one_lens(climb.images) and zoom.principal_point_spread(best) > APART
    if not zoomed and not cropped:
        return
    place.mkdir()
    copy_with_own_cameras(climb.found.work, place, climb.images)
    models = mapping.sub_models(place, climb.images, seed, mapping.DEFAULTS, **quiet)
    if zoomed:
        climb.tried(EACH, place, models, least=1 - MAX_STILL_DISAGREEING * (1 - climb.agreement))
    if cropped and models and climb.found.rung != EACH:
        models[0] = zoom.with_principal_points(models[0], quiet["safe_point"])
        closer = models[0].compute_mean_reprojection_error() < CLOSER * best.compute_mean_reprojection_error()
        climb.tried(CROPPED, place, models, better=SAME if closer else BETTER)


def _try_networks(climb: _Climb, place: Path, networks: tuple[Path, Path], *, seed: int, threads: int, **quiet: Any) -> None:
    """Match photographs without a camera by networks. The mapper continues the model with points of these matches; where it has less than half of the
    photographs, the mapper begins anew."""
    remove(place)
    place.mkdir()
    copy_database(climb.found.work, place)
    weak, count = climb.missing(), len(climb.images)
    near = neighbours(place, count)
    if count <= MAX_EXHAUSTIVE:
        partners = {pairs.ordered(i, j) for i in weak for j in range(count) if i != j}
    else:
        partners = pairs.wider_pairs(matches.likeness(climb.found.work, seed, quiet["safe_point"]), weak, near, WIDER)
    wanted = pairs_of(weak, sorted(partners), inlier_counts(database_path(place)))
    add_matches(place, climb.images, wanted, networks, seed=seed, threads=threads, **quiet)
    if climb.found.models:
        best = merging.triangulated(place, climb.images, climb.found.models[:1], {0: Similarity.identity()}, seed, quiet["safe_point"])
        climb.tried(NETWORK, place, mapping.continued(place, climb.images, best, seed, mapping.RELAXED, **quiet))
    if len(climb.missing()) > count / 2:
        for options in (mapping.DEFAULTS, mapping.RELAXED):
            if not climb.is_enough():
                climb.tried(NETWORK_ANEW, place, mapping.sub_models(place, climb.images, seed, options, **quiet))


def _of_one_lens(images: Sequence[WorkImage]) -> bool:
    """Whether nothing says that photographs are of several lenses, or reduced by different factors; of fisheye lenses no principal points are looked for."""
    return len({(image.focal, round(image.work_width / image.width, 2)) for image in images}) == 1 and not any(image.fisheye for image in images)


def _detect_more(place: Path, images: Sequence[WorkImage], weak: Sequence[int], *, features: int, threads: int, **quiet: Any) -> None:
    """More features in the place of those of some photographs, whose pairs are forgotten."""
    count = len(images)
    forget(place, FEATURES, [i + 1 for i in weak])
    forget(place, PAIRS, [pair_id_of(a + 1, b + 1) for i in weak for j in range(count) if i != j for a, b in [pairs.ordered(i, j)]])
    chosen = [images[i] for i in weak]
    matches.extract_features(place, chosen, features=MORE_FEATURES * features, threads=threads, contrast=LESS_CONTRAST, **quiet)


def _match_again(place: Path, images: Sequence[WorkImage], weak: Sequence[int], rung: str, *, seed: int, workers: int, **quiet: Any) -> None:
    """Match some photographs with more of the others, or again with those that they do not overlap with for sure."""
    near = neighbours(place, len(images))
    if len(images) <= MAX_EXHAUSTIVE:
        wanted = {pairs.ordered(i, j) for i in weak for j in range(len(images)) if i != j}
    else:
        wanted = pairs.wider_pairs(matches.likeness(place, seed, quiet["safe_point"]), weak, near, WIDER)
    wanted = {(i, j) for i, j in wanted if j not in near[i]}
    forget(place, PAIRS, [pair_id_of(i + 1, j + 1) for i, j in sorted(wanted)])
    matches.match_pairs(place, images, wanted, seed=seed, workers=workers, name=f"{rung.split()[0]}_", guided=True, **quiet)


def features_for(count: int) -> int:
    """The default limit for each of `count` photographs."""
    return OF_FEW if count <= MAX_EXHAUSTIVE else OF_MANY


def matching_for(count: int) -> str:
    """The meaning of "auto"."""
    return "exhaustive" if count <= MAX_EXHAUSTIVE else "retrieval"


def match(work: Path, images: Sequence[WorkImage], how: str, *, seed: int, workers: int, progress: Progress, safe_point: SafePoint) -> None:
    """Verified matches of the pairs that `how` stands for; of retrieval also of more pairs of the photographs that overlap with few others."""
    if how == "exhaustive":
        wanted = pairs.all_pairs(len(images))
    elif how == "sequential":
        wanted = pairs.sequential_pairs(len(images))
    elif how == "retrieval":
        likeness = matches.likeness(work, seed, safe_point)
        wanted = pairs.retrieved_pairs(likeness)
    else:
        raise ValueError(f"matching {how!r}: expected 'exhaustive', 'retrieval' or 'sequential'")
    matches.match_pairs(work, images, wanted, seed=seed, workers=workers, progress=progress, safe_point=safe_point)
    if how == "retrieval":
        near = neighbours(work, len(images))
        weak = [i for i, others in near.items() if len(others) < FEW_NEIGHBOURS] + [i for part in components(near)[1:] for i in part]
        wanted = pairs.wider_pairs(likeness, weak, near, WIDER)
        matches.match_pairs(work, images, wanted, name="wider_", seed=seed, workers=workers, progress=progress, safe_point=safe_point)


def neighbours(work: Path, count: int, least: int = OVERLAPPING) -> dict[int, set[int]]:
    """The positions of the photographs that each overlaps with: of `least` verified matches."""
    found: dict[int, set[int]] = {i: set() for i in range(count)}
    for (i, j), inliers in inlier_counts(database_path(work)).items():
        if inliers >= least:
            found[i - 1].add(j - 1)
            found[j - 1].add(i - 1)
    return found


def components(near: dict[int, set[int]]) -> list[list[int]]:
    """Photographs that are joined by overlaps, the largest component first."""
    left, found = set(near), []
    while left:
        part, edge = set[int](), {min(left)}
        while edge:
            part |= edge
            edge = {j for i in edge for j in near[i]} - part
        left -= part
        found.append(sorted(part))
    return sorted(found, key=lambda part: (-len(part), part))
