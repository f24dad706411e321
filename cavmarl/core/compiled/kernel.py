"""`Kernel`: a compiled function, called from Python or by other kernels."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable
from functools import cached_property, update_wrapper
from operator import is_
from typing import Any, ParamSpec, TypeVar

from cavmarl.core.compiled.arguments import (
    ArgumentType,
    Words,
    offsets_of,
    result_reader,
    type_key,
    type_of,
)
from cavmarl.core.compiled.machine_code import find_code
from cavmarl.core.compiled.signatures import record_call

P = ParamSpec("P")
R = TypeVar("R")


def is_on(name: str) -> bool:
    """Return whether an environment variable of Numba is switched on."""
    return os.environ.get(name, "0") not in ("", "0")


IS_PLAIN = is_on("NUMBA_DISABLE_JIT")  # kernels are plain Python functions
CHECKS_INDICES = is_on("NUMBA_BOUNDSCHECK")


class Kernel:
    """A compiled function, for any argument types.

    Each call determines the types of all arguments; `specialized` avoids that.
    """

    def __init__(self, function: Callable[..., Any], is_inlined: bool) -> None:
        update_wrapper(self, function)
        self.py_func = function
        self._is_inlined = is_inlined
        self._calls: dict[Any, TypedKernel] = {}

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        """Call the kernel.

        Raises:
            TypeError: kernels do not accept one of the arguments.
            KernelError: the kernel must be compiled, which is not allowed or not possible.
        """
        arguments = self.in_order(arguments, named)
        return self.call_for(arguments)(arguments)

    def in_order(self, arguments: tuple[Any, ...], named: dict[str, Any]) -> tuple[Any, ...]:
        """Return all arguments of a call, defaults included, in the order of the signature."""
        if not named and len(arguments) == self._arity:
            return arguments
        bound = self._signature.bind(*arguments, **named)
        bound.apply_defaults()
        return bound.args

    def call_for(self, arguments: tuple[Any, ...]) -> TypedKernel:
        """Return the kernel for the types of some arguments; compile it if necessary."""
        key = tuple(map(type_key, arguments))
        call = self._calls.get(key)
        if call is None:
            call = self._calls[key] = TypedKernel(self.py_func, arguments)
        return call

    @cached_property
    def _arity(self) -> int:
        return len(self._signature.parameters)

    @cached_property
    def _signature(self) -> inspect.Signature:
        return inspect.signature(self.py_func)

    @cached_property
    def _part(self) -> Any:
        from cavmarl.core.compiled.compiler import make_part

        return make_part(self.py_func, self._is_inlined)

    @property
    def _numba_type_(self) -> Any:
        """The type of the kernel for Numba, which compiles a kernel that calls it."""
        return self._part._numba_type_


class TypedKernel:
    """A kernel for arguments of certain types."""

    __slots__ = (
        "address", "enter", "name", "num_words", "offsets", "read_result", "types", "words",
    )  # fmt: skip

    def __init__(self, function: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
        self.name = function.__name__
        self.types: tuple[ArgumentType, ...] = tuple(map(type_of, arguments))
        self.offsets = offsets_of(self.types)
        record_call(function, arguments)
        code = find_code(function, arguments, self.types)
        self.enter = code.enter
        self.address = code.address
        count = sum(kind.count for kind in self.types)
        results, self.read_result = result_reader(code.result, count)
        self.num_words = count + results
        self.words: list[Words] = []  # free memory; each call takes one item

    def __call__(self, arguments: tuple[Any, ...]) -> Any:
        """Call with arguments of these types; no reference to them is kept."""
        try:
            words = self.words.pop()
        except IndexError:
            words = Words(self.num_words)
        for kind, at, argument in zip(self.types, self.offsets, arguments, strict=True):
            kind.write(words, at, argument)
        if status := self.enter(words.address):
            raise self.error(status)
        result = self.read_result(words)
        self.words.append(words)
        return result

    def check(self, kind: ArgumentType, new: Any, last: Any = None) -> None:
        """Raise a TypeError if an argument does not have the type `kind`, which `last` has."""
        if not kind.fits(new, last):
            raise TypeError(
                f"{self.name}: an argument has the type {type_of(new).text}, but had "
                f"{kind.text} in the first call; make another specialized kernel for it"
            )

    def error(self, status: int) -> Exception:
        """Return the error for a status; only kernels that check their indices raise one."""
        return IndexError(f"{self.name}: an index is out of bounds (status {status})")


def specialized(kernel: Callable[P, R], checks: bool = True) -> Callable[P, R]:
    """Return a kernel for one caller whose arguments have the same types in every call.

    The first call determines the types. A later call stores an argument, or an item of a bundle,
    only if it is another object than in the previous call. Each call therefore keeps its arguments
    alive until the next call. An argument of another type is a TypeError. Without `checks`, types
    are not compared. This is for time-critical communication between processes, where the few
    callers ensure the types.

    With `NUMBA_DISABLE_JIT=1`, this is the kernel itself.
    """
    if not isinstance(kernel, Kernel):
        return kernel
    call: Any = _Specialized(kernel, checks)
    return call  # type: ignore[no-any-return]


def unchecked(kernel: Callable[P, R]) -> Callable[P, R]:
    """Return a kernel for callers whose arguments always have the types of the first call.

    Types are not compared, and no reference to the arguments is kept. This is for small kernels
    that all callers of a process share.
    """
    if not isinstance(kernel, Kernel):
        return kernel
    call: Any = _Unchecked(kernel)
    return call  # type: ignore[no-any-return]


class _Unchecked:
    __slots__ = ("_call", "_kernel")

    def __init__(self, kernel: Kernel) -> None:
        self._kernel = kernel
        self._call: TypedKernel | None = None

    def __call__(self, *arguments: Any) -> Any:
        if self._call is None:
            self._call = self._kernel.call_for(arguments)
        return self._call(arguments)


class _Specialized:
    __slots__ = ("_call", "_checks", "_kernel", "_words")

    def __init__(self, kernel: Kernel, checks: bool) -> None:
        self._kernel = kernel
        self._checks = checks
        self._call: TypedKernel | None = None
        self._words: list[Words] = []

    def __call__(self, *arguments: Any) -> Any:
        try:
            words = self._words.pop()
        except IndexError:
            words = self._first_words(arguments)
        last = words.last
        call: Any = self._call
        if not all(map(is_, arguments, last)) or len(arguments) != len(last):
            self._update(words, arguments)
        if status := call.enter(words.address):
            raise call.error(status)
        result = call.read_result(words)
        self._words.append(words)
        return result

    def _first_words(self, arguments: tuple[Any, ...]) -> Words:
        """Return new words with these arguments."""
        call = self._call
        if call is None:
            call = self._call = self._kernel.call_for(arguments)
        words = Words(call.num_words)
        for kind, at, new in zip(call.types, call.offsets, arguments, strict=True):
            if self._checks:
                call.check(kind, new)
            kind.write(words, at, new)
        words.last = arguments
        return words

    def _update(self, words: Words, arguments: tuple[Any, ...]) -> None:
        """Store the arguments that have changed; after an error, the words are not used again."""
        call: Any = self._call
        for kind, at, new, last in zip(
            call.types, call.offsets, arguments, words.last, strict=True
        ):
            if new is last:
                continue
            if self._checks:
                call.check(kind, new, last)
            kind.update(words, at, new, last)
        words.last = arguments
