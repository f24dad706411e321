"""The choice of an episode's map from a network with several maps."""

from __future__ import annotations

import numpy as np

from cavmarl.core.compiled import kernel
from cavmarl.core.math.rng import STREAM_MAP, below


@kernel
def map_of(key: np.uint64, num_maps: int) -> int:
    """Return the MAP row of an episode, given the key of its seed, world and episode."""
    if num_maps == 1:
        return 0
    number: int = np.int64(below(key, 0, 0, STREAM_MAP, num_maps))  # type: ignore[assignment]
    return number
