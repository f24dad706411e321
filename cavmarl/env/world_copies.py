"""Copies of environments. Each copy has its own worlds, which continue bit for bit."""

from __future__ import annotations

from copy import deepcopy
from typing import Any


class OwnWorlds:
    """Base of objects that hold worlds. Two shallow copies would step the same worlds."""

    def __copy__(self) -> Any:
        """Return a deep copy, so that two environments never step the same worlds."""
        return deepcopy(self)
