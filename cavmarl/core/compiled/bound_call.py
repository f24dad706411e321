"""Kernel calls with fixed arguments, and sequences of such calls that run without Python between.

A kernel call from Python costs one to three microseconds: the arguments are looked at, a lock is
released, a result becomes a Python object. In a small world that is most of the time of a tick. A
`BoundCall` has looked at its arguments once. A `CallSequence` enters many bound calls from one
compiled loop, which can skip calls by the results of others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Generic, ParamSpec, TypeVar, cast

import numpy as np

from cavmarl.core.compiled.arguments import Words
from cavmarl.core.compiled.kernel import Kernel
from cavmarl.core.compiled.run_calls import ADDRESS, ENTRY, TARGET, run_calls

P = ParamSpec("P")
R = TypeVar("R")


class BoundCall(Generic[R]):
    """A kernel with its arguments. The arrays may change, but not be replaced.

    Only one thread at a time may make the call.
    """

    __slots__ = ("_arguments", "_call", "_enter", "_kernel", "_read", "_result", "words")

    def __init__(self, kernel: Callable[..., R], arguments: tuple[Any, ...]) -> None:
        self._arguments = arguments  # kept alive: the words hold their addresses
        self._kernel = kernel
        self._result: Any = None  # of the last call without the compiler
        self._call: Any = None
        self.words = Words(0)
        if isinstance(kernel, Kernel):
            call = self._call = kernel.call_for(arguments)
            words = self.words = Words(call.num_words)
            for kind, at, argument in zip(call.types, call.offsets, arguments, strict=True):
                kind.write(words, at, argument)
            self._enter, self._read = call.enter, call.read_result

    def __call__(self) -> R:
        """Call the kernel and return its result."""
        if self._call is None:
            self._result = self._kernel(*self._arguments)
            return cast(R, self._result)
        if status := self._enter(self.words.address):
            raise self._call.error(status)
        return cast(R, self._read(self.words))

    @property
    def is_compiled(self) -> bool:
        return self._call is not None

    @property
    def entry(self) -> int:
        """The address of the compiled code."""
        return int(self._call.address)

    def error(self, status: int) -> Exception:
        """Return the error that a status of the compiled code stands for."""
        return cast(Exception, self._call.error(status))

    def result_address(self, item: int) -> int:
        """Return the address of the word that holds an item of the last result."""
        results = sum(kind.count for kind in self._call.types)
        return int(self.words.address + 8 * (results + item))

    def is_set(self, item: int) -> bool:
        """Return whether an item of the last result, without the compiler, is true."""
        result = self._result
        return bool(result[item] if isinstance(result, tuple) else result)


def bind(kernel: Callable[P, R], *arguments: P.args, **named: P.kwargs) -> BoundCall[R]:
    """Return a call of a kernel with these arguments, which `BoundCall` keeps.

    Raises:
        TypeError: a kernel takes no such arguments.
        KernelError: the kernel has to be compiled, and may or can not be.
    """
    if isinstance(kernel, Kernel):
        return BoundCall(kernel, kernel.in_order(arguments, named))
    from inspect import signature

    bound = signature(kernel).bind(*arguments, **named)
    bound.apply_defaults()
    return BoundCall(kernel, bound.args)


def keep_last(make: Callable[P, R]) -> Callable[P, R]:
    """Return a function that calls `make` only if an argument is not the one of the last call."""
    last: list[Any] = [None, None]

    def find(*arguments: P.args, **named: P.kwargs) -> R:
        known = last[0]
        if known is None or not all(map(_is_same, arguments, known)) or named:
            last[:] = arguments, make(*arguments, **named)
        return cast(R, last[1])

    return find


def _is_same(one: Any, other: Any) -> bool:
    return one is other or (type(one) in (int, float) and one == other)


class CallSequence:
    """Bound calls in their order; some only if the result of an earlier call is true."""

    def __init__(self) -> None:
        self._rows: list[list[int]] = []
        self._steps: list[tuple[BoundCall[Any], int]] = []  # a call, and -1 or the tested item
        self._ops: Any = None

    def __len__(self) -> int:
        return len(self._steps)

    def call(self, bound: BoundCall[Any]) -> None:
        """Append a call."""
        row = [bound.entry, bound.words.address] if bound.is_compiled else [0, 0]
        self._add(bound, -1, row)

    @contextmanager
    def only_if(self, bound: BoundCall[Any], item: int = 0) -> Iterator[None]:
        """Skip what is appended within, unless the last result of a call is true.

        Args:
            bound: a call that comes earlier in the sequence.
            item: the item of a result that is a tuple.
        """
        address = bound.result_address(item) if bound.is_compiled else 0
        self._add(bound, item, [0, address])
        test = self._rows[-1]
        yield
        test[TARGET] = len(self._rows)

    def _add(self, bound: BoundCall[Any], item: int, row: list[int]) -> None:
        self._steps.append((bound, item))
        self._rows.append([*row, 0])
        self._ops = None

    def run(self) -> None:
        """Make the calls.

        Raises:
            IndexError: a kernel that checks its indices has found one out of bounds.
        """
        if not self._steps:
            return
        if not self._steps[0][0].is_compiled:
            self._run_plain()
            return
        if self._ops is None:
            self._ops = bind(run_calls, np.array(self._rows, dtype=np.int64))
        at, status = self._ops()
        if status:
            raise self._steps[at][0].error(status)

    def _run_plain(self) -> None:
        at = 0
        while at < len(self._steps):
            bound, item = self._steps[at]
            if item < 0:
                bound()
            elif not bound.is_set(item):
                at = self._rows[at][TARGET]
                continue
            at += 1


assert (ENTRY, ADDRESS, TARGET) == (0, 1, 2)  # the order of a row in `CallSequence`
