"""`Zeros` makes the arrays that a tick writes, in memory of one process or of several."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

from numpy.typing import NDArray

Zeros: TypeAlias = Callable[..., NDArray[Any]]
"""Called like `numpy.zeros`, which it is unless processes share a world."""
