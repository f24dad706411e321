"""Reads untrusted pickles: only builtins and NumPy's arrays of numbers and text.

A pickle can call any function that it names, and set the state and the attributes of its objects.
This reader knows a fixed list of names, and replaces NumPy's functions and types by versions that
check arguments and states. Before that, it checks the operations. An index in the memo above the
number of operations, or a length beyond the content, could reserve any amount of memory.
"""

from __future__ import annotations

import pickle
import pickletools
from collections import OrderedDict, defaultdict
from collections.abc import Callable
from io import BytesIO
from typing import Any

import numpy as np

from cavmarl.core.errors import MapError

_FORBIDDEN = frozenset(
    "NEXT_BUFFER READONLY_BUFFER PERSID BINPERSID EXT1 EXT2 EXT4 INST OBJ".split()
)
_KINDS = "biufSU"  # kinds of numbers and text; objects and records could contain anything


_NONE = object()  # an argument that was not given


class _ForbiddenError(pickle.UnpicklingError):
    """The pickle refers to a name that is not on the list, or changes an object of the list."""


class _Function:
    """A function that a pickle may call. The pickle cannot set its attributes."""

    __slots__ = ("_function",)

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    def __call__(
        self, first: Any, second: Any = _NONE, third: Any = _NONE, fourth: Any = _NONE
    ) -> Any:
        given = (first, second, third, fourth)
        return self._function(*(one for one in given if one is not _NONE))

    def __setstate__(self, state: object) -> None:
        raise _ForbiddenError("a changed function")


class _Type:
    """A dtype of numbers or text. Its state is only the byte order.

    NumPy would also accept flags in the state that declare an array of objects.
    """

    __slots__ = ("dtype",)

    def __init__(self, code: str, align: bool = False, copy: bool = True) -> None:
        del align, copy
        self.dtype = np.dtype(code)
        if self.dtype.kind not in _KINDS or not self.dtype.itemsize:
            raise _ForbiddenError(f"an array of dtype {str(code)[:40]!r}")

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _, order, subtype, names, fields = state[:5]
        if (subtype, names, fields) != (None, None, None) or order not in ("<", ">", "|", "="):
            raise _ForbiddenError("an array of records")
        self.dtype = self.dtype.newbyteorder(order)


class _Array(np.ndarray[Any, Any]):
    """An array whose content follows in the pickle; memory is reserved when the content arrives."""

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _, shape, kind, is_fortran, data = state
        super().__setstate__((1, shape, _dtype_of(kind), is_fortran, _bytes_of(data)))


def _dtype_of(kind: object) -> np.dtype[Any]:
    if not isinstance(kind, _Type):
        raise _ForbiddenError("an array without a dtype")
    return kind.dtype


def _bytes_of(data: object) -> bytes:
    if not isinstance(data, bytes | bytearray):
        raise _ForbiddenError("an array of objects")
    return bytes(data)


def _array(subtype: object, shape: object, code: object) -> Any:
    del subtype, shape, code
    return np.ndarray.__new__(_Array, (0,), "b")


def _scalar(kind: object, data: object) -> Any:
    return np.frombuffer(_bytes_of(data), _dtype_of(kind), 1)[0]


def _from_buffer(data: object, kind: object, shape: tuple[int, ...], order: str) -> Any:
    found = np.frombuffer(_bytes_of(data), _dtype_of(kind))
    return found.reshape(shape, order="F" if order == "F" else "C")


def _encoded(text: str, encoding: str = "latin1") -> bytes:
    if encoding not in ("latin1", "latin-1"):
        raise _ForbiddenError(f"text in the encoding {encoding[:40]!r}")
    return text.encode("latin1")


_NUMPY: dict[str, _Function] = {
    "_reconstruct": _Function(_array),
    "scalar": _Function(_scalar),
    "_frombuffer": _Function(_from_buffer),
}
_NAMES: dict[tuple[str, str], Any] = {
    ("numpy", "ndarray"): "ndarray",  # only the first argument of `_reconstruct`: not callable
    ("numpy", "dtype"): _Function(_Type),
    ("_codecs", "encode"): _Function(_encoded),
    ("collections", "OrderedDict"): OrderedDict,
    ("collections", "defaultdict"): defaultdict,
    **{
        ("builtins", kind.__name__): kind
        for kind in (int, float, set, frozenset)  # the other builtins have their own opcodes
    },
}
_MODULES = ("numpy.core.multiarray", "numpy._core.multiarray", "numpy.core.numeric",
            "numpy._core.numeric")  # fmt: skip


class _RestrictedUnpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        """Return the object of a name; raise an error for a name that is not on the list."""
        module = module.replace("__builtin__", "builtins")
        if (module, name) in _NAMES:
            return _NAMES[module, name]
        if module in _MODULES and name in _NUMPY:
            return _NUMPY[name]
        raise _ForbiddenError(f"{module[:60]}.{name[:60]}")


def _check_operations(content: bytes) -> None:
    count = 0
    for operation, argument, _ in pickletools.genops(content):
        count += 1
        name = operation.name
        if name in _FORBIDDEN:
            raise _ForbiddenError(f"the operation {name}")
        if name in ("PUT", "BINPUT", "LONG_BINPUT") and int(str(argument)) > count:
            raise _ForbiddenError(f"{argument} as a place in the memo")


def unpickle(content: bytes) -> Any:
    """Return the object of a pickle.

    Raises MapError: the pickle is broken, or contains other objects than builtins and arrays.
    """
    try:
        _check_operations(content)
        return _RestrictedUnpickler(BytesIO(content)).load()
    except _ForbiddenError as error:
        raise MapError(
            f"the pickle contains {error}: only builtins and NumPy's arrays of numbers and text "
            "are read, because a pickle may run code; export the scene as plain dictionaries"
        ) from error
    except Exception as error:  # a damaged pickle raises almost any exception
        raise MapError(
            f"broken pickle ({type(error).__name__}: {str(error)[:200]}): export the scene again"
        ) from error
