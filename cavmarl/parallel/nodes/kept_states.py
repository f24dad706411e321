"""`KeptStates`: what a node keeps of its zones and of those of the node before it.

Now and then, between two steps, each node keeps what it needs to go on from there, and sends it to
the next node that lives. When a node is lost, the next one hosts its zones, and all go back to the
newest state that everyone has. What was done since is done again, which gives the same bytes. A
new node gets its zones in the same way, from those that have had them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from numpy.typing import NDArray

from cavmarl.core.errors import WorkerError
from cavmarl.parallel.checkpoint.world_cases import from_bytes, to_bytes
from cavmarl.parallel.local_worlds import LocalWorlds
from cavmarl.parallel.nodes.links import FrameKind, Links, NodeFrame

Array = NDArray[Any]
KEPT = 2  # so many states: the newest may not have come everywhere


class KeptStates:
    """Those of one node."""

    def __init__(self, worlds: LocalWorlds, links: Links, number: int) -> None:
        self._worlds = worlds
        self._links = links
        self._number = number
        self._own: dict[int, bytes] = {}  # by numbers of states
        self._others: dict[int, dict[int, bytes]] = {}  # node → the same

    def keep(self, state: int, living: Sequence[int]) -> None:
        """Keep what the worlds are now, here and at the next of the living nodes."""
        data = to_bytes(self._worlds.save())
        _add(self._own, state, data)
        if len(living) > 1:
            to = living[(living.index(self._number) + 1) % len(living)]
            self._links.send(to, FrameKind.KEEP, state, [data])

    def take(self, number: int, frame: NodeFrame) -> None:
        """What another node wants to have kept here."""
        _add(self._others.setdefault(number, {}), frame.number, bytes(frame.data))

    def load(
        self,
        state: int,
        lost: Sequence[int],  # nodes whose zones are hosted here from now on
        zones: Sequence[int],  # all that are
        takers: Sequence[int],  # nodes that are given some of those that were
    ) -> None:
        """Go back to a state.

        Raises:
            WorkerError: what a lost node had is not here.
        """
        worlds = self._worlds
        like = worlds.save()
        saved = from_bytes(self._own[state], like)
        for number in lost:
            found = self._others.get(number, {}).get(state)
            if found is None:
                raise WorkerError(f"what node {number} had is kept nowhere")
            saved[self._first - 1] += self._join(saved, from_bytes(found, like), like)
        if takers:
            data = to_bytes(saved)
            for taker in takers:
                self._links.send(taker, FrameKind.KEEP, state, [data])
        self._load_zones(saved, zones)

    def take_over(
        self,
        state: int,
        donors: Sequence[int],  # nodes that have had the zones
        zones: Sequence[int],
        check: Callable[[], None],  # raises if what is awaited will never come
    ) -> None:
        """Go on from a state that others had, with some of their zones."""
        like = self._worlds.save()
        for donor in donors:
            while state not in self._others.get(donor, {}):
                check()
                self._links.pump(None)
        first, *rest = (from_bytes(self._others[donor][state], like) for donor in donors)
        for found in rest:
            self._join(first, found, like)
        first[self._first - 1][...] = 0  # contacts stay where they were counted
        self._load_zones(first, zones)

    @property
    def _first(self) -> int:
        """Where in what is saved the vehicles of the first zone stand."""
        simulation, zones = self._worlds.simulation, self._worlds.world.partition.count
        return len(self._worlds.save()) - simulation.num_worlds * zones

    def _load_zones(self, saved: list[Array], zones: Sequence[int]) -> None:
        count = self._worlds.world.partition.count
        for n in range(self._first, len(saved)):
            if (n - self._first) % count not in zones:
                saved[n] = saved[n][:0]
        self._worlds.load_own(saved, zones[0])

    def _join(self, saved: list[Array], other: Sequence[Array], like: Sequence[Array]) -> Array:
        """Add the vehicles of another node to the saved ones, and what is kept of its agents.

        Returns:
            (W,) the contacts that it has counted.
        """
        simulation, zones = self._worlds.simulation, self._worlds.world.partition.count
        first = self._first
        kept = {id(array) for array in simulation.of_agents()}
        of_agents = [n for n, array in enumerate(like) if id(array) in kept]
        for n in range(first, len(saved)):
            if not len(other[n]):
                continue
            saved[n] = other[n]
            w = (n - first) // zones
            agents = other[n]["agent"][other[n]["agent"] >= 0]
            for k in of_agents:
                saved[k][w, agents] = other[k][w, agents]
        return other[first - 1]


def _add(states: dict[int, bytes], state: int, data: bytes) -> None:
    states[state] = data
    for old in sorted(states)[:-KEPT]:
        del states[old]
