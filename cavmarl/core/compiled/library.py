"""The library of compiled kernels in a wheel, and a check whether this machine can use it.

`prebuilt/kernels.so` defines an entry point for each kernel and list of argument types.
`prebuilt/kernels.json` lists them with the sources and the processor that they were built for.
"""

from __future__ import annotations

import ctypes
import hashlib
import json
import sys
import sysconfig
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from cavmarl.core.compiled.address_tables import attach_library
from cavmarl.core.compiled.arguments import accepts

FOLDER = Path(__file__).with_name("prebuilt")
LIBRARY_FILE = "kernels.so"
INDEX_FILE = "kernels.json"
FORMAT = 1

LEVEL_SYMBOL = "cavmarl_processor"  # writes the result of the instruction `cpuid`
# Features of x86-64-v3 beyond x86-64, as bits of the words that `LEVEL_SYMBOL` writes.
_LEAF_1_ECX = {
    "SSE3": 0, "SSSE3": 9, "FMA": 12, "CMPXCHG16B": 13, "SSE4.1": 19, "SSE4.2": 20, "MOVBE": 22,
    "POPCNT": 23, "OSXSAVE": 27, "AVX": 28, "F16C": 29,
}  # fmt: skip
_LEAF_7_EBX = {"BMI1": 3, "AVX2": 5, "BMI2": 8}
_EXTENDED_ECX = {"LAHF": 0, "LZCNT": 5}
_SAVED = {"XMM state": 1, "YMM state": 2}  # state that the system saves, from `xgetbv`
# Required bits of each word that `LEVEL_SYMBOL` writes.
LEVEL_WORDS = (_LEAF_1_ECX, _LEAF_7_EBX, _EXTENDED_ECX, _SAVED)


class Entry(NamedTuple):
    """The entry point of a kernel in the library."""

    address: int
    result: str  # type of the result


class UnusableLibraryError(Exception):
    """The library cannot be used on this machine; the message is a clause that gives the reason."""


class Library:
    """The opened library.

    Raises:
        UnusableLibraryError: there is no library, or it is damaged or for another machine.
    """

    def __init__(self, folder: Path = FOLDER) -> None:
        index = _read_index(folder / INDEX_FILE)
        here = python_tag()
        if index["python"] != here:
            raise UnusableLibraryError(
                f"the library of compiled kernels is for {index['python']}, but this is {here}"
            )
        path = folder / LIBRARY_FILE
        try:
            content = path.read_bytes()
        except OSError as error:
            raise UnusableLibraryError(f"{path} cannot be read ({error.strerror})") from error
        if hashlib.sha256(content).hexdigest() != index["sha256"]:
            raise UnusableLibraryError(f"{path} is damaged: install cavmarl again")
        try:
            self._library = ctypes.CDLL(str(path))
        except OSError as error:
            raise UnusableLibraryError(f"{path} cannot be loaded ({error})") from error
        if missing := missing_features(self._library, index["processor"]):
            raise UnusableLibraryError(
                f"the library of compiled kernels is for {index['processor']}, but this processor "
                f"lacks {', '.join(missing)}"
            )
        attach_library(self._library)
        self._modules: Mapping[str, str] = index["modules"]
        self._kernels: Mapping[str, Mapping[str, list[str]]] = index["kernels"]

    @staticmethod
    def is_there() -> bool:
        """Return whether this installation contains a library, usable or not."""
        return (FOLDER / INDEX_FILE).exists()

    def has(self, name: str, digest: str) -> bool:
        """Return whether the library has a kernel, for any types, from sources with this digest."""
        return name in self._kernels and self._modules[name.rpartition(".")[0]] == digest

    def find(self, name: str, types: str, digest: str) -> Entry | None:
        """Return a kernel's entry point for some argument types, or None."""
        if not self.has(name, digest):
            return None
        found = self._kernels[name]
        fitting = types if types in found else next((t for t in found if accepts(t, types)), None)
        if fitting is None:
            return None
        symbol, result = found[fitting]
        address = ctypes.cast(getattr(self._library, symbol), ctypes.c_void_p).value
        return None if address is None else Entry(address, result)


def python_tag() -> str:
    """Return the interpreter's tag for extensions, which fixes the memory layout of objects."""
    return str(sysconfig.get_config_var("SOABI") or sys.implementation.cache_tag)


def _read_index(path: Path) -> Mapping[str, Any]:
    try:
        content = path.read_bytes()
    except OSError as error:
        raise UnusableLibraryError(
            "this installation contains no library of compiled kernels"
        ) from error
    try:
        index: Mapping[str, Any] = json.loads(content)
        if index["format"] != FORMAT:
            raise UnusableLibraryError(f"{path} has format {index['format']}, must be {FORMAT}")
        body = {key: value for key, value in index.items() if key != "index_sha256"}
        if index_digest(body) != index["index_sha256"]:
            raise UnusableLibraryError(f"{path} is damaged: install cavmarl again")
    except (ValueError, KeyError, TypeError) as error:
        raise UnusableLibraryError(f"{path} is damaged: install cavmarl again") from error
    return index


def index_digest(index: Mapping[str, Any]) -> str:
    """Return the checksum of an index; it is stored in the index."""
    return hashlib.sha256(json.dumps(index, sort_keys=True).encode()).hexdigest()


def missing_features(library: ctypes.CDLL, processor: str) -> list[str]:
    """Return the features of x86-64-v3 that this processor lacks; empty for other targets."""
    if processor != "x86-64-v3":
        return []
    words = (ctypes.c_uint64 * len(LEVEL_WORDS))()
    getattr(library, LEVEL_SYMBOL)(words)
    return [
        name
        for word, bits in zip(words, LEVEL_WORDS, strict=True)
        for name, bit in bits.items()
        if not word >> bit & 1
    ]
