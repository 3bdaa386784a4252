"""Compiles the CPU kernels of a run in the background: a process of low priority takes a small made scene through all stages."""
