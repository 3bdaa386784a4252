"""Other projects' methods on the same scenes, views and pixels: `python -m benchmarks.peers --help`."""
