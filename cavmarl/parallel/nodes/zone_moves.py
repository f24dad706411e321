"""Which node hosts which zones after nodes were lost or have joined."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

from cavmarl.core.errors import MessageError, WorkerDeathError
from cavmarl.parallel.nodes.peer_faults import check_indices, read_json

Zones = list[list[int]]  # zones of each node


class ZoneMoves(NamedTuple):
    """Changes of the hosts of zones, with which nodes resume from a kept state."""

    zones: Zones  # new zones of each node
    heirs: dict[int, int]  # lost node → node that takes over its zones
    donors: list[tuple[int, int]]  # node that gives zones away, and node that receives them


def living_of(zones: Sequence[Sequence[int]]) -> list[int]:
    """Return the nodes that host zones, in ascending order."""
    return [number for number, some in enumerate(zones) if some]


def read_order(data: memoryview, zones: int) -> dict[str, Any]:
    """Read the order of the caller to recover, and check it.

    Raises:
        MessageError: the order names unknown zones, nodes or worlds.
    """
    order: dict[str, Any] = read_json(data, dict)
    nodes = len(order["zones"])
    hosted = [zone for some in order["zones"] for zone in some]
    check_indices("zone", hosted, zones)
    if sorted(hosted) != list(range(zones)):
        raise MessageError(f"it gives nodes the zones {hosted}: there are {zones} zones")
    pairs = [*order["heirs"], *order["donors"]]
    named = [order["number"], order["first"], *order["lost"], *(n for pair in pairs for n in pair)]
    check_indices("node", [*named, *(node for node, _ in order["places"])], nodes)
    order["places"] = {node: (str(host), int(port)) for node, (host, port) in order["places"]}
    num_worlds = order["num_worlds"]
    check_indices("number", [num_worlds - 1], 1 << 62)
    counts = {len(order["runs"]), len(order["hostings"])}
    if any(len(pair) != 2 for pair in pairs) or counts != {num_worlds}:
        raise MessageError("it names other worlds or nodes than there are")
    for some in order["hostings"]:
        check_indices("number", (n for numbers in some for n in numbers), 1 << 62)
        if [len(numbers) for numbers in some] != [4] * zones:
            raise MessageError(f"it has hostings of {len(some)} zones: there are {zones}")
    order["state"], order["begins"] = int(order["state"]), bool(order["begins"])
    return order


_LOST_STATE = (
    "Only the lost nodes had the state of these zones: make the environment again, which begins "
    "new episodes; the log says why each node was lost"
)


def moves_of(
    kept: Sequence[Sequence[int]],  # zones of each node when the state was kept
    homes: Sequence[Sequence[int]],  # zones of each node if none is lost
    lost: Sequence[int],
    living: Collection[int],
    state: int,  # number of the state
) -> ZoneMoves:
    """Give the zones of a lost node to the next node of the ring; return zones to their homes.

    Raises:
        WorkerDeathError: the next node is lost as well.
    """
    ring = living_of(kept)
    zones = [list(some) for some in kept]
    heirs: dict[int, int] = {}
    for number in (n for n in ring if n in lost):
        heir = ring[(ring.index(number) + 1) % len(ring)]
        if heir in lost:
            both = "; ".join(name_of(homes[n]) for n in (number, heir))
            causes = [f"node {n} was lost" for n in lost]
            raise WorkerDeathError(number, both, state, "step", causes, _LOST_STATE)
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
    """Return the node of each zone."""
    pairs = ((zone, node) for node, some in enumerate(zones) for zone in some)
    return [node for _, node in sorted(pairs)]


def name_of(zones: Sequence[int]) -> str:
    """Return a description of the part of a node."""
    return f"zones {', '.join(map(str, zones))}"
