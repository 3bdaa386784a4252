"""Text that comes from files, as it may be shown: a name, a licence, a lock's command may hold terminal escapes, line ends, or bytes of no encoding.

All that a stranger wrote goes through `printable` where it enters a message; every line goes through it once more on its way to a terminal.
"""

import difflib
from collections.abc import Sequence


def printable(text: object, limit: int | None = None) -> str:
    """`text` with every character that is no letter, mark, number, punctuation, symbol or plain space as an escape: \\n, \\x1b, \\u202e, \\udcff.

    limit  most characters returned, of which the last is an ellipsis where something was cut; None: all

    The result encodes in UTF-8: bytes of a file name that no encoding explains (surrogateescape) come out as \\udc80 to \\udcff.
    """
    shown = str(text)
    if limit is not None:
        shown = shown[: limit + 1]  # an escape is never shorter than what it stands for
    if not shown.isprintable():
        shown = "".join(each if each.isprintable() else each.encode("unicode_escape").decode("ascii") for each in shown)
    if limit is not None and len(shown) > limit:
        shown = shown[: max(limit - 1, 0)] + "…"
    return shown


def suggestion(name: str, known: Sequence[str], prefix: str = "") -> str:
    """`Did you mean x?` of the nearest name that is known, or all that are."""
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    return f"Did you mean {prefix}{near[0]}?" if near else f"There are: {', '.join(known) or 'none'}."
