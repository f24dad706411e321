"""`V2xComponent`: the message bus as a `Component`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.engine.component import Component, ComponentContext
from cavmarl.roads.network import CARS
from cavmarl.shards.shard import Commands, common_of
from cavmarl.v2x.bus import Bus


class V2xComponent(Component):
    """Lets the stations of W worlds send and receive at the end of each tick.

    Messages that are received in a tick are in the inboxes when agents sense at its end.
    """

    reads_all = ("end",)

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
        # permissions (W, L) in the worlds and (L,) on the map; None: lanes do not change
        self._permissions: NDArray[np.uint32] | None = None
        if host.config.map.changed_lanes and len(self.bus.units):
            self._permissions = host.shards[0].own_lanes["permissions"]
        self._on_map: NDArray[np.uint32] = host.network.lanes["permissions"]

    def reset(self, chosen: NDArray[np.bool_]) -> None:
        self.bus.reset(chosen)

    def begin(self, commands: Commands) -> None:
        """Pass the events that agents declare to the bus, in the first tick of a step."""
        if commands.declared.size and self._ticks.item(0) % self._ticks_per_step == 0:
            self.bus.declare(commands.declared)
        if self._permissions is not None:
            for world, permissions in enumerate(self._permissions):
                is_closed = (permissions & CARS == 0) & (self._on_map & CARS != 0)
                self.bus.tell_closures(world, is_closed)

    def end(self) -> None:
        self.bus.exchange(self._division.side)

    def arrays(self) -> Iterator[NDArray[Any]]:
        """Return the inboxes, the counts and the messages in flight."""
        return self.bus.arrays()

    def wrong(self, saved: Sequence[NDArray[Any]]) -> str:
        return self.bus.wrong(saved)


def without_network(attached: Iterable[object]) -> AbstractContextManager[None]:
    """Return a context in which no network simulator is called; see `Bus.muted`."""
    buses = (part.bus for part in attached if isinstance(part, V2xComponent))
    return next((bus.muted() for bus in buses), nullcontext())
