"""The asset file: FORMAT.md, a reader written from it alone, golden files, and a hostile file for each rule."""

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

from efficientnerf.asset import format
from efficientnerf.asset.cascades import cascades_of
from efficientnerf.asset.file import container
from efficientnerf.asset.file.metadata import STRUCTURE
from efficientnerf.asset.format import LAYOUTS, FormatError, describe, load, save, serialize
from efficientnerf.asset.queries import colour_at, density_at
from efficientnerf.asset.rendering import render_rays
from efficientnerf.asset.tree import NerfTree, Region
from tests.efficientnerf import nerftree_reader, packed_reader
from tests.efficientnerf.damaged import METADATA, NESTED, ORBIT, added, blob, header_with, joined, meta_with, padded, parts, tiny
from tests.efficientnerf.hostile import HOSTILE
from tests.efficientnerf.nerftree_reader import Tree
from tests.efficientnerf.tree_reference import render_reference
from tests.efficientnerf.trees import random_cascades, random_tree, rays_at, tensors

GOLDEN = Path(__file__).parents[2] / "data" / "golden"


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


@pytest.mark.parametrize(("brick", "degree"), [(1, 0), (2, 4), (5, 3), (16, 0)])
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
    format.save(again, tmp_path / "b.nerftree")
    assert (tmp_path / "a.nerftree").read_bytes() == (tmp_path / "b.nerftree").read_bytes()
    assert format.load(tmp_path / "b.nerftree").voxel == tree.voxel
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.nerftree", "b.nerftree"]


def test_bricks_are_written_in_the_order_of_their_cells() -> None:
    """A tree whose bricks, those of its region too, and voxels are numbered otherwise is the same tree, and the same file."""
    rng, made = np.random.default_rng(0), random_tree(3)
    tree = replace(made, region=Region(np.stack([made.bounds_min, made.bounds_max]), bricks=rng.random(len(made.voxel_index)) < 0.5))
    bricks, voxels = rng.permutation(len(tree.voxel_index)), rng.permutation(len(tree.density_values))
    back = np.argsort(voxels)
    other = replace(
        tree,
        brick_index=np.where(tree.brick_index >= 0, np.argsort(bricks)[tree.brick_index], -1).astype(np.int32),
        voxel_index=np.where(tree.voxel_index >= 0, back[tree.voxel_index], -1)[bricks].astype(np.int32),
        density_values=tree.density_values[voxels],
        harmonics=tree.sh[voxels],
        region=replace(tree.region, bricks=tree.region.bricks[bricks]),  # type: ignore[type-var, index, union-attr]
    )
    points = np.random.default_rng(1).uniform(tree.bounds_min, tree.bounds_max, (100, 3))
    assert np.array_equal(density_at(other, points), density_at(tree, points))
    assert serialize(other) == serialize(tree)


def test_values_that_a_half_cannot_hold_are_cut(tmp_path: Path) -> None:
    tree = tiny()
    tree.density_values[0], tree.sh[0, 0, 0], tree.sh[1, 0, 0] = 1e9, -1e9, 1e9
    save(tree, tmp_path / "a.nerftree")
    again = load(tmp_path / "a.nerftree")
    assert again.density_values[0] == -again.sh[0, 0, 0] == again.sh[1, 0, 0] == 64992


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda t: t.density_values.__setitem__(0, np.nan), r"voxel\.density"),
        (lambda t: t.density_values.__setitem__(0, -1), r"voxel\.density"),
        (lambda t: t.sh.__setitem__((0, 0, 0), np.inf), r"voxel\.sh"),
        (lambda t: t.metadata.__setitem__("note", math.nan), "metadata"),
        (lambda t: t.metadata.__setitem__("note", {1, 2}), "metadata"),
    ],
)
def test_trees_that_make_no_sound_file_are_not_saved(tmp_path: Path, change: Callable[[NerfTree], None], named: str) -> None:
    tree = tiny()
    change(tree)
    with pytest.raises(FormatError, match=named):
        save(tree, tmp_path / "a.nerftree")
    assert not list(tmp_path.iterdir())


def test_a_failed_save_leaves_the_older_file_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.nerftree"
    save(tiny(), path)
    before = path.read_bytes()

    def full(number: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(container.os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        save(random_tree(0), path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.nerftree"]


# The text alone is enough.


@pytest.mark.parametrize(("brick", "degree"), [(4, 3), (5, 4)])
def test_a_reader_written_from_the_text_alone_sees_the_same(tmp_path: Path, brick: int, degree: int) -> None:
    save(random_tree(brick, brick=brick, degree=degree, step_size=1.0 if brick == 4 else 0.5), tmp_path / "a.nerftree")
    ours, theirs = load(tmp_path / "a.nerftree"), Tree(tmp_path / "a.nerftree")
    points = np.random.default_rng(0).uniform(ours.bounds_min - 0.1, ours.bounds_max + 0.1, (100, 3))
    directions = rays_at(ours, 100)[1]
    np.testing.assert_allclose(density_at(ours, points), [theirs.density(p) for p in points], atol=2e-3)
    np.testing.assert_allclose(colour_at(ours, points, directions), [theirs.colour(p, d) for p, d in zip(points, directions, strict=True)], atol=1e-3)
    seen = render_rays(ours, *(a[:12] for a in rays_at(ours, 12)))
    for r, (origin, direction) in enumerate(zip(*rays_at(ours, 12), strict=True)):
        colour, opacity = theirs.ray(origin, direction)
        np.testing.assert_allclose(seen.colour[r], colour, atol=1.5e-3)
        assert float(seen.opacity[r]) == pytest.approx(opacity, abs=1.5e-3)


@pytest.mark.parametrize("lookup", ["trilinear", "nearest"])
def test_a_reader_written_from_the_text_alone_sees_the_same_whole_scene(tmp_path: Path, lookup: str) -> None:
    save(random_cascades(3, brick=2, degree=2, lookup=lookup), tmp_path / "a.nerftree")
    ours, theirs = load(tmp_path / "a.nerftree"), Tree(tmp_path / "a.nerftree")
    low, high = ours.outer[-1].bounds(ours.brick)
    points, directions = np.random.default_rng(0).uniform(low, high, (150, 3)), rays_at(ours, 150)[1]
    points[:40] = np.random.default_rng(1).uniform(ours.bounds_min, ours.bounds_max, (40, 3))
    np.testing.assert_allclose(density_at(ours, points), [theirs.density(p) for p in points], atol=2e-3)
    assert not density_at(ours, points + 2 * (high - low)).any()
    np.testing.assert_allclose(colour_at(ours, points, directions), [theirs.colour(p, d) for p, d in zip(points, directions, strict=True)], atol=1e-3)
    origins, directions = rays_at(ours, 30)
    for r, (seen, opacity) in enumerate(zip(*render_reference(ours, *tensors(origins, directions)), strict=True)):
        expected, full = theirs.ray(origins[r], directions[r])
        np.testing.assert_allclose(seen, expected, atol=1e-5)
        assert float(opacity) == pytest.approx(full, abs=1e-5)


# Golden files: made once, readable for ever.


@pytest.mark.parametrize("path", sorted(GOLDEN.glob("*.nerftree")), ids=lambda path: path.stem)
def test_golden_files_stay_readable(path: Path, tmp_path: Path) -> None:
    known = json.loads((GOLDEN / f"{path.stem}.json").read_text())
    assert path.stat().st_size < 20_000
    assert hashlib.sha256(path.read_bytes()).hexdigest() == known["sha256"]
    tree = load(path)
    points, directions = np.array(known["points"]), np.array(known["directions"])
    np.testing.assert_allclose(density_at(tree, points), known["density"], atol=1e-3)
    np.testing.assert_allclose(colour_at(tree, points, directions), known["colour"], atol=1e-4)
    rendered, opacity = render_reference(tree, *tensors(points - 3 * directions, directions))
    np.testing.assert_allclose(opacity, known["opacity"], atol=1.5e-3)
    if "rendered" in known:
        np.testing.assert_allclose(rendered, known["rendered"], atol=1.5e-3)
    drawn = render_rays(tree, points - 3 * directions, directions)
    np.testing.assert_allclose(drawn.opacity, known["opacity"], atol=1.5e-3)
    if "rendered" in known:
        np.testing.assert_allclose(drawn.colour, known["rendered"], atol=1.5e-3)
    assert max(known["opacity"]) > 0.5
    about = describe(path)
    assert {key: about[key] for key in known["describe"]} == known["describe"]
    if tree.ndc is not None:
        return  # the short reader stays in the frame of the grid
    theirs = Tree(path)
    np.testing.assert_allclose([theirs.density(p) for p in points], known["density"], atol=1e-3)
    np.testing.assert_allclose([theirs.colour(p, d) for p, d in zip(points, directions, strict=True)], known["colour"], atol=1e-4)


@pytest.mark.parametrize("path", sorted(GOLDEN.glob("*.nerftree")), ids=lambda path: path.stem)
def test_a_reader_of_the_text_alone_decodes_golden_files_alike(path: Path) -> None:
    ours, theirs = load(path), Tree(path)
    for reader, lines in ((nerftree_reader, 150), (packed_reader, 150)):
        text = Path(reader.__file__).read_text()
        assert len(text.splitlines()) <= lines
        assert "efficientnerf" not in re.sub('""".*?"""', "", text, flags=re.S).replace("tests.efficientnerf.packed_reader", "")
    for cascade, grid in zip(cascades_of(ours), theirs.grids, strict=True):
        assert [tuple(cell) for cell in np.argwhere(cascade.brick_index >= 0)] == grid.occupied
        assert (cascade.voxel, cascade.bounds_min.tolist()) == (grid.voxel, grid.low.tolist())
        number = {}
        for cell in grid.occupied:
            for v, local in enumerate(np.ndindex(*(ours.brick,) * 3)):
                if (voxel := ours.voxel_index[cascade.brick_index[cell], v]) >= 0:
                    number[tuple(c * ours.brick + p for c, p in zip(cell, local, strict=True))] = voxel
        assert number == grid.stored
    assert np.array_equal(ours.density_values, theirs.densities.astype(np.float32))
    assert np.array_equal(ours.sh, theirs.sh.astype(np.float32))
    assert (ours.environment is None) == (theirs.environment is None)
    assert ours.environment is None or np.array_equal(ours.environment, theirs.environment.astype(np.float32))
    bricks = None if ours.region is None or ours.region.bricks is None else ours.region.bricks.tolist()
    assert bricks == theirs.region


def test_there_is_a_golden_file_for_each_layout_and_released_version() -> None:
    found = {(about["layout"], about["format_version"]) for about in map(describe, GOLDEN.glob("*.nerftree"))}
    released = {("sparse", "1.0"), ("compact", "1.1"), ("full", "1.1"), ("ndc-compact", "1.2"), ("nearest-compact", "1.3")}
    assert found == {*released, ("nested-compact", "1.4"), ("sparse", "1.4"), ("packed", "1.5"), ("nested-packed", "1.5"), ("sparse", "1.6")}
    assert {layout.removeprefix("nearest-").removeprefix("ndc-").removeprefix("nested-") for layout, _ in found} == set(LAYOUTS)


@pytest.mark.parametrize(
    ("stem", "layout"),
    [
        ("sparse-1.0", None),
        ("compact-1.1", None),
        ("compact-1.1", "compact"),
        ("groups-1.1", None),
        ("ndc-1.2", None),
        ("nearest-1.3", None),
        ("nested-1.4", None),
        ("nested-1.4", "compact"),
        ("region-1.4", None),
        ("packed-1.5", "packed"),
        ("nested-packed-1.5", "packed"),
        ("step-1.6", None),
        ("full-1.1", "full"),
        ("floats-1.1", "full32"),
    ],
)
def test_golden_files_are_written_to_the_same_bytes(tmp_path: Path, stem: str, layout: str | None) -> None:
    save(load(GOLDEN / f"{stem}.nerftree"), tmp_path / "a.nerftree", layout)
    assert (tmp_path / "a.nerftree").read_bytes() == (GOLDEN / f"{stem}.nerftree").read_bytes()


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


@pytest.mark.parametrize("of", [*LAYOUTS, *NESTED])
def test_a_file_cut_short_anywhere_is_refused(tmp_path: Path, of: str) -> None:
    data = blob(of)
    for length in range(len(data)):
        refusal(data[:length], tmp_path)


@pytest.mark.parametrize("of", [*LAYOUTS, *NESTED])
def test_any_flipped_bit_of_the_data_is_noticed(tmp_path: Path, of: str) -> None:
    data = blob(of)
    for at in range(8 + int.from_bytes(data[:8], "little"), len(data)):
        refusal(data[:at] + bytes([data[at] ^ 1 << at % 8]) + data[at + 1 :], tmp_path)


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


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], derandomize=True)
@given(
    of=st.sampled_from(sorted([*LAYOUTS, *NESTED])),
    changes=st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.binary(min_size=0, max_size=3)), min_size=1, max_size=4),
)
def test_a_header_of_noise_raises_nothing_else(tmp_path: Path, of: str, changes: list[tuple[float, bytes]]) -> None:
    data = blob(of)
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


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], derandomize=True)
@given(of=st.sampled_from(sorted([*LAYOUTS, *NESTED])), key=st.sampled_from([*sorted(STRUCTURE), "world_from_capture", "orbit", "metric"]), value=JSON)
def test_any_value_of_any_key_raises_nothing_else(tmp_path: Path, of: str, key: str, value: Any) -> None:
    outcome(tmp_path / "a.nerftree", meta_with(of, **{key: value}))


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], derandomize=True)
@given(of=st.sampled_from(sorted([*LAYOUTS, *NESTED])), which=st.integers(0, 11), key=st.sampled_from(["dtype", "shape", "data_offsets"]), value=JSON)
def test_any_value_of_any_entry_raises_nothing_else(tmp_path: Path, of: str, which: int, key: str, value: Any) -> None:
    names = list(parts(blob(of))[0])
    outcome(tmp_path / "a.nerftree", header_with(names[which % len(names)], of, **{key: value}))
