"""Work that the threads of a numba kernel share: each takes the next task when it is done with one, so that none waits for another's long ones."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic


@intrinsic
def take_next(typing_context: Any, counter: Any) -> Any:
    """p[0] of a pointer to int64, which is raised by one: no two threads get the same."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.atomic_rmw("add", args[0], ir.Constant(ir.IntType(64), 1), "monotonic")

    return types.int64(types.CPointer(types.int64)), codegen
