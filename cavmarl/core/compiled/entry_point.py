"""The entry point of a compiled kernel: it converts words to Numba's arguments.

The function `int32 entry(int64 *words)` reads each argument as `arguments.py` has stored it. For an
array, it reads address, shape and strides from NumPy's C structure (`PyArrayObject`), so the words
of an array need no update if the array changes in place. The result is written to the words after
the arguments. The function returns Numba's status: 0, or the number of an exception.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import types as numba_types
from numba.core.cgutils import alloca_once, gep_inbounds

_WORD = ir.IntType(64)
_DOUBLE = ir.DoubleType()
_allocate: Any = alloca_once
_field: Any = gep_inbounds
types: Any = numba_types  # partly untyped

# Offsets in `PyArrayObject`, in bytes after the header of a Python object.
_DATA, _SHAPE, _STRIDES = 0, 16, 24


class EntryPoint:
    """Builds the entry point of one kernel in its own module."""

    def __init__(self, context: Any, fndesc: Any, symbol: str) -> None:
        self._context = context
        self._fndesc = fndesc
        self.module: Any = context.create_module(f"{symbol}.entry")
        function_type = ir.FunctionType(ir.IntType(32), [_WORD.as_pointer()])
        function = ir.Function(self.module, function_type, symbol)
        self._words = function.args[0]
        self._builder = ir.IRBuilder(function.append_basic_block("entry"))
        self._at = 0  # the next word to read
        self._build()

    def _build(self) -> None:
        context, builder, fndesc = self._context, self._builder, self._fndesc
        kind = context.call_conv.get_function_type(fndesc.restype, fndesc.argtypes)
        callee = ir.Function(self.module, kind, fndesc.llvm_func_name)
        arguments = [self._read_argument(kind) for kind in fndesc.argtypes]
        status, result = context.call_conv.call_function(
            builder, callee, fndesc.restype, fndesc.argtypes, arguments
        )
        with builder.if_then(status.is_error):
            builder.ret(status.code)
        if isinstance(fndesc.restype, types.BaseTuple):
            for at, kind in enumerate(fndesc.restype.types):
                self._write_word(at, kind, builder.extract_value(result, at))
        elif not isinstance(fndesc.restype, types.NoneType):
            self._write_word(0, fndesc.restype, result)
        builder.ret(ir.IntType(32)(0))

    def _next_word(self) -> Any:
        place = self._builder.gep(self._words, [_WORD(self._at)])
        self._at += 1
        return self._builder.load(place)

    def _read_argument(self, kind: Any) -> Any:
        if isinstance(kind, types.BaseTuple) and len(kind) > 0:
            place = _allocate(self._builder, self._context.get_value_type(kind))
            self._fill(place, kind)
            value = self._builder.load(place)
            value.borrowed = True  # passed by address, see `compiler._BundleModel`
            return value
        return self._read(kind)

    def _fill(self, place: Any, kind: Any) -> None:
        """Store the next value of a type at an address."""
        if isinstance(kind, types.BaseTuple):
            for k, item in enumerate(kind.types):
                self._fill(_field(self._builder, place, 0, k), item)
        else:
            self._builder.store(self._read(kind), place)

    def _read(self, kind: Any) -> Any:
        context, builder = self._context, self._builder
        if isinstance(kind, types.Array):
            return self._read_array(kind)
        value_type = context.get_value_type(kind)
        if isinstance(kind, types.NoneType) or isinstance(kind, types.BaseTuple):
            return context.get_constant_null(kind)
        word = self._next_word()
        if isinstance(kind, types.Boolean):
            return builder.icmp_unsigned("!=", word, _WORD(0))
        if isinstance(kind, types.Integer):
            return word if value_type.width == 64 else builder.trunc(word, value_type)
        if isinstance(kind, types.Float):
            value = builder.bitcast(word, _DOUBLE)
            return value if value_type == _DOUBLE else builder.fptrunc(value, value_type)
        if isinstance(kind, types.Record):
            return builder.inttoptr(word, value_type)
        raise TypeError(f"a kernel cannot take an argument of Numba's type {kind}")

    def _read_array(self, kind: Any) -> Any:
        """Build Numba's description of an array from its Python object; it has no owner."""
        context, builder = self._context, self._builder
        array = context.make_array(kind)(context, builder)
        python = self._next_word()
        address = self._load(python, _DATA)
        shape = self._read_dimensions(self._load(python, _SHAPE), kind.ndim)
        strides = self._read_dimensions(self._load(python, _STRIDES), kind.ndim)
        count = _WORD(1)
        for k in range(kind.ndim):
            count = builder.mul(count, builder.extract_value(shape, k))
        array.meminfo = ir.Constant(array.meminfo.type, None)
        array.parent = ir.Constant(array.parent.type, None)
        array.nitems = count
        array.itemsize = _WORD(_size_of(context, kind.dtype))
        array.data = builder.inttoptr(address, array.data.type)
        array.shape = shape
        array.strides = strides
        return array._getvalue()

    def _load(self, python: Any, offset: int) -> Any:
        """Read a word of a Python object at an offset after its header."""
        place = self._builder.add(python, _WORD(object.__basicsize__ + offset))
        return self._builder.load(self._builder.inttoptr(place, _WORD.as_pointer()))

    def _read_dimensions(self, address: Any, ndim: int) -> Any:
        numbers = self._builder.inttoptr(address, _WORD.as_pointer())
        found: Any = ir.Constant(ir.ArrayType(_WORD, ndim), ir.Undefined)
        for k in range(ndim):
            number = self._builder.load(self._builder.gep(numbers, [_WORD(k)]))
            found = self._builder.insert_value(found, number, k)
        return found

    def _write_word(self, at: int, kind: Any, value: Any) -> None:
        builder = self._builder
        if isinstance(kind, types.Float):
            wide = value if value.type == _DOUBLE else builder.fpext(value, _DOUBLE)
            word = builder.bitcast(wide, _WORD)
        elif isinstance(kind, types.Boolean):
            word = builder.zext(value, _WORD)
        elif value.type.width == 64:
            word = value
        else:
            word = (builder.sext if kind.signed else builder.zext)(value, _WORD)
        builder.store(word, builder.gep(self._words, [_WORD(self._at + at)]))


def _size_of(context: Any, dtype: Any) -> int:
    return int(context.get_abi_sizeof(context.get_data_type(dtype)))


def result_text(result: Any) -> str:
    """Return the type of a result as text, as `arguments.result_reader` reads it.

    Raises:
        TypeError: the result is not a number or a tuple of numbers.
    """
    if isinstance(result, types.NoneType):
        return "none"
    if isinstance(result, types.BaseTuple):
        return "".join(f"{_number_text(item)}," for item in result.types)
    return _number_text(result)


def _number_text(kind: Any) -> str:
    if isinstance(kind, types.Boolean):
        return "bool"
    if isinstance(kind, types.Integer):
        return "signed" if kind.signed else "unsigned"
    if isinstance(kind, types.Float):
        return "float"
    raise TypeError(f"a kernel cannot return Numba's type {kind}: return a number or several")
