"""Streams of the layout `packed`: bytes of a tensor to a `Coder` and back. FORMAT.md, section 14.

    which table each context has   T (a byte), then pairs of a table and a run length, until every context has one
    the tables                     frequencies of the symbols 0, 1, ... until their sum is 2^14; a 0 is followed by how many more zeros there are
    the slices                     how many words each has
    rANS                           words of 16 bits, slice by slice; a slice's begin with the upper and lower half of each lane's state

Numbers are LEB128; T and tables are bytes.

M symbols, n contexts, T tables, S slices, L lanes.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from efficientnerf.asset.file.container import FormatError
from efficientnerf.backends.numba.entropy import rans

MOST_TABLES = 255
MOST_SLICES = 4096
MOST_HEAD = 2**20  # bytes, more than those of 255 tables and 4096 slices
PIECE = 2**20  # symbols that are encoded or counted at once
EMPTY = np.zeros((0, 256), np.uint32)

Coder = object  # of `efficientnerf.backends.numba.entropy.rans`, whose import is heavy


class Family(NamedTuple):
    """Contexts of a stream up to `end`, from where the family before ends; they share tables among themselves alone."""

    end: int
    lane: int = 0  # which state codes them
    symbols: int = 256  # how many a table may have


def _ranges(families: Sequence[Family]) -> Iterator[tuple[slice, Family]]:
    begin = 0
    for family in families:
        yield slice(begin, family.end), family
        begin = family.end


def _lanes(families: Sequence[Family]) -> int:
    return 1 + max(family.lane for family in families)


def recorder(most: Sequence[int]) -> Coder:
    """A coder that records at most so many symbols of each slice."""
    ends = np.cumsum([0, *most], dtype=np.int64)
    blank = np.zeros((0, rans.SLOTS), np.uint8)
    state, failed = np.zeros((len(most), 1), np.int64), np.zeros(len(most), np.int64)
    none = np.zeros(0, np.uint8)
    recorded = np.zeros(int(ends[-1]), np.uint8), np.zeros(int(ends[-1]), np.uint16)
    return rans.Coder(False, state, ends[:-1].copy(), ends[:-1].copy(), failed, none.astype(np.uint16), none, blank, EMPTY, *recorded)


def reader(name: str, tensor: str, raw: np.ndarray, families: Sequence[Family], slices: int) -> Coder:
    """A coder that reads the bytes of a tensor; FormatError where its tables break a rule."""
    contexts, lanes = families[-1].end, _lanes(families)
    try:
        table, frequency, sizes, at = _parsed(raw[:MOST_HEAD].tobytes(), contexts, rans.SLOTS, slices)
    except (IndexError, ValueError) as error:
        what = "ends within its tables" if isinstance(error, IndexError) else str(error)
        raise FormatError(f"{name}: '{tensor}' {what}; it is no stream of {contexts} contexts and {slices} slices") from None
    for part, family in _ranges(families):
        if frequency[np.unique(table[part]), family.symbols :].any():
            raise FormatError(f"{name}: '{tensor}' has a table of symbols above {family.symbols - 1} for one of the contexts {part.start} to {part.stop - 1}")
    for number, size in enumerate(sizes):
        if size < 2 * lanes:
            raise FormatError(f"{name}: slice {number} of '{tensor}' has {size} words; expected {2 * lanes} at least")
    if 2 * sum(sizes) != len(raw) - at:
        raise FormatError(f"{name}: '{tensor}' has {len(raw) - at} bytes after its tables; expected {2 * sum(sizes)}, the words of its slices")
    words = np.append(np.frombuffer(raw[at:].tobytes(), "<u2").astype(np.uint16), np.uint16(0))
    symbol, shares = np.zeros((len(frequency), rans.SLOTS), np.uint8), np.zeros((len(frequency), 256), np.uint32)
    rans.fill_slots(frequency, shares, symbol)
    ends = np.cumsum([0, *sizes], dtype=np.int64)
    first = words[ends[:-1, None] + np.arange(2 * lanes)].astype(np.int64).reshape(slices, lanes, 2)
    state = first[:, :, 0] << 16 | first[:, :, 1]
    if state.min() < rans.LOWEST:
        raise FormatError(f"{name}: '{tensor}' begins with the state {state.min()}; expected {rans.LOWEST} or more")
    none = np.zeros(0, np.uint8), np.zeros(0, np.uint16)
    return rans.Coder(True, state, ends[:-1] + 2 * lanes, ends[1:].copy(), np.zeros(slices, np.int64), words, table, symbol, shares, *none)


def check(name: str, tensor: str, coder: Coder) -> None:
    """FormatError where what was read is no stream, or does not end with its bytes."""
    assert isinstance(coder, rans.Coder)
    if not coder.reads:
        return
    if coder.failed.any():
        what = "ends before its last symbol, or holds one that stands for nothing"
        raise FormatError(f"{name}: slice {int(np.argmax(coder.failed != 0))} of '{tensor}' {what}")
    if not_at_its_end := np.flatnonzero((coder.at != coder.end) | (coder.state != rans.LOWEST).any(axis=1)).tolist():
        raise FormatError(f"{name}: slice {not_at_its_end[0]} of '{tensor}' does not end where its last symbol does")


def _parsed(data: bytes, contexts: int, slots: int, slices: int) -> tuple[np.ndarray, np.ndarray, list[int], int]:
    """Table of each context, frequencies, words of each slice, and where the words begin. IndexError or ValueError where a rule is broken."""
    at = 1
    tables = data[0]
    if tables == 0:
        raise ValueError("has no table")

    def number() -> int:
        nonlocal at
        value = shift = 0
        while True:
            byte = data[at]
            at += 1
            value |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                return value
            if shift > 21:
                raise ValueError("holds a number of more than four bytes")

    table = np.zeros(contexts, np.uint8)
    reached = 0
    while reached < contexts:
        which = data[at]
        at += 1
        run = number()
        if which >= tables or not 1 <= run <= contexts - reached:
            raise ValueError(f"gives {run} contexts the table {which} of {tables}")
        table[reached : reached + run] = which
        reached += run
    frequency = np.zeros((tables, 256), np.uint32)
    for row in frequency:
        symbol = total = 0
        while total < slots:
            if symbol > 255:
                raise ValueError(f"has a table whose sum is {total}, not {slots}")
            value = number()
            if value == 0:
                symbol += number()
            else:
                row[symbol] = value
            total += value
            symbol += 1
        if total != slots:
            raise ValueError(f"has a table whose sum is {total}, not {slots}")
    sizes = [number() for _ in range(slices)]
    return table, frequency, sizes, at


def counts(coder: Coder, contexts: int) -> np.ndarray:
    """How often (n, 256) each symbol of each context was recorded."""
    assert isinstance(coder, rans.Coder)
    out = np.zeros((contexts, 256), np.int64)
    for first, last in zip(coder.end.tolist(), coder.at.tolist(), strict=True):
        for begin in range(first, last, PIECE):
            part = slice(begin, min(last, begin + PIECE))
            rans.count_symbols(coder.symbols[part], coder.contexts[part], out)
    return out


def written(coder: Coder, families: Sequence[Family]) -> np.ndarray:
    """The bytes of the tensor that hold what `coder` recorded."""
    assert isinstance(coder, rans.Coder)
    begin, end, slices, lanes = coder.end, coder.at, len(coder.at), _lanes(families)
    table, frequency = _tables(counts(coder, families[-1].end), families)
    symbol, shares = np.zeros((len(frequency), rans.SLOTS), np.uint8), np.zeros((len(frequency), 256), np.uint32)
    rans.fill_slots(frequency, shares, symbol)
    lane = np.zeros(len(table), np.uint8)
    for part, family in _ranges(families):
        lane[part] = family.lane
    room = np.cumsum([0, *(end - begin + 2 * lanes)])  # a symbol takes a word at most
    words, at, state = np.zeros(int(room[-1]), np.uint16), room[1:].copy(), np.full((slices, lanes), rans.LOWEST, np.int64)
    each = max(1, PIECE // slices)
    for done in range(0, int((end - begin).max()), each):
        rans.encode(coder.symbols, coder.contexts, lane, table, shares, words, begin, end, at, state, done, each)
    at -= 2 * lanes
    words[at[:, None] + np.arange(2 * lanes)] = np.stack([state >> 16, state & 0xFFFF], axis=-1).reshape(slices, 2 * lanes)
    sizes = (room[1:] - at).tolist()
    if max(sizes) >= 2**28:
        raise FormatError(f"a slice of {max(sizes)} words can't be saved; expected fewer than {2**28}")
    head = bytes([len(frequency)]) + _runs(table) + b"".join(map(_table, frequency)) + b"".join(map(_leb128, sizes))
    return np.frombuffer(b"".join([head, *(words[a:b].astype("<u2").tobytes() for a, b in zip(at, room[1:], strict=True))]), np.uint8)


def _tables(counts: np.ndarray, families: Sequence[Family]) -> tuple[np.ndarray, np.ndarray]:
    """The table of each context (n,) uint8, and the frequencies (T, 256) uint32 of each."""
    table = np.zeros(len(counts), np.uint8)
    rows: list[np.ndarray] = []
    most = max(1, MOST_TABLES // len(families))
    for contexts, _ in _ranges(families):
        part = counts[contexts]
        owner = rans.merge_contexts(part.astype(np.float64), most)
        known = np.unique(owner[part.sum(axis=1) > 0])
        last = len(rows)
        for least in known:
            rows.append(_quantised(part[owner == least].sum(axis=0), rans.SLOTS))
        which = {int(least): last + n for n, least in enumerate(known)}
        for n in range(contexts.start, contexts.stop):  # contexts that do not occur share the table before theirs, so that runs are long
            last = which.get(int(owner[n - contexts.start]), last)
            table[n] = min(last, max(len(rows) - 1, 0))
    if not rows:
        rows.append(_quantised(np.zeros(256, np.int64), rans.SLOTS))
    return table, np.array(rows, np.uint32)


def _quantised(counts: np.ndarray, slots: int) -> np.ndarray:
    """Frequencies (256,) of the sum `slots`, at least 1 where a symbol occurs, nearly in proportion to these counts."""
    if not counts.any():
        counts = np.eye(1, 256, dtype=np.int64)[0]
    share = counts / counts.sum() * slots
    out = np.where(counts > 0, np.maximum(1, np.floor(share)), 0).astype(np.int64)
    while (over := int(out.sum()) - slots) != 0:
        # Take where the loss is least, give where the gain is greatest.
        worth = np.where(counts > 0, counts / np.maximum(out, 1), -1.0)
        if over < 0:
            out[int(np.argmax(worth))] += min(-over, max(1, -over // 4))
        else:
            cost = np.where(out > 1, counts / np.maximum(out - 1, 1), np.inf)
            out[int(np.argmin(cost))] -= 1
    return out


def _leb128(value: int) -> bytes:
    out = bytearray()
    while value > 127:
        out.append(128 | value & 127)
        value >>= 7
    return bytes([*out, value])


def _runs(table: np.ndarray) -> bytes:
    """Tables of the contexts as pairs of a table and a run length."""
    starts = np.flatnonzero(np.concatenate([[True], table[1:] != table[:-1]]))
    lengths = np.diff(np.append(starts, len(table)))
    return b"".join(bytes([int(table[start])]) + _leb128(int(length)) for start, length in zip(starts, lengths, strict=True))


def _table(frequency: np.ndarray) -> bytes:
    """Frequencies up to the last that is not 0."""
    out, symbol = bytearray(), 0
    last = int(np.flatnonzero(frequency)[-1])
    while symbol <= last:
        value = int(frequency[symbol])
        out += _leb128(value)
        symbol += 1
        if value == 0:
            zeros = int(np.argmax(frequency[symbol:] > 0))
            out += _leb128(zeros)
            symbol += zeros
    return bytes(out)
