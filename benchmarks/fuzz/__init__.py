"""Fuzzing of everything that is read: valid files, changed at random, must be read or refused in the documented way, in bounded time and memory.

    python -m benchmarks.fuzz [READER ...] [--inputs 100000] [--seed 0] [--jobs 1] [--plain] [--findings DIR] [--json FILE]
    python -m benchmarks.fuzz READER --file FILE     one input again

reader.py       what a reader is, how an outcome is judged
table.py        the readers, one for each kind of file; assets, datasets, meshes, pictures, requests, runs and scratch hold them
values.py       numbers and texts that break readers
json_text.py, toml_text.py, lines.py, binary.py, safetensors_bytes.py, image_bytes.py   mutations that know a format
worker.py       a process that reads one input after another, guided by coverage where atheris is installed; makes the input of a finding smaller
nursery.py      a process that has imported everything, and forks workers
campaign.py     hands out the inputs, goes on where a worker dies, and counts
"""
