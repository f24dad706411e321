"""`KeptStates`: what a node keeps of its zones and of those of the node before it.

Now and then, between two steps, each node keeps what it needs to go on from there, and sends it to
the next node that lives. When a node is lost, the next one hosts its zones, and all go back to the
newest state that everyone has. What was done since is done again, which gives the same bytes.
"""

from __future__ import annotations

from collections.abc import Sequence
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

    def load(self, state: int, lost: Sequence[int], home: int) -> None:
        """Go back to a state, with the zones of lost nodes.

        Raises:
            WorkerError: what one of them had is not here.
        """
        worlds = self._worlds
        like = worlds.save()
        saved = from_bytes(self._own[state], like)
        for number in lost:
            found = self._others.get(number, {}).get(state)
            if found is None:
                raise WorkerError(f"what node {number} had is kept nowhere")
            self._join(saved, from_bytes(found, like), like)
        worlds.load_own(saved, home)

    def _join(self, saved: list[Array], lost: Sequence[Array], like: Sequence[Array]) -> None:
        """Add the vehicles of a lost node to the saved ones, and what is kept of its agents."""
        simulation, zones = self._worlds.simulation, self._worlds.world.partition.count
        first = len(saved) - simulation.num_worlds * zones
        kept = {id(array) for array in simulation.of_agents()}
        of_agents = [n for n, array in enumerate(like) if id(array) in kept]
        saved[first - 1] += lost[first - 1]  # contacts
        for n in range(first, len(saved)):
            if not len(lost[n]):
                continue
            saved[n] = lost[n]
            w = (n - first) // zones
            agents = lost[n]["agent"][lost[n]["agent"] >= 0]
            for k in of_agents:
                saved[k][w, agents] = lost[k][w, agents]


def _add(states: dict[int, bytes], state: int, data: bytes) -> None:
    states[state] = data
    for old in sorted(states)[:-KEPT]:
        del states[old]
