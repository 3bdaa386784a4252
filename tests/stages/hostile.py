"""Hostile inputs of every reader but the asset's (tests/efficientnerf/hostile.py), and the message of each.

tests/data/hostile/READER/FILE was found by `make fuzz` and made smaller; large ones are made here.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.fuzz import safetensors_bytes, scratch
from benchmarks.fuzz.table import READERS

FOLDER = Path(__file__).resolve().parents[1] / "data" / "hostile"
READ = "read"  # what a file that is not a reason to stop is answered with: it only saves time, or tells people something
NUMPY = "not a NumPy array of numbers, or truncated"
NO_PICTURE = "no picture in a format that is read"
FINITE = "expected a finite number"
WHOLE = "is not a whole number"

# reader: {file: words of the message, or READ}
FILES = {
    "blocks": dict.fromkeys(("dtype-empty-tuple.npy", "header-cut-off.npy", "header-longer-than-memory.npy", "shape-with-true.npy", "zip-cut-off.npy"), READ),
    "camera_path": {"fov-of-nothing.json": "expected degrees between 0 and 180"},
    "colmap_cameras_txt": {"superscript-digit.txt": WHOLE, "two-minus-signs.txt": WHOLE},
    "colmap_images_bin": {
        "control-characters-in-name.bin": r"image \\x11S4@.*expected a unit quaternion",
        "name-not-utf8.bin": r"image g\\udcad.*expected a unit quaternion",
    },
    "colmap_images_txt": {"two-minus-signs.txt": WHOLE},
    "colmap_points3D_txt": {"superscript-digit.txt": WHOLE},
    "config": dict.fromkeys(("nested-arrays.toml", "nested-keys.toml", "nested-tables.toml"), "nested|nests too deeply"),
    "images": {"dds.png": NO_PICTURE, "exif-without-directory.jpg": "unreadable", "idat-length-beyond-memory.png": "unreadable"},
    "lock": dict.fromkeys(("host-nul.json", "since-1e30.json", "since-1e38.json", "since-beyond-time_t.json"), READ),
    "log": dict.fromkeys(("a-number.jsonl", "no-step.jsonl", "not-utf8.jsonl", "null.jsonl"), READ),
    "masks": {"bomb.png": "more than 178 million pixels", "exif-without-directory.png": "unreadable: damaged", "idat-length-beyond-memory.png": "unreadable"},
    "options": {"byte-of-no-encoding.txt": "expected a time", "byte-of-no-encoding-in-list.txt": "expected a time"},
    "posed_images": {"dds.png": READ, "exif-without-directory.jpg": READ},  # left out with a warning
    "poses_bounds": dict.fromkeys(
        (
            "dtype-empty-tuple.npy", "header-cut-off.npy", "header-nested.npy", "header-no-literal.npy", "header-null-bytes.npy", "zip-cut-off.npy",
            "zip-damaged.npy",
        ),
        NUMPY,
    )
    | {"shape-with-true.npy": "not finite"},
    "report_bake": {"lone-surrogate-in-name.json": READ},
    "report_evaluate": dict.fromkeys(("psnr-of-400-digits.json", "ssim-of-400-digits.json", "view-of-a-number.json"), READ),
    "report_mesh": {"lone-surrogate.json": READ},
    "report_poses": dict.fromkeys(
        ("error-of-400-digits.json", "lone-surrogate-name.json", "lone-surrogate-warning.json", "registered-number.json", "warnings-infinity.json"), READ
    ),
    "schedule": {"iterations-infinity.json": READ},
    "transforms": {
        "angle-of-nothing.json": "expected an angle",
        "angle-of-400-digits.json": FINITE,
        "camera-model-list.json": "camera_model a list of 0; supported are",
        "camera-model-object.json": "camera_model an object; supported are",
        "cx-of-400-digits.json": FINITE,
        "cy-of-objects.json": "cy is a list of 94, expected a finite number",
        "offset-of-400-digits.json": "expected a positive number and three numbers",
        "scale-of-nothing.json": "expected a positive number and three numbers",
        "width-of-long-list.json": "w is a list of 1, expected a finite number",
    },
}  # fmt: skip
NESTED = {"arrays": b"[" * 100_000, "objects": b'{"a":' * 100_000, "arrays that end": b"[" * 5000 + b"]" * 5000}
JSON = {
    "transforms": "nested too deeply|not valid JSON",
    "camera_path": "nested too deeply|not valid JSON",
    "run": "not valid JSON",
    "manifest": "not valid JSON",
    "scene": "not valid JSON",
}
IGNORED = ("log", "schedule", "note", "lock", "hashes", "report_bake", "report_evaluate", "report_mesh", "report_poses")


def with_entry(reader: str, tensor: str, **changes: Any) -> bytes:
    """The valid file with another header entry of one tensor, digests put right where they can be."""
    header, body = _valid(reader)
    return scratch.with_digest(safetensors_bytes.joined({**header, tensor: {**header[tensor], **changes}}, body))


def with_about(reader: str, text: str | None = None, **changes: Any) -> bytes:
    """The valid field file or checkpoint with another text, or other values, in its metadata."""
    header, body = _valid(reader)
    text = text or json.dumps(json.loads(header["__metadata__"]["field"]) | changes)
    return safetensors_bytes.joined({**header, "__metadata__": {"field": text}}, body)


def _valid(reader: str) -> tuple[dict[str, Any], bytes]:
    found = safetensors_bytes.parts(READERS[reader].seeds()[0])
    assert found is not None
    return found


DEEP = '{"a":' * 900 + "1" + "}" * 900
MADE: dict[tuple[str, str], tuple[Callable[[], bytes], str]] = {
    **{(reader, f"nested {name}"): (lambda data=data: data, says) for name, data in NESTED.items() for reader, says in JSON.items()},  # type: ignore[misc]
    **{(reader, f"nested {name}"): (lambda data=data: data, READ) for name, data in NESTED.items() for reader in IGNORED},  # type: ignore[misc]
    **{(reader, "integer of 5000 digits"): (lambda: b"1" * 5000, says.replace("nested too deeply|", "")) for reader, says in JSON.items()},
    ("checkpoint", "progress of complex numbers"): (lambda: with_entry("checkpoint", "progress", dtype="C64"), READ),
    ("checkpoint", "progress on its side"): (lambda: with_entry("checkpoint", "progress", shape=[2, 1]), READ),
    ("checkpoint", "a table on its side"): (lambda: with_entry("checkpoint", "fine.table", shape=_valid("checkpoint")[0]["fine.table"]["shape"][::-1]), READ),
    ("checkpoint", "a moment of whole numbers"): (lambda: with_entry("checkpoint", "adam.0.fine.table", dtype="I32"), READ),
    ("checkpoint", "a list of seconds"): (lambda: with_about("checkpoint", seconds=[1.5]), READ),
    ("checkpoint", "seconds as a text of infinity"): (lambda: with_about("checkpoint", seconds="1e999"), READ),
    ("checkpoint", "nested metadata"): (lambda: with_about("checkpoint", DEEP), READ),
    ("config", "a table of a long name, twice"): (lambda: (b"[" + b".".join([b"a"] * 300) + b"]\n") * 2, "not valid TOML: .*a"),
    ("field", "nested metadata"): (lambda: with_about("field", DEEP), "field file of format nothing|not a readable field file"),
    ("field", "settings that are no object"): (lambda: with_about("field", settings=[1]), "settings"),
    ("field", "names that are no list"): (lambda: with_about("field", exposed=5), "expected a list of names"),
    ("points", "observers of complex numbers"): (lambda: with_entry("points", "observer_counts", dtype="C64"), "points"),
    ("points", "coordinates in one row"): (lambda: with_entry("points", "xyz", shape=[180]), "points"),
    **{(reader, "nothing"): (lambda: b"", "the file is empty") for reader in JSON},
}  # fmt: skip
