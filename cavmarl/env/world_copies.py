"""Copies of environments: each has worlds of its own, which go on bit for bit."""

from __future__ import annotations

from copy import deepcopy
from typing import Any


class OwnWorlds:
    """Base of whatever holds worlds: a shallow copy would step those of the first one."""

    def __copy__(self) -> Any:
        """As `copy.deepcopy`: two environments never step the same worlds."""
        return deepcopy(self)
