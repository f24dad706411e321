"""Driver models from outside of the package: kernels call them through a table of addresses.

The table is a symbol of this process, by name: compiled kernels refer to the name and not to what
stands there, so the cache on disk is the same whichever models are registered.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any

import llvmlite.binding
import numba
import numba.core.config
from llvmlite import ir
from numba import types
from numba.extending import intrinsic, overload

FIRST_REGISTERED = 16  # MODEL_* code of the first registered model
MAX_REGISTERED = 64

_NUM_NUMBERS = 8
_SYMBOL = "cavmarl_driver_models"
_ADDRESSES = (ctypes.c_int64 * MAX_REGISTERED)()
_MODELS: dict[int, Callable[..., float]] = {}
_COMPILED: dict[int, Any] = {}  # keeps the machine code of the addresses
_SIGNATURE = types.float64(*(types.float64,) * _NUM_NUMBERS)

llvmlite.binding.add_symbol(_SYMBOL, ctypes.addressof(_ADDRESSES))


def put_model(code: int, model: Callable[..., float]) -> None:
    """Let `ask_model` find a model; it is compiled now, and not kept on disk.

    Raises:
        numba.core.errors.NumbaError: it does not compile.
    """
    settings: Any = numba.core.config
    if not settings.DISABLE_JIT:
        compiled: Any = numba.cfunc(_SIGNATURE, error_model="numpy")(
            getattr(model, "py_func", model)
        )
        _COMPILED[code] = compiled
        _ADDRESSES[code - FIRST_REGISTERED] = compiled.address
    _MODELS[code] = model


def ask_model(
    code: int,
    speed: float,
    allowed: float,
    gap: float,
    front_speed: float,
    min_gap: float,
    tau: float,
    accel: float,
    decel: float,
) -> float:
    """The acceleration in m/s² that a registered model asks for."""
    return float(_MODELS[code](speed, allowed, gap, front_speed, min_gap, tau, accel, decel))


@intrinsic
def _call(typing_context: Any, code: Any, *numbers: Any) -> Any:
    """Call what the table holds for a code."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        place = ir.IntType(64)
        module = builder.module
        table_type = ir.ArrayType(place, MAX_REGISTERED)
        table = module.globals.get(_SYMBOL)
        if table is None:
            table = ir.GlobalVariable(module, table_type, _SYMBOL)
            table.linkage = "external"
        # By `*numbers` the rest comes as one tuple.
        values = [builder.extract_value(arguments[1], k) for k in range(_NUM_NUMBERS)]
        index = builder.sub(arguments[0], place(FIRST_REGISTERED))
        address = builder.load(builder.gep(table, [place(0), index]))
        double = ir.DoubleType()
        pointer = ir.FunctionType(double, [double] * _NUM_NUMBERS).as_pointer()
        return builder.call(builder.inttoptr(address, pointer), values)

    star: Any = types.StarArgTuple
    rest = star((types.float64,) * _NUM_NUMBERS)
    return types.float64(types.int64, rest), generate


@overload(ask_model)
def _ask_model(
    code: Any,
    speed: Any,
    allowed: Any,
    gap: Any,
    front_speed: Any,
    min_gap: Any,
    tau: Any,
    accel: Any,
    decel: Any,
) -> Any:
    def asked(
        code: Any,
        speed: Any,
        allowed: Any,
        gap: Any,
        front_speed: Any,
        min_gap: Any,
        tau: Any,
        accel: Any,
        decel: Any,
    ) -> Any:
        return _call(code, speed, allowed, gap, front_speed, min_gap, tau, accel, decel)

    return asked
