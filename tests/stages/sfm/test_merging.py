"""Sub-models put together where the points that they share fit, and left alone where they do not."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.poses import aligned_errors
from efficientnerf.geometry.cameras import Similarity
from stages.sfm import attempts, mapping, matches, merging
from stages.sfm.attempts import Search
from stages.sfm.colmap import quiet_pycolmap
from stages.sfm.database import PAIRS, WorkImage, forget, pair_id_of
from stages.sfm.merging import Sights
from stages.sfm.reconstruction import find_models
from tests.stages.sfm.made_matches import cameras, matched, off, registered
from tests.stages.sfm.still_life import QUIET

MOVED = Similarity(3.0, np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([5.0, -2, 1]))
TRUTH = cameras()


def part_of(model: Any, numbers: list[int], moved: Similarity | None = None) -> Any:
    """A sub-model of these photographs, in a frame of its own."""
    part = model.__deepcopy__({})
    for image_id in sorted(part.reg_image_ids()):
        if image_id - 1 not in numbers:
            part.deregister_frame(part.images[image_id].frame_id)
    if moved is not None:
        with quiet_pycolmap() as pycolmap:
            part.transform(pycolmap.Sim3d(moved.matrix()[:3]))
    assert part.num_reg_images() == len(numbers)
    return part


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[WorkImage], Any]:
    """The scratch folder of nine photographs and the model of all of them."""
    work = tmp_path_factory.mktemp("scene")
    images = matched(work, TRUTH)
    return work, images, mapping.sub_models(work, images, 0, mapping.DEFAULTS, **QUIET)[0]


def merged(scene: tuple[Path, list[WorkImage], Any], *parts: Any) -> list[Any]:
    return merging.merged(scene[0], scene[1], parts, 0, lambda: None)


@pytest.mark.parametrize("second", [[4, 5, 6, 7, 8], [5, 6, 7, 8]])
def test_two_sub_models_become_one_by_photographs_or_matches(scene: tuple[Path, list[WorkImage], Any], second: list[int]) -> None:
    parts = part_of(scene[2], [0, 1, 2, 3, 4]), part_of(scene[2], second, MOVED)
    (whole,) = merged(scene, *parts)
    assert [image.name for image in registered(whole)] == [image.file for image in scene[1]]
    assert off(whole, TRUTH) < 1.5 * off(scene[2], TRUTH) < 0.01
    assert whole.compute_mean_reprojection_error() < 1.1 * scene[2].compute_mean_reprojection_error()
    assert mapping.match_agreement(scene[0], whole) > 0.97
    again = merged(scene, *parts)[0]
    for one, other in zip(registered(whole), registered(again), strict=True):
        assert one.cam_from_world().matrix().tobytes() == other.cam_from_world().matrix().tobytes()
    assert not (scene[0] / "merged").exists()


def test_sub_models_without_anything_in_common_stay_apart(tmp_path: Path) -> None:
    images = matched(tmp_path, TRUTH)
    model = mapping.sub_models(tmp_path, images, 0, mapping.DEFAULTS, **QUIET)[0]
    forget(tmp_path, PAIRS, [pair_id_of(i + 1, j + 1) for i in range(5) for j in range(5, 9)])
    apart = part_of(model, [0, 1, 2, 3, 4]), part_of(model, [5, 6, 7, 8], MOVED)
    assert merging.merged(tmp_path, images, apart, 0, lambda: None) == []
    # One more, which shares photographs with the first.
    whole, left = merging.merged(tmp_path, images, [*apart, part_of(model, [2, 3, 4])], 0, lambda: None)
    assert (whole.num_reg_images(), left) == (5, apart[1])


def sights(similarity: Similarity, wrong: float, count: int = 200) -> tuple[Sights, Sights]:
    """Points that a photograph of either model sees, some of them wrong."""
    rng = np.random.default_rng(1)
    xyz, centres = rng.normal(0, 1, (count, 3)), rng.normal((0, 0, 9), 1, (count, 3))
    there = xyz.copy()
    there[: round(wrong * count)] = rng.permutation(there[: round(wrong * count)])

    def seen(xyz: np.ndarray) -> Sights:
        towards = xyz - centres + rng.normal(0, 0.002, xyz.shape)
        return Sights(xyz, centres, towards / np.linalg.norm(towards, axis=1, keepdims=True), np.full(count, 1000.0))

    return seen(xyz).moved(similarity), seen(there)


@pytest.mark.parametrize(("wrong", "found"), [(0.0, True), (0.5, True), (0.7, False)])
def test_a_similarity_is_found_among_wrong_matches_unless_most_are(wrong: float, found: bool) -> None:
    similarity = merging.similarity_of(*sights(MOVED, wrong), seed=0)
    assert (similarity is not None) == found
    if similarity is not None:
        np.testing.assert_allclose(similarity.matrix(), MOVED.matrix(), atol=0.02)
    few = [each.only(np.arange(merging.MIN_SHARED - 1)) for each in sights(MOVED, 0.0)]
    assert merging.similarity_of(few[0], few[1], seed=0) is None


# ---------------------------------------------------------------------------------------------------------- attempts


def climbed(scene: tuple[Path, list[WorkImage], Any], parts: list[Any], monkeypatch: pytest.MonkeyPatch) -> Search:
    """All attempts, of which the mapper leaves these sub-models, and finds no camera more."""
    work, images, _ = scene
    monkeypatch.setattr(mapping, "sub_models", lambda work, images, seed, options, **_: parts if options is mapping.DEFAULTS else [])
    monkeypatch.setattr(mapping, "continued", lambda *_, **__: [])
    monkeypatch.setattr(matches, "match_photographs", lambda *_, **__: None)
    monkeypatch.setattr(attempts, "match_again", lambda *_, **__: None)
    monkeypatch.setattr(attempts, "find_features_again", lambda *_, **__: None)
    return find_models(Search(work, images, 0, 100, 1, **QUIET), "exhaustive")


def test_a_merge_that_contradicts_the_matches_is_refused(scene: tuple[Path, list[WorkImage], Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """The second half is turned about the scene's middle, as where two sides of a thing look alike."""
    model = scene[2]
    parts = [part_of(model, [0, 1, 2, 3, 4]), part_of(model, [5, 6, 7, 8], MOVED)]
    turned = np.array([[-1.0, 0, 0], [0, -1, 0], [0, 0, 1]])
    middle = np.mean([point.xyz for _, point in sorted(model.points3D.items())], 0)
    about = Similarity(1.0, turned, middle - turned @ middle)
    asked = []

    def false_place(ours: Sights, theirs: Sights, seed: int) -> Similarity:
        asked.append(len(ours.xyz))
        place = MOVED.inverse()
        return replace(place, rotation=about.rotation @ place.rotation, translation=about.points(place.translation))

    monkeypatch.setattr(merging, "similarity_of", false_place)
    found = climbed(scene, parts, monkeypatch)
    assert asked
    tried = {str(attempt["step"]): attempt for attempt in found.tried}
    assert tried[attempts.MERGED]["agreeing"] < tried["exhaustive"]["agreeing"] - attempts.MAX_AGREEMENT_LOSS  # type: ignore[operator]
    assert found.best == "exhaustive"
    assert found.models[0].num_reg_images() == 5
    errors = aligned_errors(np.array([image.projection_center() for image in registered(found.models[0])]), np.array([c.centre for c in TRUTH[:5]]))
    assert errors.max() < 0.02
