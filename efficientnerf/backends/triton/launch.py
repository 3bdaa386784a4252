"""How the CUDA kernels (Triton) are launched.

None of their functions waits for the device unless it says so. With TRITON_INTERPRET=1, set before the first import, Triton's interpreter runs all of
them on CPU tensors.

Numbers that change from launch to launch are in no kernel's constants, and named in its `do_not_specialize`: else Triton compiles a kernel anew for a number
that is one, or a multiple of sixteen, and training waits seconds for it.
"""

from __future__ import annotations

import os

INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"
# Programs are many and small on a device; the interpreter runs one after the other, each operation at a price whatever the size of its block.
LANES = 1024 if INTERPRETED else 128


def blocks(count: int, block: int = LANES) -> int:
    """Programs of `block` lanes for `count` entries; at least one, since CUDA refuses to launch none."""
    return max(1, -(-count // block))
