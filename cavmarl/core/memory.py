"""`Zeros`: a function that allocates arrays in the memory of one process or of several."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

from numpy.typing import NDArray

Zeros: TypeAlias = Callable[..., NDArray[Any]]
"""A function with the arguments of `numpy.zeros`; it may use huge pages or shared memory."""
