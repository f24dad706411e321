"""Who hosts which zones after nodes were lost, or others have come."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import NamedTuple

from cavmarl.core.errors import WorkerDeathError

Zones = list[list[int]]  # of each node


class ZoneMoves(NamedTuple):
    """What changes, from a state that nodes have kept."""

    zones: Zones  # from now on
    heirs: dict[int, int]  # lost node → who hosts its zones now
    donors: list[tuple[int, int]]  # nodes that give zones away, and who gets them


def moves_of(
    kept: Sequence[Sequence[int]],  # zones of each node when the state was kept
    first: Sequence[Sequence[int]],  # zones of each node at the beginning
    lost: Sequence[int],
    living: Collection[int],
    state: int,  # its number
) -> ZoneMoves:
    """The next node of the ring has what a lost one had; a new one gets what it would have had.

    Raises:
        WorkerDeathError: the next one is lost, too.
    """
    ring = [number for number, zones in enumerate(kept) if zones]
    zones = [list(some) for some in kept]
    heirs: dict[int, int] = {}
    for number in (n for n in ring if n in lost):
        heir = ring[(ring.index(number) + 1) % len(ring)]
        if heir in lost:
            both = "; ".join(name_of(first[n]) for n in (number, heir))
            causes = [f"node {n} was lost" for n in lost]
            raise WorkerDeathError(number, both, state, "step", causes)
        heirs[number] = heir
    for number, heir in heirs.items():
        zones[heir] += zones[number]
        zones[number] = []
    donors: list[tuple[int, int]] = []
    old = [number for number in sorted(living) if zones[number]]
    for number in (n for n in sorted(living) if n not in old):
        for donor in old:
            given = set(first[number]) & set(zones[donor])
            if given:
                donors.append((donor, number))
                zones[donor] = [zone for zone in zones[donor] if zone not in given]
                zones[number] += given
    return ZoneMoves([sorted(some) for some in zones], heirs, donors)


def name_of(zones: Sequence[int]) -> str:
    """A node's part, in words."""
    return f"zones {', '.join(map(str, zones))}"
