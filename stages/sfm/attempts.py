"""What is tried to find cameras, and the best result so far. `stages.sfm.reconstruction` has the order.

Attempts that match again work in scratch folders of their own, made anew: leftovers of a killed call would change the attempts before them.
docs/experiments/sfm.md
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from efficientnerf.geometry.cameras import Similarity
from pipeline.files import SafePoint
from stages.sfm import mapping, matches, merging, pairs
from stages.sfm.added.matches import add_matches, pairs_of
from stages.sfm.database import FEATURES, PAIRS, WorkImage, copy_database, copy_with_own_cameras, database_path, forget, inlier_counts, neighbours, pair_id_of
from stages.sfm.images import Progress
from stages.sfm.intrinsics import zoom
from stages.verdict.verdict import DOUBTFUL

MIN_REGISTERED = 0.9  # of the photographs with a camera, from which the costlier attempts are not made; and
MIN_AGREEING = 0.8  # of the verified matches, that agree with the cameras
MIN_GAIN = 1.005  # times the score, from which a later attempt is better than an earlier one
MORE_FEATURES, LESS_CONTRAST = 2, 0.35
OWN_FOCAL_LENGTHS, OWN_PRINCIPAL_POINTS, MERGED = "a focal length each", "a principal point each", "merged sub-models"
BEGIN_ANEW, SMALL_ANGLES = "another beginning", "small angles"
NETWORK, NETWORK_ANEW = "matches by a network", "another beginning with matches by a network"
MATCHED_AGAIN, NETWORKS, OWN_CAMERAS = "matched_again", "networks", "own_cameras"  # scratch folders
MAX_AGREEMENT_LOSS = 0.02  # of the matches, that fewer may agree when sub-models are merged: a false place contradicts the matches between them
MIN_FOCAL_SPREAD = 1.08  # between the focal lengths of single photographs, from which they may have been zoomed
MIN_MIDDLE_SPREAD = 0.009  # of the longest side, between the principal points of single photographs, from which they may have been cropped
# Principal points of their own must lower the reprojection error to so many times; and keep so much of the score.
MAX_ERROR_RATIO, MIN_SCORE_RATIO = 0.85, 0.995
MAX_STILL_DISAGREEING = 0.5  # of the matches that disagreed, that may disagree with a focal length each: more parameters fit anything a little better

Models = list[Any]  # sub-models, largest first


@dataclass
class Search:
    """The best result so far, and what the attempts share.

    place  the scratch folder whose matches are used: `base`, or one in it
    work   the scratch folder whose database the models are of
    """

    base: Path  # the scratch folder
    images: Sequence[WorkImage]  # its photographs, whose features are detected
    seed: int
    features: int  # of a photograph, at most
    threads: int  # on which features are detected, and processes in which pairs are matched
    progress: Progress
    safe_point: SafePoint
    networks: tuple[Path, Path] | None = None  # files of a detector and a matcher, for photographs that are left without a camera
    models: Models = field(default_factory=list)  # sub-models of the best attempt
    best: str = ""  # its name
    agreement: float = 0.0  # share of the matches that agrees with it
    # all attempts: the name, the number of photographs that had a camera then, and the share of matches that agreed
    tried: list[dict[str, object]] = field(default_factory=list)
    others: Models = field(default_factory=list)  # sub-models of the mapper's first run that are not merged
    own: Models | None = None  # sub-models with a camera for each photograph, once they were looked for
    _score: float = 0.0

    def __post_init__(self) -> None:
        self.place = self.work = self.base
        self.quiet: dict[str, Any] = {"progress": self.progress, "safe_point": self.safe_point}

    def keep(self, name: str, models: Models, *, least: float = 0.0, better: float = MIN_GAIN) -> None:
        """Keep an attempt's result where its score, the number of photographs with a camera times the share of the matches that agree, is `better` times
        the best, and at least the share `least` agrees."""
        agreement, count = mapping.match_agreement(self.place, models[0]) if models else 0.0, mapping.num_registered(models)
        self.tried.append({"step": name, "registered": count, "agreeing": round(agreement, 4)})
        if count * agreement > better * self._score and agreement >= least:
            self._score, self.agreement = count * agreement, agreement
            self.models, self.best, self.work = models, name, self.place
            if name == MERGED:
                self.others = models[1:]

    def begin(self, options: mapping.Options) -> Models:
        """The mapper's sub-models from the matches."""
        return mapping.sub_models(self.place, self.images, self.seed, options, **self.quiet)

    def go_on(self, model: Any = None) -> Models:
        """The mapper's sub-models from a model, else the best, else from the beginning; with fewer matches to a photograph."""
        model = next(iter(self.models), None) if model is None else model
        return self.begin(mapping.RELAXED) if model is None else mapping.continued(self.place, self.images, model, self.seed, **self.quiet)

    @property
    def missing(self) -> list[int]:
        """The positions of the photographs without a camera."""
        there = {image.name for image in self.models[0].images.values() if image.has_pose} if self.models else set()
        return [position for position, image in enumerate(self.images) if image.file not in there]

    @property
    def most_missing(self) -> bool:
        return len(self.missing) > len(self.images) / 2

    @property
    def enough(self) -> bool:
        return mapping.num_registered(self.models) >= MIN_REGISTERED * len(self.images) and self.agreement >= MIN_AGREEING

    def was_last(self, name: str) -> bool:
        return self.tried[-1]["step"] == name

    def begun_anew(self) -> bool:
        """Whether the mapper has begun anew from these matches."""
        return self.place == self.base and any(attempt["step"] == BEGIN_ANEW for attempt in self.tried)


@dataclass(frozen=True)
class Attempt:
    """One way to better the result so far."""

    name: str  # in reports
    when: Callable[[Search], object]  # whether it is made
    run: Callable[[Search], Models | None]  # its sub-models; None where nothing was tried
    least: Callable[[Search], float] = lambda search: 0.0  # share of the matches that has to agree with the result, for it to be kept
    better: Callable[[Search, Models], float] = lambda search, models: MIN_GAIN  # times the best score, that it has to have


def anew(name: str, when: Callable[[Search], bool], options: mapping.Options) -> Attempt:
    """The mapper begins from another pair."""
    return Attempt(name, when, lambda search: search.begin(options))


def unmerged(search: Search) -> object:
    """Other sub-models with photographs that the best one lacks; no others are merged later."""
    lacking = {search.images[position].file for position in search.missing}
    search.others = [model for model in search.others if any(image.name in lacking for image in model.images.values() if image.has_pose)]
    return search.others and search.models


def merge(search: Search) -> Models:
    return merging.merged(search.place, search.images, [search.models[0], *search.others], search.seed, search.safe_point)


def match_more(search: Search) -> Models:
    """Photographs without a camera are matched with more of the others, and along the geometry of the first matches."""
    search.place = _with_database_of(search.base, search.base / MATCHED_AGAIN)
    match_again(search, "wider_")
    return search.go_on()


def detect_more(search: Search) -> Models:
    """More features, of less contrast, in the place of those of photographs without a camera, which are matched again."""
    find_features_again(search)
    match_again(search, "more_")
    return search.go_on()


def _with_database_of(work: Path, place: Path) -> Path:
    place.mkdir()
    copy_database(work, place)
    return place


def find_features_again(search: Search) -> None:
    weak, place = search.missing, search.place
    forget(place, FEATURES, [i + 1 for i in weak])
    forget(place, PAIRS, [pair_id_of(i + 1, j + 1) for i, j in pairs.pairs_with(weak, len(search.images))])
    chosen = [search.images[i] for i in weak]
    matches.extract_features(place, chosen, features=MORE_FEATURES * search.features, threads=search.threads, contrast=LESS_CONTRAST, **search.quiet)


def match_again(search: Search, name: str) -> None:
    """Match photographs without a camera with more of the others, or again with those that they do not overlap with for sure."""
    place, near = search.place, neighbours(search.place, len(search.images))
    wanted = {(i, j) for i, j in _partners(search, place, near) if j not in near[i]}
    forget(place, PAIRS, [pair_id_of(i + 1, j + 1) for i, j in sorted(wanted)])
    matches.match_pairs(place, search.images, wanted, seed=search.seed, workers=search.threads, name=name, guided=True, **search.quiet)


def _partners(search: Search, described: Path, near: dict[int, set[int]]) -> set[pairs.Pair]:
    """Pairs of the photographs without a camera: with all others, or of many photographs with those that are most like them.

    described  the scratch folder with the features that likeness is told by
    """
    count = len(search.images)
    if count <= pairs.MAX_EXHAUSTIVE:
        return pairs.pairs_with(search.missing, count)
    return pairs.wider_pairs(matches.likeness(described, search.seed, search.safe_point), search.missing, near)


def match_by_networks(search: Search) -> Models | None:
    """Photographs without a camera are matched by networks. The mapper goes on with points of these matches, where it has a model."""
    assert search.networks is not None
    search.place = _with_database_of(search.work, search.base / NETWORKS)
    partners = _partners(search, search.work, neighbours(search.place, len(search.images)))
    wanted = pairs_of(search.missing, sorted(partners), inlier_counts(database_path(search.place)))
    add_matches(search.place, search.images, wanted, search.networks, seed=search.seed, threads=search.threads, **search.quiet)
    if not search.models:
        return None
    best = merging.triangulated(search.place, search.images, search.models[:1], {0: Similarity.identity()}, search.seed, search.safe_point)
    return search.go_on(best)


def zoomed(search: Search) -> bool:
    """Whether single photographs would have another focal length, or matches disagree with the cameras."""
    return bool(search.models) and (search.agreement < DOUBTFUL or zoom.focal_length_spread(search.models[0]) > MIN_FOCAL_SPREAD)


def cropped(search: Search) -> bool:
    """Whether single photographs of one lens would have another principal point; of fisheye lenses none are looked for."""
    lenses = {(image.focal, round(image.work_width / image.width, 2)) for image in search.images}  # or reduced by different factors
    of_one = len(lenses) == 1 and not any(image.fisheye for image in search.images)
    return bool(search.models) and search.best != OWN_FOCAL_LENGTHS and of_one and zoom.principal_point_spread(search.models[0]) > MIN_MIDDLE_SPREAD


def with_own_cameras(search: Search) -> Models:
    """Each photograph gets a camera of its own."""
    search.place = search.base / OWN_CAMERAS
    search.place.mkdir()
    copy_with_own_cameras(search.work, search.place, search.images)
    search.own = search.begin(mapping.DEFAULTS)
    return search.own


def with_own_principal_points(search: Search) -> Models | None:
    models = with_own_cameras(search) if search.own is None else search.own
    return [zoom.with_principal_points(models[0], search.safe_point), *models[1:]] if models else None


def better_where_closer(search: Search, models: Models) -> float:
    closer = models[0].compute_mean_reprojection_error() < MAX_ERROR_RATIO * search.models[0].compute_mean_reprojection_error()
    return MIN_SCORE_RATIO if closer else MIN_GAIN
