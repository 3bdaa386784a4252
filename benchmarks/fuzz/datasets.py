"""Readers of posed data sets: a small folder in each format, of which one file is the input."""

import io
import json
import re
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from random import Random

import numpy as np

from benchmarks.fuzz import binary, json_text, lines
from benchmarks.fuzz.reader import Opened, Read, Reader
from tests.stages import captures, exports

COUNT = 4  # images of a data set, of which one may be left out
EVERY = 100  # of so many inputs one goes through the command line: a whole poses stage takes as long as a hundred of them
NGP = {"is_fisheye": False, "k1": 0.01}


def read_source(folder: Path, data: bytes) -> None:
    """As the poses stage reads a source: the formats that it may be, of one input in four the files that it depends on, the cameras."""
    from stages.formats import importers

    settings = captures.Settings()
    name = importers.candidates(folder)[0]
    importer = importers.IMPORTERS[name]
    if len(data) % 4 == 0:
        importer.files(folder, settings)  # type: ignore[arg-type]
    if importer.posed:
        capture = importer.read(folder, settings)  # type: ignore[arg-type]
        for photo in capture.photos:
            assert np.isfinite(photo.camera.world_from_camera).all(), "a camera that is not finite"
            assert np.isfinite(photo.camera.params).all(), "a lens that is not finite"
            assert photo.image.resolve().is_relative_to(folder.resolve()), "an image outside the source"
        assert capture.bounds is None or np.isfinite(capture.bounds).all(), "bounds that are not finite"


def with_poses(read: Read, source: Path, *commands: tuple[str, ...]) -> Opened:
    """A reader of the source, with commands and the poses stage, in a new run each time."""
    run = source.parent / "run"
    stage = ("run", str(source), "--out", str(run), "--until", "poses", "--preset", "tiny", "--quiet")
    return Opened(read, (*commands, stage), lambda data: shutil.rmtree(run, ignore_errors=True))


def open_file(write: Callable[..., Path], name: str) -> Callable[[Path], Opened]:
    """A reader of one file of the data set that `write` writes."""

    def opened(folder: Path) -> Opened:
        source = folder / "source"
        write(source, captures.cameras(COUNT))
        path = source / name

        def read(data: bytes) -> None:
            path.write_bytes(data)
            read_source(source, data)

        inspect = ("inspect", str(source))
        return with_poses(read, source, inspect, (*inspect, "--json"), inspect)

    return opened


def _bytes_of(write: Callable[..., Path], name: str) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        return (write(Path(folder) / "source", captures.cameras(COUNT)) / name).read_bytes()


def _shorter(data: bytes) -> bytes:
    """The first points of a text; the whole of anything else."""
    head, _, rest = data.partition(b"\n")
    if not head.startswith(b"# Number of points"):
        return data
    return b"# Number of points: 8, mean track length: 6\n" + b"\n".join(rest.split(b"\n")[:8]) + b"\n"


def transforms_seeds() -> list[bytes]:
    """The dialects in one file each; images lie where nerfstudio's are."""
    nerfstudio = json.loads(_bytes_of(captures.nerfstudio, "transforms.json"))
    ngp = json.loads(_bytes_of(captures.instant_ngp, "transforms.json")) | NGP
    blender = {"camera_angle_x": 0.76, "frames": captures.frames(captures.cameras(COUNT), "./images", "")}
    masked = {**nerfstudio, "frames": [{**frame, "mask_path": frame["file_path"], "k3": 0.01, "depth_file_path": "x"} for frame in nerfstudio["frames"]]}
    named = {
        **nerfstudio,
        "train_filenames": [frame["file_path"] for frame in nerfstudio["frames"]],
        "ply_file_path": "p.ply",
        "applied_transform": [[1, 0, 0, 0]],
    }
    rolling = {
        **ngp,
        "frames": [
            {"file_path": f["file_path"], "transform_matrix_start": f["transform_matrix"], "transform_matrix_end": f["transform_matrix"]} for f in ngp["frames"]
        ],
    }
    lens = {**nerfstudio, "camera_model": "OPENCV_FISHEYE", "k3": 0.001, "k4": 0.001}
    return [json.dumps(each).encode() for each in (nerfstudio, ngp, blender, masked, named, rolling, lens)]


def npy_seeds() -> list[bytes]:
    rows = captures.llff_rows(captures.cameras(COUNT))
    made = []
    for array in (rows, rows.astype(">f8"), rows.astype(np.float32), np.asfortranarray(rows), rows.round().astype(np.int64)):
        out = io.BytesIO()
        np.save(out, array)
        made.append(out.getvalue())
    for version in ((2, 0), (3, 0)):
        out = io.BytesIO()
        np.lib.format.write_array(out, rows, version=version)
        made.append(out.getvalue())
    out = io.BytesIO()
    np.savez(out, rows)
    return [*made, out.getvalue()]


_NPY_WORDS = [b"'<f8'", b"'<f4'", b"'|O'", b"'<U9999999'", b"'<c16'", b"'<M8[s]'", b"'|V17'", b"[('a', '<f8')]", b"True", b"False",
              b"(3, 17)", b"(17,)", b"(0, 17)", b"(4611686018427387904, 17)", b"(-1, 17)", b"()", b"(1000000000, 17)",
              b"None", b"1e9", b"'\\x00'", b"(" * 500, b"__import__('os')", b"(3, 17, 1)", b"(True, 17)"]  # fmt: skip


def npy_changed(rng: Random, data: bytes) -> bytes:
    """The header's values, numbers of the array, or bytes."""
    head = 10 + int.from_bytes(data[8:10], "little") if data[:6] == b"\x93NUMPY" and len(data) > 10 else 0
    kind = rng.random()
    if kind < 0.35 and head:
        text = data[10:head]
        found = [*re.finditer(rb"'[^']*'(?=[,}])|True|False|\([^)]*\)", text)]
        if found:
            chosen = rng.choice(found)
            text = text[: chosen.start()] + rng.choice(_NPY_WORDS) + text[chosen.end() :]
        length = len(text) if rng.random() < 0.8 else rng.choice((0, 65535, len(text) + 1))
        return data[:8] + min(length, 65535).to_bytes(2, "little") + text + data[head:]
    if kind < 0.7 and head:
        return binary.changed_bytes(rng, data, begin=head)
    return binary.changed_bytes(rng, data, end=None if rng.random() < 0.5 else max(head, 16))


def _reader(name: str, what: str, write: Callable[..., Path], file: str, changed: Callable[[Random, bytes], bytes], share: float) -> Reader:
    """A reader of one file of the data set that `write` writes."""
    return Reader(name, what, lambda: [_shorter(_bytes_of(write, file))], changed, open_file(write, file), every=EVERY, share=share)


# Of exports of other programs the file that states the cameras.
EXPORTED = {
    "polycam": ("polycam", "keyframes/corrected_cameras/img_2.json", "a camera of Polycam"),
    "record3d": ("record3d", "EXR_RGBD/metadata.json", "metadata.json of Record3D"),
    "scanner_app": ("3d scanner app", "frame_00002.json", "a frame of 3D Scanner App"),
    "metashape": ("metashape", "cameras.xml", "Metashape's XML of cameras"),
    "realitycapture_csv": ("realitycapture csv", "registration.csv", "RealityCapture's table of cameras"),
    "realitycapture_xmp": ("realitycapture xmp", "images/img_2.xmp", "RealityCapture's XMP files"),
    "opensfm": ("opensfm", "opensfm/reconstruction.json", "OpenSfM's reconstruction.json"),
    "kapture_sensors": ("kapture", "sensors/sensors.txt", "Kapture's sensors.txt"),
    "kapture_trajectories": ("kapture", "sensors/trajectories.txt", "Kapture's trajectories.txt"),
    "scannetpp": ("scannet++", "dslr/nerfstudio/transforms.json", "ScanNet++'s transforms.json"),
    "mvsnet": ("mvsnet", "cams/00000002_cam.txt", "MVSNet's cameras"),
    "idr": ("idr", "cameras_sphere.npz", "cameras_sphere.npz of IDR"),
    "nsvf": ("nsvf", "intrinsics.txt", "intrinsics.txt of NSVF"),
    "tanks": ("tanks and temples", "Barn_COLMAP_SfM.log", "trajectories of Tanks and Temples"),
}
_BY_SUFFIX = {".json": json_text.changed, ".npz": binary.changed_bytes}


def _exported(how: str) -> Callable[..., Path]:
    return lambda folder, made=None: exports.EXPORTS[how][1](folder)[0]


TRANSFORMS = open_file(captures.nerfstudio, "transforms.json")
READERS = (
    Reader("transforms", "transforms.json, three dialects", transforms_seeds, json_text.changed, TRANSFORMS, every=EVERY),
    Reader("poses_bounds", "poses_bounds.npy of LLFF", npy_seeds, npy_changed, open_file(captures.llff, "poses_bounds.npy"), every=EVERY),
    *(
        _reader(f"colmap_{part}_{kind}", f"COLMAP's {part}.{kind}", write, f"sparse/0/{part}.{kind}", changed, 1 / 3)
        for kind, write, changed in (("bin", captures.colmap_bin, binary.changed_bytes), ("txt", captures.colmap_txt, lines.changed))
        for part in ("cameras", "images", "points3D")
    ),
    *(
        _reader(name, what, _exported(how), file, _BY_SUFFIX.get(Path(file).suffix, lines.changed), 0.1)
        for name, (how, file, what) in EXPORTED.items()
    ),
)
