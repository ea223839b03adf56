"""Sharing out work among threads while they run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic


@intrinsic
def take(typingctx: Any, counters: Any, index: Any, amount: Any) -> Any:
    """Add to ``counters[index]`` in one step that no other thread can interrupt, and give what was there before."""
    if not (isinstance(counters, types.Array) and counters.dtype == types.int64 and counters.ndim == 1):
        return None

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Sequence[Any]) -> Any:
        table, place, amount = arguments
        data = context.make_array(signature.args[0])(context, builder, table).data
        return builder.atomic_rmw("add", builder.gep(data, [place]), amount, "monotonic")

    return types.int64(counters, types.intp, types.int64), generate
