"""Values that break readers: numbers beyond every type, text that is no text, wrong types, deep nesting."""

from random import Random
from typing import Any

NUMBERS = [
    0, 1, -1, 2, 3, 7, 255, 256, 65535, 65536, 2**31 - 1, 2**31, -(2**31), 2**32, 2**53, 2**63 - 1, 2**63, 2**64, -(2**63) - 1, 10**20, 10**30, 10**308,
    10**309, 10**400, -(10**400), 0.5, -0.0, 1e-320, 5e-324, 1e-30, -1e-9, 1e30, 1e100, 1e154, 1e155, 1e300, 1e308, -1e308, 1.7976931348623157e308,
]  # fmt: skip
TEXTS = [
    "", " ", ".", "..", "/", "../x", "/etc/passwd", "C:\\x", "\\\\host\\share", "a\nb", "a\r\nb", "\n", "\t", "\0", "a\0b", "\x1b[31mred\x1b[0m",
    "\x1b]0;title\x07", "\x7f\x80\x9b",
    "\ud800", "x\udcff.png", "\udfff\ud800", "\u202egnp.exe", "\ufeff", "\U0001f600", "é", "e\u0301", "a" * 300, "a/" * 200, "%s%n{}", "{0.__class__}",
    "null", "NaN", "inf", "1e999",
    "-0", "0x10", "0" * 50, "9" * 50, "9" * 500, "١٢٣", "²", "true", "auto", "OPENCV", "PINHOLE", "FULL_OPENCV", "OPENCV_FISHEYE", "SIMPLE_RADIAL",
    "<script>", "'; --", "con",
]  # fmt: skip
# What no Python value stands for; a writer puts them in place of their marks.
RAW = ["NaN", "Infinity", "-Infinity", "1e999", "-1e999", "1" + "0" * 5000, "-" + "9" * 4299, "0." + "0" * 400 + "1", "1E+400000000", "\"\\ud800\"",
    "\"\\u0000\"", "01", "+1", "1_000", "0x1F",
       "{}" + ",", "[", "]", "'x'", "nul", "\"unfinished", "\xa0", "/* x */ 1", "[" * 300 + "]" * 300, "[" * 100_000, '{"a":' * 990 + "1" + "}" * 990,
    "[" * 5000 + "]" * 5000]  # fmt: skip
MARK = "@@raw"


def hostile(rng: Random, depth: int = 0) -> Any:
    """Any value of JSON, of kinds that break readers, and marks of RAW."""
    kind = rng.randrange(12 if depth < 3 else 8)
    if kind == 0:
        return rng.choice((None, True, False))
    if kind in (1, 2, 3):
        return rng.choice(NUMBERS)
    if kind in (4, 5):
        return rng.choice(TEXTS)
    if kind == 6:
        return f"{MARK}{rng.randrange(len(RAW))}@@"
    if kind == 7:
        return rng.uniform(-10, 10)
    if kind == 8:
        return {rng.choice(TEXTS): hostile(rng, depth + 1) for _ in range(rng.randrange(3))}
    if kind == 9:
        return [hostile(rng, depth + 1)] * rng.choice((1, 2, 3, 4, 16, 17, 100))
    return [hostile(rng, depth + 1) for _ in range(rng.randrange(5))]


def unlike(rng: Random, value: Any) -> Any:
    """A value near the given one: a neighbouring number, cut or doubled text, a longer or shorter list."""
    if isinstance(value, bool):
        return rng.choice((not value, int(value), str(value)))
    if isinstance(value, (int, float)):
        if abs(value) > 1e300:
            return rng.choice((-value, value - 1, [value], 0))
        return rng.choice((value + 1, value - 1, -value, value * 2, value / 2, float(value), str(value), value + 1e-4, [value]))
    if isinstance(value, str):
        at = rng.randrange(len(value) + 1)
        return rng.choice((value[:at], value + value, value[:at] + rng.choice(TEXTS) + value[at:], value.upper(), [value], f"/{value}", f"../{value}"))
    if isinstance(value, list):
        if not value:
            return rng.choice(([None], {}, None))
        at = rng.randrange(len(value))
        return rng.choice((value[:at], value + value[:1], value[at:] + value[:at], [value], value * 3, {"0": value[0]}, [[]] * len(value)))
    if isinstance(value, dict):
        return rng.choice(([value], list(value), {**value, rng.choice(TEXTS): hostile(rng)}, {}))
    return hostile(rng)
