"""Streams of the layout `packed`: bytes of a tensor to a `Coder` and back. FORMAT.md, section 14.

    which table each context has   T (a byte), then pairs of a table and a run length, until every context has one
    the tables                     frequencies of the symbols 0, 1, ... until their sum is 2^14; a 0 is followed by how many more zeros there are
    rANS                           words of 16 bits, the state's upper and lower half first

Numbers are LEB128, but for T and tables, which are bytes.

M symbols, n contexts, T tables.
"""

from __future__ import annotations

import numpy as np

from efficientnerf.asset.file.container import FormatError

MOST_TABLES = 255
PIECE = 2**20  # symbols that are encoded or counted at once
EMPTY = np.zeros((0, 256), np.uint32)

Coder = object  # of `efficientnerf.backends.numba.entropy.rans`, whose import is heavy


def recorder(symbols: int) -> Coder:
    """A coder that records at most so many symbols."""
    from efficientnerf.backends.numba.entropy import rans

    none = np.zeros(0, np.uint8)
    blank = np.zeros((0, rans.SLOTS), np.uint8)
    recorded = np.zeros(symbols, np.uint8), np.zeros(symbols, np.uint16)
    return rans.Coder(False, np.zeros(3, np.int64), none.astype(np.uint16), none, blank, EMPTY, *recorded)


def reader(name: str, tensor: str, raw: np.ndarray, contexts: int) -> Coder:
    """A coder that reads the bytes of a tensor; FormatError where its tables break a rule."""
    from efficientnerf.backends.numba.entropy import rans

    try:
        table, frequency, at = _parsed(raw.tobytes() if len(raw) < 2**16 else raw[: 2**20].tobytes(), contexts, rans.SLOTS)
    except (IndexError, ValueError) as error:
        what = "ends within its tables" if isinstance(error, IndexError) else str(error)
        raise FormatError(f"{name}: '{tensor}' {what}; it is no stream of {contexts} contexts") from None
    if (len(raw) - at) % 2 or len(raw) - at < 4:
        raise FormatError(f"{name}: '{tensor}' has {len(raw) - at} bytes after its tables; expected words of 16 bits, two at least")
    words = np.frombuffer(raw[at:].tobytes(), "<u2").astype(np.uint16)
    symbol, shares = np.zeros((len(frequency), rans.SLOTS), np.uint8), np.zeros((len(frequency), 256), np.uint32)
    rans.fill_slots(frequency, shares, symbol)
    state = np.array([int(words[0]) << 16 | int(words[1]), 2, 0], np.int64)
    if state[0] < rans.LOWEST:
        raise FormatError(f"{name}: '{tensor}' begins with the state {state[0]}; expected {rans.LOWEST} or more")
    return rans.Coder(True, state, words, table, symbol, shares, np.zeros(0, np.uint8), np.zeros(0, np.uint16))


def check(name: str, tensor: str, coder: Coder, *, ended: bool) -> None:
    """FormatError where what was read so far is no stream; with `ended`, where it does not end with its bytes."""
    from efficientnerf.backends.numba.entropy import rans

    assert isinstance(coder, rans.Coder)
    if coder.reads and coder.state[rans.FAILED]:
        raise FormatError(f"{name}: '{tensor}' ends before its last symbol, or holds one that stands for nothing")
    if coder.reads and ended and (coder.state[rans.AT] != len(coder.words) or coder.state[rans.X] != rans.LOWEST):
        raise FormatError(f"{name}: '{tensor}' does not end where its last symbol does")


def _parsed(data: bytes, contexts: int, slots: int) -> tuple[np.ndarray, np.ndarray, int]:
    """Table of each context, frequencies, and where the words begin. IndexError or ValueError where a rule is broken."""
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
    return table, frequency, at


def counts(coder: Coder, contexts: int) -> np.ndarray:
    """How often (n, 256) each symbol of each context was recorded."""
    from efficientnerf.backends.numba.entropy import rans

    assert isinstance(coder, rans.Coder)
    count, out = int(coder.state[rans.AT]), np.zeros((contexts, 256), np.int64)
    for begin in range(0, count, PIECE):
        rans.count_symbols(coder.symbols[begin : min(count, begin + PIECE)], coder.contexts[begin : min(count, begin + PIECE)], out)
    return out


def written(coder: Coder, families: list[tuple[int, int]]) -> np.ndarray:
    """The bytes of the tensor that hold what `coder` recorded.

    families  ranges of contexts, which share tables among themselves alone; together all
    """
    from efficientnerf.backends.numba.entropy import rans

    assert isinstance(coder, rans.Coder)
    count = int(coder.state[rans.AT])
    symbols, contexts = coder.symbols[:count], coder.contexts[:count]
    table, frequency = _tables(counts(coder, families[-1][1]), families)
    symbol, shares = np.zeros((len(frequency), rans.SLOTS), np.uint8), np.zeros((len(frequency), 256), np.uint32)
    rans.fill_slots(frequency, shares, symbol)
    words = np.zeros(count + 2, np.uint16)  # a symbol takes 14 bits at most
    state = np.array([rans.LOWEST, len(words)], np.int64)
    for end in range(count, 0, -PIECE):
        begin = max(0, end - PIECE)
        rans.encode(symbols[begin:end], contexts[begin:end], table, shares, words, state)
    at = int(state[1])
    ends = np.array([state[0] >> 16, state[0] & 0xFFFF], "<u2")
    head = bytes([len(frequency)]) + _runs(table) + b"".join(map(_table, frequency))
    return np.frombuffer(head + ends.tobytes() + words[at:].astype("<u2").tobytes(), np.uint8)


def _tables(counts: np.ndarray, families: list[tuple[int, int]]) -> tuple[np.ndarray, np.ndarray]:
    """The table of each context (n,) uint8, and the frequencies (T, 256) uint32 of each."""
    from efficientnerf.backends.numba.entropy import rans

    table = np.zeros(len(counts), np.uint8)
    rows: list[np.ndarray] = []
    most = max(1, MOST_TABLES // len(families))
    for begin, end in families:
        part = counts[begin:end]
        owner = rans.merge_contexts(part.astype(np.float64), most)
        known = np.unique(owner[part.sum(axis=1) > 0])
        last = len(rows)
        for least in known:
            rows.append(_quantised(part[owner == least].sum(axis=0), rans.SLOTS))
        which = {int(least): last + n for n, least in enumerate(known)}
        for n in range(begin, end):  # contexts that do not occur share the table before theirs, so that runs are long
            last = which.get(int(owner[n - begin]), last)
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
