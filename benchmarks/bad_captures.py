"""Bad captures made from a good one: each must end in cameras that are right, or in the right diagnosis.

    python -m benchmarks.bad_captures --work FOLDER [--only blur,tiny] [--photographs 36] [--out benchmarks/results]

The first photographs of examples/still_life, which go round in order and whose true cameras are known, are spoiled in a known way; `enerf check` forecasts,
`enerf run --until poses` finds cameras, both as a user would. A row is right where the centres are within MOST_ERROR of the truth, or where the verdict or the
error names one of the problems that the capture has. Writes bad_captures.json and .md.
"""

import argparse
import json
import shutil
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from benchmarks.machine import hardware
from benchmarks.poses import STILL_LIFE, TRUTH, found_centres, percent_off, true_centres
from benchmarks.project import ENERF, RESULTS, ROOT, last_object
from benchmarks.scenes import room
from pipeline.files import write_json
from stages.io.pictures import opened, rgb_and_alpha

MOST_ERROR = 1.0  # % of the mean distance of the cameras from their middle, root mean square
ENOUGH = 0.75  # share of the photographs that can be placed, from which a capture without a diagnosis counts
Pictures = dict[str, np.ndarray]  # by name; BGR


@dataclass(frozen=True)
class Capture:
    """A way to spoil a capture.

    make       the spoiled pictures, of the good ones
    diagnoses  words of which the right diagnosis has one
    placeable  pictures whose cameras can be found; all by default
    names      name of the good photograph that each picture shows, where it is another
    quality     of the JPEGs
    """

    name: str
    make: Callable[[Pictures], Pictures]
    diagnoses: tuple[str, ...]
    placeable: Callable[[list[str]], list[str]] = list
    names: Callable[[str], str] = str
    quality: int = 92


def each(change: Callable[[np.ndarray, int], np.ndarray], *, every: int = 1) -> Callable[[Pictures], Pictures]:
    """The same change to every n-th picture."""
    return lambda good: {name: change(picture, n) if n % every == 0 else picture for n, (name, picture) in enumerate(good.items())}


def motion_blur(picture: np.ndarray, n: int) -> np.ndarray:
    length, angle = 13, 40.0 * n
    kernel = np.zeros((length, length), np.float32)
    kernel[length // 2] = 1 / length
    turned = cv2.warpAffine(kernel, cv2.getRotationMatrix2D((length // 2, length // 2), angle, 1), (length, length))
    return cv2.filter2D(picture, -1, turned / turned.sum())


def brighter(factor: float) -> Callable[[np.ndarray, int], np.ndarray]:
    """In linear light."""
    return lambda picture, n: np.clip(255 * ((picture / 255.0) ** 2.2 * factor) ** (1 / 2.2), 0, 255).astype(np.uint8)


def noisy(deviation: float) -> Callable[[np.ndarray, int], np.ndarray]:
    return lambda picture, n: np.clip(picture + np.random.default_rng(n).normal(0, deviation, picture.shape), 0, 255).astype(np.uint8)


def zoomed(picture: np.ndarray, n: int) -> np.ndarray:
    h, w = picture.shape[:2]
    share = (1.0, 0.8, 0.65)[n % 3]
    dy, dx = round(h * (1 - share) / 2), round(w * (1 - share) / 2)
    return cv2.resize(picture[dy : h - dy, dx : w - dx], (w, h), interpolation=cv2.INTER_CUBIC)


def cropped(picture: np.ndarray, n: int) -> np.ndarray:
    """Somewhere, so that the principal point is nowhere near the middle."""
    h, w = picture.shape[:2]
    y, x = (int(k) for k in np.random.default_rng(n).integers(0, (h // 4, w // 4)))
    return picture[y : y + 3 * h // 4, x : x + 3 * w // 4]


def shrunk(picture: np.ndarray, n: int) -> np.ndarray:
    return cv2.resize(picture, (96, 72), interpolation=cv2.INTER_AREA)


def labelled(picture: np.ndarray, n: int) -> np.ndarray:
    """A date and a frame that stay put, as cheap cameras burn in."""
    out = picture.copy()
    cv2.rectangle(out, (4, 4), (out.shape[1] - 5, out.shape[0] - 5), (255, 255, 255), 2)
    cv2.putText(out, "2026-11-23 12:00 CAM 01 REC", (20, 340), cv2.FONT_HERSHEY_SIMPLEX, 0.8, (255, 255, 255), 2)
    return out


def moving(picture: np.ndarray, n: int) -> np.ndarray:
    """Before it a balloon with a pattern, which is elsewhere and leans another way each time."""
    rng, (h, w) = np.random.default_rng(5), picture.shape[:2]
    octaves = [40 * 0.9**k * cv2.resize(rng.normal(0, 1, (2**k, 2**k, 3)), (256, 256), interpolation=cv2.INTER_CUBIC) for k in range(2, 7)]
    y, x = np.mgrid[:256, :256]
    balloon = np.dstack([np.clip(np.sum(octaves, axis=0) + np.array((200, 120, 90)), 0, 255), 255.0 * (np.hypot(x - 128, y - 128) < 126)]).astype(np.float32)
    angle, scale = 0.12 * np.sin(1.3 * n), 1 + 0.1 * np.sin(2.1 * n)
    lean = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) @ np.diag([0.12 * w, 0.18 * h]) / 256
    place = (0.15 + 0.7 * (n * 0.381966 % 1)) * w, (0.35 + 0.3 * (n * 0.618034 % 1)) * h
    there = cv2.warpAffine(balloon, np.column_stack([lean, place - lean @ (128, 128)]), (w, h), flags=cv2.INTER_AREA)
    opacity = there[..., 3:] / 255
    return np.clip(picture * (1 - opacity) + there[..., :3] * opacity + 0.5, 0, 255).astype(np.uint8)


def mixed(good: Pictures) -> Pictures:
    """Half of the scene, and half of another that would do by itself: a room with patterned walls."""
    names = list(good)
    others = iter(room.cameras(len(names) // 2, 480, 360, "SIMPLE_PINHOLE", (400.0, 240.0, 180.0)))
    return {name: room.picture(next(others))[..., ::-1] if n % 2 else good[name] for n, name in enumerate(names)}


def turned_only(good: Pictures) -> Pictures:
    """What a camera sees that turns on the spot, within one picture enlarged."""
    wide = cv2.resize(next(iter(good.values())), None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
    focal, out = 800.0, {}
    inside = np.array([[focal, 0, wide.shape[1] / 2], [0, focal, wide.shape[0] / 2], [0, 0, 1]])
    seen = np.array([[focal, 0, 240], [0, focal, 180], [0, 0, 1]])
    for n in range(24):
        turn = cv2.Rodrigues(np.array([0.08 * np.sin(n), 0.16 * np.cos(n / 2), 0.02 * n]))[0]
        out[f"turn_{n:02d}.jpg"] = cv2.warpPerspective(wide, seen @ turn @ np.linalg.inv(inside), (480, 360))
    return out


def white_wall(good: Pictures) -> Pictures:
    return {name: np.clip(np.random.default_rng(n).normal(228, 1.5, (360, 480, 3)), 0, 255).astype(np.uint8) for n, name in enumerate(good)}


def before_a_wall(good: Pictures) -> Pictures:
    """The scene's middle, which turns, before a wall that stands still."""
    wall = cv2.resize(np.random.default_rng(3).integers(30, 220, (72, 96, 3)).astype(np.uint8), (480, 360), interpolation=cv2.INTER_CUBIC)
    y, x = np.mgrid[:360, :480]
    inside = np.clip(1.5 - np.hypot((x - 240) / 150, (y - 190) / 130), 0, 0.1)[..., None] * 10
    return {name: np.round(picture * inside + wall * (1 - inside)).astype(np.uint8) for name, picture in good.items()}


def shuffled(good: Pictures) -> Pictures:
    order = np.random.default_rng(0).permutation(len(good))
    names = list(good)
    return {f"{k:03d}_{names[n]}": good[names[n]] for k, n in enumerate(order)}


def upright_or_not(picture: np.ndarray, n: int) -> np.ndarray:
    return np.rot90(picture, n % 4)


def few(good: Pictures) -> Pictures:
    return dict(list(good.items())[:: len(good) // 4])


APART = ("components", "groups", "not registered", "sub-models", "no camera", "folded")
CAPTURES = (
    Capture("as it is", dict, ()),
    Capture("blur", each(lambda p, n: cv2.GaussianBlur(p, (0, 0), 4)), ("blurred", "blurry")),
    Capture("motion blur of every second", each(motion_blur, every=2), ("blurred", "blurry")),
    Capture("noise", each(noisy(45)), ("noise", "not registered", "few points", "reprojection error")),
    Capture("dark", each(brighter(0.01)), ("dark", "clipped", "black")),
    Capture("overexposed", each(brighter(14)), ("clipped", "white")),
    Capture("exposure steps", each(brighter(0.25), every=2), ("exposure", "brighter or darker")),
    Capture("two scenes mixed", mixed, APART, placeable=lambda names: names[::2]),
    Capture("one image many times", lambda good: dict.fromkeys(good, next(iter(good.values()))), ("duplicates", "same as another", "one place", "parallax")),
    Capture("zoom changes", each(zoomed), ("zoom", "focal", "reprojection error")),
    Capture("cropped", each(cropped), ("cropped", "focal", "sizes", "reprojection error", "not registered")),
    Capture("tiny", each(shrunk), ("small", "smaller", "few points", "not registered")),
    Capture("four photographs", few, ("few", "overlap")),
    Capture("turned on the spot", turned_only, ("parallax", "one place")),
    Capture("white wall", white_wall, ("texture", "features", "overlap")),
    Capture("a wall that stands still", before_a_wall, ("stands still", "static", "turntable")),
    Capture("every second mirrored", each(lambda p, n: cv2.flip(p, 1), every=2), APART),
    Capture("shuffled video", shuffled, (), names=lambda name: name[4:]),
    Capture("turned by quarters", each(upright_or_not), ("orientation", "not registered", "sizes")),
    Capture("hard compression", dict, ("compress", "few points", "not registered", "reprojection error"), quality=6),
    Capture("a label burnt in", each(labelled), ("stands still", "static", "folded", "parallax")),
    Capture("something moves", each(moving), ("moves between",)),
    Capture("torn files", dict, ("cannot be used",), placeable=lambda names: names[6:]),
)


def write(capture: Capture, count: int, folder: Path) -> list[str]:
    """The pictures of a capture made of so many good ones, as JPEGs; returns their names."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    good = {}
    for path in sorted(STILL_LIFE.glob("*.jpg"))[:count]:
        with opened(path) as image:
            good[path.name] = np.ascontiguousarray(rgb_and_alpha(image)[0][..., ::-1])
    made = capture.make(good)
    for n, (name, picture) in enumerate(made.items()):
        cv2.imwrite(str(folder / name), picture, [cv2.IMWRITE_JPEG_QUALITY, capture.quality])
        if capture.name == "torn files" and n < 6:
            whole = (folder / name).read_bytes()
            (folder / name).write_bytes([whole[: len(whole) // 3], b"", b"not a picture"][n % 3])
    return sorted(made)


@dataclass
class Row:
    capture: str
    photographs: int
    forecast: str = ""
    forecast_problems: list[str] = field(default_factory=list)
    forecast_seconds: float | None = None
    exit_code: int = 0
    grade: str = ""
    registered: int = 0
    centre_rms_percent: float | None = None
    problems: list[str] = field(default_factory=list)
    seconds: float = 0.0
    right: bool = False


def measured(capture: Capture, count: int, work: Path) -> Row:
    folder, run = work / "captures" / capture.name.replace(" ", "-"), work / "runs" / capture.name.replace(" ", "-")
    names = write(capture, count, folder)
    shutil.rmtree(run, ignore_errors=True)
    row = Row(capture.name, len(names))
    checked = subprocess.run([*ENERF, "check", str(folder), "--json"], capture_output=True, text=True, check=False, cwd=ROOT)
    forecast = last_object(checked.stdout)
    row.forecast = str(forecast.get("grade") or forecast.get("message") or checked.returncode)
    row.forecast_problems = [problem["what"] for problem in forecast.get("problems", [])]
    row.forecast_seconds = forecast.get("forecast", {}).get("poses_seconds")
    started = time.monotonic()
    done = subprocess.run([*ENERF, "run", str(folder), "--out", str(run), "--until", "poses"], capture_output=True, text=True, check=False, cwd=ROOT)
    row.seconds, row.exit_code = round(time.monotonic() - started, 1), done.returncode
    verdicts = [run / "poses" / "verdict.json", *sorted((run / ".work").rglob("verdict.json"))]
    diagnosis = ""
    for verdict in [path for path in verdicts if path.exists()][:1]:
        found = json.loads(verdict.read_text())
        row.grade, row.registered, row.problems = found["grade"], found["registered"] or 0, [problem["what"] for problem in found["problems"]]
        diagnosis = " ".join(f"{problem['what']} {problem['sentence']}" for problem in found["problems"]).lower()
        if done.returncode == 0:
            row.centre_rms_percent = percent_off({capture.names(name): at for name, at in found_centres(run).items()}, true_centres(TRUTH))
    placeable = len(capture.placeable(names))
    placed = row.centre_rms_percent is not None and row.centre_rms_percent <= MOST_ERROR and row.registered >= ENOUGH * placeable
    row.right = "Traceback" not in done.stdout + done.stderr and (placed or any(word in diagnosis for word in capture.diagnoses))
    return row


def in_markdown(rows: list[Row]) -> str:
    columns = (
        "capture", "photographs", "`check` forecasts", "problems that it sees", "grade of the run", "registered", "centres, %", "problems that it names",
        "exit code", "seconds forecast", "seconds", "right",
    )  # fmt: skip
    lines = ["# Bad captures", "", "`python -m benchmarks.bad_captures`; what `enerf check` forecasts, and what `enerf run --until poses` then did.", ""]
    lines += ["| " + " | ".join(columns) + " |", "|---" * len(columns) + "|"]
    for row in rows:
        error = "" if row.centre_rms_percent is None else f"{row.centre_rms_percent:.2f}"
        forecast = "" if row.forecast_seconds is None else f"{row.forecast_seconds:.0f}"
        parts = [row.capture, row.photographs, row.forecast, ", ".join(row.forecast_problems), row.grade, row.registered, error]
        parts += [", ".join(row.problems), row.exit_code, forecast, f"{row.seconds:.0f}"]
        lines.append("| " + " | ".join(map(str, [*parts, "yes" if row.right else "**no**"])) + " |")
    right = sum(row.right for row in rows)
    lines += ["", f"{right} of {len(rows)} end in cameras within {MOST_ERROR:g} % of the truth or in the right diagnosis.", ""]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--only", default="", help="names, with commas between; rows of others stay in the table")
    parser.add_argument("--photographs", type=int, default=36)
    parser.add_argument("--out", type=Path, default=RESULTS)
    given = parser.parse_args()
    wanted = {name.strip() for name in given.only.split(",") if name.strip()}
    given.out.mkdir(parents=True, exist_ok=True)
    table = given.out / "bad_captures.json"
    rows = {row["capture"]: Row(**row) for row in json.loads(table.read_text())["rows"]} if wanted and table.exists() else {}
    for capture in CAPTURES:
        if wanted and capture.name not in wanted:
            continue
        row = rows[capture.name] = measured(capture, given.photographs, given.work.resolve())
        print(f"{row.capture}: {row.grade or row.exit_code}, {'right' if row.right else 'WRONG'}", flush=True)
        ordered = [rows[each.name] for each in CAPTURES if each.name in rows]
        write_json(table, {"machine": hardware("cpu"), "photographs": given.photographs, "rows": [vars(row) for row in ordered]})
        table.with_suffix(".md").write_text(in_markdown(ordered), encoding="utf-8")


if __name__ == "__main__":
    main()
