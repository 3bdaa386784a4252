"""The grades of all verdicts, best first."""

GRADES = ("good", "usable", "poor", "failed")
