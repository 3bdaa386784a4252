"""Workflows of stages, and their command line."""

import os

if os.name == "nt":  # before the first import of what only POSIX systems have: locks, limits, groups of processes
    raise SystemExit("enerf: Windows itself is not supported. Install it inside WSL 2 (wsl --install).")

# Before torch and numba load their OpenMP: threads that wait must sleep. By default they spin, which saves a sixth of a training step on a quiet
# machine, and takes four times as long where two runs share the cores. Results are the same.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
