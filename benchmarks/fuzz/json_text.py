"""Mutation of JSON: one or a few values replaced, anywhere in the document; the text itself changed at times."""

import json
import re
from random import Random
from typing import Any

from benchmarks.fuzz.binary import LARGEST, changed_bytes
from benchmarks.fuzz.values import MARK, RAW, TEXTS, hostile, unlike

_MARKED = re.compile(f'"{MARK}(\\d+)@@"')
_TOKENS = b'0123456789-.eE+[]{},:"\\ \n\tntf'


def parsed(data: bytes) -> Any:
    """The document, or None where it is none that mutations can be made of."""
    try:
        return json.loads(data)
    except (ValueError, RecursionError):
        return None


def written(document: Any) -> bytes:
    """The text of a document, marks replaced by what they stand for; lone surrogates as bytes that are no UTF-8 at times."""
    text = _MARKED.sub(lambda found: RAW[int(found[1]) % len(RAW)], json.dumps(document))
    return text.encode("utf-8", "surrogatepass")[:LARGEST]


def changed(rng: Random, data: bytes) -> bytes:
    """The document with one to three changes."""
    document = parsed(data)
    if document is None or not isinstance(document, (dict, list)) or rng.random() < 0.12:
        return changed_bytes(rng, data, _TOKENS)
    for _ in range(1 + (rng.random() < 0.3) + (rng.random() < 0.1)):
        document = with_change(rng, document)
    try:
        return written(document)
    except (RecursionError, ValueError):
        return data


def with_change(rng: Random, root: Any) -> Any:
    """The document with one value replaced by a hostile or a near one, removed, repeated, renamed, or moved. Containers on the way are copied."""
    if not isinstance(root, (dict, list)) or not root or rng.random() < 0.01:
        return hostile(rng)
    root = node = root.copy()
    while True:
        key: Any = rng.choice(list(node)) if isinstance(node, dict) else rng.randrange(len(node))
        if isinstance(node[key], (dict, list)) and node[key] and rng.random() < 0.75:
            node[key] = node[key].copy()
            node = node[key]
            continue
        _change(rng, node, key)
        return root


def _change(rng: Random, node: Any, key: Any) -> None:
    kind = rng.random()
    if kind < 0.5:
        node[key] = hostile(rng)
    elif kind < 0.75:
        node[key] = unlike(rng, node[key])
    elif kind < 0.85:
        del node[key]
    elif isinstance(node, list):
        if kind < 0.95:
            node[key:key] = [node[key]] * rng.choice((1, 2, 50))
        else:
            rng.shuffle(node)
    elif kind < 0.92:
        node[rng.choice(TEXTS)] = node.pop(key)
    else:
        other = rng.choice(list(node))
        node[key], node[other] = node[other], node[key]
