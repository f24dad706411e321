"""Driver models that a user registers: kernels call them through a table of addresses.

Compiled kernels refer to the table by a symbol name and not by its content. So their code is the
same, whichever models are registered.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from cavmarl.core.compiled import IS_PLAIN, kernel
from cavmarl.core.compiled.address_tables import define_table
from cavmarl.core.compiled.intrinsic import intrinsic
from cavmarl.driving.kernels.models.acceleration_models import acceleration_model

FIRST_REGISTERED = 16  # MODEL_* code of the first registered model
MAX_REGISTERED = 64

_NUM_NUMBERS = 8
_SYMBOL = "cavmarl_driver_models"
_TABLE = define_table(_SYMBOL, MAX_REGISTERED)
_MODELS: dict[int, Callable[..., float]] = {}
_COMPILED: dict[int, Any] = {}  # keeps the machine code of the addresses


def put_model(code: int, model: Callable[..., float]) -> None:
    """Compile a model and add it to the table of `ask_model`; its code is not cached on disk.

    Raises:
        MissingExtraError: Numba is not installed.
        numba.core.errors.NumbaError: Numba cannot compile the model.
    """
    if not IS_PLAIN:
        from cavmarl.core.compiled.compiler import compile_callback

        compiled = compile_callback(getattr(model, "py_func", model), _NUM_NUMBERS)
        _COMPILED[code] = compiled
        _TABLE.write(code - FIRST_REGISTERED, compiled.address)
    _MODELS[code] = model


def _generate_call(typing: Any, code: Any, *numbers: Any) -> Any:
    """Generate a call of the function whose address is in the table at a code."""
    from llvmlite import ir
    from numba.core import types

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        place = ir.IntType(64)
        module = builder.module
        table_type = ir.ArrayType(place, MAX_REGISTERED)
        table = module.globals.get(_SYMBOL)
        if table is None:
            table = ir.GlobalVariable(module, table_type, _SYMBOL)
            table.linkage = "external"
        # The second argument is the tuple `*numbers`.
        values = [builder.extract_value(arguments[1], k) for k in range(_NUM_NUMBERS)]
        index = builder.sub(arguments[0], place(FIRST_REGISTERED))
        address = builder.load(builder.gep(table, [place(0), index]))
        double = ir.DoubleType()
        pointer = ir.FunctionType(double, [double] * _NUM_NUMBERS).as_pointer()
        return builder.call(builder.inttoptr(address, pointer), values)

    star: Any = types.StarArgTuple
    rest = star((types.float64,) * _NUM_NUMBERS)
    return types.float64(types.int64, rest), generate


@intrinsic(_generate_call)
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
    """Return the acceleration in m/s² that a registered model returns."""
    return float(_MODELS[code](speed, allowed, gap, front_speed, min_gap, tau, accel, decel))


@kernel
def _acceleration(
    kind: np.void, speed: float, allowed: float, gap: float, front_speed: float, front_decel: float
) -> float:
    min_gap = float(kind["min_gap"])
    tau = float(kind["tau"])
    accel = float(kind["accel"])
    decel = float(kind["decel"])
    code = int(kind["model"])
    return ask_model(code, speed, allowed, gap, front_speed, min_gap, tau, accel, decel)


REGISTERED = acceleration_model(_acceleration)  # functions of all registered models
