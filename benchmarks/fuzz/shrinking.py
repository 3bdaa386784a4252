"""Smaller inputs with the same finding."""

import copy
import json
import time
from collections.abc import Callable, Iterator
from typing import Any

from benchmarks.fuzz.json_text import parsed


def shrunk(data: bytes, fails: Callable[[bytes], bool], seconds: float) -> bytes:
    """The input with parts removed for as long as it still fails, for at most so many seconds: of JSON members and items, of anything runs of bytes."""
    end = time.monotonic() + seconds
    document = parsed(data)
    if isinstance(document, (dict, list)) and len(data) < 2**17:
        data = _shrunk_document(document, data, fails, end)
    size = max(len(data) // 2, 1)
    while size and time.monotonic() < end:
        at = 0
        while at < len(data) and time.monotonic() < end:
            candidate = data[:at] + data[at + size :]
            if fails(candidate):
                data = candidate
            else:
                at += size
        size //= 2
    return data


def _shrunk_document(document: Any, data: bytes, fails: Callable[[bytes], bool], end: float) -> bytes:
    smaller = True
    while smaller and time.monotonic() < end:
        smaller = False
        for path in list(_paths(document)):
            candidate = copy.deepcopy(document)
            node = candidate
            try:
                for key in path[:-1]:
                    node = node[key]
                del node[path[-1]]
                text = json.dumps(candidate).encode()
            except (KeyError, IndexError, TypeError, ValueError):
                continue
            if time.monotonic() > end:
                break
            if len(text) < len(data) and fails(text):
                document, data, smaller = candidate, text, True
    return data


def _paths(node: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Every place in a document, the large ones first; items of a list from the last."""
    entries: list[tuple[Any, Any]] = list(node.items()) if isinstance(node, dict) else list(enumerate(node))[::-1] if isinstance(node, list) else []
    for key, _ in entries:
        yield (*path, key)
    for key, value in entries:
        yield from _paths(value, (*path, key))
