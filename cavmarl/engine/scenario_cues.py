"""`Cues` detects the cues that the scripts of a scenario wait for."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import specialized
from cavmarl.driving.kernels.motion.scripted_rows import note_cues
from cavmarl.handoff.division import ZonedShards
from cavmarl.shards.shard import Commands, Shard


class Cues:
    """Looks at the agents of all zones at the beginning of each tick; `Component` to the worlds.

    Which cues have come is among what all shards have in common, `Worlds.cues`.
    """

    reads_all: tuple[str, ...] = ("begin",)

    def __init__(
        self, cues: NDArray[np.void], shards: Sequence[Shard], division: ZonedShards
    ) -> None:
        self._cues = cues
        self._worlds = shards[0].worlds
        self._division = division
        self._note_cues = specialized(note_cues)

    def reset(self, chosen: NDArray[np.bool_]) -> None:
        """Nothing to do: with the actors of an episode no cue has come yet."""

    def begin(self, commands: Commands) -> None:
        """Note cues whose time has come, or that an agent is near."""
        zoned, worlds = self._division.zoned, self._worlds
        rows = zoned.rows[self._division.side]
        self._note_cues(self._cues, rows, zoned.num_owned, worlds.ticks, worlds.cues)

    def end(self) -> None:
        """Nothing to do: rows follow their scripts as they move."""

    def arrays(self) -> Iterator[NDArray[Any]]:
        """None of its own."""
        return iter(())

    def wrong(self, saved: Sequence[NDArray[Any]]) -> str:
        """Return nothing: no number of them is the place of something."""
        return ""
