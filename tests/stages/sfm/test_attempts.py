"""Attempts of structure from motion: what is tried when, what is kept, and that a weak photograph gets its camera."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageFilter

from pipeline.errors import BadInput
from pipeline.files import read_json
from stages.sfm import attempts, mapping, matches, merging, pairs
from stages.sfm.attempts import Search
from stages.sfm.cameras import find_cameras
from stages.sfm.database import WorkImage
from stages.sfm.intrinsics import zoom
from stages.sfm.reconstruction import Request, find_models
from tests.stages.sfm.still_life import QUIET, SILENT, STILL_LIFE, errors_of, neighbours

ANEW = ["another beginning", "small angles"]
IMAGES = [WorkImage(f"{k}.jpg", f"{k:05d}.png", 64, 48, 64, 48, None, "a") for k in range(20)]


class Rig:
    """Stands for COLMAP: each attempt registers as many photographs, with such a share of matches that agrees."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, outcomes: dict[str, tuple[int, float]]) -> None:
        self.outcomes, self.tried, self.weak = outcomes, list[str](), list[list[int]]()
        self._step, self.spread, self.apart = "exhaustive", 1.0, 0.001
        monkeypatch.setattr(mapping, "sub_models", lambda work, images, seed, options, *a, **k: self.model(work, "begin", options))
        monkeypatch.setattr(mapping, "continued", lambda work, images, model, seed, *a, **k: self.model(work, "continue", mapping.RELAXED))
        monkeypatch.setattr(mapping, "match_agreement", self.agreement)
        monkeypatch.setattr(zoom, "focal_length_spread", lambda model: self.spread)
        monkeypatch.setattr(zoom, "principal_point_spread", lambda model: self.apart)
        monkeypatch.setattr(zoom, "with_principal_points", lambda model, safe_point: self.model(Path("own_cameras"), "adjust", None)[0])
        monkeypatch.setattr(matches, "match_photographs", lambda *a, **k: None)
        monkeypatch.setattr(attempts, "copy_database", lambda *a: None)
        monkeypatch.setattr(attempts, "copy_with_own_cameras", lambda *a: None)
        monkeypatch.setattr(attempts, "find_features_again", lambda search: self.weak.append(search.missing))
        monkeypatch.setattr(attempts, "match_again", self.match_again)

    def agreement(self, work: Path, model: Any) -> float:
        assert work.is_dir(), "there is no database to read"
        return float(model.agreeing)

    def match_again(self, search: Search, name: str) -> None:
        self._step = {"wider_": "wider matching", "more_": "more features"}[name]
        self.weak.append(search.missing)

    def model(self, work: Path, how: str, options: Any) -> list[Any]:
        if work.name == "own_cameras":
            name = attempts.OWN_PRINCIPAL_POINTS if how == "adjust" else attempts.OWN_FOCAL_LENGTHS
        elif work.name == attempts.MATCHED_AGAIN and how == "begin" and self._step == "beyond":
            name = "small angles" if options is mapping.FORWARD else "another beginning"
        elif work.name == "networks":
            name = attempts.NETWORK if how == "continue" else attempts.NETWORK_ANEW
        elif how == "continue" and work.name != attempts.MATCHED_AGAIN:
            name = "fewer matches"
        elif how == "begin" and options is not mapping.DEFAULTS and self._step in ("exhaustive", "more features"):
            name = "small angles" if options is mapping.FORWARD else "another beginning"
        else:
            name = self._step
        self.tried.append(name)
        count, agreeing = self.outcomes.get(name, (0, 0.0))
        if not count:
            return []
        images = {k: SimpleNamespace(name=IMAGES[k].file, has_pose=True) for k in range(count)}
        error = 0.3 if name == attempts.OWN_PRINCIPAL_POINTS else 0.5
        return [SimpleNamespace(images=images, num_reg_images=lambda: count, agreeing=agreeing, step=name, compute_mean_reprojection_error=lambda: error)]


def climbed(rig: Rig, tmp_path: Path) -> Search:
    return find_models(Search(tmp_path, IMAGES, 0, 100, 1, **QUIET), "exhaustive")


def test_attempts_go_on_until_enough_have_a_camera_and_the_best_is_kept(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    rig = Rig(monkeypatch, {"exhaustive": (8, 0.95), "fewer matches": (9, 0.95), "wider matching": (11, 0.94), "more features": (19, 0.93)})
    found = climbed(rig, tmp_path)
    assert rig.tried == ["exhaustive", "fewer matches", *ANEW, "wider matching", "more features", attempts.OWN_FOCAL_LENGTHS]
    assert [attempt["registered"] for attempt in found.tried] == [8, 9, 0, 0, 11, 19, 0]
    assert rig.weak == [list(range(9, 20)), list(range(11, 20)), list(range(11, 20))]
    assert (found.models[0].step, found.work) == ("more features", tmp_path / attempts.MATCHED_AGAIN)


def test_more_photographs_that_contradict_their_matches_are_not_better(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    rig = Rig(monkeypatch, {"exhaustive": (12, 0.95), "more features": (20, 0.4), "another beginning": (14, 0.9)})
    found = climbed(rig, tmp_path)
    assert rig.tried == ["exhaustive", "fewer matches", "wider matching", "more features", "another beginning", "small angles", attempts.OWN_FOCAL_LENGTHS]
    assert found.models[0].step == found.best == "another beginning"


@pytest.mark.parametrize(("each", "kept"), [((20, 0.97), True), ((20, 0.92), False), ((10, 0.99), False)])
def test_own_focal_lengths_are_kept_where_they_explain_disagreement(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, each: tuple[int, float], kept: bool
) -> None:
    rig = Rig(monkeypatch, {"exhaustive": (20, 0.9), attempts.OWN_FOCAL_LENGTHS: each})
    found = climbed(rig, tmp_path)
    assert rig.tried == ["exhaustive", attempts.OWN_FOCAL_LENGTHS]
    assert found.tried[-1] == {"step": attempts.OWN_FOCAL_LENGTHS, "registered": each[0], "agreeing": each[1]}
    assert (found.best, found.work) == ((attempts.OWN_FOCAL_LENGTHS, tmp_path / "own_cameras") if kept else ("exhaustive", tmp_path))


@pytest.mark.parametrize(("cropped", "kept"), [((20, 0.979), True), ((20, 0.96), False), ((19, 0.98), False)])
def test_own_principal_points_are_kept_where_points_lie_closer(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, cropped: tuple[int, float], kept: bool) -> None:
    rig = Rig(monkeypatch, {"exhaustive": (20, 0.98), attempts.OWN_FOCAL_LENGTHS: (20, 0.98), attempts.OWN_PRINCIPAL_POINTS: cropped})
    rig.apart = 0.01
    found = climbed(rig, tmp_path)
    assert [attempt["step"] for attempt in found.tried] == ["exhaustive", attempts.OWN_PRINCIPAL_POINTS]
    assert found.best == (attempts.OWN_PRINCIPAL_POINTS if kept else "exhaustive")


@pytest.mark.parametrize(
    ("registered", "tried"), [(20, []), (12, [attempts.NETWORK]), (6, [attempts.NETWORK, *2 * [attempts.NETWORK_ANEW]]), (0, 2 * [attempts.NETWORK_ANEW])]
)
def test_networks_come_last_and_for_photographs_without_a_camera_alone(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, registered: int, tried: list[str]
) -> None:
    outcomes = {"exhaustive": (registered, 0.95)}
    without = climbed(Rig(monkeypatch, outcomes), tmp_path)
    Rig(monkeypatch, outcomes)
    compared: list[list[pairs.Pair]] = []
    monkeypatch.setattr(attempts, "neighbours", lambda work, count: {i: set() for i in range(count)})
    monkeypatch.setattr(attempts, "inlier_counts", lambda path: {})
    monkeypatch.setattr(attempts, "add_matches", lambda place, images, wanted, networks, **k: compared.append(wanted))
    monkeypatch.setattr(merging, "triangulated", lambda place, images, models, *a, **k: models[0])
    found = find_models(Search(tmp_path, IMAGES, 0, 100, 1, networks=(tmp_path / "a", tmp_path / "b"), **QUIET), "exhaustive")
    steps = [attempt["step"] for attempt in found.tried]
    assert [step for step in steps if "network" in str(step)] == tried
    assert [attempt for attempt in found.tried if attempt["step"] not in tried] == without.tried
    assert (tmp_path / "networks").exists() == bool(tried)
    weak = set(range(registered, 20))
    assert compared == ([[(i, j) for i, j in sorted(pairs.all_pairs(20)) if {i, j} & weak]] if tried else [])


def test_a_faint_photograph_gets_its_camera_by_more_features(tmp_path: Path) -> None:
    """Of a sixth of the contrast, and blurred."""
    names = neighbours(6)
    for name in names:
        with Image.open(STILL_LIFE / name) as image:
            faint = np.asarray(image.filter(ImageFilter.GaussianBlur(1.0)), np.float32) * 0.15 + 85
            (Image.fromarray(faint.astype(np.uint8)) if name == names[2] else image).save(tmp_path / name, quality=95)
    capture = find_cameras(Request(tmp_path, {name: tmp_path / name for name in names}, tmp_path / "work", 360), **SILENT)
    tried = {attempt["step"]: attempt["registered"] for attempt in capture.provenance.attempts}
    assert tried["exhaustive"] == tried["wider matching"] == 5
    assert tried["more features"] == 6
    assert errors_of(capture).max() < 0.02


def test_what_was_tried_is_in_the_verdict_of_a_failure(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for k in range(3):
        coarse = Image.fromarray(rng.integers(0, 255, (24, 32, 3), np.uint8))
        coarse.resize((160, 120), Image.Resampling.BICUBIC).save(tmp_path / f"{k}.png")
    with pytest.raises(BadInput, match=r"verdict\.json"):
        find_cameras(Request(tmp_path, {f"{k}.png": tmp_path / f"{k}.png" for k in range(3)}, tmp_path / "work"), **SILENT)
    said = read_json(tmp_path / "work/verdict.json")
    assert said["grade"] == "failed"
    assert [attempt["step"] for attempt in said["attempts"]] == ["exhaustive", *ANEW, "wider matching", "more features", *ANEW]
    assert set(said["images"]) == {"0.png", "1.png", "2.png"}
    assert not said["images"]["0.png"]["registered"]
