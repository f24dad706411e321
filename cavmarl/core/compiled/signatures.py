"""Argument types of kernels as JSON, and example arguments of such types.

A signature refers to record types and bundles by the place of their definition, so it stays valid
if a field is added to one of them.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled.arguments import type_of

# Environment variable with the folder in which the package's calls of kernels are recorded.
CALLS_SETTING = "CAVMARL_KERNEL_CALLS"
_PACKAGE = "cavmarl."
_COMPILED = __name__.rpartition(".")[0]


def signature_of(arguments: tuple[Any, ...]) -> list[Any]:
    """Return the types of some arguments."""
    return [_describe(argument) for argument in arguments]


def example_arguments(signature: list[Any]) -> tuple[Any, ...]:
    """Return arguments of these types; arrays have the smallest possible size."""
    return tuple(_example(kind) for kind in signature)


def _describe(argument: Any) -> Any:
    if isinstance(argument, np.ndarray):
        text = type_of(argument).text
        layout = text[text.rindex("[") + 1 : -1]  # such as `2C readonly`
        return {"array": _describe_dtype(argument.dtype), "layout": layout}
    if isinstance(argument, tuple):
        items = [_describe(item) for item in argument]
        python = type(argument)
        if python is tuple:
            return {"tuple": items}
        fields = python._fields  # type: ignore[attr-defined]
        return {
            "bundle": f"{python.__module__}:{python.__qualname__}",
            "fields": dict(zip(fields, items, strict=True)),
        }
    if isinstance(argument, np.void):
        return {"record": _describe_dtype(argument.dtype)}
    return type_of(argument).text


def _example(kind: Any) -> Any:
    if kind == "none":
        return None
    if isinstance(kind, str):
        number = np.dtype(kind).type(0)
        return number.item() if kind in _PLAIN else number
    if "array" in kind:
        return _example_array(_find_dtype(kind["array"]), kind["layout"])
    if "record" in kind:
        return np.zeros(1, _find_dtype(kind["record"]))[0]
    if "tuple" in kind:
        return tuple(_example(item) for item in kind["tuple"])
    python = _find(kind["bundle"])
    return python(**{name: _example(item) for name, item in kind["fields"].items()})


_PLAIN = ("int64", "float64", "bool")  # Python's own types


def _example_array(dtype: np.dtype[Any], layout: str) -> NDArray[Any]:
    form, _, extra = layout.partition(" ")
    shape = (2,) * int(form[:-1])
    array = np.zeros(shape, dtype, order="F" if form[-1] == "F" else "C")
    if form[-1] == "A":
        array = np.zeros((*shape[:-1], 4), dtype)[..., ::2]
    if "unaligned" in extra:
        memory = np.zeros(array.nbytes + 1, np.uint8)
        array = memory[1:].view(dtype).reshape(shape)
    array.flags.writeable = "readonly" not in extra
    return array


def _describe_dtype(dtype: np.dtype[Any]) -> Any:
    if dtype.fields is None:
        if dtype.subdtype is not None:
            items, shape = dtype.subdtype
            return {"items": _describe_dtype(items), "shape": list(shape)}
        return dtype.str
    name = _dtype_names(len(sys.modules)).get(dtype)
    if name is not None:
        return name
    fields = [dtype.fields[field] for field in dtype.names or ()]
    return {
        "names": list(dtype.names or ()),
        "formats": [_describe_dtype(field[0]) for field in fields],
        "offsets": [field[1] for field in fields],
        "itemsize": dtype.itemsize,
    }


def _find_dtype(text: Any) -> np.dtype[Any]:
    if isinstance(text, str):
        return np.dtype(_find(text) if ":" in text else text)
    if "items" in text:
        return np.dtype((_find_dtype(text["items"]), tuple(text["shape"])))
    form: Any = {**text, "formats": [_find_dtype(part) for part in text["formats"]]}
    found: np.dtype[Any] = np.dtype(form)
    return found


def _find(name: str) -> Any:
    module, _, attribute = name.partition(":")
    return getattr(importlib.import_module(module), attribute)


@cache
def _dtype_names(loaded: int) -> dict[np.dtype[Any], str]:
    """Return the places in the package where record types are defined, by dtype."""
    found: dict[np.dtype[Any], str] = {}
    for module in sorted(name for name in sys.modules if name.startswith(_PACKAGE)):
        for name, value in vars(sys.modules[module]).items():
            if isinstance(value, np.dtype) and value.fields is not None:
                source = f"{module}:{name}"
                if len(source) < len(found.get(value, source + " ")):
                    found[value] = source
    return found


def record_call(function: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    """Append the types of a call to this process's file, if `CAVMARL_KERNEL_CALLS` names a folder.

    Calls from modules outside of the package are left out.
    """
    folder = os.environ.get(CALLS_SETTING)
    if not folder or not function.__module__.startswith(_PACKAGE) or not _is_ours():
        return
    name = f"{function.__module__}.{function.__qualname__}"
    line = json.dumps([name, signature_of(arguments)])
    with Path(folder, f"{os.getpid()}.jsonl").open("a") as file:
        file.write(line + "\n")


def _is_ours() -> bool:
    """Return whether a module of the package made the present call."""
    frame: Any = sys._getframe(1)
    while frame is not None:
        module = frame.f_globals.get("__name__", "")
        if not module.startswith((_COMPILED, "functools")):  # a cached property binds a call
            return bool(module.startswith(_PACKAGE))
        frame = frame.f_back
    return False
