"""XML files of anybody, read with the parser of the standard library (expat) within bounds.

A document type is refused before it can define an entity, so that none expands and nothing outside is named; size, depth and number of elements are bounded.
"""

from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from pipeline.errors import BadInput
from pipeline.text import printable
from stages.formats.importers.texts import read_bytes

MAX_BYTES = 128 << 20  # bytes; Metashape writes about a kilobyte a photograph
MAX_ELEMENTS = 4_000_000
MAX_DEPTH = 64
_REMEDY = "Export it again."


def read_xml(path: Path, limit: int = MAX_BYTES) -> Element:
    """The outermost element of a file; names with a namespace are "{namespace}name", as ElementTree has them. Raises BadInput."""
    data = read_bytes(path, limit)
    builder = TreeBuilder()
    parser = expat.ParserCreate(namespace_separator="}")
    count = depth = 0

    def refuse(what: str) -> BadInput:
        return BadInput(f"{path}: {what}. {_REMEDY}")

    def start(name: str, attributes: dict[str, str]) -> None:
        nonlocal count, depth
        count, depth = count + 1, depth + 1
        if count > MAX_ELEMENTS or depth > MAX_DEPTH:
            raise refuse(f"more than {MAX_ELEMENTS} elements, or more than {MAX_DEPTH} within each other")
        builder.start(_name(name), {_name(key): value for key, value in attributes.items()})

    def end(name: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(_name(name))

    def doctype(*_: Any) -> None:
        raise refuse("holds a document type; XML with entities is not read")

    parser.StartElementHandler, parser.EndElementHandler, parser.CharacterDataHandler = start, end, builder.data
    parser.StartDoctypeDeclHandler = doctype
    try:
        parser.Parse(data, True)
        return builder.close()
    except (expat.ExpatError, ValueError, LookupError, AssertionError) as error:  # of an encoding that is none, too
        raise refuse(f"not valid XML ({printable(error, 100)})") from None


def _name(name: str) -> str:
    return "{" + name if "}" in name else name
