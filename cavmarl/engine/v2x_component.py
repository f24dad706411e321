"""`V2xComponent`: the bus of messages as a part that acts in each tick."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.shards.shard import Commands, common_of
from cavmarl.v2x.bus import Bus

if TYPE_CHECKING:
    from cavmarl.engine.component import ComponentContext


class V2xComponent:
    """Lets the stations of W worlds send and receive at the end of each tick; a `Component`.

    What is received in a tick is in the inboxes when agents sense, at its end.
    """

    reads_all: tuple[str, ...] = ("end",)

    def __init__(self, host: ComponentContext) -> None:
        worlds = host.shards[0].worlds
        self._division = host.division
        self._ticks = worlds.ticks
        self._ticks_per_step = host.config.clock.ticks_per_step
        self.bus = Bus(
            host.config,
            host.network,
            host.travel.types,
            host.division.zoned,
            common_of(worlds),
            host.zeros,
        )
        for shard in host.shards:
            shard.mail = self.bus.mail

    def reset(self, chosen: NDArray[np.bool_]) -> None:
        self.bus.reset(chosen)

    def begin(self, commands: Commands) -> None:
        """Take what agents tell others of in this step; they say it once, in its first tick."""
        if commands.declared.size and self._ticks.item(0) % self._ticks_per_step == 0:
            self.bus.declare(commands.declared)

    def end(self) -> None:
        self.bus.exchange(self._division.side)

    def arrays(self) -> Iterator[NDArray[Any]]:
        """The inboxes, the counts, and what is in flight."""
        return self.bus.arrays()

    def wrong(self, saved: Sequence[NDArray[Any]]) -> str:
        return self.bus.wrong(saved)


def without_network(attached: Iterable[object]) -> AbstractContextManager[None]:
    """Return the time in which no network simulator is asked; see `Bus.muted`."""
    buses = (part.bus for part in attached if isinstance(part, V2xComponent))
    return next((bus.muted() for bus in buses), nullcontext())
