"""What holds for all tests: one thread, in this process and in those that tests start.

The kernels give the same bytes on any number of threads; bundles as small as the tests' only make threads wait for each other, many times
longer than the work takes where the machine is busy. Set before anything is imported: numba and torch read it when they are.
"""

from __future__ import annotations

import os

for variable in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ[variable] = "1"
