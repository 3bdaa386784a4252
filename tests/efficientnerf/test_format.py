"""The asset file: FORMAT.md, a reader written from it alone, golden files, and a hostile file for each rule."""

from __future__ import annotations

import hashlib
import json
import math
import re
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from efficientnerf.nerftree import format
from efficientnerf.nerftree.format import FormatError, describe, load, save, serialize
from efficientnerf.nerftree.tree import NerfTree, tree_from_voxels
from tests.efficientnerf.nerftree_reader import Tree
from tests.efficientnerf.trees import random_tree, rays_at

GOLDEN = Path(__file__).parents[1] / "data" / "golden"
SIMILARITY = {"scale": 0.5, "rotation": [[1, 0, 0], [0, 0, 1], [0, -1, 0]], "translation": [1, 2, 3]}
ORBIT = {"centre": [0.0, 0.1, 0.2], "radius": 3.0, "elevation": 25.0, "forward_facing": False, "heading": 40.0}
METADATA = {"world_from_capture": SIMILARITY, "orbit": ORBIT, "metric": True, "licence": "CC0-1.0", "provenance": {"tool": "a test"}}


def tiny(**more: Any) -> NerfTree:
    return random_tree(1, shape=(2, 1, 2), brick=2, degree=0, share=0.7, metadata=METADATA, **more)


def parts(data: bytes) -> tuple[dict[str, Any], dict[str, Any], bytes]:
    """Header without metadata, the metadata, the data."""
    length = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + length])
    return header, json.loads(header.pop("__metadata__")["nerftree"]), data[8 + length :]


def joined(header: dict[str, Any], meta: dict[str, Any] | str, data: bytes) -> bytes:
    text = meta if isinstance(meta, str) else json.dumps(meta)
    raw = json.dumps({"__metadata__": {"nerftree": text}, **header}).encode()
    return len(raw).to_bytes(8, "little") + raw + data


def with_tensor(name: str, values: np.ndarray) -> bytes:
    """The tiny file with one tensor replaced, digest and offsets put right."""
    header, meta, data = parts(serialize(tiny()))
    begin, end = header[name]["data_offsets"]
    raw = values.tobytes()
    for entry in header.values():
        entry["data_offsets"] = [n + len(raw) - (end - begin) if n >= end else n for n in entry["data_offsets"]]
    header[name] = {"dtype": header[name]["dtype"], "shape": list(values.shape), "data_offsets": [begin, begin + len(raw)]}
    meta["sha256"][name] = hashlib.sha256(raw).hexdigest()
    return joined(header, meta, data[:begin] + raw + data[end:])


def tensor(name: str) -> np.ndarray:
    header, _, data = parts(serialize(tiny()))
    begin, end = header[name]["data_offsets"]
    return np.frombuffer(data[begin:end], {"U8": "<u1", "U64": "<u8", "F16": "<f2"}[header[name]["dtype"]]).reshape(header[name]["shape"]).copy()


def refusal(data: bytes, folder: Path) -> str:
    path = folder / "hostile.nerftree"
    path.write_bytes(data)
    with pytest.raises(FormatError) as caught:
        load(path)
    text = str(caught.value)
    assert "hostile.nerftree" in text
    assert len(text) < 400
    assert text.count("\n") <= 1
    return text


# Round trips.


@pytest.mark.parametrize(("brick", "degree"), [(1, 0), (2, 4), (3, 1), (4, 2), (5, 3), (16, 0)])
def test_what_is_saved_is_loaded_and_saved_again_to_the_same_bytes(tmp_path: Path, brick: int, degree: int) -> None:
    tree = random_tree(brick, shape=(2, 1, 2) if brick > 5 else (4, 3, 5), brick=brick, degree=degree, background=(1.0, 0.5, 0.0), metadata=METADATA)
    save(tree, tmp_path / "a.nerftree")
    again = load(tmp_path / "a.nerftree")
    for name in ("brick_index", "voxel_index", "density_values", "sh", "bounds_min"):
        found, wanted = getattr(again, name), getattr(tree, name)
        assert found.dtype == wanted.dtype, name
        assert np.array_equal(found, wanted), name
    for name in ("shape", "brick", "voxel", "background", "metadata", "degree"):
        assert getattr(again, name) == getattr(tree, name), name
    again.save(tmp_path / "b.nerftree")
    assert (tmp_path / "a.nerftree").read_bytes() == (tmp_path / "b.nerftree").read_bytes()
    assert NerfTree.load(tmp_path / "b.nerftree").voxel == tree.voxel
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.nerftree", "b.nerftree"]


def test_bricks_are_written_in_the_order_of_their_cells() -> None:
    """A tree whose bricks and voxels are numbered otherwise is the same tree, and the same file."""
    tree = random_tree(3)
    rng = np.random.default_rng(0)
    bricks, voxels = rng.permutation(len(tree.voxel_index)), rng.permutation(len(tree.density_values))
    back = np.argsort(voxels)
    other = replace(
        tree,
        brick_index=np.where(tree.brick_index >= 0, np.argsort(bricks)[tree.brick_index], -1).astype(np.int32),
        voxel_index=np.where(tree.voxel_index >= 0, back[tree.voxel_index], -1)[bricks].astype(np.int32),
        density_values=tree.density_values[voxels],
        harmonics=tree.sh[voxels],
    )
    points = np.random.default_rng(1).uniform(tree.bounds_min, tree.bounds_max, (100, 3))
    assert np.array_equal(other.density(points), tree.density(points))
    assert serialize(other) == serialize(tree)


def test_an_empty_tree_is_a_file_too(tmp_path: Path) -> None:
    save(tree_from_voxels((2, 3, 1), 0.1, np.zeros(3), np.zeros((0, 3), int), np.zeros(0), np.zeros((0, 4, 3))), tmp_path / "empty.nerftree")
    tree = load(tmp_path / "empty.nerftree")
    assert tree.shape == (2, 3, 1)
    assert not len(tree.density_values)


def test_values_that_a_half_cannot_hold_are_cut(tmp_path: Path) -> None:
    tree = tiny()
    tree.density_values[0], tree.sh[0, 0, 0], tree.sh[1, 0, 0] = 1e9, -1e9, 1e9
    save(tree, tmp_path / "a.nerftree")
    again = load(tmp_path / "a.nerftree")
    assert again.density_values[0] == -again.sh[0, 0, 0] == again.sh[1, 0, 0] == 64992


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.density_values.__setitem__(0, np.nan), r"voxel\.density: holds values that are not finite"),
        (lambda t: t.density_values.__setitem__(0, -1), r"voxel\.density: holds values below zero"),
        (lambda t: t.sh.__setitem__((0, 0, 0), np.inf), r"voxel\.sh: holds values that are not finite"),
        (lambda t: t.metadata.__setitem__("note", math.nan), "metadata can't be written"),
        (lambda t: t.metadata.__setitem__("note", {1, 2}), "metadata can't be written"),
    ],
)
def test_trees_that_make_no_sound_file_are_not_saved(tmp_path: Path, change: Callable[[NerfTree], None], message: str) -> None:
    tree = tiny()
    change(tree)
    with pytest.raises(FormatError, match=message):
        save(tree, tmp_path / "a.nerftree")
    assert not list(tmp_path.iterdir())


def test_a_failed_save_leaves_the_older_file_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.nerftree"
    save(tiny(), path)
    before = path.read_bytes()

    def full(number: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(format.os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        save(random_tree(0), path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.nerftree"]


# The text alone is enough.


@pytest.mark.parametrize(("brick", "degree"), [(2, 1), (4, 3), (5, 4)])
def test_a_reader_written_from_the_text_alone_sees_the_same(tmp_path: Path, brick: int, degree: int) -> None:
    save(random_tree(brick, brick=brick, degree=degree), tmp_path / "a.nerftree")
    ours, theirs = load(tmp_path / "a.nerftree"), Tree(tmp_path / "a.nerftree")
    points = np.random.default_rng(0).uniform(ours.bounds_min - 0.1, ours.bounds_max + 0.1, (100, 3))
    directions = rays_at(ours, 100)[1]
    np.testing.assert_allclose(ours.density(points), [theirs.density(p) for p in points], atol=2e-3)
    np.testing.assert_allclose(ours.colour(points, directions), [theirs.colour(p, d) for p, d in zip(points, directions, strict=True)], atol=1e-3)
    seen = ours.render_rays(*(a[:12] for a in rays_at(ours, 12)))
    for r, (origin, direction) in enumerate(zip(*rays_at(ours, 12), strict=True)):
        colour, opacity = theirs.ray(origin, direction)
        np.testing.assert_allclose(seen.colour[r], colour, atol=1.5e-3)
        assert float(seen.opacity[r]) == pytest.approx(opacity, abs=1.5e-3)


def test_the_text_names_all_that_the_reader_knows() -> None:
    text = (Path(format.__file__).parent / "FORMAT.md").read_text(encoding="utf-8")
    for word in [*format.TENSORS, *format._STRUCTURE, "world_from_capture", "orbit", "metric", f"{format.MAJOR}.{format.MINOR}", f"{format.HEADER_LIMIT:,}"]:
        assert word in text, word


# Golden files: made once, readable for ever.


@pytest.mark.parametrize("path", sorted(GOLDEN.glob("*.nerftree")), ids=lambda path: path.stem)
def test_golden_files_stay_readable(path: Path, tmp_path: Path) -> None:
    known = json.loads((GOLDEN / f"{path.stem}.json").read_text())
    assert path.stat().st_size < 20_000
    assert hashlib.sha256(path.read_bytes()).hexdigest() == known["sha256"]
    tree = load(path)
    points, directions = np.array(known["points"]), np.array(known["directions"])
    np.testing.assert_allclose(tree.density(points), known["density"], atol=1e-3)
    np.testing.assert_allclose(tree.colour(points, directions), known["colour"], atol=1e-4)
    np.testing.assert_allclose(tree.render_rays(points - 3 * directions, directions).opacity, known["opacity"], atol=1.5e-3)
    assert max(known["opacity"]) > 0.5
    about = describe(path)
    assert {key: about[key] for key in known["describe"]} == known["describe"]
    theirs = Tree(path)
    np.testing.assert_allclose([theirs.density(p) for p in points], known["density"], atol=1e-3)


def test_there_are_golden_files() -> None:
    assert {path.stem for path in GOLDEN.glob("*.nerftree")} >= {"sparse-1.0", "wide-1.0"}


def test_golden_files_are_written_to_the_same_bytes(tmp_path: Path) -> None:
    path = GOLDEN / "sparse-1.0.nerftree"
    save(load(path), tmp_path / "a.nerftree")
    assert (tmp_path / "a.nerftree").read_bytes() == path.read_bytes()


def test_describe_reads_the_header_alone(tmp_path: Path) -> None:
    tree = tiny()
    data = serialize(tree)
    path = tmp_path / "a.nerftree"
    path.write_bytes(data[:-1] + bytes([data[-1] ^ 255]))  # damaged beyond the header
    about = describe(path)
    assert about["resolution"] == [4, 2, 4]
    assert about["bytes"] == len(data) == sum(about["bytes_per_part"].values())
    assert about["voxels"] == len(tree.density_values)
    assert about["orbit"] == ORBIT
    assert about["bounds"]["min"] == tree.bounds_min.tolist()
    np.testing.assert_allclose(about["bounds"]["max"], tree.bounds_max)


# Hostile files.


def meta_with(**changes: Any) -> bytes:
    header, meta, data = parts(serialize(tiny()))
    return joined(header, {key: value for key, value in {**meta, **changes}.items() if value != "absent"}, data)


def header_with(name: str, **changes: Any) -> bytes:
    header, meta, data = parts(serialize(tiny()))
    header[name] = {key: value for key, value in {**header[name], **changes}.items() if value != "absent"}
    return joined(header, meta, data)


def replaced(old: bytes, new: bytes) -> bytes:
    """The tiny file with its header text changed; the header's length follows."""
    data = serialize(tiny())
    length = int.from_bytes(data[:8], "little")
    raw = data[8 : 8 + length]
    assert old in raw
    raw = raw.replace(old, new, 1)
    return len(raw).to_bytes(8, "little") + raw + data[8 + length :]


def without(name: str) -> bytes:
    header, meta, data = parts(serialize(tiny()))
    begin, end = header.pop(name)["data_offsets"]
    for entry in header.values():
        entry["data_offsets"] = [n - (end - begin) if n >= end else n for n in entry["data_offsets"]]
    return joined(header, meta, data[:begin] + data[end:])


def added(name: str, dtype: str = "F64") -> bytes:
    header, meta, data = parts(serialize(tiny()))
    header[name] = {"dtype": dtype, "shape": [1], "data_offsets": [len(data), len(data) + 8]}
    return joined(header, meta, data + bytes(8))


def negative(name: str) -> np.ndarray:
    values = tensor(name)
    values.reshape(-1)[0] = -1 if name == "voxel.density" else np.inf
    return values


def nan(name: str) -> np.ndarray:
    values = tensor(name)
    values.reshape(-1)[-1] = np.nan
    return values


def flipped(name: str, bit: int) -> np.ndarray:
    values = tensor(name)
    values.reshape(-1)[-1] ^= np.array(1 << bit).astype(values.dtype)
    return values


def rotated(**changes: Any) -> bytes:
    return meta_with(world_from_capture={**SIMILARITY, **changes})


def orbiting(**changes: Any) -> bytes:
    return meta_with(orbit={**ORBIT, **changes})


HOSTILE: dict[str, tuple[Callable[[], bytes], str]] = {
    # container
    "empty": (lambda: b"", "0 bytes; a NerfTree begins with an 8-byte header length"),
    "header longer than the file": (lambda: (10**6).to_bytes(8, "little") + b"{}", "header of 1000000 bytes in a file of 10"),
    "header longer than anything": (lambda: b"\xff" * 8 + b"{}", "header of 18446744073709551615 bytes"),
    "a PNG": (lambda: b"\x89PNG\r\n\x1a\n" + bytes(100), "no NerfTree"),
    "not JSON": (lambda: (4).to_bytes(8, "little") + b"{]]}", "header is not JSON"),
    "not UTF-8": (lambda: replaced(b'"bounds_min', b'"bounds\xff_min'[1:]), "header is not JSON"),
    "UTF-16": (lambda: (lambda raw: len(raw).to_bytes(8, "little") + raw)("{}".encode("utf-16")), "header is not JSON"),
    "nested deep": (lambda: (lambda raw: len(raw).to_bytes(8, "little") + raw)(b"[" * 200_000), "header is not JSON"),
    "a list": (lambda: (2).to_bytes(8, "little") + b"[]", "header is not a JSON object"),
    "no metadata": (lambda: (2).to_bytes(8, "little") + b"{}", "a safetensors file without 'nerftree' metadata"),
    "metadata is no text": (lambda: (lambda raw: len(raw).to_bytes(8, "little") + raw)(b'{"__metadata__":{"nerftree":3}}'), "without 'nerftree' metadata"),
    "metadata is not JSON": (lambda: joined({}, "{", b""), "header is not JSON"),
    "a key named twice": (lambda: joined({}, '{"format": "nerftree", "format": "nerftree"}', b""), "names a key twice"),
    "NaN in the metadata": (lambda: joined({}, '{"format": NaN}', b""), "NaN, which is no finite number"),
    "an infinite number": (lambda: meta_with(note="x").replace(b'\\"note\\": \\"x\\"', b'\\"note\\": 1e999'), "1e999, which is no finite number"),
    "an entry with more keys": (lambda: header_with("brick.mask", colour="red"), "expected dtype, shape and data_offsets"),
    "an entry with fewer keys": (lambda: header_with("brick.mask", shape="absent"), "expected dtype, shape and data_offsets"),
    "a negative count": (lambda: header_with("brick.mask", shape=[-1, 1]), "is not a list of counts"),
    "a fractional count": (lambda: header_with("brick.mask", shape=[1.5, 1]), "is not a list of counts"),
    "a huge count": (lambda: header_with("brick.mask", shape=[2**60, 1]), "is not a list of counts"),
    "offsets the wrong way": (lambda: header_with("brick.mask", data_offsets=[8, 0]), "are not a range"),
    "offsets beyond the end": (lambda: header_with("brick.mask", data_offsets=[0, 10**9]), "the file is cut short"),
    "too few bytes for the shape": (lambda: header_with("brick.mask", shape=[1000, 1]), "does not fill its"),
    "overlapping tensors": (lambda: overlapping(), "tensors must lie end to end"),
    "a gap": (lambda: without_entry("voxel.density"), "tensors must lie end to end|appended to"),
    "bytes appended": (lambda: serialize(tiny()) + b"\0", "1 bytes after the last tensor; the file was appended to"),
    # metadata
    "another format": (lambda: meta_with(format="octree"), "metadata 'format' is octree; expected nerftree"),
    "version 2": (lambda: meta_with(format_version="2.0"), r"format version 2\.0; this build reads 1\.x\. Upgrade"),
    "no version": (lambda: meta_with(format_version="absent"), "expected MAJOR.MINOR"),
    "a strange version": (lambda: meta_with(format_version="1.٠"), "expected MAJOR.MINOR"),
    "a version that is a number": (lambda: meta_with(format_version=1), "expected MAJOR.MINOR"),
    "another layout": (lambda: meta_with(layout="octree"), "layout octree; this build reads 'sparse'. Upgrade"),
    "other harmonics": (lambda: meta_with(sh_convention="complex"), "harmonics complex"),
    "another colour space": (lambda: meta_with(colour_space="linear"), "expected real-orthonormal-plenoctree in srgb-sigmoid"),
    "no shape": (lambda: meta_with(shape="absent"), "'shape' is None; expected 3 numbers"),
    "a shape of two": (lambda: meta_with(shape=[2, 2]), "expected 3 numbers"),
    "a fractional shape": (lambda: meta_with(shape=[2, 1, 2.5]), "expected whole numbers"),
    "a shape of nothing": (lambda: meta_with(shape=[0, 1, 2]), "expected 3 numbers from 1"),
    "a shape too large": (lambda: meta_with(shape=[65536, 65536, 65536]), "a product of at most 1073741824"),
    "a shape of true": (lambda: meta_with(shape=[True, 1, 2]), "expected 3 numbers"),
    "brick 0": (lambda: meta_with(brick=0), "'brick' is 0; expected a whole number from 1 to 16"),
    "brick 17": (lambda: meta_with(brick=17), "expected a whole number from 1 to 16"),
    "degree 5": (lambda: meta_with(sh_degree=5), "expected a whole number from 0 to 4"),
    "degree true": (lambda: meta_with(sh_degree=True), "expected a whole number from 0 to 4"),
    "no voxel": (lambda: meta_with(voxel=0), "'voxel' is 0"),
    "a voxel of text": (lambda: meta_with(voxel="1"), "'voxel' is 1; expected a number"),
    "no corner": (lambda: meta_with(bounds_min=[0, 0]), "'bounds_min'"),
    "a corner far away": (lambda: meta_with(bounds_min=[0, 0, 10**400]), "'bounds_min'"),
    "no background": (lambda: meta_with(background="absent"), "'background' is missing"),
    "a bright background": (lambda: meta_with(background=[1, 1, 2]), "expected 3 numbers from 0 to 1"),
    "a similarity of text": (lambda: meta_with(world_from_capture="identity"), "'world_from_capture' is identity; expected an object"),
    "a similarity without scale": (lambda: meta_with(world_from_capture={}), "'scale' is None"),
    "a scale of zero": (lambda: rotated(scale=0), "'scale' is 0"),
    "a rotation of two rows": (lambda: rotated(rotation=[[1, 0, 0], [0, 1, 0]]), "expected three rows"),
    "a rotation of short rows": (lambda: rotated(rotation=[[1, 0], [0, 1, 0], [0, 0, 1]]), "expected 3 numbers"),
    "a reflection": (lambda: rotated(rotation=[[1, 0, 0], [0, 1, 0], [0, 0, -1]]), "is not a rotation"),
    "a shear": (lambda: rotated(rotation=[[1, 0.1, 0], [0, 1, 0], [0, 0, 1]]), "is not a rotation"),
    "a translation of text": (lambda: rotated(translation="0 0 0"), "'translation'"),
    "an orbit of text": (lambda: meta_with(orbit="round"), "'orbit' is round; expected an object"),
    "an orbit without centre": (lambda: meta_with(orbit={"radius": 1}), "'centre' is None"),
    "an orbit of no radius": (lambda: orbiting(radius=0), "'radius' is 0"),
    "an orbit below the ground": (lambda: orbiting(elevation=-91), "'elevation' is -91"),
    "an orbit that winds": (lambda: orbiting(heading=1e9), "'heading'"),
    "an orbit facing 1": (lambda: orbiting(forward_facing=1), "'forward_facing' is 1; expected true or false"),
    "metric 1": (lambda: meta_with(metric=1), "'metric' is 1; expected true or false"),
    # tensors
    "a tensor of another name": (lambda: added("voxel.roughness"), r"unknown tensor 'voxel\.roughness'; only names that begin with 'x\.'"),
    **{f"no {name}": (lambda name=name: without(name), f"tensor '{re.escape(name)}' is missing") for name in format.TENSORS},  # type: ignore[misc]
    "densities of integers": (lambda: header_with("voxel.density", dtype="I16"), "is I16; expected F16"),
    "a dtype of another world": (lambda: header_with("voxel.density", dtype=["F16"]), "expected F16"),
    "too few cells": (lambda: with_tensor("coarse.occupancy", np.zeros(0, "<u1")), r"has shape \(0,\); expected \(1,\)"),
    "masks of two words": (lambda: with_tensor("brick.mask", np.zeros((3, 2), "<u8")), r"'brick\.mask' has shape \(3, 2\)"),
    "fewer harmonics than densities": (lambda: with_tensor("voxel.sh", tensor("voxel.sh")[:-1]), r"'voxel\.sh' has shape"),
    "harmonics of another degree": (lambda: meta_with(sh_degree=1), r"'voxel\.sh' has shape"),
    "densities in a table": (lambda: with_tensor("voxel.density", tensor("voxel.density")[:, None]), r"'voxel\.density' has shape"),
    "a wrong digest": (lambda: meta_with(sha256=dict.fromkeys(format.TENSORS, "0" * 64)), "SHA-256 .* the file says 0{12}…; the file is damaged"),
    "no digests": (lambda: meta_with(sha256="absent"), "the file is damaged"),
    "a cell beyond the last": (lambda: with_tensor("coarse.occupancy", flipped("coarse.occupancy", 7)), "bits set beyond its 4 cells"),
    "a brick without a cell": (lambda: with_tensor("coarse.occupancy", np.zeros(1, "<u1")), "0 occupied cells but"),
    "a voxel beyond the brick": (lambda: with_tensor("brick.mask", flipped("brick.mask", 8)), "bits set beyond the 8 voxels of a brick"),
    "a voxel more than stored": (lambda: with_tensor("brick.mask", tensor("brick.mask") * np.uint64(0)), "masks name 0 voxels but"),
    "a density below zero": (lambda: with_tensor("voxel.density", negative("voxel.density")), "densities must be finite and not negative"),
    "a density that is no number": (lambda: with_tensor("voxel.density", nan("voxel.density")), "densities must be finite"),
    "an infinite harmonic": (lambda: with_tensor("voxel.sh", negative("voxel.sh")), "harmonics finite"),
}


def padded(data: bytes) -> bytes:
    end = 8 + int.from_bytes(data[:8], "little")
    return (end - 8 + 5).to_bytes(8, "little") + data[8:end] + b"     " + data[end:]


def overlapping() -> bytes:
    header, meta, data = parts(serialize(tiny()))
    header["x.a"] = {"dtype": "F64", "shape": [1], "data_offsets": [0, 8]}
    return joined(header, meta, data)


def without_entry(name: str) -> bytes:
    header, meta, data = parts(serialize(tiny()))
    del header[name]
    return joined(header, meta, data)


@pytest.mark.parametrize("which", HOSTILE)
def test_hostile_files_are_refused(which: str, tmp_path: Path) -> None:
    make, message = HOSTILE[which]
    text = refusal(make(), tmp_path)
    assert re.search(message, text), text


def test_what_may_be_there_may_be_there(tmp_path: Path) -> None:
    for bytes_ in (
        added("x.roughness"),
        meta_with(format_version="1.7", mood="good"),
        meta_with(world_from_capture="absent", orbit="absent", metric="absent", licence="absent", provenance="absent"),
        padded(serialize(tiny())),
    ):
        path = tmp_path / "a.nerftree"
        path.write_bytes(bytes_)
        assert np.array_equal(load(path).density_values, tiny().density_values)


def test_a_file_cut_short_anywhere_is_refused(tmp_path: Path) -> None:
    data = serialize(tiny())
    for length in range(len(data)):
        refusal(data[:length], tmp_path)


def test_any_flipped_bit_of_the_data_is_noticed(tmp_path: Path) -> None:
    data = serialize(tiny())
    for at in range(8 + int.from_bytes(data[:8], "little"), len(data)):
        refusal(data[:at] + bytes([data[at] ^ 1 << at % 8]) + data[at + 1 :], tmp_path)


def test_no_file_and_a_folder(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"absent\.nerftree: can't be read \(No such file"):
        load(tmp_path / "absent.nerftree")
    with pytest.raises(FormatError, match="can't be read"):
        load(tmp_path)


def test_huge_claims_allocate_nothing(tmp_path: Path) -> None:
    header, meta, data = parts(serialize(tiny()))
    claims = [
        joined(header, {**meta, "shape": [1024, 1024, 1024]}, data),
        header_with("voxel.sh", shape=[2**40, 1, 3]),
        header_with("brick.mask", shape=[2**40, 1]),
        header_with("voxel.density", dtype="X", shape=[2**47] * 8),
        (2**24).to_bytes(8, "little") + b"{}",
    ]
    refusal(claims[0], tmp_path)
    tracemalloc.start()
    for claim in claims:
        refusal(claim, tmp_path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**20


def outcome(path: Path, data: bytes) -> NerfTree | None:
    path.write_bytes(data)
    try:
        tree = load(path)
    except FormatError:
        tree = None
    try:
        describe(path)
    except FormatError:
        assert tree is None
    return tree


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], derandomize=True)
@given(changes=st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.binary(min_size=0, max_size=3)), min_size=1, max_size=4))
def test_a_header_of_noise_raises_nothing_else(tmp_path: Path, changes: list[tuple[float, bytes]]) -> None:
    data = serialize(tiny())
    end = 8 + int.from_bytes(data[:8], "little")
    for share, noise in changes:
        at = int(share * end)
        data = data[:at] + noise + data[at + len(noise) :]
    outcome(tmp_path / "a.nerftree", data)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], derandomize=True)
@given(key=st.sampled_from([*sorted(format._STRUCTURE), "world_from_capture", "orbit", "metric"]), value=JSON)
def test_any_value_of_any_key_raises_nothing_else(tmp_path: Path, key: str, value: Any) -> None:
    outcome(tmp_path / "a.nerftree", meta_with(**{key: value}))


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], derandomize=True)
@given(name=st.sampled_from(sorted(format.TENSORS)), key=st.sampled_from(["dtype", "shape", "data_offsets"]), value=JSON)
def test_any_value_of_any_entry_raises_nothing_else(tmp_path: Path, name: str, key: str, value: Any) -> None:
    outcome(tmp_path / "a.nerftree", header_with(name, **{key: value}))
