"""Features and matches by networks that the user has: tiny ones, made here, in the layouts of public exports; and cameras that SIFT alone does not find."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.errors import BadInput
from stages.sfm import matches
from stages.sfm.added.matches import NEIGHBOURS, pairs_of
from stages.sfm.database import FEATURES, forget
from stages.sfm.reconstruction import Request, reconstruct
from tests.stages.sfm.still_life import SILENT, STILL_LIFE, errors_of, neighbours

pytest.importorskip("onnx", reason="the package onnx, which makes the networks of these tests, is not installed")
pytest.importorskip("onnxruntime", reason="the package onnxruntime is not installed (extra rembg)")

from stages.sfm.added.networks import Detector, Features, Matcher
from tests.stages.sfm.made_networks import WIDE, _Graph, detector, matcher, value

WIDTH, HEIGHT = 330, 250


def squares() -> tuple[np.ndarray, np.ndarray]:
    """(HEIGHT, WIDTH, 3) squares of different greys, and their corners (N, 2), px from the corner of the picture."""
    rng = np.random.default_rng(0)
    picture, corners = np.full((HEIGHT, WIDTH), 20, np.uint8), []
    for y in range(20, HEIGHT - 40, 45):
        for x in range(20, WIDTH - 60, 45):
            side = int(rng.integers(18, 28))
            picture[y : y + side, x : x + side] = rng.integers(90, 250)
            corners += [(x + a, y + b) for a in (0, side) for b in (0, side)]
    return np.repeat(picture[..., None], 3, 2), np.array(corners, np.float64)


def strongest(path: Path, mask: np.ndarray | None = None) -> Features:
    return Detector(path).features(squares()[0], mask, 100)


@pytest.mark.parametrize("layout", ["LightGlue-ONNX", "TensorRT", "COLMAP"])
def test_a_network_of_one_size_gets_the_picture_at_its_size(tmp_path: Path, layout: str) -> None:
    found, corners = strongest(detector(tmp_path / "d.onnx", layout, (160, 192))), squares()[1]
    assert max(found.size[0] / 192, found.size[1] / 160) == pytest.approx(1.0, abs=0.01)
    assert np.median(np.linalg.norm(found.xy[:, None] - corners, axis=2).min(1)) < 5.0


def refused_networks(folder: Path) -> dict[str, Path]:
    (folder / "text.onnx").write_text("no network")
    wrong = {"text": folder / "text.onnx"}
    for name, inputs, outputs in (
        ("pipeline", {"images": (2, 3, 64, 64)}, ("keypoints", "matches", "mscores")),
        ("grey", {"image": (1, 1, 64, 64)}, ("keypoints", "descriptors", "scores")),
        ("mask", {"image": (1, 3, 64, 64)}, ("mask",)),
        ("two images", {"image0": (1, 3, 64, 64), "image1": (1, 3, 64, 64)}, ("keypoints", "descriptors", "scores")),
        ("dense", {"image": (1, 3, 64, 64)}, ("keypoints", "descriptors", "scores")),
    ):
        g = _Graph()
        for output in outputs:
            g.add("Identity", next(iter(inputs)), out=output)
        wrong[name] = g.save(folder / f"{name}.onnx", [value(key, shape) for key, shape in inputs.items()], [value(each, None) for each in outputs])
    return wrong


def test_what_is_no_such_network_is_refused_in_one_line(tmp_path: Path) -> None:
    for path in refused_networks(tmp_path).values():
        for kind in (Detector, Matcher):
            with pytest.raises(BadInput) as caught:
                kind(path) if kind is Matcher else kind(path).features(squares()[0], None, 10)
            assert "\n" not in str(caught.value)
            assert str(path) in str(caught.value)
    with pytest.raises(BadInput):
        Detector(matcher(tmp_path / "m.onnx"))
    with pytest.raises(BadInput):
        Matcher(detector(tmp_path / "d.onnx"))
    found = strongest(tmp_path / "d.onnx")
    with pytest.raises(BadInput):  # of another detector
        Matcher(tmp_path / "m.onnx").matches(found, Features(found.xy, found.seen, found.size, np.zeros((len(found.xy), WIDE + 1), np.float32)))


def test_photographs_without_cameras_are_compared_with_others() -> None:
    overlaps = {(i, j): 100 - 10 * (j - i) for i in range(1, 9) for j in range(i + 1, 9)} | {(2, 9): 0}
    pairs = pairs_of([0], [(0, 8), (7, 0), (0, 6)], overlaps)
    assert pairs == [(0, 6), (0, 7), (0, 8), (6, 7)]
    assert pairs_of([0, 1, 2], [(0, 1), (2, 0), (1, 2)], {}) == [(0, 1), (0, 2), (1, 2)]
    every = pairs_of([0], [(0, j) for j in range(1, 9)], overlaps)
    assert all(sum(i in pair for pair in every) >= 1 + NEIGHBOURS for i in range(1, 8))


def test_a_photograph_without_sift_features_gets_its_camera(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = neighbours(6)
    detect = matches.extract_features

    def without_the_third(work: Path, images: Any, **how: Any) -> None:
        detect(work, images, **how)
        if any(image.file == "00002.png" for image in images):
            forget(work, FEATURES, [3])
            with matches.quiet_pycolmap() as pycolmap, pycolmap.Database.open(matches.database_path(work)) as database:
                database.write_keypoints(3, np.zeros((0, 6), np.float32))
                database.write_descriptors(3, pycolmap.FeatureDescriptors(data=np.zeros((0, 128), np.uint8), type=pycolmap.FeatureExtractorType.SIFT))

    monkeypatch.setattr(matches, "extract_features", without_the_third)
    networks = detector(tmp_path / "d.onnx", "COLMAP"), matcher(tmp_path / "m.onnx", "COLMAP")
    paths = {name: STILL_LIFE / name for name in names}
    usual = reconstruct(Request(STILL_LIFE, paths, tmp_path / "without", 360, 4096, threads=1), **SILENT)
    asked = [Request(STILL_LIFE, paths, tmp_path / f"with {threads}", 360, 4096, threads=threads, networks=networks) for threads in (1, 2)]
    found = [reconstruct(request, **SILENT) for request in asked]
    assert [name for name, _ in usual.rejected] == [names[2]]
    before, after = (list(capture.provenance.attempts) for capture in (usual, found[0]))
    assert after[: len(before)] == before, "what is tried before it is the same"
    assert found[0].rejected == ()
    assert errors_of(found[0]).max() < 0.02
    for one, other in zip(*(capture.photos for capture in found), strict=True):
        assert (one.camera.name, one.camera.params) == (other.camera.name, other.camera.params)
        np.testing.assert_array_equal(one.camera.world_from_camera, other.camera.world_from_camera)
    np.testing.assert_array_equal(found[0].points.xyz, found[1].points.xyz)  # type: ignore[union-attr]
