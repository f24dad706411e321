"""The compiler of kernels: Numba's, with the following changes.

Indices count from the front only. In Python, `a[-1]` is the last item, so Numba compares every
signed index with zero before it reads. In kernels, -1 means "none" and is checked beforehand.
Without that comparison, a tick of traffic is a tenth faster (decision 008). A negative literal
index, as in `a[-1]`, keeps its meaning. With `NUMBA_BOUNDSCHECK=1`, every index outside of its
array, including negative ones, is an `IndexError`; `make bounds` runs the tests with it.

The cache has only the machine code of a kernel, not its LLVM code, which would stay in memory.
Three changes shorten the first compilation (decision 002):

- A kernel that is called by another kernel is compiled as a part of its caller: it is not callable
  from Python, not cached, and optimised once, together with its caller. Numba makes each kernel
  callable, caches it and optimises it.
- A bundle of arrays is passed as one address and read in place. Numba passes each array as seven
  numbers, and rebuilds the bundle in the called function. A bundle that a kernel creates is stored
  once, when it is assigned, and not again for each call that it is passed to; the next execution of
  that line overwrites it.
- Without reference counts, no code is generated for the end of a variable's life.
"""

from __future__ import annotations

import gc
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from typing import Any

import numba
from llvmlite import ir
from llvmlite.binding import ModuleRef, Target, get_process_triple
from numba.core.cgutils import alloca_once, alloca_once_value, gep_inbounds
from numba.core.codegen import CodeLibrary, JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder, Flags
from numba.core.compiler_lock import global_compiler_lock
from numba.core.compiler_machinery import register_pass
from numba.core.datamodel.models import TupleModel
from numba.core.datamodel.registry import default_manager
from numba.core.ir import Assign
from numba.core.lowering import Lower
from numba.core.registry import CPUDispatcher
from numba.core.typed_passes import InlineOverloads, NativeLowering, NopythonRewrites
from numba.core.types import Integer, IntegerLiteral, NamedTuple, float64, int32, intp
from numba.core.untyped_passes import InlineClosureLikes, InlineInlinables
from numba.np import arrayobj

from cavmarl.core.compiled.entry_point import EntryPoint, result_text

# Passes for features that no kernel uses, such as array expressions: kernels create no arrays.
_NEEDLESS = {InlineClosureLikes, InlineInlinables, InlineOverloads, NopythonRewrites}


_copy: Any = alloca_once_value
_place: Any = alloca_once
_field: Any = gep_inbounds


@contextmanager
def _from_the_front() -> Iterator[None]:
    """Compile array accesses without the comparison while this context is open.

    Numba compiles under one lock, so no other function is lowered at the same time.
    """
    usual: Any = arrayobj.fix_integer_index

    def fix(context: Any, builder: Any, index_type: Any, index: Any, size: Any) -> Any:
        if index_type.signed and not isinstance(index, ir.Constant):
            return context.cast(builder, index, index_type, intp)
        return usual(context, builder, index_type, index, size)

    arrayobj.fix_integer_index = fix
    try:
        yield
    finally:
        arrayobj.fix_integer_index = usual


def _is_bundle(kind: Any) -> bool:
    return isinstance(kind, NamedTuple) and kind.instance_class.__module__.startswith("cavmarl.")


def _borrow(builder: Any, address: Any, is_fixed: bool) -> Any:
    """Load the value at an address, and mark it as borrowed: used in place, not copied.

    LLVM reads only the parts that are used.

    `is_fixed`: whether the address and the value there are the same in the whole function.
    """
    value = builder.load(address)
    value.borrowed = True
    value.is_fixed = is_fixed
    return value


def _read_apart(builder: Any, address: Any) -> Any:
    """Load the value at an address, number by number."""
    kind = address.type.pointee
    if not isinstance(kind, (ir.LiteralStructType, ir.ArrayType)):
        return builder.load(address)
    whole = ir.Constant(kind, ir.Undefined)
    for place in range(len(kind)):
        number = _read_apart(builder, _field(builder, address, 0, place))
        whole = builder.insert_value(whole, number, place)
    return whole


def _is_borrowed(value: Any) -> bool:
    return getattr(value, "borrowed", False)


_Model: Any = TupleModel


class _BundleModel(_Model):  # type: ignore[misc]
    """Numba's model of named tuples: bundles are passed by address, others unchanged."""

    def get_argument_type(self) -> Any:
        if _is_bundle(self._fe_type):
            return self.get_value_type().as_pointer()
        return super().get_argument_type()

    def as_argument(self, builder: Any, value: Any) -> Any:
        """Return the address of the bundle, or of a copy that is made for the call."""
        if not _is_bundle(self._fe_type):
            return super().as_argument(builder, value)
        return value.operands[0] if _is_borrowed(value) else _copy(builder, value)

    def from_argument(self, builder: Any, value: Any) -> Any:
        """Return the bundle at that address."""
        if not _is_bundle(self._fe_type):
            return super().from_argument(builder, value)
        return _borrow(builder, value, is_fixed=True)


_manager: Any = default_manager
_manager.register(NamedTuple, _BundleModel)

_Lower: Any = Lower


class _KernelLower(_Lower):  # type: ignore[misc]
    """Reads the fields of bundles in place, and generates no code for the end of variables.

    Functions that count references are lowered as usual.
    """

    def init(self) -> None:
        """Count the assignments of each variable."""
        super().init()
        self._bundles: dict[str, Any] = {}
        # by variable: where the address of its present bundle is stored; see `storevar`
        self._addresses: dict[str, Any] = {}
        self._fields: dict[tuple[Any, int], Any] = {}
        blocks = self.blocks.values()
        self._assigned = Counter(
            step.target.name for block in blocks for step in block.find_insts(Assign)
        )

    def setup_function(self, fndesc: Any) -> None:
        """Declare bundles as never written, so that LLVM need not read a field again."""
        super().setup_function(fndesc)
        for argument in self.call_conv.get_arguments(self.function):
            kind = argument.type
            if isinstance(kind, ir.PointerType) and isinstance(kind.pointee, ir.LiteralStructType):
                argument.add_attribute("noalias")
                argument.attributes.dereferenceable = self.context.get_abi_sizeof(kind.pointee)

    def lower_expr(self, resty: Any, expr: Any) -> Any:
        """Read a field of a borrowed bundle at the field's address, without the whole bundle."""
        if expr.op == "getattr" and not self.context.enable_nrt:
            kind = self.typeof(expr.value.name)
            bundle: Any = self.loadvar(expr.value.name) if _is_bundle(kind) else None
            if _is_borrowed(bundle):
                place = kind.fields.index(expr.attr)
                read = self._read if bundle.is_fixed else self._read_here
                return read(bundle.operands[0], place, resty)
        return super().lower_expr(resty, expr)

    def create_cpython_wrapper(self, release_gil: bool = False) -> None:
        """Create the entry point for calls from Python, in place of Numba's wrapper."""
        self.library.add_ir_module(EntryPoint(self.context, self.fndesc, _ENTRY).module)

    def _read(self, address: Any, place: int, kind: Any) -> Any:
        """Read a field of a bundle at the start of the function, once for all its uses."""
        if (address, place) not in self._fields:
            with self.builder.goto_entry_block():
                field = _field(self.builder, address, 0, place)
                self._fields[address, place] = self._read_field(field, kind, is_fixed=True)
        return self._fields[address, place]

    def _read_here(self, address: Any, place: int, kind: Any) -> Any:
        """Read a field of a bundle that is not the same in the whole function."""
        return self._read_field(_field(self.builder, address, 0, place), kind, is_fixed=False)

    def _read_field(self, address: Any, kind: Any, is_fixed: bool) -> Any:
        if _is_bundle(kind):
            return _borrow(self.builder, address, is_fixed)
        return _read_apart(self.builder, address)

    def _alloca_var(self, name: str, fetype: Any) -> None:
        if name not in self._bundles and name not in self._addresses:
            super()._alloca_var(name, fetype)

    def loadvar(self, name: str) -> Any:
        """Return a borrowed bundle without copying it into a variable."""
        if name in self._addresses:
            address = self.builder.load(self._addresses[name])
            return _borrow(self.builder, address, is_fixed=False)
        return self._bundles[name] if name in self._bundles else super().loadvar(name)

    def storevar(self, value: Any, name: str, argidx: Any = None) -> None:
        """Store a value, or the address of a bundle, without reading the variable's old value."""
        if self.context.enable_nrt or name in self._singly_assigned_vars:
            super().storevar(value, name, argidx)
        elif _is_bundle(self.typeof(name)):
            if _is_borrowed(value) and value.is_fixed and self._assigned[name] == 1:
                self._bundles[name] = value
                return
            address = value.operands[0] if _is_borrowed(value) else _copy(self.builder, value)
            if name not in self._addresses:
                self._addresses[name] = _place(self.builder, address.type)
            self.builder.store(address, self._addresses[name])
        else:
            self._alloca_var(name, self.typeof(name))
            self.builder.store(value, self.getvar(name))

    def delvar(self, name: str) -> None:
        """Release the variable only if references are counted."""
        if self.context.enable_nrt:
            super().delvar(name)


_Library: Any = JITCodeLibrary
_ENTRY = "cavmarl_entry"  # name of a kernel's entry point until its object is written


class _Whole(_Library):  # type: ignore[misc]
    """A kernel that Python calls, linked into one module with all kernels that it calls."""

    def add_linking_library(self, library: CodeLibrary) -> None:
        """Link a library; if it is a part, also link the libraries that it calls."""
        if not isinstance(library, _Part):
            super().add_linking_library(library)
        elif library not in self._linking_libraries:
            self._linking_libraries.append(library)
            for called in library._linking_libraries:
                self.add_linking_library(called)

    def _optimize_functions(self, module: ModuleRef) -> None:
        module.data_layout = self._codegen._data_layout

    def _optimize_final_module(self) -> None:
        for function in self.get_defined_functions():
            if function.name != _ENTRY:
                function.linkage = "internal"
        super()._optimize_final_module()

    def _finalize_final_module(self) -> None:
        """Keep the module out of Numba's execution engine: only its object code is needed."""
        self._finalized = True

    def emit_object(self, symbol: str) -> bytes:
        """Return the machine code as a relocatable ELF object that defines one symbol."""
        self.finalize()
        self._final_module.get_function(_ENTRY).name = symbol
        code: bytes = _position_independent(self._codegen).emit_object(self._final_module)
        return code


@cache
def _position_independent(codegen: Any) -> Any:
    """Return a target machine for position-independent code, as in a shared library."""
    return Target.from_triple(get_process_triple()).create_target_machine(
        cpu=codegen._get_host_cpu_name(),
        features=codegen._tm_features,
        opt=3,
        reloc="pic",
        codemodel="default",
    )


class _Part(_Library):  # type: ignore[misc]
    """The code of a kernel for other kernels; it is never optimised on its own."""

    def add_linking_library(self, library: CodeLibrary) -> None:
        """Remember the called libraries for the kernels into which this part is linked."""
        self._linking_libraries.append(library)

    def _optimize_functions(self, module: ModuleRef) -> None:
        module.data_layout = self._codegen._data_layout

    def _get_module_for_linking(self) -> ModuleRef:
        """Return the module even if no call is known: it may be linked later."""
        return self._final_module


_register: Any = register_pass


@_register(mutates_CFG=True, analysis_only=False)
class _KernelLowering(NativeLowering):
    _name = "kernel_lowering"

    @property
    def lowering_class(self) -> Any:
        return _KernelLower

    def run_pass(self, state: Any) -> bool:
        """Lower to LLVM; register a part by a key, because it has no address, for its callers."""
        flags = state.flags
        is_part = flags.no_cpython_wrapper
        library = _Part if is_part else _Whole
        state.library = library(state.targetctx.codegen(), state.func_id.func_qualname)
        flags.no_compile = True
        lower: Any = super().run_pass
        with _from_the_front():
            done = bool(lower(state))
        key, lowered = object(), state["cr"]
        if is_part:
            state.targetctx.insert_user_function(key, lowered.fndesc, [state.library])
        state["cr"] = lowered._replace(cfunc=key)
        return done


_Flags: Any = Flags
_HASH = hash(_Flags())  # the same for all flags: Numba hashes only the names of the options


class _QuickFlags(_Flags):  # type: ignore[misc]
    """Numba's flags with a fast comparison: Numba compares them about 100,000 times."""

    __slots__ = ()

    def copy(self) -> Any:
        """Return flags for a called function, without how its caller is inlined and built."""
        flags = super().copy()
        for name in ("forceinline", "no_compile", "no_cpython_wrapper"):
            flags.discard(name)
        return flags

    def __hash__(self) -> int:
        return _HASH

    def __eq__(self, other: object) -> bool:
        if isinstance(other, Flags) and self._values == other._values:
            return True
        return bool(super().__eq__(other))


_Compiler: Any = CompilerBase


class KernelCompiler(_Compiler):  # type: ignore[misc]
    """Numba's usual pipeline with `_KernelLowering`, and without needless passes."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.state.flags = _QuickFlags(self.state.flags)

    def compile_extra(self, func: Any) -> Any:
        """Compile without the garbage collector, which would visit all objects that Numba keeps."""
        collects = gc.isenabled()
        gc.disable()
        try:
            return super().compile_extra(func)
        finally:
            if collects:
                gc.enable()

    def define_pipelines(self) -> list[Any]:
        builder: Any = DefaultPassBuilder
        manager = builder.define_nopython_pipeline(self.state)
        needless = set() if self.state.flags.nrt else _NEEDLESS
        manager.passes[:] = [
            (_KernelLowering if step is NativeLowering else step, about)
            for step, about in manager.passes
            if step not in needless
        ]
        manager.finalize()
        return [manager]


_Dispatcher: Any = CPUDispatcher
_compiler_lock: Any = global_compiler_lock


def _widened(kind: Any) -> Any:
    """Return one type for all whole numbers, whether literals or read from 32-bit fields."""
    if isinstance(kind, IntegerLiteral):
        kind = kind.literal_type
    return intp if kind is int32 else kind


class _PartDispatcher(_Dispatcher):  # type: ignore[misc]
    """Compiles a kernel for the kernels that call it."""

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """Return the template without compiling again for another kind of whole number."""
        wide = {name: _widened(kind) for name, kind in kws.items()}
        return super().get_call_template([_widened(kind) for kind in args], wide)

    def add_overload(self, result: Any) -> None:
        """Add the overload for kernels, but not for calls from Python."""
        self.overloads[tuple(result.signature.args)] = result


_Integer: Any = Integer


def _as_called(kind: Any) -> Any:
    """Return the type of a number or an array as it is passed by `arguments`."""
    is_short = isinstance(kind, _Integer) and kind.bitwidth < 64
    return intp if is_short else kind


_OPTIONS = {
    "nopython": True,
    "fastmath": False,
    "parallel": False,
    "nogil": True,
    "error_model": "numpy",
    "no_cfunc_wrapper": True,
    "_nrt": False,
}


def make_part(function: Callable[..., Any], is_inlined: bool) -> Any:
    """Return Numba's representation of a kernel that is called by other kernels."""
    options = {**_OPTIONS, "no_cpython_wrapper": True, "forceinline": is_inlined}
    return _PartDispatcher(function, targetoptions=options, pipeline_class=KernelCompiler)


def compile_kernel(
    function: Callable[..., Any], arguments: Sequence[Any], symbol: str
) -> tuple[str, bytes]:
    """Compile a kernel for the types of some arguments.

    Args:
        function: the Python function.
        arguments: example arguments; only their types count.
        symbol: name of the entry point, see `entry_point`.

    Returns:
        The type of the result, see `arguments.result_reader`, and a relocatable ELF object.

    Raises:
        numba.core.errors.NumbaError: Numba cannot compile the function.
    """
    typeof: Any = numba.typeof
    kinds = tuple(_as_called(typeof(argument)) for argument in arguments)
    whole: Any = _Dispatcher(function, targetoptions=dict(_OPTIONS), pipeline_class=KernelCompiler)
    with _compiler_lock:
        whole.typingctx.refresh()
        whole.targetctx.refresh()
        compiled = whole._compiler.compile(kinds, None)
        result = result_text(compiled.signature.return_type)
        return result, compiled.library.emit_object(symbol)


def compile_callback(function: Callable[..., Any], num_numbers: int) -> Any:
    """Compile a function from float64 to float64, for kernels that call it by address.

    Returns:
        An object with an `address`, which is valid as long as the object lives.

    Raises:
        numba.core.errors.NumbaError: Numba cannot compile the function.
    """
    cfunc: Any = numba.cfunc
    return cfunc(float64(*(float64,) * num_numbers), error_model="numpy")(function)
