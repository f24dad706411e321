"""Kernel calls with fixed arguments, and sequences of such calls that run without Python.

A kernel call from Python costs one to three microseconds: the arguments are inspected, a lock is
released, and a result becomes a Python object. In a small world, this is most of the time of a
tick. A `BoundCall` inspects its arguments once. A `CallSequence` makes many bound calls from one
compiled loop, and can skip calls depending on earlier results.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cached_property
from inspect import signature
from typing import Any, Generic, ParamSpec, Protocol, TypeVar, cast

import numpy as np

from cavmarl.core.compiled.arguments import Words
from cavmarl.core.compiled.kernel import Kernel
from cavmarl.core.compiled.run_calls import ADDRESS, ENTRY, TARGET, run_calls

P = ParamSpec("P")
R = TypeVar("R")


class BoundCall(Generic[R]):
    """A kernel with fixed arguments. Arrays may change their content, but cannot be replaced.

    Only one thread at a time may call it.
    """

    __slots__ = ("_arguments", "_call", "_enter", "_kernel", "_read", "_result", "words")

    def __init__(self, kernel: Callable[..., R], arguments: tuple[Any, ...]) -> None:
        self._arguments = arguments  # kept alive, because the words contain their addresses
        self._kernel = kernel
        self._result: Any = None  # of the last call, if the kernel is plain Python
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
        """Return the error for a status of the compiled code."""
        return cast(Exception, self._call.error(status))

    def result_address(self, item: int) -> int:
        """Return the address of the word with an item of the last result."""
        results = sum(kind.count for kind in self._call.types)
        return int(self.words.address + 8 * (results + item))

    def is_set(self, item: int) -> bool:
        """Return whether an item of the last result is true, if the kernel is plain Python."""
        result = self._result
        return bool(result[item] if isinstance(result, tuple) else result)


def bind(kernel: Callable[P, R], *arguments: P.args, **named: P.kwargs) -> BoundCall[R]:
    """Return a call of a kernel with these arguments; the `BoundCall` keeps them alive.

    Raises:
        TypeError: kernels do not accept one of the arguments.
        KernelError: the kernel must be compiled, which is not allowed or not possible.
    """
    if isinstance(kernel, Kernel):
        return BoundCall(kernel, kernel.in_order(arguments, named))
    given = signature(kernel).bind(*arguments, **named)
    given.apply_defaults()
    return BoundCall(kernel, given.args)


def bind_by_name(
    kernel: Callable[..., R],
    values: Mapping[str, Any],  # name of a parameter → its value; other names are ignored
) -> BoundCall[R]:
    """Return a call of a kernel with the values that have the names of its parameters.

    Raises:
        KeyError: a parameter has no value.
    """
    return bind(kernel, **{name: values[name] for name in signature(kernel).parameters})


class HasValues(Protocol):
    """An object with arguments for kernels."""

    @property
    def values(self) -> Mapping[str, Any]:
        """Name of a parameter → its value."""
        ...


def bound(kernel: Callable[..., R]) -> cached_property[BoundCall[R]]:
    """Return a property: the call of a kernel with the values of the object, by name."""

    def call(owner: HasValues) -> BoundCall[R]:
        return bind_by_name(kernel, owner.values)

    return cached_property(call)


def keep_last(make: Callable[P, R]) -> Callable[P, R]:
    """Return a function that calls `make` only if an argument differs from the last call's."""
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
    """Bound calls in order. Some calls run only if the result of an earlier call is true."""

    def __init__(self) -> None:
        self._rows: list[list[int]] = []
        self._steps: list[tuple[BoundCall[Any], int]] = []  # a call, with -1 or the tested item
        self._ops: Any = None

    def __len__(self) -> int:
        return len(self._steps)

    def call(self, bound: BoundCall[Any]) -> None:
        """Append a call."""
        row = [bound.entry, bound.words.address] if bound.is_compiled else [0, 0]
        self._add(bound, -1, row)

    @contextmanager
    def only_if(self, bound: BoundCall[Any], item: int = 0) -> Iterator[None]:
        """Skip the calls appended within the block unless the last result of a call is true.

        Args:
            bound: a call that is earlier in the sequence.
            item: index of the item, if the result is a tuple.
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
            IndexError: a kernel that checks its indices found one out of bounds.
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


assert (ENTRY, ADDRESS, TARGET) == (0, 1, 2)  # the columns of a row in `CallSequence`
