"""Fleets: of many simulated scenes, of scenes whose worker, scheduler and client are killed, of small real ones beside a plain loop;
their page in a browser.

python -m benchmarks.fleet simulated [--scenes 1000] [--json FILE]
python -m benchmarks.fleet kills --folder FOLDER [--kills 20] [--json FILE]
python -m benchmarks.fleet real --folder FOLDER [--scenes 24] [--json FILE]
python -m benchmarks.fleet page --folder FOLDER [--json FILE]
"""
