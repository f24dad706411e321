"""Tables of addresses that Python fills and compiled kernels read by name."""

from __future__ import annotations

import ctypes
from typing import Any


class AddressTable:
    """A table that kernels know by its symbol.

    The table has several copies, which all have the same content. Kernels that LLVM loads use the
    copy that this class makes. Each shared library of kernels contains a copy for its own kernels.
    """

    def __init__(self, symbol: str, size: int) -> None:
        self.symbol = symbol
        self.size = size
        self._copies: list[Any] = [(ctypes.c_int64 * size)()]

    @property
    def address(self) -> int:
        """The address of the first copy."""
        return ctypes.addressof(self._copies[0])

    def write(self, row: int, address: int) -> None:
        """Set a row of all copies."""
        for copy in self._copies:
            copy[row] = address

    def add_copy(self, library: ctypes.CDLL) -> None:
        """Fill the table's copy in a library, if there is one, and keep it up to date."""
        if not hasattr(library, self.symbol):
            return
        copy = (ctypes.c_int64 * self.size).in_dll(library, self.symbol)
        copy[:] = self._copies[0][:]
        self._copies.append(copy)


tables: list[AddressTable] = []
_libraries: list[ctypes.CDLL] = []


def define_table(symbol: str, size: int) -> AddressTable:
    """Return a new table of 64-bit addresses, all zero."""
    table = AddressTable(symbol, size)
    tables.append(table)
    for library in _libraries:
        table.add_copy(library)
    return table


def attach_library(library: ctypes.CDLL) -> None:
    """Fill the tables of a library of kernels, and keep them up to date."""
    _libraries.append(library)
    for table in tables:
        table.add_copy(library)
