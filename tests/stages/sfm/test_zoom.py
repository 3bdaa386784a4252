"""Photographs that were zoomed or cropped, each by itself, and whose EXIF data do not say so: each gets a camera of its own."""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from benchmarks.poses import aligned_errors
from efficientnerf.geometry.cameras import Camera, project
from stages.sfm import ladder, lenses, mapping
from stages.sfm.colmap import quiet_pycolmap
from stages.sfm.database import FEATURES, PAIRS, copy_with_own_cameras, database_path, open_database
from stages.sfm.images import WorkImage
from stages.verdict.verdict import DOUBTFUL

SIZE = 480, 360
COUNT, POINTS = 9, 250
QUIET: dict[str, Any] = {"progress": lambda *a, **k: None, "safe_point": lambda: None}
ZOOMED = tuple(400.0 / (1.0, 0.8, 0.65)[k % 3] for k in range(COUNT))


def cameras(focal: tuple[float, ...] = (400.0,) * COUNT, cut: Sequence[tuple[int, int]] = ((0, 0),) * COUNT) -> list[Camera]:
    """Along a third of a circle, at different heights, looking at its middle.

    cut  pixels that are cut off at the left and at the top
    """
    made = []
    for k in range(COUNT):
        angle = 2.0 * k / COUNT
        centre = np.array([2 * np.cos(angle), 2 * np.sin(angle), 0.5 + 0.5 * np.sin(1.7 * k)])
        forward = -centre / np.linalg.norm(centre)
        right = np.cross(forward, (0, 0, 1))
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3] = np.stack([right, np.cross(forward, right), forward, centre], -1)
        made.append(Camera(f"{k}.png", *SIZE, "SIMPLE_RADIAL", (focal[k], SIZE[0] / 2 - cut[k][0], SIZE[1] / 2 - cut[k][1], -0.04), pose))
    return made


def matched(work: Path, taken: list[Camera]) -> list[WorkImage]:
    """Grey pictures, and a database of features where points of a cloud are seen, 0.4 px off, and of verified matches, of which 5 % were wrong before."""
    rng = np.random.default_rng(0)
    cloud = rng.normal(0, 0.35, (POINTS, 3))
    (work / "images").mkdir(parents=True)
    images = [WorkImage(camera.name, f"{k:05d}.png", *SIZE, *SIZE, None, "one") for k, camera in enumerate(taken)]
    for image in images:
        Image.new("RGB", SIZE, (90, 90, 90)).save(work / "images" / image.file)
    open_database(work, images, print)
    seen = [project(camera, cloud)[0] + rng.normal(0, 0.4, (POINTS, 2)) for camera in taken]
    inside = [((xy > 0) & (xy < SIZE)).all(1) for xy in seen]
    with quiet_pycolmap() as pycolmap, pycolmap.Database.open(database_path(work)) as database:
        camera = database.read_all_cameras()[0]
        options = pycolmap.TwoViewGeometryOptions()
        options.ransac.random_seed = 0
        for k, xy in enumerate(seen):
            database.write_keypoints(k + 1, np.clip(xy, 0, None).astype(np.float32))
            database.write_descriptors(k + 1, pycolmap.FeatureDescriptors(data=np.zeros((POINTS, 128), np.uint8), type=pycolmap.FeatureExtractorType.SIFT))
        for i in range(COUNT):
            for j in range(i + 1, COUNT):
                both = np.flatnonzero(inside[i] & inside[j] & (rng.random(POINTS) < 0.9 ** (j - i)))
                pairs = np.stack([both, both], 1).astype(np.uint32)
                wrong = rng.random(len(both)) < 0.05
                pairs[wrong, 1] = rng.permutation(pairs[wrong, 1])
                database.write_matches(i + 1, j + 1, pairs)
                geometry = pycolmap.estimate_two_view_geometry(camera, seen[i], camera, seen[j], pairs, options)
                database.write_two_view_geometry(i + 1, j + 1, geometry)
    return images


def found_for(work: Path, images: list[WorkImage]) -> ladder.Found:
    return ladder.find_models(work, images, "exhaustive", features=POINTS, seed=0, threads=1, **QUIET)


def registered(model: Any) -> list[Any]:
    return sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)


def off(model: Any, taken: list[Camera]) -> float:
    """Root mean square of the distances of the centres from the true ones."""
    centres = np.array([image.projection_center() for image in registered(model)])
    return float(np.sqrt((aligned_errors(centres, np.array([camera.centre for camera in taken])) ** 2).mean()))


def numbers(found: ladder.Found) -> list[bytes]:
    model = found.models[0]
    return [np.concatenate([model.cameras[i.camera_id].params, i.cam_from_world().matrix().ravel()]).tobytes() for i in registered(model)]


def test_a_zoom_that_changed_gives_each_photograph_its_focal_length(tmp_path: Path) -> None:
    taken = cameras(ZOOMED)
    images = matched(tmp_path, taken)
    found = found_for(tmp_path, images)
    assert [rung["rung"] for rung in found.rungs] == ["exhaustive", ladder.EACH]
    one, each = (float(rung["agreeing"]) for rung in found.rungs)  # type: ignore[arg-type]
    assert one < DOUBTFUL < 0.98 < each
    assert (found.rung, found.work) == (ladder.EACH, tmp_path / "own_cameras")
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
    assert mapping.match_agreement(tmp_path, images, shared) > DOUBTFUL
    assert off(shared, taken) > 0.05
    assert lenses.focal_length_spread(shared) > ladder.SPREAD
    found = found_for(tmp_path, images)
    assert found.rung == ladder.EACH
    assert lenses.focal_length_spread(found.models[0]) < 1.01
    assert off(found.models[0], taken) < 0.01


def test_photographs_that_were_cropped_get_their_principal_points_and_one_lens(tmp_path: Path) -> None:
    cut = [(int(x), int(y)) for x, y in np.random.default_rng(0).integers((0, 0), (120, 90), (COUNT, 2)) - (60, 45)]
    taken = cameras(cut=cut)
    images = matched(tmp_path, taken)
    shared = mapping.sub_models(tmp_path, images, 0, mapping.DEFAULTS, **QUIET)[0]
    assert lenses.principal_point_spread(shared) > ladder.APART
    found = found_for(tmp_path, images)
    assert found.rung == ladder.CROPPED
    model = found.models[0]
    lens = np.array([model.cameras[image.camera_id].params for image in registered(model)])
    assert np.ptp(lens[:, [0, 3]], axis=0).max() == 0.0
    assert lens[0, 0] == pytest.approx(400.0, rel=0.08)
    true = np.array([camera.params[1:3] for camera in taken])
    assert (lens[:, 1:3] - true).std() < 0.4 * true.std()
    assert lenses.principal_point_spread(model) < ladder.APART / 2
    assert off(model, taken) < 0.5 * off(shared, taken) < 0.005
    assert numbers(found_for(tmp_path, images)) == numbers(found)


def test_the_spread_of_principal_points_does_not_depend_on_where_all_of_them_are(tmp_path: Path) -> None:
    """All cropped alike: one principal point, off the middle."""
    images = matched(tmp_path, cameras(cut=((20, -12),) * COUNT))
    shared = mapping.sub_models(tmp_path, images, 0, mapping.DEFAULTS, **QUIET)[0]
    assert lenses.principal_point_spread(shared) < ladder.APART
    assert lenses.focal_length_spread(shared) < ladder.SPREAD


def test_one_zoom_is_not_looked_at_again(tmp_path: Path) -> None:
    images = matched(tmp_path, cameras())
    found = found_for(tmp_path, images)
    assert [rung["rung"] for rung in found.rungs] == ["exhaustive"]
    assert found.rung == "exhaustive"
    assert not (tmp_path / "own_cameras").exists()


def test_a_copy_with_own_cameras_has_the_same_features_and_matches(tmp_path: Path) -> None:
    images = matched(tmp_path, cameras(ZOOMED))
    place = tmp_path / "copy"
    place.mkdir()
    copy_with_own_cameras(tmp_path, place, images)

    def rows(work: Path, table: str) -> list[Any]:
        with contextlib.closing(sqlite3.connect(database_path(work))) as connection:
            return connection.execute(f"SELECT * FROM {table} ORDER BY 1").fetchall()

    for table, _ in (*FEATURES, *PAIRS):
        assert rows(tmp_path, table) == rows(place, table)
        assert rows(place, table)
    with quiet_pycolmap() as pycolmap, pycolmap.Database.open(database_path(place)) as database:
        own = {image.name: (image.image_id, image.camera_id) for image in database.read_all_images()}
    assert [own[image.file][0] for image in images] == list(range(1, COUNT + 1))
    assert len({camera for _, camera in own.values()}) == COUNT
    copy_with_own_cameras(tmp_path, place, images)  # over what is there
    assert rows(tmp_path, "matches") == rows(place, "matches")
