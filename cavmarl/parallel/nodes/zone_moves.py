"""Which node hosts which zones after nodes were lost, or others have come."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

from cavmarl.core.errors import MessageError, WorkerDeathError
from cavmarl.parallel.nodes.peer_faults import check_indices, read_json

Zones = list[list[int]]  # of each node


class ZoneMoves(NamedTuple):
    """What changes, from a state that nodes have kept."""

    zones: Zones  # from now on
    heirs: dict[int, int]  # lost node → the one that hosts its zones now
    donors: list[tuple[int, int]]  # nodes that give zones away, and those that get them


def living_of(zones: Sequence[Sequence[int]]) -> list[int]:
    """The nodes that host some, by rising numbers."""
    return [number for number, some in enumerate(zones) if some]


def read_order(data: memoryview, zones: int) -> dict[str, Any]:
    """What the caller says of nodes that are lost or new, checked against the zones there are.

    Raises:
        MessageError: it tells of zones, nodes or worlds that there are not.
    """
    told: dict[str, Any] = read_json(data, dict)
    nodes = len(told["zones"])
    hosted = [zone for some in told["zones"] for zone in some]
    check_indices("zone", hosted, zones)
    if sorted(hosted) != list(range(zones)):
        raise MessageError(f"it gives nodes the zones {hosted}: there are {zones}")
    pairs = [*told["heirs"], *told["donors"]]
    named = [told["number"], told["first"], *told["lost"], *(n for pair in pairs for n in pair)]
    check_indices("node", [*named, *(node for node, _ in told["places"])], nodes)
    told["places"] = {node: (str(host), int(port)) for node, (host, port) in told["places"]}
    num_worlds = told["num_worlds"]
    check_indices("number", [num_worlds - 1], 1 << 62)
    counts = {len(told["runs"]), len(told["hostings"])}
    if any(len(pair) != 2 for pair in pairs) or counts != {num_worlds}:
        raise MessageError("it tells of other worlds or nodes than there are")
    for some in told["hostings"]:
        check_indices("number", (n for numbers in some for n in numbers), 1 << 62)
        if [len(numbers) for numbers in some] != [4] * zones:
            raise MessageError(f"it tells of {len(some)} zones: there are {zones}")
    told["state"], told["begins"] = int(told["state"]), bool(told["begins"])
    return told


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
