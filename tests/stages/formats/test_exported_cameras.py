"""Exports of other programs: a known point lies at the known pixel in every image, and each folder is taken by one importer."""

import json
from pathlib import Path

import numpy as np
import pytest

from efficientnerf.geometry.cameras import project
from pipeline.errors import BadInput
from stages.formats import importers
from stages.formats.importers.description import describe_source
from stages.formats.importers.source import IMAGE_SUFFIXES
from stages.io.capture import Capture
from tests.stages import captures, exports
from tests.stages.captures import Settings
from tests.stages.exports import EXPORTS, POINTS, read


def assert_seen(capture: Capture, pixels: exports.Pixels, atol: float = 1e-6) -> None:
    """The points lie where they should in every image, and in front of it."""
    found = {photo.image.name: project(photo.camera, POINTS) for photo in capture.photos}
    assert set(found) == set(pixels)
    for name, (where, depth) in found.items():
        np.testing.assert_allclose(where, pixels[name], atol=atol, err_msg=name)
        assert (depth > 0).all()


# A fourth radial coefficient becomes a quotient of polynomials.
TOLERANCE = {"metashape": 0.03, "realitycapture csv": 0.01, "realitycapture xmp": 0.01}


@pytest.mark.parametrize("how", EXPORTS)
def test_a_known_point_lies_at_the_known_pixel_in_every_image(how: str, tmp_path: Path) -> None:
    name, write = EXPORTS[how]
    folder, pixels = write(tmp_path / "source")
    assert importers.candidates(folder)[0] == name
    assert [other for other in importers.candidates(folder) if other != "photographs"] == [name]
    capture = read(folder)
    assert capture.kind == name
    assert len(capture.photos) == 6
    assert_seen(capture, pixels, TOLERANCE.get(how, 1e-6))
    listed = importers.files(folder, Settings())
    assert {photo.image for photo in capture.photos} < set(listed)
    assert all(path.is_file() for path in listed)
    described = describe_source(folder)
    json.dumps(described, allow_nan=False)
    assert (described["count"], described["format"]) == (6, name)


# --- what each format holds beside cameras


def test_metashapes_project_frame_and_cameras_without_a_place(tmp_path: Path) -> None:
    folder, pixels = exports.metashape(tmp_path / "a", {"f": 40.0, "k1": -0.1, "p1": 0.002})
    capture = read(folder)
    assert_seen(capture, pixels)
    assert capture.metric
    assert capture.rejected == (("img_9", "not aligned in Metashape"),)
    assert {photo.camera.model for photo in capture.photos} == {"OPENCV"}
    assert not any("listed" in warning for warning in capture.warnings), "labels state no folder"


def test_a_geocentric_project_keeps_scale_and_finds_up(tmp_path: Path) -> None:
    folder, _ = exports.metashape(tmp_path / "a")
    text = (folder / "cameras.xml").read_text()
    place = np.array([4.0e6, 0.8e6, 4.9e6])
    (folder / "cameras.xml").write_text(text.replace(exports.words(exports.CHUNK[1]), exports.words(place)))
    capture = read(folder)
    assert capture.up is not None
    np.testing.assert_allclose(capture.up, place / np.linalg.norm(place))
    centres = np.array([photo.camera.centre for photo in capture.photos])
    truth = np.array([camera.centre for camera in exports.cameras()]) - exports.CHUNK[1]
    np.testing.assert_allclose(centres, truth, atol=1e-9)
    assert any("positions are from the chunk's own origin" in warning for warning in capture.warnings)


@pytest.mark.parametrize(
    ("lens", "kind", "named"),
    [
        ({"f": 40.0, "b2": 5.0}, "frame", "skew"),
        ({"f": 40.0, "p3": 0.1}, "frame", "p3"),
        ({"f": 40.0}, "spherical", "spherical"),
        ({"f": 40.0, "p1": 0.1}, "fisheye", "p1"),
        ({"f": -1.0}, "frame", "focal length -1"),
        ({"f": 4e5, "cx": 5e5, "k4": 0.5}, "frame", "radial"),
        ({"f": float("nan")}, "frame", "finite"),
    ],
)
def test_lenses_of_metashape_that_no_model_describes_are_refused(lens: dict[str, float], kind: str, named: str, tmp_path: Path) -> None:
    folder, _ = exports.metashape(tmp_path / "a", lens, kind)
    with pytest.raises(BadInput, match=named):
        read(folder)


def test_splits_bounds_masks_and_bad_frames(tmp_path: Path) -> None:
    plain = read(exports.nsvf(tmp_path / "nsvf")[0])
    assert [photo.split for photo in plain.photos] == ["train"] * 2 + ["val"] * 2 + ["test"] * 2
    assert plain.bounds is not None
    np.testing.assert_allclose(plain.bounds, [[-1, -1.5, -2], [1, 1.5, 2]])
    sphere = read(exports.idr(tmp_path / "idr")[0])
    assert sphere.bounds is not None
    np.testing.assert_allclose(sphere.bounds, [[-1.9, -1.8, -1.7], [2.1, 2.2, 2.3]])
    assert [photo.mask for photo in sphere.photos] == [tmp_path / f"idr/mask/{index:03d}.png" for index in range(6)]
    indoor = read(exports.scannetpp(tmp_path / "scannetpp")[0])
    splits = {photo.image.name: photo.split for photo in indoor.photos}
    assert splits == {f"img_{index}.JPG": "train" if index < 4 else "test" for index in range(6)}
    assert ("img_9.JPG", "marked as bad by the data set") in indoor.rejected
    assert indoor.metric


# --- hostile


BESIDE = ("pair.txt", "mesh_info.json", "bbox.txt", "points3d.txt", "observations.txt")


def lists_of(folder: Path) -> list[Path]:
    """Files that state cameras."""
    return [path for path in sorted(folder.rglob("*")) if path.is_file() and path.suffix.lower() not in (*IMAGE_SUFFIXES, ".exr") and path.name not in BESIDE]


@pytest.mark.parametrize("how", EXPORTS)
def test_no_link_out_of_the_source_is_followed(how: str, tmp_path: Path) -> None:
    for what in ("image", "list"):
        folder, pixels = EXPORTS[how][1](tmp_path / what)
        path = next(folder.rglob(list(pixels)[2])) if what == "image" else lists_of(folder)[0]
        if how == "polycam":  # the corrected ones are used
            path = folder / ("keyframes/corrected_images/img_2.jpg" if what == "image" else "keyframes/corrected_cameras/img_2.json")
        (tmp_path / f"elsewhere {what}").mkdir()
        target = path.rename(tmp_path / f"elsewhere {what}" / path.name)
        path.symlink_to(target)
        for attempt in (importers.files, lambda source, settings: read(source)):
            with pytest.raises(BadInput, match="--allow-outside"):
                attempt(folder, Settings())


def tried(name: str, folder: Path) -> Capture | BadInput:
    try:
        return importers.IMPORTERS[name].read(folder, Settings())
    except BadInput as error:
        return error


@pytest.mark.parametrize("name", ["../secret.png", "/etc/hostname", "a\0b.png"])
@pytest.mark.parametrize("how", ["metashape", "realitycapture csv", "opensfm", "kapture", "scannet++"])
def test_foreign_paths_lead_nowhere(how: str, name: str, tmp_path: Path) -> None:
    folder, pixels = EXPORTS[how][1](tmp_path / "source")
    captures.write_picture(tmp_path / "secret.png", captures.picture())
    path = next(path for path in lists_of(folder) if list(pixels)[1] in path.read_text())
    listed = next(word for word in ("map/img_1.png", list(pixels)[1]) if word in path.read_text())
    if "\0" in name and path.suffix != ".json":
        name = "&#1;" if path.suffix == ".xml" else "a\x01b.png"
    path.write_text(path.read_text().replace(listed, json.dumps(name)[1:-1] if path.suffix == ".json" else name))
    capture = tried(EXPORTS[how][0], folder)
    if isinstance(capture, BadInput):
        assert str(capture).isprintable()
    else:
        assert {photo.image.name for photo in capture.photos} == set(pixels) - {list(pixels)[1]}
        assert all(folder in photo.image.parents for photo in capture.photos)


ENTITIES = '<!DOCTYPE d [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]>'


@pytest.mark.parametrize("how", ["metashape", "realitycapture xmp"])
def test_entities_are_refused_before_they_expand(how: str, tmp_path: Path) -> None:
    folder, _ = EXPORTS[how][1](tmp_path / "a")
    path = lists_of(folder)[0]
    text = path.read_text().replace('<?xml version="1.0" encoding="UTF-8"?>', "")
    path.write_bytes((ENTITIES + text).encode("utf-16"))
    with pytest.raises(BadInput):
        read(folder)


def test_an_archive_with_objects_or_bombs_is_refused(tmp_path: Path) -> None:
    folder, _ = exports.idr(tmp_path / "a")
    file = folder / "cameras_sphere.npz"
    good = file.read_bytes()
    np.savez(file, world_mat_0=np.array([{}], object), allow_pickle=True)
    with pytest.raises(BadInput):
        read(folder)
    np.savez_compressed(file, world_mat_0=np.zeros((1000, 1000)))
    with pytest.raises(BadInput):
        read(folder)
    file.write_bytes(good[: len(good) // 2])
    with pytest.raises(BadInput):
        read(folder)


@pytest.mark.parametrize("how", EXPORTS)
def test_missing_images_are_named_and_too_few_are_refused(how: str, tmp_path: Path) -> None:
    folder, pixels = EXPORTS[how][1](tmp_path / "a")
    for count, name in enumerate(list(pixels)[:4], 1):
        for path in list(folder.rglob(name)):
            path.unlink()
        if how in ("idr", "tanks and temples", "record3d", "polycam", "3d scanner app") and count == 1:
            continue  # which go by the files that are there, or refuse a count that differs
        if count == 1:
            assert any("1 of 6 listed images are missing" in warning for warning in read(folder).warnings)
    with pytest.raises(BadInput):
        read(folder)
