"""Lengths and up by markers in made captures: how far off they are, and how often the truth is outside of the stated error.

    python -m benchmarks.markers --work FOLDER [--captures 114] [--width 3000] [--out benchmarks/results] [--cameras]

A sheet on a table, with markers whose edges are 1 to 3 % of the longest side of a picture: the board of `enerf board`, or four at places of their own. Pictures
are blurred and noisy JPEGs; sheets are bent, their dictionary is none that is tried, or markers move from photograph to photograph. The cameras are off, as
those of structure from motion are. Writes markers.json and .md; exit code 1 where lengths are off by more than 0.5 %, up by more than a degree.

With --cameras: what structure from motion finds on a table without any texture, with the markers as tie points and without, and how far off lengths are then;
markers_cameras.json. Exit code 1 where lengths are off by more than is stated.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image

from efficientnerf.geometry.cameras import Camera, closest_similarity, project
from efficientnerf.rendering.colour import srgb_from_linear
from pipeline.errors import BadInput
from pipeline.files import write_atomically
from pipeline.stage import Job
from stages.figures.board import DPI, draw_board
from stages.framing.markers import find_markers, with_markers
from stages.io.capture import Capture, Photo
from stages.poses.settings import PosesSettings
from stages.sfm.cameras import find_cameras
from stages.sfm.reconstruction import Request

ROOT = Path(__file__).resolve().parents[1]
KINDS = ("plain",) * 8 + ("blurred", "blurred", "noisy", "noisy", "bent", "bent", "one moves", "all move", "wrong dictionary", "few views") * 1
REFUSED = ("all move", "wrong dictionary")  # are to be
EDGE = 0.04  # metres
SHEET = 0.5  # metres, a side of the table top that the four markers lie on
TURN, SHIFT = 0.01, 5e-4  # of cameras: standard deviations in degrees, and of their distance
ALLOWED_LENGTH, ALLOWED_UP, ALLOWED_OUTSIDE = 0.005, 1.0, 0.05
FAR = 0.3  # of their distance from the table, how far cameras are from each other whose distance is compared
SAMPLES = 2  # along a side of a pixel


_SRGB = srgb_from_linear(np.linspace(0, 1, 4096, dtype=np.float32))


@dataclass(frozen=True, eq=False)
class Sheet:
    """light (H, W) float32 of texels of a side in metres, from its middle; bend: how high its middle is over its ends along x, metres"""

    light: np.ndarray
    texel: float
    bend: float = 0.0

    def seen(self, camera: Camera) -> np.ndarray:
        """(H, W) float32 linear light of a picture: the sheet before grey."""
        f, _, cx, cy = camera.params
        turn, half = camera.world_from_camera[:3, :3].astype(np.float32), np.array(self.light.shape[::-1]) * self.texel / 2
        corners, _ = project(camera, np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (0, self.bend)]) * [*half, 1])
        left, top = np.clip(corners.min(0).astype(int) - 9, 0, [camera.width, camera.height])
        right, bottom = np.clip(corners.max(0).astype(int) + 9, 0, [camera.width, camera.height])
        side = (np.arange(SAMPLES, dtype=np.float32) + 0.5) / SAMPLES
        rows, columns = ((np.arange(low, high, dtype=np.float32)[:, None] + side).ravel() for low, high in ((top, bottom), (left, right)))
        y, x = np.meshgrid(rows, columns, indexing="ij")
        ray = [turn[axis, 0] * (x - cx) / f + turn[axis, 1] * (y - cy) / f + turn[axis, 2] for axis in range(3)]
        height: Any = np.float32(0)
        for _ in range(3 if self.bend else 1):
            far = (height - camera.centre[2]) / ray[2]
            u, v = camera.centre[0] + far * ray[0], camera.centre[1] + far * ray[1]
            height = self.bend * (1 - np.clip(u / half[0], -1, 1) ** 2)
        u = u + 2 / 3 * self.bend**2 / half[0] * (u / half[0]) ** 3  # along the paper
        at = [(value / self.texel + side / 2 - 0.5).astype(np.float32) for value, side in ((u, self.light.shape[1]), (-v, self.light.shape[0]))]
        found = cv2.remap(self.light, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0.25)
        out = np.full((camera.height, camera.width), 0.25, np.float32)
        out[top:bottom, left:right] = cv2.resize(found, (right - left, bottom - top), interpolation=cv2.INTER_AREA)
        return out


def board(texel: float, bend: float) -> Sheet:
    drawn = np.asarray(draw_board("a4", 1000 * EDGE).convert("L"), np.float32) / 255 * 0.6 + 0.03
    side = 0.0254 / DPI
    size = [round(number * side / texel) for number in drawn.shape[::-1]]
    return Sheet(cv2.resize(drawn, size, interpolation=cv2.INTER_AREA), drawn.shape[1] * side / size[0], bend)


def four(texel: float, places: np.ndarray, turns: np.ndarray, dictionary: str) -> Sheet:
    """Four markers, their middles at places (4, 2) metres."""
    side = round(SHEET / texel)
    light = np.full((side, side), 0.3, np.float32)
    known = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{dictionary}"))
    for number, (place, turn) in enumerate(zip(places, turns, strict=True)):
        tag = np.pad(np.asarray(cv2.aruco.generateImageMarker(known, number, 400), np.float32) / 255, 60, constant_values=1.0) * 0.6 + 0.03
        cos, sin = EDGE / 400 / texel * np.array([np.cos(turn), np.sin(turn)])
        middle = place * [1, -1] / texel + side / 2 - 0.5
        matrix = np.array([[cos, -sin, 0], [sin, cos, 0]])
        matrix[:, 2] = middle - matrix[:, :2] @ [259.5, 259.5]
        blurred = cv2.GaussianBlur(tag, (0, 0), 0.3 / np.hypot(cos, sin))
        cv2.warpAffine(blurred, matrix, (side, side), light, cv2.INTER_LINEAR, cv2.BORDER_TRANSPARENT)
    return Sheet(light, SHEET / side)


def cameras(rng: np.random.Generator, count: int, width: int, share: float) -> list[Camera]:
    height, f = round(width * 2 / 3), width * rng.uniform(0.8, 1.3)
    found = []
    for angle in np.linspace(0, np.radians(rng.uniform(80, 300)), count) + rng.uniform(0, 6):
        distance, tilt = f * EDGE / (share * width) * rng.uniform(0.85, 1.15), np.radians(rng.uniform(35, 65))
        centre = distance * np.array([np.cos(tilt) * np.cos(angle), np.cos(tilt) * np.sin(angle), np.sin(tilt)])
        forward = -centre / distance
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3] = np.stack([right, np.cross(forward, right), forward, centre], 1)
        found.append(Camera(f"{len(found):02d}.jpg", width, height, "PINHOLE", (f, f, width / 2, height / 2), pose))
    return found


def inexact(camera: Camera, rng: np.random.Generator) -> Camera:
    turn, _ = cv2.Rodrigues(np.radians(rng.normal(0, TURN, 3)))
    pose = camera.world_from_camera.copy()
    pose[:3, :3] = turn @ pose[:3, :3]
    pose[:3, 3] += rng.normal(0, SHIFT * np.linalg.norm(camera.centre), 3)
    return Camera(camera.name, camera.width, camera.height, camera.model, camera.params, pose)


def found(number: int, work: Path, width: int) -> dict[str, Any]:
    """Of a made capture of a bare table: photographs with a camera, root mean square error of their places as a share of their distance, and error of the focal
    length, with markers as tie points and without; and error of lengths between the cameras by the markers, at most and as stated."""
    rng, on_board = np.random.default_rng(number), number % 4 != 1
    share = 0.05 if number % 4 == 0 else 0.02
    views, texel = cameras(rng, 10, width, share), EDGE / (share * width) / SAMPLES
    places = np.array([[-0.13, -0.11], [0.12, -0.13], [-0.11, 0.12], [0.13, 0.1]]) + rng.uniform(-0.03, 0.03, (4, 2))
    sheet = board(texel, 0.0) if on_board else four(texel, places, rng.uniform(0, 6, 4), "APRILTAG_36h11")
    work.mkdir(parents=True, exist_ok=True)
    for view in views:
        light = cv2.GaussianBlur(sheet.seen(view), (0, 0), 0.8)
        grey = 255 * _SRGB[np.rint(4095 * np.clip(light, 0, 1)).astype(np.int16)] + 3 * rng.standard_normal(light.shape, np.float32)
        Image.fromarray(np.clip(np.rint(grey), 0, 255).astype(np.uint8)).convert("RGB").save(work / view.name, quality=92)
    job = Job(settings=PosesSettings(marker_size=EDGE), out=work / "out", work=work / "scratch", source=work)
    markers = find_markers(job, {view.name: (work / view.name, (view.width, view.height)) for view in views})
    facts: dict[str, Any] = {"board": on_board, "share": share, "markers": max(map(len, markers.values()))}
    quiet: dict[str, Any] = {"progress": lambda *a, **k: None, "safe_point": lambda: None, "warn": lambda *a, **k: None}
    for name, tied in (("tied", markers), ("without", {})):
        try:
            capture = find_cameras(Request(work, {view.name: work / view.name for view in views}, work / name, markers=tied), **quiet)
        except BadInput as error:
            facts[name] = {"refused": str(error).removeprefix(f"{work}: ")[:60]}
            continue
        true = {view.name: view.centre for view in views}
        centres, at = np.array([photo.camera.centre for photo in capture.photos]), np.array([true[photo.camera.name] for photo in capture.photos])
        away = np.linalg.norm(closest_similarity(centres, at).points(centres) - at, axis=1) / np.linalg.norm(at, axis=1)
        focal = float(np.median([photo.camera.intrinsics["fx"] for photo in capture.photos]) / views[0].params[0] - 1)
        facts[name] = {"cameras": len(centres), "centre": float(np.sqrt((away**2).mean())), "focal": focal}
        if tied:
            facts["lengths"] = _between_cameras(replace(capture, markers=markers), job, at)
    return facts


def _in_metres(capture: Capture, job: Job) -> Capture | str:
    """The capture in metres by its markers; or why not."""
    warnings: list[str] = []
    try:
        found = with_markers(job, capture, EDGE, warnings.append)
    except BadInput as error:
        return str(error).removeprefix(f"{job.source}: ")[:100]
    return found if found.metric else warnings[-1][:100]


def _between_cameras(capture: Capture, job: Job, true: np.ndarray) -> dict[str, Any]:
    """Of the lengths between cameras at true places (C, 3) that are far from each other."""
    found = _in_metres(capture, job)
    if isinstance(found, str):
        return {"refused": found}
    facts: Any = found.facts["markers"]
    lengths, expected = (np.linalg.norm(each[:, None] - each, axis=2) for each in (np.array([photo.camera.centre for photo in found.photos]), true))
    far = expected > FAR * np.linalg.norm(true, axis=1).mean()
    return {"worst": float(np.abs(lengths[far] / expected[far] - 1).max()), "stated": facts["error"]}


def measured(number: int, work: Path, width: int) -> dict[str, Any]:
    """A made capture, and what its markers give."""
    rng, kind = np.random.default_rng(number), KINDS[number % len(KINDS)]
    share = rng.uniform(0.01, 0.03)
    views = cameras(rng, 4 if kind == "few views" else int(rng.integers(6, 13)), width, share)
    texel = EDGE / (share * width) / SAMPLES
    on_board = kind == "bent" or (kind in ("plain", "blurred", "noisy", "few views") and number % 2 == 0)
    places = np.array([[-0.13, -0.11], [0.12, -0.13], [-0.11, 0.12], [0.13, 0.1]]) + rng.uniform(-0.03, 0.03, (4, 2))
    turns, moving = rng.uniform(0, 6, 4), {"one moves": (1,), "all move": (0, 1, 2, 3)}.get(kind, ())
    blur, noise = rng.uniform(1.5, 2.5) if kind == "blurred" else rng.uniform(0.5, 1.0), rng.uniform(8, 14) if kind == "noisy" else rng.uniform(1, 4)
    facts = {"kind": kind, "share": share, "views": len(views), "board": on_board, "blur": blur, "noise": noise, "bend": 0.0}
    if kind == "bent":
        facts["bend"] = rng.uniform(0.01, 0.04) * 0.21
    work.mkdir(parents=True, exist_ok=True)
    photos, field = [], noise * rng.standard_normal((views[0].height, width), np.float32)
    for view in views:
        shifted = places + np.array([rng.uniform(0.01, 0.04, 2) if n in moving else (0, 0) for n in range(4)])
        sheet = board(texel, facts["bend"]) if on_board else four(texel, shifted, turns, "APRILTAG_16h5" if kind == "wrong dictionary" else "APRILTAG_36h11")
        light = cv2.GaussianBlur(sheet.seen(view), (0, 0), blur)
        grey = 255 * _SRGB[np.rint(4095 * np.clip(light, 0, 1)).astype(np.int16)] + np.roll(field, rng.integers(0, 1000, 2), (0, 1))
        Image.fromarray(np.clip(np.rint(grey), 0, 255).astype(np.uint8)).convert("RGB").save(work / view.name, quality=92)
        photos.append(Photo(inexact(view, rng), work / view.name))
    return facts | outcome(Capture("photographs", tuple(photos), None, bounds=np.array([[-1.0] * 3, [1.0] * 3])), work)


def outcome(capture: Capture, work: Path) -> dict[str, Any]:
    """How far off the lengths and up are, and by how much at most they are said to be; or why not."""
    found = _in_metres(capture, Job(settings=PosesSettings(marker_size=EDGE), out=work / "out", work=work / "scratch", source=work))
    if isinstance(found, str):
        return {"refused": found}
    facts: Any = found.facts["markers"]
    before, after = (np.array([photo.camera.centre for photo in each.photos]) for each in (capture, found))
    length = np.linalg.norm(after[-1] - after[0]) / np.linalg.norm(before[-1] - before[0]) - 1
    up = None if facts["normal"] is None else float(np.degrees(np.arccos(min(1.0, facts["normal"][2]))))
    stated = {"length_stated": facts["error"], "up_stated": facts["normal_error"]}
    return {"markers": len(facts["used"]), "moved": facts["moved"], "length": float(length), "up": up} | stated


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Of each kind, and of all."""
    out = {}
    for kind in (*dict.fromkeys(row["kind"] for row in rows), "all"):
        mine = [row for row in rows if kind in ("all", row["kind"])]
        used = [row for row in mine if "length" in row]
        lengths, stated, ups = (np.array([row[name] for row in used if row[name] is not None]) for name in ("length", "length_stated", "up"))
        tilts = np.array([row["up_stated"] for row in used if row["up"] is not None])
        out[kind] = {"captures": len(mine), "refused": len(mine) - len(used)} | ({} if not used else {
            "length_median": float(np.median(np.abs(lengths))), "length_worst": float(np.abs(lengths).max()), "stated_median": float(np.median(stated)),
            "length_outside": int((np.abs(lengths) > stated).sum()), "without_up": len(used) - len(ups), "up_outside": int((ups > tilts).sum()),
            "up_median": float(np.median(ups)) if len(ups) else None, "up_worst": float(ups.max()) if len(ups) else None})  # fmt: skip
    return out


def in_markdown(table: dict[str, dict[str, Any]]) -> str:
    heads = ("kind", "captures", "refused", "length off by %, median", "at most", "stated, median", "outside of it", "up off by degrees, median", "at most",
             "outside", "no up")  # fmt: skip
    lines = ["# Lengths and up by markers in made captures", "", "`python -m benchmarks.markers`. Stated errors are those of 99 %.", ""]
    lines += ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    for kind, row in table.items():
        parts = [kind, row["captures"], row["refused"]]
        if "length_median" in row:
            parts += [f"{100 * row[name]:.3f}" for name in ("length_median", "length_worst", "stated_median")] + [row["length_outside"]]
            parts += ["", ""] if row["up_median"] is None else [f"{row['up_median']:.3f}", f"{row['up_worst']:.3f}"]
            parts += [row["up_outside"], row["without_up"]]
        else:
            parts += [""] * 8
        lines.append("| " + " | ".join(map(str, parts)) + " |")
    return "\n".join([*lines, ""])


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--captures", type=int, default=114)
    parser.add_argument("--width", type=int, default=3000)
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results")
    parser.add_argument("--cameras", action="store_true")
    given = parser.parse_args(arguments)
    if given.cameras:
        rows = [found(number, given.work / f"cameras_{number}", given.width) for number in range(given.captures)]
        write_atomically(given.out / "markers_cameras.json", (json.dumps(rows, indent=1) + "\n").encode())
        stated = [row["lengths"] for row in rows if "stated" in row.get("lengths", {})]
        return int(any(each["worst"] > each["stated"] for each in stated))
    rows = []
    for number in range(given.captures):
        rows.append(measured(number, given.work / "capture", given.width))
        print(number, rows[-1], flush=True)
    table = summary(rows)
    write_atomically(given.out / "markers.json", (json.dumps({"width": given.width, "kinds": table, "captures": rows}, indent=1) + "\n").encode())
    write_atomically(given.out / "markers.md", in_markdown(table).encode())
    everything, wrong = table["all"], [row for row in rows if ("length" in row) != (row["kind"] not in REFUSED)]
    exact = everything["length_worst"] <= ALLOWED_LENGTH and everything["up_worst"] <= ALLOWED_UP
    return 0 if exact and everything["length_outside"] < ALLOWED_OUTSIDE * len(rows) and not wrong else 1


if __name__ == "__main__":
    sys.exit(main())
