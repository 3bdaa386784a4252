"""The verdict on cameras: how photographs look, what stands against a capture, and its pictures."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image, ImageFilter

from efficientnerf.geometry.cameras import Camera
from stages.io.capture import Capture, Lens, Photo, Provenance, SparsePoints
from stages.verdict import looks, pictures
from stages.verdict.grades import GRADES
from stages.verdict.looks import Look, look
from stages.verdict.verdict import Verdict, failed, verdict_on

RNG = np.random.default_rng(0)
PICTURE = cv2.resize(RNG.integers(40, 216, (120, 160), np.uint8), (640, 480), interpolation=cv2.INTER_LANCZOS4)


def moved(picture: np.ndarray, pixels: int) -> np.ndarray:
    return np.asarray(cv2.blur(picture, (pixels, 1)))


@pytest.mark.parametrize("blur", [lambda p: cv2.GaussianBlur(p, (0, 0), 4.0), lambda p: moved(p, 15), lambda p: moved(p.T, 15).T])
def test_blur_takes_sharpness_whatever_contrast_and_brightness(blur) -> None:  # type: ignore[no-untyped-def]
    sharp, soft = look(PICTURE), look(np.ascontiguousarray(blur(PICTURE)))
    assert soft.sharpness < looks.LESS_SHARP * sharp.sharpness
    faint = look(np.rint(PICTURE * 0.4 + 60).astype(np.uint8))
    assert faint.sharpness == pytest.approx(sharp.sharpness, rel=0.05)
    noisy = np.clip(PICTURE + np.random.default_rng(1).normal(0, 2.0, PICTURE.shape), 0, 255).astype(np.uint8)
    assert look(noisy).sharpness == pytest.approx(sharp.sharpness, rel=0.1)
    assert look(np.full((48, 64), 90, np.uint8)).sharpness == 0.0


def picture_of(seed: int) -> np.ndarray:
    return cv2.resize(np.random.default_rng(seed).integers(40, 216, (12, 16), np.uint8), (320, 240), interpolation=cv2.INTER_CUBIC)


def test_the_same_picture_twice_is_found_and_another_is_not() -> None:
    jpeg = cv2.imdecode(cv2.imencode(".jpg", picture_of(0), [cv2.IMWRITE_JPEG_QUALITY, 60])[1], cv2.IMREAD_GRAYSCALE)
    shifted = np.roll(picture_of(0), 24, axis=1)
    white = np.full((240, 320), 250, np.uint8)
    seen = {name: look(p) for name, p in {"a": picture_of(0), "b": picture_of(1), "c": jpeg, "d": shifted, "e": picture_of(0), "w": white, "x": white}.items()}
    assert looks.duplicates(seen) == {"c": "a", "e": "a"}
    assert looks.duplicates({}) == {}


def test_files_are_looked_at_upright_and_what_is_no_picture_is_left_out(tmp_path: Path) -> None:
    upright = Image.fromarray(picture_of(3))
    upright.save(tmp_path / "upright.png")
    exif = Image.Exif()
    exif[274] = 6
    upright.transpose(Image.Transpose.ROTATE_90).save(tmp_path / "turned.png", exif=exif)
    (tmp_path / "text.png").write_bytes(b"no picture")
    found = looks.look_at_all({name: tmp_path / f"{name}.png" for name in ("upright", "turned", "text")})
    assert sorted(found) == ["turned", "upright"]
    assert looks.duplicates(found) == {"upright": "turned"}


def test_deep_and_transparent_pictures_are_looked_at_as_they_are_seen(tmp_path: Path) -> None:
    shown = picture_of(4)
    Image.fromarray(shown).save(tmp_path / "plain.png")
    Image.fromarray(shown.astype(np.uint16) * 257).save(tmp_path / "deep.png")
    hidden = np.dstack([np.repeat(np.where(np.arange(320) < 200, shown, 255)[..., None], 3, 2), np.where(np.arange(320) < 200, 255, 0) * np.ones((240, 1))])
    Image.fromarray(hidden.astype(np.uint8), "RGBA").save(tmp_path / "alpha.png")
    plain, deep, alpha = (looks.grey_of(tmp_path / f"{name}.png") for name in ("plain", "deep", "alpha"))
    assert (plain == shown).all()
    assert (deep == shown).all()
    assert (alpha == np.where(np.arange(320) < 200, shown, looks.PAPER)).all()


# ------------------------------------------------------------------------------------------------------------ grades


def capture(count: int = 24, radius: float = 4.0, **changes: object) -> Capture:
    """Cameras on a circle round points that each of them sees."""
    photos = []
    for k in range(count):
        angle = 2 * np.pi * k / count
        pose = np.eye(4)
        pose[:3, 3] = radius * np.cos(angle), radius * np.sin(angle), 10.0
        photos.append(Photo(Camera(f"{k:02d}.jpg", 640, 480, "SIMPLE_PINHOLE", (500.0, 320.0, 240.0), pose), Path("none")))
    xyz = np.random.default_rng(0).normal(0, 1, (200, 3))
    points = SparsePoints(xyz, np.zeros((200, 3), np.uint8), np.ones(200), tuple(tuple(range(count)) for _ in range(200)))
    given: dict[str, object] = {"reprojection_error": 0.5, "provenance": Provenance(pairs_agreeing=0.97, components=[count], models=[count])}
    return Capture(kind="photographs", photos=tuple(photos), background=None, points=points, **(given | changes))  # type: ignore[arg-type]


def sharp(names: list[str], **changes: dict[str, object]) -> dict[str, Look]:
    base = {"sharpness": 0.25, "brightness": -2.0, "clipped": 0.0, "noise": 0.5, "longest": 640}
    return {
        name: Look(**(base | changes.get(name, {})), small=np.random.default_rng(k).uniform(0, 255, (16, 24)).astype(np.float32))  # type: ignore[arg-type]
        for k, name in enumerate(names)
    }


NAMES = [f"{k:02d}.jpg" for k in range(24)]


def test_nothing_stands_against_a_good_capture() -> None:
    found = verdict_on(capture(), sharp(NAMES))
    assert (found.grade, found.problems) == ("good", ())
    assert found.images["03.jpg"]["points"] == 200
    assert json.loads(json.dumps(found.document()))["grade"] == "good"


LOST = tuple((f"lost{k}.jpg", "overlaps no other photograph well enough") for k in range(30))


@pytest.mark.parametrize(
    ("changes", "what", "grade"),
    [
        ({"rejected": LOST[:1]}, "not registered", "good"),
        ({"rejected": LOST[:6]}, "not registered", "usable"),
        ({"rejected": LOST}, "not registered", "poor"),
        ({"provenance": Provenance(pairs_agreeing=0.6)}, "folded", "poor"),
        ({"provenance": Provenance(pairs_agreeing=0.9)}, "disagreement", "usable"),
        ({"provenance": Provenance(components=[24, 7, 1])}, "components", "usable"),
        ({"provenance": Provenance(models=[24, 5])}, "sub-models", "good"),
        ({"radius": 0.05}, "parallax", "poor"),
        ({"count": 5}, "few", "usable"),
        ({"reprojection_error": 3.0}, "reprojection error", "usable"),
    ],
)
def test_each_problem_has_its_grade_and_remedy(changes: dict[str, object], what: str, grade: str) -> None:
    made = capture(**changes)  # type: ignore[arg-type]
    found = verdict_on(made, sharp([photo.camera.name for photo in made.photos]))
    assert [(problem.what, problem.grade) for problem in found.problems] == [(what, grade)]
    assert found.grade == grade
    assert found.problems[0].remedy


def test_groups_that_all_have_cameras_are_not_left_out() -> None:
    dropped, tied = (verdict_on(capture(provenance=Provenance(components=parts)), sharp(NAMES)).problems[0] for parts in ([24, 7], [17, 7]))
    assert (dropped.what, tied.what) == ("components", "components")
    assert "largest is used" in dropped.sentence
    assert "largest is used" not in tied.sentence


def test_matches_that_disagree_with_cameras_of_little_parallax_are_worse_than_either() -> None:
    doubtful = Provenance(pairs_agreeing=0.85)
    assert verdict_on(capture(radius=0.22), sharp(NAMES)).grade == "usable"
    assert verdict_on(capture(provenance=doubtful), sharp(NAMES)).grade == "usable"
    assert verdict_on(capture(radius=0.22, provenance=doubtful), sharp(NAMES)).grade == "poor"


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"sharpness": 0.1}, "blurred"),
        ({"brightness": -3.0}, "exposure"),
        ({"clipped": 0.5}, "clipped"),
        ({"noise": 20.0}, "noise"),
        ({"compressed": True}, "compression"),
    ],
)
def test_pictures_that_differ_are_named_and_count_where_they_are_many(change: dict[str, object], what: str) -> None:
    one = verdict_on(capture(), sharp(NAMES, **{"05.jpg": change}))
    assert [(problem.what, problem.grade, problem.images) for problem in one.problems] == [(what, "good", ("05.jpg",))]
    many = verdict_on(capture(), sharp(NAMES, **dict.fromkeys(NAMES[:8], change)))
    assert (many.grade, many.problems[0].images) == ("usable", tuple(NAMES[:8]))


@pytest.mark.parametrize("deviation", [5.0, 30.0])
def test_noise_is_measured_whatever_the_picture_shows(deviation: float) -> None:
    noise = np.random.default_rng(2).normal(0, deviation, PICTURE.shape)
    for picture in (PICTURE, np.full(PICTURE.shape, 120, np.uint8), cv2.GaussianBlur(PICTURE, (0, 0), 4.0)):
        seen = look(np.clip(np.rint(picture + noise), 0, 255).astype(np.uint8))
        assert seen.noise == pytest.approx(deviation, rel=0.12, abs=1.5)
        assert (seen.noise > looks.NOISY) == (deviation > looks.NOISY)


STILL_LIFE = Path(__file__).resolve().parents[3] / "examples" / "still_life"


def photograph(blur: float = 0.0) -> Image.Image:
    """Of the still life, blurred by a Gaussian: then the blocks of a good JPEG are much of what differs from pixel to pixel."""
    paths = sorted(STILL_LIFE.glob("*.jpg"))
    if not paths:
        pytest.skip("examples/still_life is not there")
    with Image.open(paths[0]) as image:
        return image.convert("RGB").filter(ImageFilter.GaussianBlur(blur))


def saved(image: Image.Image, quality: int, folder: Path) -> Path:
    image.save(folder / f"{quality}.jpg", quality=quality)
    return folder / f"{quality}.jpg"


@pytest.mark.parametrize("blur", [0.0, 4.0])
@pytest.mark.parametrize(("quality", "strong"), [(8, True), (50, False)])
def test_strong_compression_is_told_by_the_file_and_by_its_blocks_in_another(tmp_path: Path, blur: float, quality: int, strong: bool) -> None:
    path = saved(photograph(blur), quality, tmp_path)
    with Image.open(path) as image:
        image.save(tmp_path / "again.png")
        image.crop((3, 5, 403, 305)).save(tmp_path / "cropped.jpg", quality=95)
        image.resize((311, 233)).save(tmp_path / "reduced.jpg", quality=92)
    assert looks.look_at(path).compressed == strong
    assert looks.look_at(tmp_path / "again.png").compressed == strong
    assert looks.look_at(tmp_path / "cropped.jpg").compressed == strong
    assert looks.look_at(tmp_path / "reduced.jpg", path).compressed == strong
    assert not looks.look_at(tmp_path / "reduced.jpg").compressed  # smeared over all columns: nothing tells


@pytest.mark.parametrize("step", [5, 8])
def test_enlarged_pictures_have_no_blocks(step: int) -> None:
    coarse = np.random.default_rng(step).integers(0, 255, (480 // step, 640 // step), np.uint8)
    for how in (cv2.INTER_LINEAR, cv2.INTER_CUBIC, cv2.INTER_LANCZOS4):
        assert not look(cv2.resize(coarse, (640, 480), interpolation=how)).compressed
    assert not look(np.full((480, 640), 90, np.uint8)).compressed
    assert not look(coarse[:40]).compressed


def lens(**changes: float) -> tuple[float, ...]:
    return tuple(({"f": 500.0, "x": 320.0, "y": 240.0} | changes).values())


def test_photographs_that_were_zoomed_or_cropped_are_named() -> None:
    def with_lenses(own: Lens | None, others: dict[int, tuple[float, ...]]) -> Verdict:
        made = capture(provenance=Provenance(pairs_agreeing=0.98, lens=own))
        photos = [replace(photo, camera=replace(photo.camera, params=others.get(k, photo.camera.params))) for k, photo in enumerate(made.photos)]
        return verdict_on(replace(made, photos=tuple(photos)), sharp(NAMES))

    zoomed = {3: lens(f=700.0), 7: lens(f=690.0), 9: lens(f=510.0)}
    found = with_lenses("zoomed", zoomed)
    assert [(problem.what, problem.grade, problem.images) for problem in found.problems] == [("zoom", "good", ("03.jpg", "07.jpg"))]
    assert found.figures["lens"] == "zoomed"
    found = with_lenses("cropped", {3: lens(x=350.0), 7: lens(y=200.0), 9: lens(x=325.0)})
    assert [(problem.what, problem.images) for problem in found.problems] == [("cropped", ("03.jpg", "07.jpg"))]
    assert with_lenses(None, zoomed).problems == ()  # of EXIF groups, which are told apart as they should be
    assert with_lenses("zoomed", {}).problems == ()


def test_photographs_in_which_something_moves_are_named() -> None:
    def moving(count: int, first: float = 0.02, agreeing: float = 0.97, **known: Any) -> Verdict:
        shares = {name: first + 0.01 * k for k, name in enumerate(NAMES[:count])}
        return verdict_on(capture(provenance=Provenance(pairs_agreeing=agreeing, moving_parts=shares, **known)), sharp(NAMES))

    found = moving(3)
    assert [(problem.what, problem.grade, problem.images) for problem in found.problems] == [("moving parts", "usable", tuple(NAMES[:3]))]
    assert "masks/" in found.problems[0].remedy
    assert [row.get("moving") for row in found.document()["images"].values()] == [0.02, 0.03, 0.04] + [None] * 21
    assert moving(2).grade == "good"
    assert moving(3, agreeing=0.9).grade == moving(3, first=0.1).grade == "usable"
    doubtful = moving(3, first=0.1, agreeing=0.9)
    assert [(problem.what, problem.grade) for problem in doubtful.problems] == [("moving parts", "poor"), ("disagreement", "usable")]
    assert "moving parts" not in [problem.what for problem in moving(24, background="stands still").problems]  # the subject turned


BARE = tuple((f"bare{k}.jpg", "only 3 features detected: blurred, dark or without texture") for k in range(4))


def test_cameras_that_only_turned_and_photographs_without_texture_are_named() -> None:
    def words(found: Verdict) -> list[str]:
        return [problem.what for problem in found.problems]

    flat = Provenance(planar_pairs=0.95)
    assert "one place" in words(failed("none.", "try.", 0, capture(0, rejected=LOST, provenance=flat), {}))
    assert "one place" in words(verdict_on(capture(radius=0.05, provenance=flat), sharp(NAMES)))
    assert words(verdict_on(capture(provenance=flat), sharp(NAMES))) == []  # a wall seen from all sides has depth all the same
    assert "one place" not in words(failed("none.", "try.", 0, capture(0, rejected=LOST, provenance=Provenance(planar_pairs=0.3)), {}))
    bare = failed("none.", "try.", 0, capture(0, rejected=BARE), {})
    assert "without texture" in words(bare)
    assert bare.problems[1].images == tuple(name for name, _ in BARE)
    assert "without texture" not in words(verdict_on(capture(rejected=BARE[:1]), sharp(NAMES)))


def test_problems_are_in_order_and_the_worst_is_the_grade() -> None:
    found = verdict_on(capture(rejected=LOST[:6], provenance=Provenance(pairs_agreeing=0.5)), sharp(NAMES, **{"05.jpg": {"sharpness": 0.1}}))
    places = [GRADES.index(problem.grade) for problem in found.problems]
    assert places == sorted(places, reverse=True)
    assert (found.grade, len(places)) == ("poor", 3)


# ---------------------------------------------------------------------------------------------------------- pictures


def test_pictures_show_cameras_in_blue_and_lost_ones_in_red_and_repeat(tmp_path: Path) -> None:
    made = capture()
    centres = np.array([photo.camera.centre for photo in made.photos])
    forward = np.tile([0.0, 0.0, -1.0], (24, 1))
    for name, lost in (("a", np.zeros((0, 3))), ("b", np.array([[0.0, 0.0, 10.0]])), ("c", np.array([[0.0, 0.0, 10.0]]))):
        pictures.camera_plot(centres, forward, made.points.xyz, lost, "title", tmp_path / f"{name}.png")
    a, b = (np.asarray(Image.open(tmp_path / f"{name}.png")).reshape(-1, 3) for name in "ab")
    for pixels, reds in ((a, False), (b, True)):
        assert (pixels == pictures.GOOD).all(1).sum() > 24 * 10
        assert bool((pixels == pictures.LOST).all(1).any()) == reds
    assert (tmp_path / "b.png").read_bytes() == (tmp_path / "c.png").read_bytes()
