"""Software prefetch of memory that is needed soon.

The records that a vehicle needs are scattered over the tables of a city: its lane, the next lanes
and links, the row of its leader. An access that misses the caches takes as long as a hundred
operations. A loop that announces its records some rounds ahead has many accesses under way at the
same time.

This never changes a result: nothing is read, and an address outside of an array does no harm.
"""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from cavmarl.core.compiled.intrinsic import intrinsic

SOON = 8  # rounds of a loop over vehicles, about as long as a memory access

_FOR_READING, _INTO_ALL_CACHES, _DATA = 0, 3, 1
_LINE = 64  # bytes


def _generate_prefetch(typing: Any, array: Any, index: Any, line: Any) -> Any:
    from llvmlite import ir
    from numba.core import cgutils, types

    get_function: Any = cgutils.get_or_insert_function
    get_item: Any = cgutils.get_item_pointer

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = signature.args[0]
        view = context.make_array(kind)(context, builder, arguments[0])
        at = [context.cast(builder, arguments[1], signature.args[1], types.intp)]
        record = get_item(context, builder, kind, view, at)
        byte, word = ir.IntType(8).as_pointer(), ir.IntType(32)
        offset = builder.mul(arguments[2], arguments[2].type(_LINE))
        place = builder.gep(builder.bitcast(record, byte), [offset])
        function_type = ir.FunctionType(ir.VoidType(), [byte, word, word, word])
        call = get_function(builder.module, function_type, "llvm.prefetch")
        how = [word(value) for value in (_FOR_READING, _INTO_ALL_CACHES, _DATA)]
        builder.call(call, [place, *how])
        return context.get_dummy_value()

    return types.void(array, index, line), generate


@intrinsic(_generate_prefetch)
def prefetch(array: NDArray[Any], index: int, line: int) -> None:
    """Prefetch cache line `line` of record `index` of a (N,) array."""
