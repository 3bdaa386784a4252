"""Fleets of scenes whose worker, scheduler and client are killed.

python -m benchmarks.fleet kills --folder FOLDER [--kills 20] [--json FILE]
"""
