"""Published data sets and lists of cameras, in a table: how each is recognised, and how its cameras are read.

    scannetpp  ScanNet++'s DSLR captures, as nerfstudio's scannetpp_dataparser reads them: nerfstudio's frames, and `test_frames` of the same kind; z is up,
               in metres; train_test_lists.json overrules which are test images; the fisheye lens is traced as it is
    kapture    kapture_format.adoc of naver/kapture, 1.0 and 1.1: poses are world to device as COLMAP's, those of rigs rig to sensor, and lenses COLMAP's
    mvsnet     YoYo000/MVSNet, BlendedMVS, and DTU, of whose lights the fourth is taken: `extrinsic` is world to camera, `intrinsic` is K
    idr        DATA_CONVENTION.md of lioryariv/idr: `world_mat_<i>` is K [R t] of the i-th image by name, the first pixel's centre at 0, 0; `scale_mat_<i>` maps
               the unit sphere to the object's, whose box is taken for the scene's bounds
    nsvf       facebookresearch/NSVF: camera to world; names with 0_, 1_ and 2_ are training, validation and test images, without 2_ those with 1_ test
    tanks-and-temples  tanksandtemples.org and Open3D's trajectory: of each image three numbers, the first its index by name, and camera to world

x right, y down, z forward in all but the first.
"""

import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from efficientnerf.geometry.cameras import MODELS, Camera, pose_from_colmap
from pipeline.errors import BadInput
from pipeline.text import printable
from stages.formats.importers import frames, lenses
from stages.formats.importers.colmap_model import FISHEYE, as_traced, count_parameters
from stages.formats.importers.datasets.matrices import MAX_CAMERA_BYTES, REMEDY, archive_matrices, decomposed, intrinsics_of, pinhole_frame
from stages.formats.importers.frames import Frame
from stages.formats.importers.listed import Z_UP, Listed, ListFormat, places_of, sparse_points
from stages.formats.importers.source import MAX_FRAMES, Source, images_in
from stages.formats.importers.texts import head, number, numbers, read_text
from stages.formats.importers.transforms import camera_of, read_document
from stages.io.capture import SparsePoints
from stages.io.json_file import LARGEST_NUMBER, read_json

MAX_POINTS = 5_000_000
MAX_RIGS = 8  # within each other
DTU_LIGHT = 3  # of seven: each view has it


def _folder(base: Path, names: Sequence[str]) -> Path:
    """The first of the folders that is there, else the one that they lie in."""
    return next((base / name for name in names if (base / name).is_dir()), base)


def _images(base: Path, names: Sequence[str]) -> list[Path]:
    """Those of the first of the folders that has any, by name."""
    return next((found for name in names if (found := images_in(base / name))), [])


# ScanNet++. File -> folders of images and of masks.
SCANNETPP_LISTS = {
    "nerfstudio/transforms.json": (("resized_images", "images", "original_images"), ("resized_anon_masks", "masks")),
    "nerfstudio/transforms_undistorted.json": (("resized_undistorted_images", "undistorted_images"), ("resized_undistorted_masks", "undistorted_anon_masks")),
}


def _scannetpp_files(source: Source) -> Sequence[Path]:
    """The lists, those whose images are there first."""
    found = [
        (base / name, folders) for base in (source.root, source.root / "dslr") for name, (folders, _) in SCANNETPP_LISTS.items() if (base / name).is_file()
    ]
    found.sort(key=lambda one: not any((one[0].parents[1] / folder).is_dir() for folder in one[1]))
    return [source.check_inside(path) for path, _ in found]


def _scannetpp(source: Source, signs: Sequence[Path]) -> Listed:
    file, base, where = signs[0], signs[0].parents[1], source.name_of(signs[0])
    document = read_document(source.real(file))
    images, masks = (_folder(base, names) for names in SCANNETPP_LISTS[f"nerfstudio/{file.name}"])
    more = document.get("test_frames", [])
    if not isinstance(more, list):
        raise BadInput(f"{where}: test_frames is no list. {REMEDY}")
    entries = [*((entry, "train" if more else None) for entry in document["frames"]), *((entry, "test") for entry in more)]
    frames.check_count(len(entries), where)
    lists = base / "train_test_lists.json"
    splits = _scannetpp_splits(source, lists) if lists.is_file() else {}
    listed, bad = [], []
    for index, (entry, split) in enumerate(entries):
        if not isinstance(entry, dict) or not isinstance(entry.get("file_path"), str):
            raise BadInput(f"{where}: frame {index} has no `file_path`. {REMEDY}")
        image = entry["file_path"]
        if entry.get("is_bad") is True:
            bad.append((printable(image, frames.MAX_NAME), "marked as bad by the data set"))
            continue
        mask = source.find(entry["mask_path"], masks).path if isinstance(entry.get("mask_path"), str) else None
        place = f"{where}: frame {index} ({printable(image, frames.MAX_NAME)})"
        listed.append(Frame(image, images, place, camera_of(document, entry, place), mask=mask, split=splits.get(image, split)))
    texts = [file, lists] if lists.is_file() else [file]
    return Listed(where, listed, texts, bad, up=Z_UP, metric=True)


def _scannetpp_splits(source: Source, path: Path) -> dict[str, str]:
    """Image -> split."""
    document = read_json(source.real(path), REMEDY)
    splits: dict[str, str] = {}
    for split in ("train", "test"):
        names = document.get(split, []) if isinstance(document, dict) else None
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise BadInput(f"{source.name_of(path)}: {split} is no list of names. {REMEDY}")
        splits |= dict.fromkeys(names, split)
    return splits


# Kapture
SENSORS, RECORDS, TRAJECTORIES, RIGS = (f"sensors/{name}.txt" for name in ("sensors", "records_camera", "trajectories", "rigs"))
POINTS, OBSERVATIONS = "reconstruction/points3d.txt", "reconstruction/observations.txt"


@dataclass
class _Devices:
    """Sensors and how they are carried."""

    lenses: dict[str, Camera] = field(default_factory=dict)  # sensor -> camera at the origin
    mounts: dict[str, list[tuple[str, np.ndarray]]] = field(default_factory=dict)  # sensor or rig -> (the rig that carries it, sensor from rig)
    poses: dict[tuple[str, str], np.ndarray] = field(default_factory=dict)  # (timestamp, device) -> device from world

    def pose(self, timestamp: str, device: str, depth: int = 0) -> np.ndarray | None:
        """(4, 4) device from world, by its own trajectory or that of the rig that carries it; None where there is neither."""
        own = self.poses.get((timestamp, device))
        if own is not None or depth >= MAX_RIGS:
            return own
        for rig, mounted in self.mounts.get(device, []):
            carried = self.pose(timestamp, rig, depth + 1)
            if carried is not None:
                return np.asarray(mounted @ carried)
        return None


def _kapture_files(source: Source) -> Sequence[Path]:
    return [source.root / name for name in (SENSORS, RECORDS, TRAJECTORIES, RIGS, POINTS, OBSERVATIONS) if (source.root / name).is_file()]


def _is_kapture(source: Source, signs: Sequence[Path]) -> bool:
    path = source.root / SENSORS
    return path in signs and "kapture format" in head(source.real(path), 200)


def _kapture(source: Source, signs: Sequence[Path]) -> Listed:
    devices = _Devices()
    for where, values in _rows(source, SENSORS, 3):
        if values[2] != "camera":
            continue
        model, params = (values[3] if len(values) > 3 else ""), values[4:]
        if (count := count_parameters(model)) is None:
            supported = ", ".join([*MODELS, *FISHEYE])
            raise BadInput(f"{where}: camera model {printable(model, 40) or 'missing'}; supported are {supported}. Undistort the images first.")
        lens = numbers(params, 2 + count, where)
        devices.lenses[values[0]] = Camera("", *lenses.image_size(lens[0], lens[1], where, REMEDY), *as_traced(model, tuple(lens[2:].tolist())), np.eye(4))
    for where, values in _rows(source, RIGS, 9):
        devices.mounts.setdefault(values[1], []).append((values[0], _transform(values[2:9], where)))
    for where, values in _rows(source, TRAJECTORIES, 9):
        if "" not in values[2:9]:  # only a place, or only a direction, is known
            devices.poses[values[0], values[1]] = _transform(values[2:9], where)
    listed, unposed = [], []
    for where, (timestamp, sensor, name, *_) in _rows(source, RECORDS, 3):
        if sensor not in devices.lenses:
            raise BadInput(f"{where}: sensor {printable(sensor, 40)} is no camera of {SENSORS}. {REMEDY}")
        found = devices.pose(timestamp, sensor)
        if found is None:
            unposed.append((printable(name, frames.MAX_NAME), "without a pose"))
            continue
        camera = replace(devices.lenses[sensor], world_from_camera=np.linalg.inv(found))
        place = f"{where} ({printable(name, frames.MAX_NAME)})"
        listed.append(Frame(name, source.root / "sensors/records_data", place, frames.stated(camera)))
        frames.check_count(len(listed), RECORDS)
    return Listed(RECORDS, listed, signs, unposed, finish=lambda capture, kept: replace(capture, points=_kapture_points(source, places_of(kept))))


def _rows(source: Source, name: str, least: int) -> Iterator[tuple[str, list[str]]]:
    """(place for messages, values) of each line that is no comment; none where there is no such file."""
    path = source.root / name
    if not path.is_file():
        return
    for index, line in enumerate(read_text(source.real(path)).splitlines(), 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        values = [value.strip() for value in line.split(",")]
        if len(values) < least:
            raise BadInput(f"{name}: line {index} has {len(values)} values, expected {least} or more. {REMEDY}")
        yield f"{name}: line {index}", values


def _transform(values: list[str], where: str) -> np.ndarray:
    """(4, 4) of qw qx qy qz tx ty tz."""
    found = numbers(values, 7, where)
    length = float(np.linalg.norm(found[:4]))
    if not 0.99 < length < 1.01:
        raise BadInput(f"{where}: quaternion of length {length:g}, expected 1. {REMEDY}")
    return np.linalg.inv(pose_from_colmap(found[:4], found[4:]))


def _kapture_points(source: Source, places: dict[str, int]) -> SparsePoints | None:
    rows = []
    for where, values in _rows(source, POINTS, 3):
        rows.append([number(value, where) for value in values[:6]] + [128.0] * (6 - len(values[:6])))
        if len(rows) > MAX_POINTS:
            raise BadInput(f"{POINTS}: more than {MAX_POINTS} points; that many are not read.")
    if not rows:
        return None
    tracks: list[set[int]] = [set() for _ in rows]
    for where, values in _rows(source, OBSERVATIONS, 1):
        index = number(values[0], where)
        first = 1 if len(values) % 2 else 2  # from version 1.1 on with the type of the features
        if index != int(index) or not 0 <= index < len(rows):
            raise BadInput(f"{where}: point {index:g} of {len(rows)}. {REMEDY}")
        tracks[int(index)].update(places[name] for name in values[first::2] if name in places)
    array = np.array(rows)
    return sparse_points(array[:, :3], array[:, 3:], [tuple(sorted(track)) for track in tracks])


# MVSNet
def _mvsnet_files(source: Source) -> Sequence[Path]:
    """The cameras of the first of the usual folders that holds any, by number."""
    for place in ("cams", "cams_1", "cam", "Cameras", "Cameras/train"):
        folder = source.root / place
        found = [path for path in folder.glob("*_cam.txt") if re.fullmatch(r"[0-9]{1,9}_cam\.txt", path.name) and path.is_file()] if folder.is_dir() else []
        if found:
            numbered = {int(path.name.removesuffix("_cam.txt")): source.check_inside(path) for path in sorted(found)}
            return [path for _, path in sorted(numbered.items())]
    return []


def _mvsnet(source: Source, signs: Sequence[Path]) -> Listed:
    place = signs[0].parent
    frames.check_count(len(signs), place.name)
    rectified = source.root / "Rectified"  # of DTU
    scans = [path for path in sorted(rectified.iterdir()) if path.is_dir()] if rectified.is_dir() else []
    if len(scans) > 1:
        raise BadInput(f"{rectified}: {len(scans)} scans; one is read. Copy Cameras/ and Rectified/<scan> of one of them into a folder.")
    listed = []
    for path in signs:
        where, stem = source.name_of(path), path.name.removesuffix("_cam.txt")
        found = read_text(source.real(path), MAX_CAMERA_BYTES).split()
        if len(found) < 27 or found[0] != "extrinsic" or found[17] != "intrinsic":
            raise BadInput(f"{where}: expected `extrinsic` with 16 numbers and `intrinsic` with 9. {REMEDY}")
        rigid = lenses.rigid(numbers(found[1:17], 16, f"{where}: extrinsic").reshape(4, 4), f"{where}: extrinsic")
        pose = lenses.inverse(rigid[:3, :3], rigid[:3, 3])
        camera = pinhole_frame(numbers(found[18:27], 9, f"{where}: intrinsic").reshape(3, 3), pose, where)
        if scans:
            listed.append(Frame(f"rect_{int(stem) + 1:03d}_{DTU_LIGHT}_r5000.png", scans[0], where, camera))
            continue
        folders = [source.root / name for name in ("images", "blended_images", "image", "rgb", ".")]
        images = next((folder for folder in folders if not source.find(stem, folder).elsewhere), source.root)
        listed.append(Frame(stem, images, where, camera, bare=True))
    return Listed(source.name_of(place), listed, signs, facts={"cameras": source.name_of(place)})


# IDR
IDR_CAMERAS = ("cameras_sphere.npz", "cameras.npz", "cameras_large.npz", "cameras_linear_init.npz")


def _idr(source: Source, signs: Sequence[Path]) -> Listed:
    where = source.name_of(signs[0])
    matrices = archive_matrices(source.real(signs[0]), where)
    images, masks = _images(source.root, ("image", "images", "rgb")), _images(source.root, ("mask", "masks"))
    count = sum(name.startswith("world_mat_") for name in matrices)
    frames.check_count(count, where)
    for kind, found in (("images", images), ("masks", masks)):
        if len(found) != count and (found or kind == "images"):
            raise BadInput(f"{where}: {count} cameras, but {len(found)} {kind}; they belong to the sorted names. Restore those that it was made from.")
    listed = []
    for index, image in enumerate(images):
        place = f"{where}: world_mat_{index}"
        if f"world_mat_{index}" not in matrices:
            raise BadInput(f"{place}: not there, with {count} cameras. {REMEDY}")
        k, pose = decomposed(matrices[f"world_mat_{index}"][:3], place)
        k = k + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        mask = source.check_inside(masks[index]) if masks else None
        listed.append(Frame(image.name, image.parent, place, pinhole_frame(k, pose, place), mask=mask))
    return Listed(where, listed, signs, bounds=_idr_bounds(matrices, where), facts={"cameras": where})


def _idr_bounds(matrices: dict[str, np.ndarray], where: str) -> np.ndarray | None:
    """(2, 3) the box round the sphere of the object; None where the archive names none."""
    matrix = matrices.get("scale_mat_0")
    if matrix is None:
        return None
    radius = float(np.cbrt(abs(np.linalg.det(matrix[:3, :3]))))
    if not 1e-9 < radius < LARGEST_NUMBER:
        raise BadInput(f"{where}: scale_mat_0 scales by {radius:g}; expected a positive number. {REMEDY}")
    return np.stack([matrix[:3, 3] - radius, matrix[:3, 3] + radius])


# NSVF
def _nsvf_files(source: Source) -> Sequence[Path]:
    """The intrinsics, and the poses by name."""
    intrinsics, place = source.root / "intrinsics.txt", source.root / "pose"
    poses = sorted(source.check_inside(path) for path in place.glob("*.txt") if path.is_file()) if intrinsics.is_file() else []
    return [source.check_inside(intrinsics), *poses] if poses else []


def _nsvf(source: Source, signs: Sequence[Path]) -> Listed:
    intrinsics, *poses = signs
    frames.check_count(len(poses), "pose")
    k, stated = intrinsics_of(source.real(intrinsics))
    images = _folder(source.root, ("rgb", "images", "image", "color"))
    splits = {"0_": "train", "1_": "val" if any(path.name.startswith("2_") for path in poses) else "test", "2_": "test"}
    split = splits if all(path.name[:2] in splits for path in poses) else {}
    listed = []
    for path in poses:
        where = source.name_of(path)
        pose = lenses.rigid(numbers(read_text(source.real(path), MAX_CAMERA_BYTES).split(), 16, where).reshape(4, 4), where)
        camera = pinhole_frame(k, pose, intrinsics.name, stated)
        listed.append(Frame(path.stem, images, where, camera, bare=True, split=split.get(path.name[:2])))
    box = source.root / "bbox.txt"
    if not box.is_file():
        return Listed("pose", listed, signs)
    corners = numbers(read_text(source.real(box), MAX_CAMERA_BYTES).split()[:6], 6, box.name).reshape(2, 3)
    if not (corners[0] < corners[1]).all():
        raise BadInput(f"{box.name}: {corners.tolist()}; expected the lower corner, then the upper one. {REMEDY}")
    return Listed("pose", listed, [*signs, box], bounds=corners)


# Tanks and Temples
def _tanks_files(source: Source) -> Sequence[Path]:
    """Trajectories: files that begin with three whole numbers and a matrix."""
    found = []
    for path in filter(Path.is_file, sorted(source.root.glob("*.log"))):
        with suppress(ValueError):  # it is another text
            if [float(word) for word in head(source.real(path)).split()[:19]][15:] == [0, 0, 0, 1]:
                found.append(path)
    return found


def _tanks(source: Source, signs: Sequence[Path]) -> Listed:
    names = ("intrinsics.txt", "intrinsic.txt", "intrinsic.json", "intrinsics.json", "camera_intrinsic.json")
    lens = next((source.root / name for name in names if (source.root / name).is_file()), None)
    if lens is None:
        raise BadInput(f"{signs[0]}: a trajectory without intrinsics. Write fx fy cx cy, in pixels, into {source.root / names[0]}.")
    k, stated = intrinsics_of(source.real(lens))
    images = _images(source.root, ("images", "image", "rgb", "color", "."))
    where = source.name_of(signs[0])
    words = read_text(source.real(signs[0])).split()
    if len(words) % 19 or not words:
        raise BadInput(f"{where}: {len(words)} numbers; expected three and a matrix of 4x4 for each image. {REMEDY}")
    if len(words) > 19 * MAX_FRAMES:
        raise BadInput(f"{where}: {len(words) // 19} cameras; at most {MAX_FRAMES} are read.")
    listed = []
    for row in range(len(words) // 19):
        place = f"{where}: camera {row}"
        index = number(words[19 * row], f"{place}: index")
        if index != int(index) or not 0 <= index < len(images):
            raise BadInput(f"{place}: index {index:g}, and {len(images)} images; indices count the sorted names from 0. Restore the images it was made from.")
        pose = lenses.rigid(numbers(words[19 * row + 3 : 19 * row + 19], 16, place).reshape(4, 4), place)
        image = images[int(index)]
        listed.append(Frame(image.name, image.parent, place, pinhole_frame(k, pose, source.name_of(lens), stated)))
    return Listed(where, listed, [signs[0], lens], facts={"intrinsics": source.name_of(lens)})


SCANNETPP = ListFormat("scannetpp", f"{' or '.join(SCANNETPP_LISTS)}, here or in dslr/", _scannetpp_files, _scannetpp)
KAPTURE = ListFormat("kapture", f"{SENSORS} and {RECORDS}", _kapture_files, _kapture, _is_kapture)
MVSNET = ListFormat("mvsnet", "cams/00000000_cam.txt and so on", _mvsnet_files, _mvsnet)
IDR = ListFormat("idr", "cameras_sphere.npz or cameras.npz", lambda source: source.first_of(IDR_CAMERAS), _idr)
NSVF = ListFormat("nsvf", "intrinsics.txt and pose/<name>.txt", _nsvf_files, _nsvf)
TANKS = ListFormat("tanks-and-temples", "one trajectory (.log) next to the folder of images", _tanks_files, _tanks, single=True)
