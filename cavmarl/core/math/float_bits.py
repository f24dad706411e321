"""The 64 bits of a float64 as an integer, and back."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

from cavmarl.core.compiled.intrinsic import intrinsic

_FLOAT, _INT = struct.Struct("<d"), struct.Struct("<q")


def _generate_cast(source: str, target: str) -> Callable[..., Any]:
    """Return the generator of an instruction that reads the bits of one type as another."""

    def generate(typing: Any, value: Any) -> Any:
        from numba.core import types

        from_type, to_type = getattr(types, source), getattr(types, target)

        def cast(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            value = context.cast(builder, arguments[0], signature.args[0], from_type)
            return builder.bitcast(value, context.get_value_type(to_type))

        return to_type(value), cast

    return generate


@intrinsic(_generate_cast("float64", "int64"))
def float_to_bits(value: float) -> int:
    """Return the bits of a float64 as a signed integer; bit 63 is the sign."""
    bits: int = _INT.unpack(_FLOAT.pack(value))[0]
    return bits


@intrinsic(_generate_cast("int64", "float64"))
def bits_to_float(bits: int) -> float:
    """Return the float64 with these bits."""
    value: float = _FLOAT.unpack(_INT.pack(bits))[0]
    return value
