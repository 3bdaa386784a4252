"""Workflows of stages, and their command line."""

import os

if os.name == "nt":  # before the first import of what only POSIX systems have: locks, limits, groups of processes
    raise SystemExit("enerf: Windows itself is not supported. Install it inside WSL 2 (wsl --install).")

# Before torch and numba load their OpenMP: threads that wait must sleep. By default they spin, each library's stealing the cores from the
# other's, which costs a third of the speed on a quiet machine and nearly all of it on a busy one. Results are the same.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
