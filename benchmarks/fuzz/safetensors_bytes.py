"""Mutation of safetensors files: the header's JSON, its metadata, the tensors; digests in the metadata are put right."""

import contextlib
import json
from collections.abc import Callable
from random import Random
from typing import Any

from benchmarks.fuzz import json_text
from benchmarks.fuzz.binary import changed_bytes
from benchmarks.fuzz.values import hostile

_FLOATS = [b"\0\0\xc0\x7f", b"\0\0\x80\x7f", b"\0\0\x80\xff", b"\xff\xff\x7f\x7f", b"\0\0\0\0"]  # nan, inf, -inf, the largest, 0


def parts(data: bytes) -> tuple[dict[str, Any], bytes] | None:
    """The header and the data."""
    length = int.from_bytes(data[:8], "little")
    header = json_text.parsed(data[8 : 8 + length]) if length < 2**24 else None
    return (header, data[8 + length :]) if isinstance(header, dict) else None


def joined(header: Any, body: bytes) -> bytes:
    raw = json.dumps(header).encode("utf-8", "surrogatepass")
    raw += b" " * (-len(raw) % 8)
    return len(raw).to_bytes(8, "little") + raw + body


def changed(rng: Random, data: bytes) -> bytes:
    """Bytes; the header; numbers of a tensor; or a tensor under another name, of another type or of another shape that fits its bytes."""
    found = parts(data)
    kind = rng.random()
    if found is None or kind < 0.15:
        return changed_bytes(rng, data)
    header, body = found
    with contextlib.suppress(ValueError, RecursionError, TypeError, KeyError, AttributeError):
        if kind < 0.3:
            return joined(json_text.with_change(rng, header), body)
        if kind < 0.5:
            return changed_bytes(rng, data, begin=len(data) - len(body))
        if kind < 0.75:
            return joined(_reshaped(rng, header), body)
        out = bytearray(body)
        for _ in range(1 + rng.randrange(3)):
            at = 4 * rng.randrange(max(len(out) // 4, 1))
            out[at : at + 4] = rng.choice(_FLOATS)
        return joined(header, bytes(out))
    return data


def _reshaped(rng: Random, header: dict[str, Any]) -> dict[str, Any]:
    names = [name for name in header if name != "__metadata__"]
    if not names:
        return header
    name = rng.choice(names)
    entry = dict(header[name])
    count = 1
    for side in entry["shape"]:
        count *= side
    what = rng.randrange(5)
    if what == 0:
        entry["shape"] = rng.choice(([count], [1, count], [count, 1], [count // 2, 2], [], [0], [2**40, 0]))
    elif what == 1:
        entry["dtype"] = rng.choice(("F64", "F32", "F16", "BF16", "I64", "I32", "U8", "BOOL", "U64", "F8_E4M3", "C64"))
    elif what == 2:
        entry["data_offsets"] = [rng.choice((0, 8, entry["data_offsets"][0])), rng.choice((0, entry["data_offsets"][1], 2**40))]
    elif what == 3:
        return {("x" if key == name else key): value for key, value in header.items()}
    else:
        return {key: value for key, value in header.items() if key != name}
    return {**header, name: entry}


def restated(data: bytes, metadata: Callable[[dict[str, Any], bytes], dict[str, str]]) -> bytes:
    """The file with the metadata that a function gives of its header and its data, such as with right digests; unchanged where it raises."""
    found = parts(data)
    if found is None:
        return data
    with contextlib.suppress(Exception):
        return joined({**found[0], "__metadata__": metadata(*found)}, found[1])
    return data


def with_metadata(rng: Random, data: bytes, key: str) -> bytes:
    """The file with one value of the JSON text in its metadata changed."""
    found = parts(data)
    if found is None:
        return data
    header, body = found
    with contextlib.suppress(ValueError, RecursionError, TypeError, KeyError):
        about = json.loads(header["__metadata__"][key])
        about = json_text.with_change(rng, about) if rng.random() < 0.9 else hostile(rng)
        return joined({**header, "__metadata__": {key: json_text.written(about).decode("utf-8", "replace")}}, body)
    return data
