"""`SensorFrames`: the samples of one sensor, for all agents of W worlds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray


class SensorFrames(NamedTuple):
    """The samples of a sensor; S is the largest number of samples in a step.

    The newest sample is the last one. The last `fresh` samples were taken in the last step; the
    samples before them are older. Agents without a vehicle have zeros.
    """

    data: NDArray[Any]  # (W, A, S, …)
    stamp_s: NDArray[np.float64]  # (W, A, S) time of the sample, in s since the reset
    lost: NDArray[np.bool_]  # (W, A, S) whether the sample is lost; its data is zero
    fresh: NDArray[np.int64]  # (W, A) samples of the last step, including lost ones

    def part(self, first: int, last: int) -> SensorFrames:
        """Return views of the frames of the worlds [first, last)."""
        parts: list[Any] = [array[first:last] for array in self]
        return SensorFrames(*parts)

    def copy(self) -> SensorFrames:
        copies: list[Any] = [array.copy() for array in self]
        return SensorFrames(*copies)

    def of(self, world: int, agent: int) -> SensorFrames:
        """Return a copy of one agent's frames, without the axes of worlds and agents."""
        copies: list[Any] = [array[world, agent].copy() for array in self]
        return SensorFrames(*copies)


Frames: TypeAlias = Mapping[str, SensorFrames]
"""Frames by sensor name, in the order of the rig."""
