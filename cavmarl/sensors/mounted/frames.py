"""`SensorFrames`: where the samples of one sensor go, for all agents of W worlds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray


class SensorFrames(NamedTuple):
    """The samples of a sensor; S is the most that it takes in one step.

    The newest sample is the last one. Of the last step are the last `fresh` of them; those before
    are older. Agents without a vehicle have zeros.
    """

    data: NDArray[Any]  # (W, A, S, …)
    stamp_s: NDArray[np.float64]  # (W, A, S) when it was taken, in s since the reset
    lost: NDArray[np.bool_]  # (W, A, S) it was lost: its data is zeros
    fresh: NDArray[np.int64]  # (W, A) samples of the last step, lost ones among them

    def part(self, first: int, last: int) -> SensorFrames:
        """Those of some of the worlds, as views."""
        parts: list[Any] = [array[first:last] for array in self]
        return SensorFrames(*parts)

    def copy(self) -> SensorFrames:
        copies: list[Any] = [array.copy() for array in self]
        return SensorFrames(*copies)

    def of(self, world: int, agent: int) -> SensorFrames:
        """A copy of those of one agent, without the axes of worlds and agents."""
        copies: list[Any] = [array[world, agent].copy() for array in self]
        return SensorFrames(*copies)


Frames: TypeAlias = Mapping[str, SensorFrames]
"""By the sensor's name, in the order of the rig."""
