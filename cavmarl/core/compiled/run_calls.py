"""The compiled loop of a `CallSequence`: it calls other kernels by the addresses of their code."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.compiled.intrinsic import intrinsic

ENTRY, ADDRESS, TARGET = range(3)  # columns of a row


def _generate_enter(typing: Any, entry: Any, words: Any) -> Any:
    from llvmlite import ir
    from numba.core import types

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        word, number = ir.IntType(64).as_pointer(), ir.IntType(32)
        pointer = ir.FunctionType(number, [word]).as_pointer()
        function = builder.inttoptr(arguments[0], pointer)
        status = builder.call(function, [builder.inttoptr(arguments[1], word)])
        return builder.sext(status, ir.IntType(64))

    return types.int64(types.int64, types.int64), generate


def _generate_load(typing: Any, address: Any) -> Any:
    from llvmlite import ir
    from numba.core import types

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.load(builder.inttoptr(arguments[0], ir.IntType(64).as_pointer()))

    return types.int64(types.int64), generate


@intrinsic(_generate_enter)
def _enter(entry: int, words: int) -> int:
    """Call a compiled kernel with the address of its words, and return its status."""
    raise NotImplementedError("only compiled code can call a kernel by its address")


@intrinsic(_generate_load)
def _load(address: int) -> int:
    """Return the word at an address."""
    raise NotImplementedError("only compiled code can read from an address")


@kernel
def run_calls(rows: NDArray[np.int64]) -> tuple[int, int]:
    """Make the calls of a sequence in order.

    Args:
        rows: (n, 3) for each step of the sequence: the entry point of a kernel and the address of
            its words; or 0, the address of a word, and the next step if that word is 0.

    Returns:
        The number of the step that failed and its status; the status is 0 if none failed.
    """
    at = 0
    while at < rows.shape[0]:
        if rows[at, ENTRY] != 0:
            status = _enter(rows[at, ENTRY], rows[at, ADDRESS])
            if status != 0:
                return at, status
            at += 1
        elif _load(rows[at, ADDRESS]) == 0:
            at = rows[at, TARGET]
        else:
            at += 1
    return at, 0
