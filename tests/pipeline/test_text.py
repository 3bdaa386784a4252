"""Untrusted text comes out on one line, without terminal escapes, and can be encoded."""

import os

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.text import printable


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("chair 01.png", "chair 01.png"),
        ("Brücke ☃.jpg", "Brücke ☃.jpg"),
        ("a\nb\tc\r", "a\\nb\\tc\\r"),
        ("\x1b]0;owned\x07", "\\x1b]0;owned\\x07"),
        ("gnp.\u202egpj", "gnp.\\u202egpj"),
        ("\x9b31m", "\\x9b31m"),
        (os.fsdecode(b"caf\xe9.png"), "caf\\udce9.png"),
        (b"bytes", "b'bytes'"),
    ],
)
def test_what_cannot_be_shown_is_escaped(text: object, shown: str) -> None:
    assert printable(text) == shown


@given(st.text(st.characters(codec=None)), st.integers(1, 40))
def test_every_text_comes_out_short_and_encodable(text: str, limit: int) -> None:
    whole, cut = printable(text), printable(text, limit)
    assert whole.isprintable()
    whole.encode()
    assert len(cut) <= limit
    assert cut == whole if len(whole) <= limit else whole.startswith(cut[:-1])
