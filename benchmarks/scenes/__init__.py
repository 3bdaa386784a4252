"""Synthetic scenes with known cameras for choosing settings: none of them is reported in the README. `python -m benchmarks.scenes --help`."""
