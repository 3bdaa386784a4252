"""Lengths between places of a run, its unit by lengths that are known, and its up by places on the ground.

A place is `X,Y,Z` in the frame of the run's exports, as the viewer copies it, or a pixel in two or more photographs, `PHOTO:x,y+PHOTO:x,y`: x and y are pixels
of the photograph at full size and upright, from its upper left corner. All is computed in the capture's frame, and scaled at the end.
"""

import itertools
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial import cKDTree

from efficientnerf.capture.adjustment import shape_spread
from efficientnerf.capture.markers import CONFIDENCE, common_ratio
from efficientnerf.capture.supports import level_plane
from efficientnerf.capture.triangulation import Place, length_between, triangulated
from efficientnerf.geometry.cameras import Camera, Similarity
from pipeline.errors import BadInput, UsageError
from pipeline.text import printable
from stages.artifacts import BakeOutputs, MeshOutputs, PosesOutputs, TurntableOutputs
from stages.formats.exporters.glb import gltf_from_capture
from stages.formats.exporters.writing import SourceFrame
from stages.framing.markers import at_full_size
from stages.framing.true_frame import AS_CAPTURED, Ground, KnownLength, TrueFrame, load_frame
from stages.framing.upward import THE_CAMERAS
from stages.io import scene
from stages.mesh.files import read_vertices
from stages.poses.settings import PosesSettings
from stages.reports import poses_report
from workflows.cli.resolve import nearest
from workflows.cli.target import is_run, open_run
from workflows.loading import describe_asset

LARGEST_ERROR = 0.03  # of a length: what is less sure is no unit, as of markers
LARGEST_TILT = 5.0  # degrees, of up: what is less sure is none
LEVEL, FOUND_WITHIN = 5.0, 30.0  # degrees from level of a floor or table: by an up that is given; by the one that the run has
UPRIGHT = 3.0  # degrees between two that are the same to the eye
FEW_POINTS = 30  # near the surface, from which they say how noisy it is
LOWEST = 0.005  # quantile of the mesh's heights that it stands on where there is no floor or table
FLATTEST = 0.05  # of its longest side, how high the triangle of three places on the ground is at least
LARGEST_MISS = 0.01  # of a picture's longest side: beyond it the pixels are not of one point
LARGEST_PLACE = 1e12
SHOWN = 200  # characters of a place in a message
NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_POINT = re.compile(rf"\s*({NUMBER})\s*,\s*({NUMBER})\s*,\s*({NUMBER})\s*")
_PIXEL = re.compile(rf"(.+?):({NUMBER}),({NUMBER})(?:\+|$)")
_EXPECTED = "expected X,Y,Z, or pixels of two photographs or more: a.jpg:120,340+b.jpg:98,310"


@dataclass(frozen=True, eq=False)
class Measured:
    """What can be measured in."""

    cameras: Mapping[str, Camera]
    true: TrueFrame  # the frame in which places are given: that of exports
    metric: bool
    error: float | None  # of the scale, as a share (99 %); None: not known
    own_up: np.ndarray  # (3,) unit, in the capture's frame, as the run found it
    shape: float  # how sure lengths are by the cameras, whatever their scale: their standard deviation, as a share
    grain: float  # the standard deviation of a place X,Y,Z that someone picked, in the capture's unit: half a voxel

    @property
    def frame(self) -> Similarity:
        return self.true.from_capture

    @property
    def up(self) -> np.ndarray:
        """(3,) unit, in the capture's frame, as it was set since."""
        return self.own_up if self.true.ground is None else np.array(self.true.ground.up)

    @property
    def unit(self) -> str:
        return "metre" if self.metric else "unknown"

    @property
    def centres(self) -> np.ndarray:
        """(C, 3) of the cameras, in the capture's frame."""
        return np.array([camera.centre for camera in self.cameras.values()])

    def place(self, text: str) -> Place:
        """The place in the capture's frame. Raises UsageError and BadInput."""
        shown = printable(text, SHOWN)
        point = _POINT.fullmatch(text)
        if point is not None:
            numbers = np.array([float(each) for each in point.groups()])
            if not (np.abs(numbers) < LARGEST_PLACE).all():
                raise UsageError(f"{shown}: too far away to be measured.")
            return Place(self.frame.inverse().points(numbers), self.grain**2 * np.eye(3))
        matches = [*_PIXEL.finditer(text)]
        if not matches or matches[-1].end() != len(text):
            raise UsageError(f"{shown}: no place; {_EXPECTED}.")
        names = [self._name(match[1]) for match in matches]
        if len(set(names)) < 2:
            raise UsageError(f"{shown}: one photograph; a place needs its pixel in two or more.")
        cameras = [self.cameras[name] for name in names]
        places = np.array([[float(match[2]), float(match[3])] for match in matches])
        for camera, (x, y) in zip(cameras, places, strict=True):
            if not (0 <= x <= camera.width and 0 <= y <= camera.height):
                raise UsageError(f"{shown}: {x:g},{y:g} lies outside of {printable(camera.name, SHOWN)}, which has {camera.width} x {camera.height} pixels.")
        try:
            found = triangulated(cameras, places)
        except ValueError as error:
            raise BadInput(f"{shown}: no place: {error}. Pick it in photographs from different sides.") from error
        if found.miss > LARGEST_MISS * max(max(camera.width, camera.height) for camera in cameras):
            raise BadInput(f"{shown}: the pixels are not of one point: their rays miss it by {found.miss:.0f} pixels. Pick the same point in each photograph.")
        return found

    def _name(self, given: str) -> str:
        """The photograph of this name, or the only one whose name ends in it."""
        ending = [name for name in self.cameras if name == given] or [name for name in self.cameras if name.rpartition("/")[2] == given]
        if len(ending) == 1:
            return ending[0]
        if ending:
            raise UsageError(f"{printable(given, SHOWN)}: {len(ending)} photographs have this name. Give its folder, too: {printable(ending[0], SHOWN)}")
        raise UsageError(f"{printable(given, SHOWN)}: the run has no such photograph.{printable(nearest(given, self.cameras), SHOWN)}")

    def length(self, a: Place, b: Place) -> tuple[float, float]:
        """The length between two places in the frame of exports, and its error (99 %)."""
        length, spread = length_between(a, b)
        return self.frame.scale * length, self.frame.scale * float(np.hypot(CONFIDENCE * np.hypot(spread, self.shape * length), (self.error or 0.0) * length))


def measured(run: Path, *, captured: bool = False) -> Measured:
    """What a run can be measured in; `captured`: in the capture's frame, whatever was found since. Raises BadInput and CorruptArtifact."""
    if not is_run(run):
        raise BadInput(f"{run}: not a run. Give the folder of a run.")
    poses, asset = PosesOutputs(open_run(run).folder("poses")), BakeOutputs.of_run(run).asset
    if not poses.scene.is_file():
        raise BadInput(f"{run}: has no cameras yet. Make them first: enerf run --out {run} --until poses")
    found, true = scene.load(poses.folder), (None if captured else load_frame(run)) or AS_CAPTURED
    grain = float(describe_asset(asset)["voxel_side"]) / 2 / found.world_from_capture.scale if asset.is_file() else 0.0  # type: ignore[arg-type]
    cameras = {view.name: view.source_camera for view in found.views}
    report, up = poses_report(poses.folder), SourceFrame(found.world_from_capture).up
    given = open_run(run).settings.get("poses", {})
    shape = _shape_spread(poses.folder, found, report.reprojection_error, given.get("feature_image_size", PosesSettings().feature_image_size))
    metric, error = (True, true.error) if true.error is not None else (found.metric, report.facts.markers.error if found.metric else None)
    return Measured(cameras, true, metric, error, up, shape, grain)


def _shape_spread(poses: Path, found: scene.Scene, reprojection_error: float | None, feature_size: int) -> float:
    """By the covariance of bundle adjustment, of the sparse points in the scene's bounds; 0 where nothing is known of it."""
    if not found.points or not reprojection_error:
        return 0.0
    (world, counts, observers), cameras = scene.read_observations(poses), [view.source_camera for view in found.views]
    inside = ((world >= found.bounds[0]) & (world <= found.bounds[1])).all(axis=1)
    miss = at_full_size(reprojection_error, found.kind, cameras, feature_size)
    spread = shape_spread(cameras, found.world_from_capture.inverse().points(world), counts, observers, miss, inside)
    return 0.0 if np.isnan(spread) else min(1.0, spread)


def sides_of(run: Path, inside: Measured) -> dict[str, Any] | None:
    """The upright box of least area round the run's mesh: its longer side, its shorter one and its height, and their errors, of which all is in the units of
    exports: how far sparse points are from the surface, or half a voxel, and how sure the cameras are; and a photograph's pixel on it. None without a mesh.
    """
    outputs = MeshOutputs.of_run(run)
    vertices, normals = read_vertices(outputs) if outputs.ply.is_file() else (np.zeros((0, 3)),) * 2
    if not len(vertices):
        return None
    turned = vertices @ gltf_from_capture(inside.up).T  # y up
    longer, shorter = sorted(cv2.minAreaRect((turned[:, [0, 2]] - turned[0, [0, 2]]).astype(np.float32))[1], reverse=True)
    scale = inside.frame.scale
    sides = scale * np.array([longer, shorter, np.ptp(turned[:, 1])])
    surface = scale * _surface_noise(inside, vertices, normals, _points_of(run))
    errors = np.hypot(CONFIDENCE * np.hypot(np.sqrt(2) * surface, inside.shape * sides), (inside.error or 0.0) * sides)
    facts = {"surface_noise": surface, "shape_spread": inside.shape, "ground_sample_distance": scale * _pixel(inside, vertices)}
    return {"unit": inside.unit, "scale_error": inside.error, "sides": sides.tolist(), "errors": errors.tolist(), **facts}


def _pixel(inside: Measured, vertices: np.ndarray) -> float:
    """The size of a photograph's pixel on the surface, at full size, in the median over photographs; capture's unit."""
    some, sizes = vertices[:: max(1, len(vertices) // 1000)], []
    for camera in inside.cameras.values():
        depth = (some - camera.centre) @ camera.forward
        if (depth > 0).any():
            sizes.append(float(np.median(depth[depth > 0])) / camera.intrinsics["fx"])
    return float(np.median(sizes)) if sizes else 0.0


def _surface_noise(inside: Measured, vertices: np.ndarray, normals: np.ndarray, points: np.ndarray) -> float:
    """The standard deviation of the surface's places: by how far sparse points are from it, those that are within a few voxels; at least half a voxel."""
    if not len(points):
        return inside.grain
    apart, nearest = cKDTree(vertices).query(points, distance_upper_bound=max(6 * inside.grain, 1e-12))
    near, at = np.isfinite(apart), nearest[np.isfinite(apart)]
    if near.sum() < FEW_POINTS:
        return inside.grain
    off = np.abs(((points[near] - vertices[at]) * normals[at]).sum(axis=1))
    return max(inside.grain, 1.4826 * float(np.median(off)))


def sides_in_words(found: Mapping[str, Any]) -> str:
    """`0.42 m by 0.31 m, 0.60 m high, within 0.004 m (99 %); a pixel of the photographs is 0.0003 m on it`."""
    error, unit = max(found["errors"]), " m" if found["unit"] == "metre" else ""
    longer, shorter, height = (with_error(side, error, unit).partition(",")[0] for side in found["sides"])
    within = with_error(0.0, error, unit).partition(",")[2]
    pixel = f"; a pixel of the photographs is {found['ground_sample_distance']:.2g}{unit} on it"
    return f"{longer} by {shorter}, {height} high" + (f",{within}" if within else "") + pixel


def measure(inside: Measured, places: Sequence[str]) -> dict[str, Any]:
    """Lengths along places, from each to the next: the facts that `enerf measure --json` prints."""
    found = [inside.place(text) for text in places]
    legs = []
    for n, (a, b) in enumerate(itertools.pairwise(found)):
        length, error = inside.length(a, b)
        legs.append({"from": places[n], "to": places[n + 1], "length": length, "error": error})
    shown = [
        {
            "place": text, "position": inside.frame.points(place.position).tolist(), "error": inside.frame.scale * CONFIDENCE * place.spread,
            "photographs": place.views, "miss": place.miss,
        }
        for text, place in zip(places, found, strict=True)
    ]  # fmt: skip
    return {"unit": inside.unit, "scale_error": inside.error, "places": shown, "lengths": legs, "total": sum(each["length"] for each in legs)}


def frame_by_lengths(inside: Measured, run: Path, known: Sequence[tuple[str, str, float]]) -> TrueFrame:
    """The frame whose unit is a metre, by known lengths (place, place, metres). Raises BadInput where they are not sure, or do not agree."""
    ratios, spreads = [], []
    for begin, end, metres in known:
        length, spread = length_between(inside.place(begin), inside.place(end))
        if not length > 0:
            raise BadInput(f"{printable(begin, SHOWN)} and {printable(end, SHOWN)} are one place, which has no length.")
        ratios.append(metres / length)
        spreads.append(max(spread / length, 1e-6))
    ratio, error, excess = common_ratio(np.array(ratios), np.array(spreads))
    residuals = [float(ratio / each - 1) for each in ratios]
    if len(known) > 1 and excess > 3 and max(map(abs, residuals)) > LARGEST_ERROR:
        listed = ", ".join(f"{metres:g} m: {residual:+.1%}" for (_, _, metres), residual in zip(known, residuals, strict=True))
        raise BadInput(f"{run}: the known lengths do not agree ({listed}): one is wrong, or a place is not where it was meant.")
    if error > LARGEST_ERROR:
        raise BadInput(f"{run}: lengths would be known within {error:.0%} only. Give a longer one, or pick its ends in more photographs, from different sides.")
    lengths = tuple(KnownLength(begin, end, metres, off) for (begin, end, metres), off in zip(known, residuals, strict=True))
    return inside.true.with_lengths(ratio, error, lengths)


def ground_through(inside: Measured, places: Sequence[str]) -> tuple[Ground, float]:
    """The ground through three places, the cameras above it, and the error of up (99 %), degrees. Raises BadInput where they do not say which way is up."""
    found = [inside.place(text) for text in places]
    at = np.array([each.position for each in found])
    sides = np.linalg.norm(at[[1, 2, 0]] - at[[2, 0, 1]], axis=1)  # each opposite to its place
    normal = np.cross(at[1] - at[0], at[2] - at[0])
    area = float(np.linalg.norm(normal))
    listed = ", ".join(printable(text, SHOWN) for text in places)
    if not area > FLATTEST * sides.max() ** 2:
        raise BadInput(f"{listed}: three places in one line, or nearly, which up may turn about. Pick them far apart in both directions.")
    up = normal / area
    spreads = np.array([up @ each.covariance @ up for each in found]) ** 0.5
    error = float(np.degrees(np.arctan(CONFIDENCE * np.linalg.norm(spreads * sides / area))))
    if error > LARGEST_TILT:
        raise BadInput(f"{listed}: up would be known within {error:.0f} degrees only. Pick places farther apart, or in more photographs.")
    above = np.median(inside.centres @ up) - at.mean(axis=0) @ up
    up = up if above >= 0 else -up
    return Ground(tuple(up.tolist()), float(at.mean(axis=0) @ up), list(places)), error


def ground_of(inside: Measured, run: Path, text: str) -> Ground:
    """The ground of an upward direction `X,Y,Z` in the frame of exports: on the floor or table that is level by it, else under the mesh, else through the
    capture's origin. Raises UsageError."""
    numbers = _POINT.fullmatch(text)
    up = np.array([float(each) for each in numbers.groups()] if numbers else np.zeros(3))
    if not (0 < np.abs(up).max() < LARGEST_PLACE):
        raise UsageError(f"--up {printable(text, SHOWN)}: expected a direction X,Y,Z.")
    up = inside.frame.rotation.T @ (up / np.abs(up).max())
    up /= np.linalg.norm(up)
    points, mesh = _points_of(run), MeshOutputs.of_run(run)
    plane = level_plane(points, inside.centres, up, LEVEL)
    if plane is not None:
        normal, offset = plane
        middle = np.median(points, axis=0)
        height = float((middle - (middle @ normal - offset) * normal) @ up)
    else:
        vertices = read_vertices(mesh)[0] if mesh.ply.is_file() else np.zeros((1, 3))
        height = float(np.quantile(vertices @ up, LOWEST))
    return Ground(tuple(up.tolist()), height, [])


def ground_found(inside: Measured, run: Path) -> Ground:
    """The floor or table that the sparse points show, near level by the up that the run has. Raises BadInput where there is none."""
    plane = level_plane(_points_of(run), inside.centres, inside.up, FOUND_WITHIN)
    if plane is None:
        raise BadInput(f"{run}: its sparse points show no floor or table within {FOUND_WITHIN:g} degrees of level. Give three places on the ground instead.")
    return Ground(tuple(plane[0].tolist()), float(plane[1]), [])


def _points_of(run: Path) -> np.ndarray:
    """(N, 3) sparse points, in the capture's frame."""
    folder = PosesOutputs.of_run(run).folder
    found = scene.load(folder)
    return found.world_from_capture.inverse().points(scene.read_observations(folder)[0]) if found.points else np.zeros((0, 3))


def how_to_turn_upright(run: Path, inside: Measured) -> str | None:
    """How to get a turntable that stands upright, where the run's own has another up than was set since."""
    stands = inside.up @ inside.own_up > np.cos(np.radians(UPRIGHT))
    return None if stands or not TurntableOutputs.of_run(run).video.is_file() else f"enerf render {shlex.quote(str(run))} --out FRAMES --video upright.mp4"


def up_from(run: Path) -> tuple[str, bool]:
    """What the up of a run comes from, in words, and whether that is more than a guess."""
    by = poses_report(PosesOutputs.of_run(run).folder).facts.up.by
    return (f"by {by}", True) if by not in ("", THE_CAMERAS) else ("estimated from the cameras", False)


def in_words(found: Mapping[str, Any]) -> list[str]:
    """The facts of `measure` as lines."""
    unit = " m" if found["unit"] == "metre" else ""
    lines = [f"{each['from']} to {each['to']}: {with_error(each['length'], each['error'], unit)}" for each in found["lengths"]]
    if len(lines) > 1:
        lines.append(f"in all: {found['total']:.5g}{unit}")
    return lines + unit_in_words(found)


def unit_in_words(found: Mapping[str, Any]) -> list[str]:
    """What there is to say about the unit, and how to get it where it is not known."""
    if found["unit"] != "metre":
        return ["In the capture's unit, which is not known. For metres: enerf measure RUN --known-length A B 0.30m, or markers (enerf run --marker-size 50mm)."]
    return ["How sure the scale is is not known: it was given with the cameras, or by GPS."] if found["scale_error"] is None else []


def with_error(length: float, error: float, unit: str) -> str:
    """`0.3021 m, within 0.0013 m (99 %)`."""
    if not error > 0:
        return f"{length:.5g}{unit}"
    digits = int(np.clip(1 - np.floor(np.log10(error)), 0, 9))
    return f"{length:.{digits}f}{unit}, within {error:.{digits}f}{unit} (99 %)"
