"""The layout `packed`: what `compact` holds, in fewer bytes, without loss; rANS and its tables."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from efficientnerf.asset.file import packed, streams
from efficientnerf.asset.file.container import Header
from efficientnerf.asset.file.streams import Family
from efficientnerf.asset.format import contents, describe, load, save, serialize
from efficientnerf.asset.palettes import PaletteHarmonics
from efficientnerf.asset.quantisation import compacted
from efficientnerf.asset.tree import NerfTree, tree_from_voxels
from efficientnerf.backends.numba.entropy import rans, walks
from efficientnerf.backends.numba.runtime import numba
from tests.efficientnerf.nerftree_reader import Tree
from tests.efficientnerf.trees import LOW, TREES, random_cascades, random_tree


def held(path: Path) -> tuple[dict[str, np.ndarray], dict[str, object]]:
    """All tensors of a file, and its metadata but for the digests."""
    header = Header(path)
    return {name: header.read(name) for name in header.tensors}, {key: value for key, value in header.meta.items() if key != "sha256"}


def shell(size: int = 24, degree: int = 2) -> NerfTree:
    """A coloured ball's surface, values of which vary smoothly: as a baked scene's do."""
    at = np.argwhere(np.abs(np.linalg.norm(np.mgrid[:size, :size, :size].reshape(3, -1).T.reshape(size, size, size, 3) - size / 2, axis=-1) - size / 3) < 1.5)
    wave = np.sin(at @ np.random.default_rng(0).normal(size=(3, 3 * (degree + 1) ** 2)) * 0.15).reshape(len(at), -1, 3)
    wave[:, 1:] *= 0.3
    return tree_from_voxels((size // 4,) * 3, 0.05, LOW, at, 20 + 10 * wave[:, 0, 0], wave.astype(np.float32), background=(1.0, 1.0, 1.0))


@pytest.mark.parametrize(("brick", "degree"), [*TREES, (16, 1)])
@pytest.mark.parametrize("entries", [1, 7, 256, 300])
def test_compact_packed_and_compact_again_is_the_same_file(tmp_path: Path, brick: int, degree: int, entries: int) -> None:
    groups = tuple([1] * ((degree + 1) ** 2 - 1)) if entries <= 256 else ((degree + 1) ** 2 - 1,) * bool(degree)
    tree = compacted(random_tree(brick, shape=(2, 1, 2) if brick > 5 else (4, 3, 5), brick=brick, degree=degree), entries, groups)
    save(tree, tmp_path / "a.nerftree")
    save(load(tmp_path / "a.nerftree"), tmp_path / "p.nerftree", "packed")
    save(load(tmp_path / "p.nerftree"), tmp_path / "b.nerftree")
    (first, before), (second, after) = held(tmp_path / "a.nerftree"), held(tmp_path / "b.nerftree")
    assert before == after
    assert set(first) == set(second)
    for name, values in first.items():
        assert (values.dtype, values.shape) == (second[name].dtype, second[name].shape), name
        assert np.array_equal(values, second[name]), name
    assert (tmp_path / "a.nerftree").read_bytes() == (tmp_path / "b.nerftree").read_bytes()


def test_a_whole_scene_and_normalised_device_coordinates_are_packed_without_loss(tmp_path: Path) -> None:
    scene = random_cascades(4, count=3, brick=2, degree=2)
    nearest = replace(random_tree(3, degree=2), lookup="nearest")
    for tree in (scene, nearest):
        save(tree, tmp_path / "a.nerftree", "compact")
        coded = load(tmp_path / "a.nerftree")
        save(coded, tmp_path / "p.nerftree", "packed")
        save(load(tmp_path / "p.nerftree"), tmp_path / "b.nerftree", "compact")
        assert (tmp_path / "a.nerftree").read_bytes() == (tmp_path / "b.nerftree").read_bytes()


def test_an_empty_tree_is_packed_too(tmp_path: Path) -> None:
    save(tree_from_voxels((2, 3, 1), 0.1, np.zeros(3), np.zeros((0, 3), int), np.zeros(0), np.zeros((0, 4, 3))), tmp_path / "p.nerftree", "packed")
    assert load(tmp_path / "p.nerftree").shape == (2, 3, 1)
    assert describe(tmp_path / "p.nerftree")["voxels"] == 0


def test_a_smooth_surface_takes_less(tmp_path: Path) -> None:
    tree = compacted(shell())
    save(tree, tmp_path / "a.nerftree")
    save(tree, tmp_path / "p.nerftree", "packed")
    plain, coded = describe(tmp_path / "a.nerftree"), describe(tmp_path / "p.nerftree")
    assert (coded["layout"], coded["format_version"]) == ("packed", "1.5")
    assert all(coded[key] == plain[key] for key in ("voxels", "bricks", "palette", "sh_groups"))
    streams_of = sum(size for name, size in coded["bytes_per_part"].items() if name.startswith("packed."))
    codes = sum(size for name, size in plain["bytes_per_part"].items() if name.startswith(("voxel.", "brick.", "coarse.")))
    assert streams_of < 0.8 * codes  # of which tables are a quarter
    assert coded["bytes_per_voxel"] == round(streams_of / coded["voxels"], 2)


def test_a_golden_file_of_slices_is_written_to_the_same_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    path = Path(__file__).parents[2] / "data" / "golden" / "slices-1.5.nerftree"
    assert contents(path)[0]["packed"]["slice_bricks"] < describe(path)["bricks"] / 2
    assert serialize(load(path), "packed") != path.read_bytes()
    monkeypatch.setattr(packed, "SLICE_VOXELS", 64)
    assert serialize(load(path), "packed") == path.read_bytes()


def test_codes_that_neighbours_share_cost_nearly_nothing() -> None:
    tree = compacted(shell())
    assert isinstance(tree.harmonics, PaletteHarmonics)
    same = replace(tree, harmonics=replace(tree.harmonics, codes=np.full_like(tree.harmonics.codes, 5)))
    assert len(serialize(tree, "packed")) - len(serialize(same, "packed")) > 0.5 * len(tree.density_values)


# Streams


@settings(max_examples=60, deadline=None, derandomize=True)
@given(data=st.binary(max_size=300), contexts=st.integers(1, 9), spread=st.integers(1, 256), slices=st.integers(1, 5))
def test_any_symbols_of_any_contexts_are_read_as_they_were_written(data: bytes, contexts: int, spread: int, slices: int) -> None:
    symbols = np.frombuffer(data, np.uint8) % spread if spread < 256 else np.frombuffer(data, np.uint8)
    which = (np.arange(len(symbols)) ** 2 % contexts).astype(np.uint16)
    cuts = np.sort(np.arange(slices + 1) * 7 % (len(symbols) + 1))
    cuts[0], cuts[-1] = 0, len(symbols)
    families = [Family(contexts // 2, 1, 256), Family(contexts, 0, 256)] if contexts > 1 else [Family(contexts)]
    raw = streams.written(recorded(symbols, which, cuts), families)
    again = streams.reader("file", "stream", raw, families, slices)
    found: list[int] = []
    for part, (begin, end) in enumerate(itertools.pairwise(cuts.tolist())):
        found += [decoded(again, part, context, int(contexts > 1 and context < contexts // 2)) for context in which[begin:end].tolist()]
    assert found == symbols.tolist()
    streams.check("file", "stream", again)


def recorded(symbols: np.ndarray, which: np.ndarray, cuts: np.ndarray) -> object:
    """A coder that has recorded these symbols of these contexts, in slices that begin at `cuts`."""
    coder = streams.recorder((np.diff(cuts) + 3).tolist())
    assert isinstance(coder, rans.Coder)
    for part, (begin, end) in enumerate(itertools.pairwise(cuts.tolist())):
        place = slice(int(coder.at[part]), int(coder.at[part]) + end - begin)
        coder.symbols[place], coder.contexts[place] = symbols[begin:end], which[begin:end]
        coder.at[part] = place.stop
    return coder


def decoded(coder: object, part: int, context: int, lane: int) -> int:
    """One symbol by FORMAT.md, in Python."""
    assert isinstance(coder, rans.Coder)
    x, row = int(coder.state[part, lane]), int(coder.table[context])
    slot = x % rans.SLOTS
    symbol = int(coder.symbol[row, slot])
    share = int(coder.shares[row, symbol])
    x = (share & 0xFFFF) * (x >> rans.BITS) + slot - (share >> 16)
    if x < rans.LOWEST:
        x = x << 16 | int(coder.words[coder.at[part]])
        coder.at[part] += 1
    coder.state[part, lane] = x
    return symbol


def test_bytes_are_near_the_entropy() -> None:
    """Of 20,000 symbols in two contexts of opposite skew: tables and state included, within 2 % of what the counts allow."""
    rng = np.random.default_rng(0)
    which = rng.integers(0, 2, 20_000).astype(np.uint16)
    symbols = np.where(which == 1, 20 - rng.geometric(0.4, 20_000).clip(1, 20), rng.geometric(0.3, 20_000).clip(1, 20)).astype(np.uint8)
    coder = recorded(symbols, which, np.array([0, len(symbols)]))
    counts = np.zeros((2, 256))
    np.add.at(counts, (which, symbols), 1)
    share = counts / counts.sum(axis=1, keepdims=True)
    entropy = -(counts[counts > 0] * np.log2(share[counts > 0])).sum() / 8
    assert entropy <= len(streams.written(coder, [Family(2)])) <= 1.02 * entropy + 16


def test_contexts_that_are_alike_share_a_table_and_others_do_not() -> None:
    counts = np.zeros((4, 256))
    counts[0, :2] = counts[2, :2] = 900, 100
    counts[1, :2] = 100, 900
    assert rans.merge_contexts(counts, 255).tolist() == [0, 1, 0, 3]


@pytest.mark.parametrize("counts", [[1], [1] * 256, [10**9, 1], [1, 0, 0, 10**6, 3], [0] * 5])
def test_frequencies_have_the_sum_of_a_table_and_leave_out_nothing(counts: list[int]) -> None:
    padded = np.array(counts + [0] * (256 - len(counts)), np.int64)
    found = streams._quantised(padded, rans.SLOTS)
    assert found.sum() == rans.SLOTS
    assert ((found > 0) >= (padded > 0)).all()
    assert (found[1:] > 0).sum() == (padded[1:] > 0).sum()


@pytest.mark.parametrize("each", [1, 7, 1000])
def test_neighbours_are_those_one_step_back(each: int) -> None:
    """By a dense grid: across bricks, but not across slices or the edge of the grid."""
    from efficientnerf.asset.cascades import voxel_coordinates
    from efficientnerf.asset.file.packed import _bricks_before, padded

    tree = random_tree(2, brick=3)
    stored = tree.voxel_index >= 0
    before = _bricks_before([padded(tree.brick_index >= 0)], len(stored), each)
    found = np.full((len(tree.density_values), 3), -7, np.int32)
    walks.find_neighbours(tree.voxel_index, before, tree.brick, found, 0, len(stored))
    brick = np.zeros(len(tree.density_values), int)
    brick[tree.voxel_index[stored]] = np.nonzero(stored)[0]
    number = {(brick[n] // each, *at): n for n, at in enumerate(voxel_coordinates(tree).tolist())}
    for n, at in enumerate(voxel_coordinates(tree).tolist()):
        steps = [(brick[n] // each, *(a - (axis == i) for i, a in enumerate(at))) for axis in range(3)]
        assert found[n].tolist() == [number.get(step, -1) for step in steps]


@pytest.mark.parametrize("most", [1, 9, 40])
@pytest.mark.parametrize("wide", [False, True])
def test_slices_of_any_size_hold_the_same_on_any_number_of_threads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, most: int, wide: bool) -> None:
    tree = compacted(random_cascades(4, count=2, brick=2, degree=2), 300 if wide else 256, (8,) if wide else None)
    save(tree, tmp_path / "a.nerftree")
    monkeypatch.setattr(packed, "SLICE_VOXELS", most)
    data = serialize(tree, "packed")
    (tmp_path / "p.nerftree").write_bytes(data)
    about = describe(tmp_path / "p.nerftree")
    slices = -(-about["bricks"] // contents(tmp_path / "p.nerftree")[0]["packed"]["slice_bricks"])
    assert 1 < slices <= about["voxels"] // most
    theirs = Tree(tmp_path / "p.nerftree")
    threads = numba.get_num_threads()
    try:
        for count in {1, numba.config.NUMBA_NUM_THREADS}:
            numba.set_num_threads(count)
            assert serialize(tree, "packed") == data
            again = load(tmp_path / "p.nerftree")
            save(again, tmp_path / "b.nerftree")
            assert (tmp_path / "a.nerftree").read_bytes() == (tmp_path / "b.nerftree").read_bytes()
    finally:
        numba.set_num_threads(threads)
    assert np.array_equal(theirs.densities.astype(np.float32), again.density_values)
    assert np.array_equal(theirs.sh.astype(np.float32), again.sh)
