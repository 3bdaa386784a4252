"""Compiles the CPU kernels of a run in the background: a process on idle cores alone takes a small made scene through all stages."""
