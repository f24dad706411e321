"""The arguments of a compiled kernel: their types as text, and the 64-bit words that store them.

The caller passes the address of an array of words to a compiled kernel (`entry_point.py`). A number
takes one word, an array the address of its Python object, a record the address of its data, a
tuple or a bundle the words of its items in order, and `None` no word. The words of the result
follow the words of the arguments.
"""

from __future__ import annotations

import ctypes
import re
from collections.abc import Callable
from functools import cache
from itertools import repeat
from typing import Any

import numpy as np

# Bits of `flags.num` that are part of the type of an array.
_C, _F, _ALIGNED, _WRITEABLE = 0x1, 0x2, 0x100, 0x400
_TYPED = _C | _F | _ALIGNED | _WRITEABLE
# An array that is contiguous in both orders, such as one with a single item, counts as C order.
_FLAGS = {bits: bits & ~_F if bits & _C else bits for bits in range(_TYPED + 1)}
_SIGNED_LIMIT = 1 << 63
# Offset of the data pointer in a NumPy record: it follows the header of objects of variable size,
# which is all that a tuple without items has.
_VOID_DATA = tuple.__basicsize__


class Words:
    """Memory for the arguments and the result of one call, viewed as integers and as floats."""

    __slots__ = ("address", "floats", "last", "signed", "unsigned")

    def __init__(self, count: int) -> None:
        memory: Any = np.zeros(max(count, 1), dtype=np.int64)
        self.address: int = memory.ctypes.data
        self.signed = memoryview(memory)
        as_bytes = self.signed.cast("B")
        self.floats = as_bytes.cast("d")
        self.unsigned = as_bytes.cast("Q")
        self.last: tuple[Any, ...] = ()  # the arguments in these words


class ArgumentType:
    """The type of one argument.

    Attributes:
        text: the type as text, the same in each process.
        count: number of words of an argument.
    """

    __slots__ = ("count", "key", "text")

    def __init__(self, key: Any, text: str, count: int = 1) -> None:
        self.key = key  # the value of `type_key` for arguments of this type
        self.text = text
        self.count = count

    def fits(self, new: Any, last: Any = None) -> bool:
        """Return whether an argument has this type.

        `last`: an earlier argument that has this type; None: not known. Items that are the same
        objects in both are not checked again.
        """
        return bool(type_of(new).text == self.text)

    def write(self, words: Words, at: int, new: Any) -> None:
        """Store an argument in the words from `at` on."""
        raise NotImplementedError

    def update(self, words: Words, at: int, new: Any, last: Any) -> None:
        """Store an argument in words that contain `last`."""
        self.write(words, at, new)


class _NoneType(ArgumentType):
    __slots__ = ()

    def write(self, words: Words, at: int, new: Any) -> None:
        """Store nothing: `None` takes no word."""


class _Signed(ArgumentType):
    __slots__ = ()

    def write(self, words: Words, at: int, new: Any) -> None:
        words.signed[at] = int(new)


class _Unsigned(ArgumentType):
    __slots__ = ()

    def write(self, words: Words, at: int, new: Any) -> None:
        words.unsigned[at] = int(new)


class _Float(ArgumentType):
    __slots__ = ()

    def write(self, words: Words, at: int, new: Any) -> None:
        words.floats[at] = new


class _Array(ArgumentType):
    __slots__ = ()

    def fits(self, new: Any, last: Any = None) -> bool:
        if type(new) is not np.ndarray:
            return False
        dtype, ndim, flags = self.key
        return bool(
            (new.dtype is dtype or new.dtype == dtype)
            and new.ndim == ndim
            and new.flags.num & flags == flags
        )

    def write(self, words: Words, at: int, new: Any) -> None:
        words.signed[at] = id(new)


class _Record(ArgumentType):
    __slots__ = ()

    def write(self, words: Words, at: int, new: Any) -> None:
        words.signed[at] = ctypes.c_int64.from_address(id(new) + _VOID_DATA).value


class _Tuple(ArgumentType):
    """A tuple, or a bundle: a named tuple of arrays and numbers."""

    __slots__ = ("_items", "_offsets", "_python")

    def __init__(self, key: Any, python: type[Any], items: tuple[ArgumentType, ...]) -> None:
        name = "" if python is tuple else f"{python.__module__}.{python.__qualname__}"
        text = f"{name}({','.join(item.text for item in items)})"
        super().__init__(key, text, sum(item.count for item in items))
        self._python = python
        self._items = items
        self._offsets = offsets_of(items)

    def fits(self, new: Any, last: Any = None) -> bool:
        return (
            type(new) is self._python
            and len(new) == len(self._items)
            and all(
                value is known or item.fits(value, known)
                for item, value, known in zip(
                    self._items, new, repeat(None) if last is None else last, strict=False
                )
            )
        )

    def write(self, words: Words, at: int, new: Any) -> None:
        for item, offset, value in zip(self._items, self._offsets, new, strict=True):
            item.write(words, at + offset, value)

    def update(self, words: Words, at: int, new: Any, last: Any) -> None:
        for item, offset, value, known in zip(self._items, self._offsets, new, last, strict=True):
            if value is not known:
                item.update(words, at + offset, value, known)


def offsets_of(types: tuple[ArgumentType, ...]) -> tuple[int, ...]:
    """Return the index of the first word of each argument."""
    offsets, at = [], 0
    for kind in types:
        offsets.append(at)
        at += kind.count
    return tuple(offsets)


_NUMBERS: dict[type[Any], tuple[type[ArgumentType], str]] = {
    bool: (_Signed, "bool"),
    np.bool_: (_Signed, "bool"),
    float: (_Float, "float64"),
    np.float64: (_Float, "float64"),
    np.float32: (_Float, "float32"),
    np.uint64: (_Unsigned, "uint64"),
    # Shorter integers are widened, so that no kernel is compiled for each length.
    **dict.fromkeys(
        (np.int8, np.int16, np.int32, np.int64, np.uint8, np.uint16, np.uint32), (_Signed, "int64")
    ),
}
_LAYOUT = re.compile(r"\[(\d+)([CFA])( readonly)?( unaligned)?\]")


def type_key(argument: Any) -> Any:
    """Return a value that is equal for two arguments only if their types are equal."""
    python = type(argument)
    if python is np.ndarray:
        return argument.dtype, argument.ndim, _FLAGS[argument.flags.num & _TYPED]
    if python is int:
        return -_SIGNED_LIMIT <= argument < _SIGNED_LIMIT
    if issubclass(python, tuple):
        return python, *map(type_key, argument)
    if python is np.void:
        return argument.dtype
    return python


_TYPES: dict[Any, ArgumentType] = {}


def type_of(argument: Any) -> ArgumentType:
    """Return the type of an argument.

    Raises:
        TypeError: kernels do not accept the argument.
    """
    key = type_key(argument)
    found = _TYPES.get(key)
    if found is None:
        found = _TYPES[key] = _make_type(argument, key)
    return found


def _make_type(argument: Any, key: Any) -> ArgumentType:
    python = type(argument)
    if python is np.ndarray:
        return _Array(key, _array_text(*key))
    if python is int:
        return _Signed(key, "int64") if key else _Unsigned(key, "uint64")
    if issubclass(python, tuple):
        return _Tuple(key, python, tuple(map(type_of, argument)))
    if python is np.void:
        return _Record(key, _dtype_text(argument.dtype))
    if argument is None:
        return _NoneType(key, "none", 0)
    if python in _NUMBERS:
        kind, text = _NUMBERS[python]
        return kind(key, text)
    raise TypeError(
        f"an argument of a kernel is a {python.__module__}.{python.__qualname__}; pass NumPy "
        "arrays, numbers, None, or tuples of these"
    )


def _array_text(dtype: np.dtype[Any], ndim: int, flags: int) -> str:
    """Return the type of an array as text: dtype, dimensions, memory layout."""
    layout = "C" if flags & _C else "F" if flags & _F else "A"
    extra = "" if flags & _WRITEABLE else " readonly"
    extra += "" if flags & _ALIGNED else " unaligned"
    return f"{_dtype_text(dtype)}[{ndim}{layout}{extra}]"


def accepts(compiled: str, called: str) -> bool:
    """Return whether code that was compiled for some types can be called with other types.

    Code for read-only arrays never writes to them, and code for any layout (`A`) follows the
    strides. Both also accept other arrays.

    Args:
        compiled: types for which the code was compiled, as text.
        called: types of the arguments of a call, as text.
    """
    if compiled == called:
        return True
    if _LAYOUT.sub("[]", compiled) != _LAYOUT.sub("[]", called):
        return False
    return all(
        one[0] == other[0]
        and one[1] in ("A", other[1])
        and (one[2] != "" or other[2] == "")
        and (one[3] != "" or other[3] == "")
        for one, other in zip(_LAYOUT.findall(compiled), _LAYOUT.findall(called), strict=True)
    )


@cache
def _dtype_text(dtype: np.dtype[Any]) -> str:
    if dtype.fields is None:
        if dtype.subdtype is not None:
            items, shape = dtype.subdtype
            return f"{_dtype_text(items)}{list(shape)}"
        return dtype.str
    fields = ";".join(
        f"{name}:{_dtype_text(dtype.fields[name][0])}@{dtype.fields[name][1]}"
        for name in dtype.names or ()
    )
    return f"{{{fields}|{dtype.itemsize}}}"


def result_reader(text: str, at: int) -> tuple[int, Callable[[Words], Any]]:
    """Return the number of words of a result, and a function that reads it.

    Args:
        text: type of the result, as described by `entry_point.result_text`: `none`, `bool`,
            `signed`, `unsigned`, `float`; for a tuple several of these, each followed by a comma.
        at: index of the first word of the result.
    """
    if text == "none":
        return 0, lambda words: None
    if "," not in text:
        return 1, _word_reader(text, at)
    names = text.split(",")[:-1]
    readers = [_word_reader(name, at + k) for k, name in enumerate(names)]
    return len(names), lambda words: tuple([read(words) for read in readers])


def _word_reader(name: str, at: int) -> Callable[[Words], Any]:
    if name == "float":
        return lambda words: words.floats[at]
    if name == "bool":
        return lambda words: words.signed[at] != 0
    if name == "unsigned":
        return lambda words: words.unsigned[at]
    return lambda words: words.signed[at]
