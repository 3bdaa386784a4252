"""The layout `packed`: what `compact` holds, in fewer bytes, without loss; rANS and its tables."""

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
from efficientnerf.asset.quantisation import compacted
from efficientnerf.backends.numba.entropy import rans
from efficientnerf.backends.numba.runtime import numba
from tests.efficientnerf.nerftree_reader import Tree
from tests.efficientnerf.threads import on_threads
from tests.efficientnerf.trees import TREES, random_cascades, random_tree


def held(path: Path) -> tuple[dict[str, np.ndarray], dict[str, object]]:
    """All tensors of a file, and its metadata but for the digests."""
    header = Header(path)
    return {name: header.read(name) for name in header.tensors}, {key: value for key, value in header.meta.items() if key != "sha256"}


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


def test_whole_scenes_and_ndc_are_packed_without_loss(tmp_path: Path) -> None:
    scene = random_cascades(4, count=3, brick=2, degree=2)
    nearest = replace(random_tree(3, degree=2), lookup="nearest")
    for tree in (scene, nearest):
        save(tree, tmp_path / "a.nerftree", "compact")
        coded = load(tmp_path / "a.nerftree")
        save(coded, tmp_path / "p.nerftree", "packed")
        save(load(tmp_path / "p.nerftree"), tmp_path / "b.nerftree", "compact")
        assert (tmp_path / "a.nerftree").read_bytes() == (tmp_path / "b.nerftree").read_bytes()


def test_a_golden_file_of_slices_is_written_to_the_same_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    path = Path(__file__).parents[2] / "data" / "golden" / "slices-1.5.nerftree"
    assert contents(path)[0]["packed"]["slice_bricks"] < describe(path)["bricks"] / 2
    assert serialize(load(path), "packed") != path.read_bytes()
    monkeypatch.setattr(packed, "SLICE_VOXELS", 64)
    assert serialize(load(path), "packed") == path.read_bytes()


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


@pytest.mark.parametrize("counts", [[1], [1] * 256, [10**9, 1], [1, 0, 0, 10**6, 3], [0] * 5])
def test_frequencies_have_the_sum_of_a_table_and_leave_out_nothing(counts: list[int]) -> None:
    padded = np.array(counts + [0] * (256 - len(counts)), np.int64)
    found = streams._quantised(padded, rans.SLOTS)
    assert found.sum() == rans.SLOTS
    assert ((found > 0) >= (padded > 0)).all()
    assert (found[1:] > 0).sum() == (padded[1:] > 0).sum()


@pytest.mark.parametrize(("most", "wide"), [(1, False), (9, True), (40, False)])
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
    for count in {1, numba.config.NUMBA_NUM_THREADS}:
        with on_threads(count):
            assert serialize(tree, "packed") == data
            again = load(tmp_path / "p.nerftree")
            save(again, tmp_path / "b.nerftree")
            assert (tmp_path / "a.nerftree").read_bytes() == (tmp_path / "b.nerftree").read_bytes()
    assert np.array_equal(theirs.densities.astype(np.float32), again.density_values)
    assert np.array_equal(theirs.sh.astype(np.float32), again.sh)
