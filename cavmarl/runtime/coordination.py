"""`Coordination`: the coordinators of W worlds, and the rows that change hands as they say."""

from __future__ import annotations

import secrets
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cavmarl.kernels.arrays import Gate
from cavmarl.kernels.zones import zones_of
from cavmarl.ownership.limits import Limits
from cavmarl.ownership.messages import RUN_BYTES
from cavmarl.runtime.coordinator import Coordinator, Journal, Near, Watcher
from cavmarl.runtime.division import Division
from cavmarl.runtime.post import Post

__all__ = ["Coordination", "RowStates"]


class RowStates:
    """States of one world's vehicles at the committed tick, read from the rows of their owners.

    Args:
        division: of all worlds.
        world: which one.
    """

    def __init__(self, division: Division, world: int) -> None:
        self._division = division
        self._world = world
        self._known: dict[int, bytes] = {}

    def forget(self) -> None:
        """Another tick is committed."""
        self._known.clear()

    def near(self, entry: Near) -> bytes:
        """Of a vehicle near a border, whose row is known."""
        found = self._known.get(entry.vehicle)
        if found is None:
            found = self._division.state(self._world, entry.source, entry.row)
            self._known[entry.vehicle] = found
        return found

    def state(self, vehicle: int) -> bytes:
        """Of any vehicle."""
        found = self._known.get(vehicle)
        if found is None:
            found = self._division.state(self._world, *self._division.find(self._world, vehicle))
            self._known[vehicle] = found
        return found


class Coordination:
    """Who advances which vehicle, in all worlds.

    Args:
        division: whose rows change hands.
        limits: deadlines of the protocol.
        posts: what carries the messages, by world; empty: they arrive directly.
        journals: what takes the records, by world; empty: nothing.
        watchers: told of all that happens in a world, by world; empty: nobody.
    """

    def __init__(
        self,
        division: Division,
        limits: Limits,
        posts: Sequence[Post] = (),
        journals: Sequence[Journal] = (),
        watchers: Sequence[Sequence[Watcher]] = (),
    ) -> None:
        self._division = division
        self._states = tuple(RowStates(division, w) for w in range(division.num_worlds))
        self.coordinators = tuple(
            Coordinator(
                secrets.token_bytes(RUN_BYTES),
                division.count,
                states,
                limits,
                posts[w] if posts else None,
                journals[w] if journals else None,
                watchers[w] if watchers else (),
            )
            for w, states in enumerate(self._states)
        )

    @property
    def switched(self) -> int:
        """Vehicles that have changed their owner since the worlds were made."""
        return sum(coordinator.switched for coordinator in self.coordinators)

    def reset(self, chosen: NDArray[np.bool_]) -> None:
        """Begin an episode in the chosen worlds (W,), with the vehicles that are there."""
        for w, coordinator in enumerate(self.coordinators):
            if chosen[w]:
                coordinator.reset()
                coordinator.entered(self._division.owners(w))

    def begin(self) -> None:
        """Lease the next tick, and hand over whose owner changes."""
        for w, coordinator in enumerate(self.coordinators):
            self._states[w].forget()
            near = self._division.near(w)
            rows = {entry.vehicle: entry.row for entry in near}
            for switch, state in coordinator.begin(near, self._states[w].near):
                self._division.hand_over(w, switch, state, rows.get(switch.vehicle, 0))

    def end(self) -> None:
        """Commit the tick that all zones have computed."""
        for coordinator in self.coordinators:
            coordinator.end(lambda zone: 0)

    def left(self, gate: Gate) -> None:
        """Those in `gate.passing` have left their worlds."""
        for w, coordinator in enumerate(self.coordinators):
            gone = gate.passing[w, : gate.num_passing[w]]
            if len(gone):
                coordinator.left(zip(gone["id"].tolist(), gone["events"].tolist(), strict=True))

    def entered(self, gate: Gate) -> None:
        """Those in `gate.passing` have come into their worlds."""
        for w, coordinator in enumerate(self.coordinators):
            new = gate.passing[w, : gate.num_passing[w]]
            if len(new):
                zones = np.empty(len(new), dtype=np.int32)
                zones_of(self._division.zones, new, len(new), zones)
                coordinator.entered(zip(new["id"].tolist(), zones.tolist(), strict=True))
