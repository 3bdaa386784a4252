"""The grades of all verdicts, best first."""

from __future__ import annotations

GRADES = ("good", "usable", "poor", "failed")
