"""Calls that are made again and again, with arguments of the same types every time.

Before each call Numba finds out the type of every argument, and of every array in a bundle: in a
small world that takes longer than what the kernel does (decision 008).
"""

from __future__ import annotations

from collections.abc import Callable
from operator import is_
from typing import Any, ParamSpec, TypeVar

import numba
import numba.core.config
import numpy as np
from numba.extending import typeof_impl
from numpy.typing import NDArray

P = ParamSpec("P")
R = TypeVar("R")


def specialized(kernel: Callable[P, R], checks: bool = True) -> Callable[P, R]:
    """A kernel for one caller whose arguments, by position, are of the same types in every call.

    The types are those of the first call. Later calls compare what is not the same object as in the
    call before, array by array in a bundle: another type is a TypeError. For that a call keeps its
    arguments until the next one. Without `checks` nothing is compared: for loops in which one
    process waits for another, and for frames, whose few callers see to the types.

    With `NUMBA_DISABLE_JIT=1` or `NUMBA_BOUNDSCHECK=1` it is the kernel itself.
    """
    settings: Any = numba.core.config
    if settings.DISABLE_JIT or settings.BOUNDSCHECK:
        return kernel
    call: Any = _Specialized(kernel) if checks else _Unchecked(kernel)
    return call  # type: ignore[no-any-return]


class _Unchecked:
    """Calls what Numba has compiled for the types of the first call."""

    __slots__ = ("_compiled", "_kernel")

    def __init__(self, kernel: Any) -> None:
        self._kernel = kernel
        self._compiled: Callable[..., Any] | None = None

    def __call__(self, *arguments: Any) -> Any:
        if self._compiled is None:
            self._compiled = self._kernel.compile(tuple(map(_kind, arguments)))
        return self._compiled(*arguments)


class _Specialized(_Unchecked):
    """Looks, too, whether the arguments are of these types."""

    __slots__ = ("_forms", "_last")

    def __init__(self, kernel: Any) -> None:
        super().__init__(kernel)
        self._forms: tuple[_Form, ...] = ()
        self._last: tuple[Any, ...] = ()

    def __call__(self, *arguments: Any) -> Any:
        compiled = self._compiled
        if compiled is None:
            types = tuple(map(_kind, arguments))
            self._compiled = compiled = self._kernel.compile(types)
            self._forms = tuple(map(_Form, arguments, types))
        elif not all(map(is_, arguments, self._last)):
            self._check(arguments)
        self._last = arguments
        return compiled(*arguments)

    def _check(self, arguments: tuple[Any, ...]) -> None:
        for form, new, last in zip(self._forms, arguments, self._last, strict=True):
            if new is last or type(new) is form.scalar:
                continue
            if not form.fits(new, last):
                raise TypeError(
                    f"{self._kernel.__name__}: an argument of {_kind(new)} where the first "
                    f"call had one of {form.kind}"
                )


class _Form:
    """What an argument has to be like: the type of the one that it was made of."""

    __slots__ = ("_dtype", "_fields", "_ndim", "_python", "_wants", "kind", "scalar")

    def __init__(self, argument: Any, kind: Any) -> None:
        self.kind = kind
        self.scalar: type[Any] | None = None  # that of a number
        self._python = type(argument)
        self._fields: tuple[_Form, ...] = ()
        self._dtype: np.dtype[Any] | None = None
        if isinstance(argument, np.ndarray):
            self._dtype, self._ndim = argument.dtype, argument.ndim
            self._wants = _flags_of(argument)
        elif isinstance(argument, tuple):
            self._fields = tuple(map(_Form, argument, kind.types))
        else:
            self.scalar = self._python

    def fits(self, new: Any, last: Any) -> bool:
        """Whether an argument is of the type; `last` is one that was."""
        if self.scalar is not None:
            return type(new) is self.scalar or bool(_kind(new) == self.kind)
        if type(new) is not self._python:
            return False
        if self._dtype is not None:
            return bool(
                (new.dtype is self._dtype or new.dtype == self._dtype)
                and new.ndim == self._ndim
                and new.flags.num & self._wants == self._wants
            )
        return all(
            item is known or form.fits(item, known)
            for form, item, known in zip(self._fields, new, last, strict=True)
        )


# By what decides it, the type of an array.
_arrays: dict[tuple[Any, ...], Any] = {}
_extensible: Any = typeof_impl
_typeof_array: Any = _extensible.dispatch(np.ndarray)


@_extensible.register(np.ndarray)  # type: ignore[untyped-decorator]
def _type_of_array(array: NDArray[Any], context: Any) -> Any:
    """Numba's type of an array, in the place of its own function.

    Numba puts the type of an array of records together from its fields each time. A world has
    hundreds of such arrays, and a few types of them.
    """
    if type(array) is not np.ndarray:
        return _typeof_array(array, context)
    dtype = array.dtype
    form = (dtype, dtype.isalignedstruct, array.ndim, array.flags.num)
    kind = _arrays.get(form)
    if kind is None:
        kind = _arrays[form] = _typeof_array(array, context)
    return kind


# By the types of its parts, that of a bundle. An entry keeps these, since their addresses are its
# key.
_bundles: dict[tuple[Any, ...], tuple[Any, tuple[Any, ...]]] = {}


def _kind(argument: Any) -> Any:
    """Numba's type of an argument."""
    typeof: Any = numba.typeof
    if not isinstance(argument, tuple):
        return typeof(argument)
    kinds = tuple(map(_kind, argument))
    parts = (type(argument), *map(id, kinds))
    if parts not in _bundles:
        _bundles[parts] = typeof(argument), kinds
    return _bundles[parts][0]


def _flags_of(array: np.ndarray[Any, Any]) -> int:
    """Bits of `flags.num` that later arrays must have, too: layout, alignment, may be written."""
    flags = array.flags
    layout = 1 if flags.c_contiguous else 2 * flags.f_contiguous
    return int(layout | 0x100 * flags.aligned | 0x400 * flags.writeable)
