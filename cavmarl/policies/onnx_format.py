"""Writing of ONNX models as bytes, without a library.

ONNX files are Protocol Buffers. The numbers of their fields are from the file onnx.proto3 of ONNX
(https://github.com/onnx/onnx/blob/main/onnx/onnx.proto3). This module has the fields that a driver
needs. Equal arguments give equal bytes.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

IR_VERSION = 8
OPSET = 17  # the first operator set with LayerNormalization
FLOAT, INT64 = 1, 7  # TensorProto.DataType
_VARINT, _BYTES, _FIXED32 = 0, 2, 5  # wire types of Protocol Buffers
_ATTRIBUTE_FLOAT, _ATTRIBUTE_INT = 1, 2  # AttributeProto.AttributeType


class OnnxGraph:
    """A chain of operators; each operator reads the result of the previous one.

    Args:
        inputs: name of the input, float32 (rows, width).
        width: numbers in a row of the input.
    """

    def __init__(self, inputs: str, width: int) -> None:
        self.result = self._inputs = inputs
        self._width = width
        self._nodes: list[bytes] = []
        self._tensors: list[bytes] = []

    def add(
        self, operator: str, *others: str, of: str = "", to: str = "", **attributes: int | float
    ) -> str:
        """Add an operator and return the name of its result.

        Args:
            operator: name of an operator of ONNX.
            others: names of its inputs after the first.
            of: name of its first input; empty: the result of the previous operator.
            to: name for its result; empty: a new name.
            attributes: attributes of the operator.
        """
        first, result = of or self.result, to or f"{operator.lower()}_{len(self._nodes)}"
        parts = [_text(1, name) for name in (first, *others)]
        parts += [_text(2, result), _text(3, result), _text(4, operator)]
        parts += [_field(5, _attribute(name, value)) for name, value in attributes.items()]
        self._nodes.append(b"".join(parts))
        self.result = result
        return result

    def constant(self, name: str, values: NDArray[Any]) -> str:
        """Add an array, float32 or int64, and return its name."""
        array = np.asarray(values)
        kind = {np.dtype(np.float32): FLOAT, np.dtype(np.int64): INT64}[array.dtype]
        raw = array.astype(array.dtype.newbyteorder("<")).tobytes()
        parts = [_number(1, size) for size in array.shape]
        parts += [_number(2, kind), _text(8, name), _field(9, raw)]
        self._tensors.append(b"".join(parts))
        return name

    def model(self, result: str, width: int, name: str, facts: Mapping[str, str]) -> bytes:
        """Return the model as the bytes of a file.

        Args:
            result: name for the last operator's result.
            width: numbers in a row of the result.
            name: name of the model.
            facts: metadata of the model.
        """
        self.add("Identity", to=result)
        graph = [_field(1, node) for node in self._nodes]
        graph += [_text(2, name), *(_field(5, tensor) for tensor in self._tensors)]
        graph += [_field(11, _rows(self._inputs, self._width)), _field(12, _rows(result, width))]
        model = [_number(1, IR_VERSION), _text(2, "cavmarl"), _field(7, b"".join(graph))]
        model += [_field(8, _number(2, OPSET))]
        model += [_field(14, _text(1, key) + _text(2, value)) for key, value in facts.items()]
        return b"".join(model)


def _rows(name: str, width: int) -> bytes:
    """Return a ValueInfoProto: float32 of any number of rows of this width."""
    shape = _field(1, _text(2, "rows")) + _field(1, _number(1, width))
    return _text(1, name) + _field(2, _field(1, _number(1, FLOAT) + _field(2, shape)))


def _attribute(name: str, value: int | float) -> bytes:
    if isinstance(value, float):
        single = np.array(value, dtype="<f4").tobytes()
        return _text(1, name) + _key(2, _FIXED32) + single + _number(20, _ATTRIBUTE_FLOAT)
    return _text(1, name) + _number(3, value) + _number(20, _ATTRIBUTE_INT)


def _text(number: int, text: str) -> bytes:
    return _field(number, text.encode())


def _field(number: int, content: bytes) -> bytes:
    return _key(number, _BYTES) + _varint(len(content)) + content


def _number(number: int, value: int) -> bytes:
    return _key(number, _VARINT) + _varint(value)


def _key(number: int, wire_type: int) -> bytes:
    return _varint(number << 3 | wire_type)


def _varint(value: int) -> bytes:
    """Return a number of at least 0 in groups of seven bits, the lowest group first."""
    groups = []
    while value > 0x7F:
        groups.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*groups, value])
