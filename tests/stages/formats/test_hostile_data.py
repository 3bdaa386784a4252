"""Lists of cameras from anybody: numbers of 400 digits, values of other types, deep nesting and lying headers are refused with one short line."""

import json
import struct
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from efficientnerf.geometry.cameras import Similarity
from pipeline.errors import BadInput
from stages.formats import importers
from stages.formats.importers.description import describe_source
from stages.io.camera_path import read_camera_path
from tests.stages import captures
from tests.stages.captures import Settings

SAME = Similarity(1.0, np.eye(3), np.zeros(3))
LONG = 10**400
DEEP = "[" * 900 + "]" * 900
HOSTILE: dict[str, str] = {  # as JSON texts
    "an integer of 400 digits": str(LONG),
    "beyond all floats": "1e999",
    "the least of all floats": "5e-324",
    "a list": "[]",
    "a deep list": DEEP,
    "a large list": "[" + ",".join(["1e30"] * 5000) + "]",
    "an object": "{}",
    "half a surrogate pair": '"\\ud800"',
    "a terminal escape": '"\\u001b[2J\\n"',
    "a long text": '"' + "x" * 100_000 + '"',
    "true": "true",
    "null": "null",
}
PLACES = {
    "nerfstudio": ["w", "h", "fl_x", "fl_y", "cx", "k1", "camera_model", "ply_file_path", "applied_transform", "train_filenames", "orientation_override"],
    "instant-ngp": ["aabb_scale", "scale", "offset", "camera_angle_x", "is_fisheye"],
}
IN_FRAMES = ["file_path", "transform_matrix", "mask_path", "fl_x", "k4", "transform_matrix_start"]


def assert_read_or_refused(read: Callable[[], Any]) -> None:
    """That something is read, or refused with one line that may be shown."""
    text = "read"
    try:
        read()
    except BadInput as error:
        text = str(error)
    assert text.isprintable()
    assert 0 < len(text) < 1000


def with_text(document: Any, place: str, text: str) -> str:
    """The document as JSON, `place` given as a JSON text."""
    return json.dumps(document | {place: "HERE"}).replace('"HERE"', text)


@pytest.mark.parametrize("what", HOSTILE)
@pytest.mark.parametrize("kind", PLACES)
def test_hostile_values_in_transforms(tmp_path: Path, kind: str, what: str) -> None:
    source = captures.WRITERS[kind][1](tmp_path / "source")
    file = next(path for path in sorted(source.glob("*.json")))
    document = json.loads(file.read_text())
    texts = [with_text(document, place, HOSTILE[what]) for place in PLACES[kind]]
    for place in IN_FRAMES:
        frame = with_text(document["frames"][0], place, HOSTILE[what])
        texts.append(json.dumps(document | {"frames": ["FRAME", *document["frames"][1:]]}).replace('"FRAME"', frame))
    matrix = with_text(document["frames"][0], "transform_matrix", f"[[{HOSTILE[what]},0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]")
    texts.append(json.dumps(document | {"frames": ["FRAME", *document["frames"][1:]]}).replace('"FRAME"', matrix))
    for text in texts:
        file.write_text(text)
        assert_read_or_refused(lambda: importers.files(source, Settings()))
        assert_read_or_refused(lambda: json.dumps(describe_source(source), allow_nan=False))


def test_what_a_list_names_is_searched_for_in_bounded_time(tmp_path: Path) -> None:
    source = captures.nerfstudio(tmp_path / "source")
    document = json.loads((source / "transforms.json").read_text())
    names = ["a/" * 100_000 + "b.png", "\\".join(["a"] * 2000), "/" + "a/" * 2000 + "b.png"] * 20
    document["frames"] += [{**document["frames"][0], "file_path": name} for name in names]
    (source / "transforms.json").write_text(json.dumps(document))
    capture = importers.IMPORTERS["nerfstudio"].read(source, Settings())
    assert len(capture.rejected) == len(names)
    assert max(len(name) for name, _ in capture.rejected) <= 200


@pytest.mark.parametrize("what", HOSTILE)
def test_hostile_values_in_camera_paths(tmp_path: Path, what: str) -> None:
    camera = {"camera_to_world": np.eye(4).ravel().tolist(), "fov": 50.0}
    document = {"camera_type": "perspective", "render_width": 32, "render_height": 24, "fps": 24, "camera_path": [camera]}
    path = tmp_path / "camera_path.json"
    texts = [with_text(document, place, HOSTILE[what]) for place in document]
    for place in camera:
        texts.append(json.dumps(document | {"camera_path": ["CAMERA"]}).replace('"CAMERA"', with_text(camera, place, HOSTILE[what])))
    texts.append(json.dumps(document).replace("1.0", HOSTILE[what], 1))
    for text in texts:
        path.write_text(text)
        assert_read_or_refused(lambda: read_camera_path(path, SAME))


# --- poses_bounds.npy


def npy(header: str, data: bytes = b"") -> bytes:
    text = header.encode().ljust(118) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + data


@pytest.mark.parametrize(
    "data",
    [
        npy("{'descr': '<f8', 'fortran_order': False, 'shape': (100000000, 17)}"),
        npy("{'descr': '<f8', 'fortran_order': False, 'shape': (10000000000000000000000, 17)}"),
        npy("{'descr': '<f8', 'fortran_order': False, 'shape': (-6, 17)}", b"\0" * 816),
        npy("{'descr': '|O', 'fortran_order': False, 'shape': (6, 17)}", b"cos\nsystem\n(S'true'\ntR." * 40),
        npy("{'descr': [('a', '<f8', (1000000000,))], 'fortran_order': False, 'shape': (6, 17)}"),
        npy("{'descr': '<f8', 'fortran_order': False, 'shape': ((((6, 17))))"),
        npy("{'descr': '<f8', 'fortran_order': False, 'shape': (True, 17)}", b"\0" * 100),
        npy("{'descr': (), 'fortran_order': False, 'shape': (6, 17)}", b"\0" * 816),
        npy("(" * 100),
        b"PK\x03\x04" + b"\0" * 100,
        b"\x80\x04\x95" + b"\0" * 100,
        b"\x93NUMPY\x09\x00" + b"\0" * 100,
        b"\x93NUMPY\x02\x00\xff\xff\xff\xff" + b"(" * 200,
    ],
)
def test_the_header_of_poses_bounds_is_not_believed(tmp_path: Path, data: bytes) -> None:
    source = captures.llff(tmp_path / "source")
    (source / "poses_bounds.npy").write_bytes(data)
    tracemalloc.start()
    try:
        with pytest.raises(BadInput, match=r"poses_bounds\.npy") as caught:
            importers.files(source, Settings())
        assert tracemalloc.get_traced_memory()[1] < 64 << 20
    finally:
        tracemalloc.stop()
    assert str(caught.value).isprintable()


def test_other_types_and_orders_of_poses_bounds_are_read(tmp_path: Path) -> None:
    from stages.formats.importers.llff import read_rows

    rows = captures.llff_rows(captures.cameras())
    for array in (rows.astype("<f4"), rows.astype(">f8"), np.asfortranarray(rows), rows.astype(np.float16)):
        np.save(tmp_path / "a.npy", array)
        np.testing.assert_array_equal(read_rows(tmp_path / "a.npy"), array.astype(np.float64))


# --- COLMAP


@pytest.mark.parametrize("word", ["²", "1" * 5000, "-", "1e3"])
@pytest.mark.parametrize("name", ["cameras.txt", "images.txt", "points3D.txt"])
def test_numbers_in_colmap_texts(tmp_path: Path, name: str, word: str) -> None:
    source = captures.colmap_txt(tmp_path / "source")
    path = source / "sparse/0" / name
    lines = path.read_text().splitlines()
    first = next(index for index, line in enumerate(lines) if not line.startswith("#"))
    for number in range(len(lines[first].split())):
        words = lines[first].split()
        words[number] = word
        path.write_text("\n".join([*lines[:first], " ".join(words), *lines[first + 1 :]]) + "\n")
        assert_read_or_refused(lambda: importers.IMPORTERS["colmap"].read(source, Settings()))
    path.write_text("\n".join([f"# Number of {name[:6]}: {word}", *lines[first:]]) + "\n")
    assert_read_or_refused(lambda: importers.IMPORTERS["colmap"].read(source, Settings()))
