"""Which node hosts which zones after nodes were lost, or others have come."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import NamedTuple

from cavmarl.core.errors import WorkerDeathError

Zones = list[list[int]]  # of each node


class ZoneMoves(NamedTuple):
    """What changes, from a state that nodes have kept."""

    zones: Zones  # from now on
    heirs: dict[int, int]  # lost node → the one that hosts its zones now
    donors: list[tuple[int, int]]  # nodes that give zones away, and those that get them


def living_of(zones: Sequence[Sequence[int]]) -> list[int]:
    """The nodes that host some, by rising numbers."""
    return [number for number, some in enumerate(zones) if some]


def moves_of(
    kept: Sequence[Sequence[int]],  # zones of each node when the state was kept
    homes: Sequence[Sequence[int]],  # zones of each node if none is lost
    lost: Sequence[int],
    living: Collection[int],
    state: int,  # its number
) -> ZoneMoves:
    """The next node of the ring has what a lost one had; zones go home where they can.

    Raises:
        WorkerDeathError: the next one is lost, too.
    """
    ring = living_of(kept)
    zones = [list(some) for some in kept]
    heirs: dict[int, int] = {}
    for number in (n for n in ring if n in lost):
        heir = ring[(ring.index(number) + 1) % len(ring)]
        if heir in lost:
            both = "; ".join(name_of(homes[n]) for n in (number, heir))
            causes = [f"node {n} was lost" for n in lost]
            raise WorkerDeathError(number, both, state, "step", causes)
        heirs[number] = heir
    for number, heir in heirs.items():
        zones[heir] += zones[number]
        zones[number] = []
    host = {zone: number for number, some in enumerate(zones) for zone in some}
    goes: dict[int, int] = {
        zone: number
        for number, some in enumerate(homes)
        for zone in some
        if number in living and host[zone] != number
    }
    donors = sorted({(host[zone], number) for zone, number in goes.items()})
    host |= goes
    after: Zones = [[] for _ in kept]
    for zone in sorted(host):
        after[host[zone]].append(zone)
    return ZoneMoves(after, heirs, donors)


def nodes_of(zones: Sequence[Sequence[int]]) -> list[int]:
    """Zone → the node that hosts it."""
    pairs = ((zone, node) for node, some in enumerate(zones) for zone in some)
    return [node for _, node in sorted(pairs)]


def name_of(zones: Sequence[int]) -> str:
    """A node's part, in words."""
    return f"zones {', '.join(map(str, zones))}"
