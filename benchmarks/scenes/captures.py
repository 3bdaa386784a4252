"""Twelve captures that no rule was made on, as people take them: photographs, true cameras, sparse points as a reconstruction has them, and which part is the
subject.

    python -m benchmarks.scenes.captures FOLDER [--kinds gamepad,mirror] [--width 320] [--seed 0]

FOLDER/KIND/images are the photographs alone (`enerf run FOLDER/KIND/images`); FOLDER/KIND is the same as a COLMAP data set with cameras and points, which
has them where texture is: many on patterned walls, few on plain subjects, what mirrors show behind them, outliers in both directions, and views in which
nothing near is found. The same arguments give the same files.
"""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from benchmarks.scenes.catalogue import look_at
from benchmarks.scenes.rendering import image, nearest
from benchmarks.scenes.shapes import BLUE, DARK, GREEN, RED, STONE, WOOD, Box, Capsule, Ground, Material, Shape, Sphere, point
from benchmarks.scenes.thin import plant
from efficientnerf.geometry.cameras import Camera, project, rays

WHITE, BLACK = ((0.80, 0.80, 0.78), (0.68, 0.68, 0.66)), ((0.010, 0.010, 0.012), (0.03, 0.03, 0.035))
FLOOR = -0.75  # m; the top of a table is at 0
NOISE, QUALITY = 1.5, 92  # of the photographs: levels, JPEG
Place = tuple[np.ndarray, np.ndarray]  # of a camera, and what it looks at


@dataclass(frozen=True)
class MadeCapture:
    """A scene and how it is photographed.

    subject  shapes that it is about
    around   all others
    places   of the cameras
    focal    length over the image's width
    weak     share of the views in which nothing near is found: out of focus, or too plain
    wrong    views whose stated camera stands inside the ring, looking elsewhere
    """

    subject: tuple[Shape, ...]
    around: tuple[Shape, ...]
    places: tuple[Place, ...]
    focal: float = 0.85
    weak: float = 0.1
    wrong: tuple[int, ...] = ()

    @property
    def shapes(self) -> tuple[Shape, ...]:
        return (*self.subject, *self.around)


def ring(
    count: int, radius: float, height: float, *, arc: tuple[float, float] = (0.0, 360.0), target: tuple[float, float, float] = (0.0, 0.0, 0.05), seed: int = 0
) -> list[Place]:
    """Cameras that are held by hand along an arc, degrees, each a little off."""
    rng, made = np.random.default_rng(seed), []
    for n in range(count):
        angle = np.radians(arc[0] + (arc[1] - arc[0]) * (n + 0.5) / count)
        away = radius * rng.uniform(0.92, 1.08)
        centre = np.array([away * np.cos(angle), away * np.sin(angle), height + 0.06 * radius * rng.normal()]) + np.array([*target[:2], 0.0])
        made.append((centre, np.array(target) + 0.06 * radius * rng.normal(size=3)))
    return made


def room(half: float, height: float = 2.6, scale: float = 3.0) -> tuple[Shape, ...]:
    """Four patterned walls and a floor, lit from above; its middle is the origin."""
    at, middle = half + 0.1, FLOOR + height / 2
    colours = (STONE, BLUE, WOOD, GREEN)
    walls = [
        Box((x * at, y * at, middle), (0.1 if x else at, 0.1 if y else at, height / 2), Material(colours[n], "noise", scale))
        for n, (x, y) in enumerate(((1, 0), (0, 1), (-1, 0), (0, -1)))
    ]
    return (Ground(FLOOR, Material(STONE, "checks", 1.7)), *walls)


def table(material: Material, half: tuple[float, float] = (0.6, 0.45)) -> Shape:
    return Box((0.0, 0.0, -0.02), (*half, 0.02), material)


def _gamepad() -> MadeCapture:
    shell = Material(BLACK, mirror=0.1, specular=(0.5, 60.0))
    body: tuple[Shape, ...] = (
        Capsule((-0.07, 0.0, 0.035), (0.07, 0.0, 0.035), 0.035, shell),
        Capsule((-0.08, 0.0, 0.035), (-0.11, -0.09, 0.025), 0.025, shell),
        Capsule((0.08, 0.0, 0.035), (0.11, -0.09, 0.025), 0.025, shell),
        Sphere((-0.04, -0.01, 0.075), 0.014, shell),
        Sphere((0.04, -0.01, 0.075), 0.014, shell),
    )
    dots = Material((WHITE[0], (0.45, 0.45, 0.45)), "noise", 40.0)
    return MadeCapture(body, (table(dots), *room(4.0)), (*ring(18, 0.55, 0.25), *ring(14, 0.5, 0.5, seed=1)))


def _headphones() -> MadeCapture:
    plain = Material(BLACK, specular=(0.2, 20.0))
    bow = [np.array([0.09 * np.cos(a), 0.09 * np.sin(a), 0.03]) for a in np.linspace(0, np.pi, 9)]
    band = [Capsule(point(*a), point(*b), 0.012, plain) for a, b in pairwise(bow)]
    cups = [Capsule((x, -0.01, 0.035), (x, -0.03, 0.035), 0.034, plain) for x in (-0.09, 0.09)]
    return MadeCapture((*band, *cups), (table(Material(WOOD)), *room(5.0)), tuple(ring(26, 0.6, 0.35)))


def _bare_table() -> MadeCapture:
    plain = Material(WHITE)
    things: tuple[Shape, ...] = (
        Capsule((0.06, 0.0, 0.05), (0.06, 0.0, 0.1), 0.05, plain),
        Box((-0.1, 0.04, 0.04), (0.06, 0.05, 0.04), plain, heading=25.0),
        Sphere((-0.02, -0.1, 0.04), 0.04, Material(STONE)),
    )
    return MadeCapture(things, (table(plain), *room(3.0)), tuple(ring(28, 0.7, 0.35)), weak=0.15)


def _mirror() -> MadeCapture:
    things: tuple[Shape, ...] = (
        Sphere((0.1, -0.05, 0.08), 0.08, Material(((0.7, 0.7, 0.72),) * 2, mirror=0.85)),
        Box((-0.12, 0.0, 0.07), (0.05, 0.05, 0.07), Material(RED, "checks", 40.0), heading=20.0),
    )
    glass = Box((0.0, 0.35, 0.3), (0.45, 0.01, 0.3), Material(DARK, mirror=0.9))
    places = ring(26, 0.75, 0.35, arc=(-165.0, -15.0))
    return MadeCapture(things, (glass, table(Material(WOOD, "noise", 14.0)), *room(3.5)), tuple(places))


def _far_room() -> MadeCapture:
    things: tuple[Shape, ...] = (
        Box((0.0, 0.0, 0.1), (0.1, 0.07, 0.1), Material(BLUE, "noise", 20.0), heading=15.0),
        Sphere((0.0, 0.0, 0.27), 0.07, Material(RED)),
    )
    return MadeCapture(things, (table(Material(WHITE)), *room(8.0, 4.0, 1.5)), tuple(ring(32, 1.2, 0.5, target=(0.0, 0.0, 0.15))), focal=0.75, weak=0.15)


def _arc() -> MadeCapture:
    things: tuple[Shape, ...] = (
        Box((0.0, 0.0, 0.06), (0.12, 0.08, 0.06), Material(WOOD, "stripes", 30.0), heading=10.0),
        Box((0.02, 0.0, 0.17), (0.07, 0.06, 0.05), Material(GREEN, "noise", 25.0), heading=40.0),
        Capsule((-0.2, 0.05, 0.03), (-0.2, 0.05, 0.25), 0.03, Material(BLUE)),
    )
    wall = Box((0.0, 0.9, 0.5), (2.5, 0.05, 1.25), Material(STONE, "noise", 4.0))
    places = ring(22, 0.8, 0.3, arc=(-140.0, -50.0), target=(0.0, 0.0, 0.1))
    return MadeCapture(things, (wall, table(Material(WOOD, "noise", 12.0)), Ground(FLOOR, Material(STONE, "checks", 2.0))), tuple(places))


def _strays() -> MadeCapture:
    things: tuple[Shape, ...] = (
        Sphere((0.0, 0.0, 0.12), 0.12, Material(STONE, "noise", 18.0)),
        Box((0.0, 0.0, 0.27), (0.06, 0.06, 0.05), Material(RED, "checks", 30.0), heading=33.0),
    )
    inside = [(np.array([0.3, -0.15, 0.2]), np.array([0.0, 0.0, 0.15])), (np.array([1.6, 1.4, 0.5]), np.array([0.0, 0.0, 0.1]))]
    around = ring(30, 0.8, 0.35, target=(0.0, 0.0, 0.12))
    return MadeCapture(things, (table(Material(WOOD, "noise", 12.0)), *room(3.0)), (*around, *inside), wrong=(7, 19))


def _drone() -> MadeCapture:
    rng, houses = np.random.default_rng(4), []
    for n in range(14):
        x, y, high = 4.0 * (n % 4) - 6 + rng.uniform(-0.8, 0.8), 4.5 * (n // 4) - 6 + rng.uniform(-0.8, 0.8), rng.uniform(0.8, 2.2)
        houses.append(Box((x, y, high), (1.1, 0.8, high), Material((WOOD, STONE, RED)[n % 3], "checks" if n % 2 else "noise", 2.5), heading=float(13 * n)))
    trees = [Sphere((float(x), float(y), 1.2), 0.9, Material(GREEN, "noise", 4.0)) for x, y in rng.uniform(-8, 8, (6, 2))]
    grid = [(3.2 * (n % 6) - 8.0, 3.6 * (n // 6) - 7.2) for n in range(30)]
    places = [(np.array([x, y, 14.0]) + rng.normal(0, 0.2, 3), np.array([x, y + 0.5, 0.0])) for x, y in grid]
    return MadeCapture(tuple(houses), (*trees, Ground(0.0, Material(STONE, "noise", 0.9))), tuple(places), focal=0.8, weak=0.0)


def _two_scales() -> MadeCapture:
    things: tuple[Shape, ...] = (
        Box((0.0, 0.0, 0.15), (0.15, 0.1, 0.15), Material(STONE, "noise", 12.0), heading=12.0),
        Sphere((0.0, -0.11, 0.2), 0.03, Material(BLUE, "noise", 60.0)),
        Sphere((0.08, -0.11, 0.1), 0.02, Material(RED, "noise", 80.0)),
    )
    close = ring(12, 0.2, 0.25, arc=(-120.0, -60.0), target=(0.02, -0.1, 0.17), seed=3)
    return MadeCapture(things, (table(Material(WOOD, "noise", 12.0)), *room(3.0)), (*ring(22, 1.1, 0.5, target=(0.0, 0.0, 0.12)), *close))


def _corridor() -> MadeCapture:
    colours = (RED, BLUE, WOOD, GREEN)
    things = tuple(
        Box((1.1 * (n + 1), (-0.8, 0.8)[n % 2], FLOOR + 0.4), (0.25, 0.2, 0.4), Material(colours[n % 4], "noise", 7.0), heading=float(17 * n)) for n in range(8)
    )
    walls: list[Shape] = [Box((5.0, y, 0.4), (7.0, 0.1, 1.2), Material(WHITE if y > 0 else STONE, "plain" if y > 0 else "noise", 3.0)) for y in (-1.2, 1.2)]
    end = Box((11.0, 0.0, 0.4), (0.1, 1.2, 1.2), Material(WOOD, "noise", 3.0))
    rng, places = np.random.default_rng(9), []
    for n in range(28):
        centre = np.array([-1.0 + 0.27 * n, 0.15 * np.sin(n), 0.3 + 0.05 * rng.normal()])
        places.append((centre, centre + np.array([2.0, 0.5 * np.sin(0.9 * n), -0.35])))
    return MadeCapture(things, (*walls, end, Ground(FLOOR, Material(WOOD, "noise", 4.0))), tuple(places), focal=0.7)


def _before_black() -> MadeCapture:
    bone = Material(((2.6, 2.4, 2.0), (0.6, 0.5, 0.35)), "noise", 30.0)  # brighter than white: by the flash
    skull: tuple[Shape, ...] = (
        Sphere((0.0, 0.0, 0.18), 0.11, bone),
        Box((0.0, -0.07, 0.08), (0.055, 0.05, 0.05), bone),
        *(Sphere((x, -0.1, 0.17), 0.03, Material(BLACK)) for x in (-0.04, 0.04)),
    )
    night = Sphere((0.0, 0.0, 0.0), 30.0, Material(((0.0, 0.0, 0.0),) * 2))
    places = (*ring(16, 0.5, 0.15, target=(0.0, 0.0, 0.15)), *ring(14, 0.45, 0.4, target=(0.0, 0.0, 0.15), seed=2))
    return MadeCapture(skull, (night, Capsule((0.0, 0.0, -0.3), (0.0, 0.0, 0.02), 0.03, Material(BLACK))), places, wrong=(11,))


def _sill() -> MadeCapture:
    things = (*plant((0.0, 0.0), 7, 4, 5), Capsule((0.3, 0.0, 0.04), (0.3, 0.0, 0.25), 0.04, Material(GREEN, mirror=0.2)))
    frame = [Box((x, 0.3, 0.4), (0.8, 0.05, 1.2), Material(WHITE)) for x in (-1.6, 1.6)]
    frame += [Box((0.0, 0.3, -0.42), (0.8, 0.05, 0.4), Material(WHITE)), Box((0.0, 0.3, 1.5), (0.8, 0.05, 0.2), Material(WHITE))]
    hills = [Sphere((14.0 * n - 28.0, 45.0 + 6.0 * (n % 2), -9.0), 13.0, Material((GREEN, WOOD)[n % 2], "noise", 0.5)) for n in range(5)]
    houses = [Box((7.0 * n - 14.0, 16.0 + 4.0 * (n % 3), 0.0), (1.8, 1.5, 2.5), Material((RED, STONE)[n % 2], "checks", 0.9)) for n in range(5)]
    places = ring(24, 1.0, 0.45, arc=(-135.0, -45.0), target=(0.05, 0.0, 0.35))
    return MadeCapture(things, (table(Material(WHITE), (0.8, 0.25)), *frame, *hills, *houses, Ground(-3.0, Material(GREEN, "noise", 0.7))), tuple(places))


def captures() -> dict[str, MadeCapture]:
    """Every kind, by name."""
    return {
        "gamepad": _gamepad(), "headphones": _headphones(), "bare_table": _bare_table(), "mirror": _mirror(), "far_room": _far_room(), "arc": _arc(),
        "strays": _strays(), "drone": _drone(), "two_scales": _two_scales(), "corridor": _corridor(), "before_black": _before_black(), "sill": _sill(),
    }  # fmt: skip


def cameras(capture: MadeCapture, width: int) -> list[Camera]:
    """Where the photographs were taken from."""
    return [look_at(f"photo_{n:03d}.jpg", centre, target, width, capture.focal) for n, (centre, target) in enumerate(capture.places)]


def stated_cameras(capture: MadeCapture, width: int) -> list[Camera]:
    """What a reconstruction says: the same but for the wrong ones, which stand between the others and the subject."""
    made, middle = cameras(capture, width), np.mean([target for _, target in capture.places], axis=0)
    for n in capture.wrong:
        centre = middle + 0.4 * (capture.places[n][0] - middle)
        made[n] = look_at(made[n].name, centre, 2 * centre - middle + np.array([0.1, 0.2, 0.0]), width, capture.focal)
    return made


def visible(capture: MadeCapture, points: np.ndarray, camera: Camera) -> np.ndarray:
    """(N,) bool: which points (N, 3) of surfaces a camera sees."""
    pixels, depth = project(camera, points)
    with np.errstate(invalid="ignore"):
        seen = np.flatnonzero((depth > 0) & (pixels >= 0).all(1) & (pixels <= (camera.width, camera.height)).all(1))
    way = points[seen] - camera.centre
    distance = np.linalg.norm(way, axis=1)
    first = nearest(capture.shapes, np.broadcast_to(camera.centre, way.shape), way / distance[:, None]).distance
    out = np.zeros(len(points), bool)
    out[seen[first > distance * (1 - 1e-3) - 1e-4]] = True
    return out


def subject_points(capture: MadeCapture, views: Sequence[Camera], *, seed: int = 0, per_view: int = 1500, observers: int = 3) -> np.ndarray:
    """(N, 3) points of the subject's surface that so many of the views show, by their true cameras."""
    rng, found = np.random.default_rng(seed), []
    for camera in views:
        origins, directions = rays(camera, rng.random((per_view, 2)) * [camera.width, camera.height])
        hits = nearest(capture.shapes, origins, directions)
        on = (hits.shape >= 0) & (hits.shape < len(capture.subject))
        found.append(origins[on] + hits.distance[on, None] * directions[on])
    points = np.concatenate(found)
    return points[np.sum([visible(capture, points, camera) for camera in views], axis=0) >= observers]


TEXTURED = {"noise": 1.0, "checks": 1.0, "stripes": 0.6, "plain": 0.03}  # share of the places at which features are found
ANGLE, MATCHED = np.radians(40.0), 0.6  # between views that match, at most; share of the matches that are found
OUTLIERS, SPREAD = 0.02, 0.004  # share of the points; error of the others along a ray, of the depth
CANDIDATES = 260  # places a view


def sparse_points(capture: MadeCapture, width: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Points (N, 3), reprojection errors (N,) in pixels, and the views of each, as a reconstruction of the photographs has them."""
    rng, views = np.random.default_rng([seed, 1]), cameras(capture, width)
    points, virtual = [], []
    for camera in views:
        origins, directions = rays(camera, rng.random((CANDIDATES, 2)) * [camera.width, camera.height])
        place, seen = _featured(capture, origins, directions, rng)
        points.append(place)
        virtual.append(seen)
    xyz, shown = np.concatenate(points), np.concatenate(virtual)
    centres = np.array([camera.centre for camera in views])
    weak = rng.random(len(views)) < capture.weak
    middle = subject_points(capture, views, seed=seed, per_view=200).mean(0)
    reach = 2.0 * np.linalg.norm(centres - middle, axis=1)  # what a weak view finds lies farther away
    order = np.repeat(np.arange(len(views)), [len(each) for each in points])
    seen = np.stack([visible(capture, shown, camera) for camera in views], axis=1)  # (N, C)
    way = shown[:, None] - centres
    distance = np.linalg.norm(way, axis=2)
    own = np.take_along_axis(way, order[:, None, None], 1) / np.take_along_axis(distance, order[:, None], 1)[..., None]
    seen &= (way * own).sum(2) > np.cos(ANGLE) * distance
    seen &= rng.random(seen.shape) < MATCHED
    seen[np.arange(len(shown)), order] = True
    seen &= ~(weak & (distance < reach))
    seen[:, list(capture.wrong)] &= rng.random((len(shown), len(capture.wrong))) < 0.1
    xyz = centres[order] + (xyz - centres[order]) * (1 + SPREAD * rng.normal(size=(len(xyz), 1)))
    error = rng.uniform(0.3, 1.0, len(xyz))
    out = rng.random(len(xyz)) < OUTLIERS
    xyz[out] = centres[order[out]] + (xyz[out] - centres[order[out]]) * rng.choice([0.05, 0.15, 0.4, 2.5, 8.0], (out.sum(), 1))
    error[out] = rng.uniform(1.5, 3.0, out.sum())
    for n in np.flatnonzero(out):  # outliers are seen by two or three
        seen[n, np.flatnonzero(seen[n])[3:]] = False
    kept = seen.sum(1) >= 2
    return xyz[kept], error[kept], [np.flatnonzero(row) for row in seen[kept]]


def _featured(capture: MadeCapture, origins: np.ndarray, directions: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Places (N, 3) of features along rays, and the points (N, 3) of surfaces that show them: for mirrors the place lies behind, where it seems to be."""
    hits = nearest(capture.shapes, origins, directions)
    met = np.flatnonzero(hits.shape >= 0)
    materials = [capture.shapes[k].material for k in hits.shape[met]]
    mirrors = rng.random(len(met)) < [material.mirror for material in materials]
    found = rng.random(len(met)) < [0.0 if not np.any(material.colours) else TEXTURED[material.pattern] for material in materials]  # pure black shows nothing
    surface = origins + np.where(np.isfinite(hits.distance), hits.distance, 0)[:, None] * directions
    extra = np.zeros(len(origins))
    for at in met[mirrors]:
        shape = capture.shapes[hits.shape[at]]
        normal = shape.normal(surface[at : at + 1])
        onwards = directions[at : at + 1] - 2 * (directions[at] * normal).sum() * normal
        behind = nearest(capture.shapes, surface[at : at + 1] + 1e-3 * normal, onwards)
        textured = behind.shape[0] >= 0 and rng.random() < TEXTURED[capture.shapes[behind.shape[0]].material.pattern]
        extra[at] = behind.distance[0] if textured else 0.0
    at = met[(found & ~mirrors) | (mirrors & (extra[met] > 0))]
    return surface[at] + extra[at, None] * directions[at], surface[at]


def write_model(folder: Path, capture: MadeCapture, width: int, seed: int = 0) -> None:
    """sparse/0 of a COLMAP data set, as text: the stated cameras, and the points with their views."""
    from scipy.spatial.transform import Rotation

    model = folder / "sparse" / "0"
    model.mkdir(parents=True, exist_ok=True)
    stated = stated_cameras(capture, width)
    first = stated[0]
    (model / "cameras.txt").write_text(f"1 SIMPLE_PINHOLE {first.width} {first.height} {' '.join(map(repr, first.params))}\n", encoding="utf-8")
    lines = []
    for number, camera in enumerate(stated, 1):
        inverse = np.linalg.inv(camera.world_from_camera)
        x, y, z, w = Rotation.from_matrix(inverse[:3, :3]).as_quat()
        lines += [f"{number} {' '.join(f'{value:.12g}' for value in (w, x, y, z, *inverse[:3, 3]))} 1 {camera.name}", ""]
    (model / "images.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    rows = [
        f"{n} {' '.join(f'{value:.9g}' for value in point)} 128 128 128 {error:.4f} " + " ".join(f"{view + 1} 0" for view in track)
        for n, (point, error, track) in enumerate(zip(*sparse_points(capture, width, seed), strict=True), 1)
    ]
    (model / "points3D.txt").write_text("\n".join(rows) + "\n", encoding="utf-8")


def photographs(capture: MadeCapture, width: int, seed: int = 0, supersample: int = 2) -> Iterator[tuple[str, np.ndarray]]:
    """Name and (H, W, 3) uint8 of each, with a sensor's noise."""
    for number, camera in enumerate(cameras(capture, width)):
        drawn = image(capture.shapes, camera, supersample=supersample, alpha=False)
        noisy = drawn + np.random.default_rng([seed, number]).normal(0, NOISE, drawn.shape)
        yield camera.name, np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def write_capture(folder: Path, capture: MadeCapture, width: int, seed: int = 0) -> None:
    """Photographs and the COLMAP model."""
    from PIL import Image

    (folder / "images").mkdir(parents=True, exist_ok=True)
    for name, pixels in photographs(capture, width, seed):
        exif = Image.Exif()
        exif.get_ifd(34665)[41989] = round(36 * capture.focal)  # FocalLengthIn35mmFilm
        Image.fromarray(pixels).save(folder / "images" / name, quality=QUALITY, exif=exif)
    write_model(folder, capture, width, seed)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--kinds", default=",".join(captures()))
    parser.add_argument("--width", type=int, default=320, help="pixels; three quarters as high")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(arguments)
    wanted = given.kinds.split(",")
    for kind in wanted:
        if kind not in captures():
            parser.error(f"--kinds: found {kind!r}, expected some of {', '.join(captures())}")
    for kind in wanted:
        write_capture(given.folder / kind, captures()[kind], given.width, given.seed)
        print(f"{given.folder / kind}: written", flush=True)


if __name__ == "__main__":
    main()
