"""Photographs that were zoomed or cropped, each by itself, and whose EXIF data do not say so: each gets a camera of its own."""

from pathlib import Path

import numpy as np
import pytest

from stages.sfm import attempts, mapping
from stages.sfm.attempts import Search
from stages.sfm.database import WorkImage
from stages.sfm.intrinsics import zoom
from stages.sfm.reconstruction import find_models
from stages.verdict.verdict import DOUBTFUL
from tests.stages.sfm.made_matches import COUNT, POINTS, cameras, matched, off, registered
from tests.stages.sfm.still_life import QUIET

ZOOMED = tuple(400.0 / (1.0, 0.8, 0.65)[k % 3] for k in range(COUNT))


def found_for(work: Path, images: list[WorkImage]) -> Search:
    return find_models(Search(work, images, 0, POINTS, 1, **QUIET), "exhaustive")


def numbers(found: Search) -> list[bytes]:
    model = found.models[0]
    return [np.concatenate([model.cameras[i.camera_id].params, i.cam_from_world().matrix().ravel()]).tobytes() for i in registered(model)]


def test_a_zoom_that_changed_gives_each_photograph_its_focal_length(tmp_path: Path) -> None:
    taken = cameras(ZOOMED)
    images = matched(tmp_path, taken)
    found = found_for(tmp_path, images)
    assert [attempt["step"] for attempt in found.tried] == ["exhaustive", attempts.OWN_FOCAL_LENGTHS]
    one, each = (float(attempt["agreeing"]) for attempt in found.tried)  # type: ignore[arg-type]
    assert one < DOUBTFUL < 0.98 < each
    assert (found.best, found.work) == (attempts.OWN_FOCAL_LENGTHS, tmp_path / "own_cameras")
    model = found.models[0]
    assert [image.name for image in registered(model)] == [image.file for image in images]
    assert [model.cameras[image.camera_id].focal_length for image in registered(model)] == pytest.approx(ZOOMED, rel=0.01)
    assert off(model, taken) < 0.01
    shared = mapping.sub_models(tmp_path, images, 0, mapping.DEFAULTS, **QUIET)[0]
    assert shared.num_reg_images() == COUNT
    assert off(shared, taken) > 0.05
    assert numbers(found_for(tmp_path, images)) == numbers(found)


def test_two_zooms_are_told_where_the_matches_agree_with_one(tmp_path: Path) -> None:
    taken = cameras((400.0,) * 5 + (520.0,) * 4)
    images = matched(tmp_path, taken)
    shared = mapping.sub_models(tmp_path, images, 0, mapping.DEFAULTS, **QUIET)[0]
    assert mapping.match_agreement(tmp_path, shared) > DOUBTFUL
    assert off(shared, taken) > 0.05
    assert zoom.focal_length_spread(shared) > attempts.MIN_FOCAL_SPREAD
    found = found_for(tmp_path, images)
    assert found.best == attempts.OWN_FOCAL_LENGTHS
    assert zoom.focal_length_spread(found.models[0]) < 1.01
    assert off(found.models[0], taken) < 0.01


def test_cropped_photographs_get_principal_points_and_one_lens(tmp_path: Path) -> None:
    cut = [(int(x), int(y)) for x, y in np.random.default_rng(0).integers((0, 0), (120, 90), (COUNT, 2)) - (60, 45)]
    taken = cameras(cut=cut)
    images = matched(tmp_path, taken)
    shared = mapping.sub_models(tmp_path, images, 0, mapping.DEFAULTS, **QUIET)[0]
    assert zoom.principal_point_spread(shared) > attempts.MIN_MIDDLE_SPREAD
    found = found_for(tmp_path, images)
    assert found.best == attempts.OWN_PRINCIPAL_POINTS
    model = found.models[0]
    lens = np.array([model.cameras[image.camera_id].params for image in registered(model)])
    assert np.ptp(lens[:, [0, 3]], axis=0).max() == 0.0
    assert lens[0, 0] == pytest.approx(400.0, rel=0.08)
    true = np.array([camera.params[1:3] for camera in taken])
    assert (lens[:, 1:3] - true).std() < 0.4 * true.std()
    assert zoom.principal_point_spread(model) < attempts.MIN_MIDDLE_SPREAD / 2
    assert off(model, taken) < 0.5 * off(shared, taken) < 0.005
    assert numbers(found_for(tmp_path, images)) == numbers(found)
