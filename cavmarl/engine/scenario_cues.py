"""`Cues` detects the cues that the scripts of a scenario wait for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import specialized
from cavmarl.driving.kernels.motion.scripted_rows import note_cues
from cavmarl.engine.component import Component
from cavmarl.handoff.division import ZonedShards
from cavmarl.shards.shard import Commands, Shard


class Cues(Component):
    """Checks the agents of all zones at the beginning of each tick.

    The detected cues are in `Worlds.cues`, which all shards share.
    """

    reads_all = ("begin",)

    def __init__(
        self, cues: NDArray[np.void], shards: Sequence[Shard], division: ZonedShards
    ) -> None:
        self._cues = cues
        self._worlds = shards[0].worlds
        self._division = division
        self._note_cues = specialized(note_cues)

    def begin(self, commands: Commands) -> None:
        """Record each cue whose time has come, or that has an agent nearby."""
        zoned, worlds = self._division.zoned, self._worlds
        rows = zoned.rows[self._division.side]
        self._note_cues(self._cues, rows, zoned.num_owned, worlds.ticks, worlds.cues)
