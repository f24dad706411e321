"""Zones of a node whose messages a plan of faults harms, and whose process it kills."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

from numpy.typing import NDArray

from cavmarl.engine.simulation import Simulation
from cavmarl.handoff.fault_injection.fault_plan import PHASES, Faults, read_faults
from cavmarl.handoff.fault_injection.injected_faults import Crashes
from cavmarl.handoff.shard_setup import limits_of
from cavmarl.ownership.messages import COORDINATOR, Done, Message, Prepare, Step
from cavmarl.ownership.reactions import Advance, Hosting
from cavmarl.parallel.nodes.fault_phases import (
    Parcel,
    PhasedPost,
    Said,
    Told,
    packed_parcels,
    unpacked_parcels,
)
from cavmarl.parallel.nodes.link import FrameKind, NodeFrame
from cavmarl.parallel.nodes.links import Links
from cavmarl.parallel.nodes.zone_hosts import ZoneHosts
from cavmarl.shards.executor import Executor

NEVER = -1  # a tick in which no process dies


class FaultyZoneHosts(ZoneHosts):
    """Hosts that send and take all messages in the caller's phases.

    Raises:
        ZoneDeath: in any call; the process of a zone dies as planned.
    """

    def __init__(self, *arguments: Any, faults: Faults) -> None:
        super().__init__(*arguments)
        num_worlds = len(self._endpoints)
        self._post = PhasedPost(faults, num_worlds)
        self._crashes = Crashes(faults) if faults.crashes else None
        self._advances: list[dict[int, Advance]] = [{} for _ in range(num_worlds)]
        own = {self._node_of[zone] for zone in self._zones}
        self._others = sorted(set(self._node_of) - own)
        self._arrived: defaultdict[int, dict[int, memoryview]] = defaultdict(dict)

    def executor(self, plain: Executor) -> Executor:
        """What runs the phases of a tick."""
        return plain if self._crashes is None else _Dying(plain, sorted(self._zones), self._crashes)

    def lease(self, data: memoryview) -> None:
        """Begin the ticks for which all zones have taken their lease."""
        self._leases, self._advances = self._advances, [{} for _ in self._advances]

    def phase(self, frame: NodeFrame) -> None:
        head, parcels = unpacked_parcels(frame.data)
        told = Told(*head)  # type: ignore[arg-type]
        post = self._post
        post.begin(told.harms)
        if self._crashes is not None:
            self._crashes.tick = told.tick if told.harms else NEVER
        if told.again:
            for w, endpoints in enumerate(self._endpoints):
                for endpoint in endpoints.values():
                    post.send(w, endpoint.offer_again())
        due: defaultdict[int, list[Parcel]] = defaultdict(list)
        for parcel in post.deliver():
            due[self._place(parcel.destination)].append(parcel)
        number = self._generation << 32 | told.phase
        for node in self._others:
            self._links.send(node, FrameKind.MESSAGES, number, packed_parcels(None, due[node]))
        parcels += due[self._own]
        for node in self._others:
            parcels += self._from(node, number)
        self._arrived.pop(number, None)
        for parcel in parcels:
            self._take_parcel(parcel)
        said = packed_parcels(self._said(len(parcels)), due[COORDINATOR])
        self._links.send(COORDINATOR, FrameKind.PHASE, self._generation, said)

    @property
    def _own(self) -> int:
        return self._place(min(self._zones))

    def _place(self, destination: int) -> int:
        return COORDINATOR if destination == COORDINATOR else self._node_of[destination]

    def hear(self, number: int, frame: NodeFrame) -> None:
        """Keep what another node sends in a phase until it is this one's turn, too."""
        if frame.number >> 32 == self._generation:
            self._arrived[frame.number][number] = frame.data

    def _from(self, node: int, number: int) -> list[Parcel]:
        """What another node sends in a phase."""
        links = self._links
        links.wanted = (node,)
        while node not in self._arrived[number]:
            links.heed()
            links.pump(None)
        links.wanted = ()
        return unpacked_parcels(self._arrived[number][node])[1]

    def _said(self, arrived: int) -> Said:
        every = [
            (w, zone, endpoint)
            for w, endpoints in enumerate(self._endpoints)
            for zone, endpoint in endpoints.items()
        ]
        injected = self._post.take_injected()
        return Said(
            arrived,
            sum(len(endpoint.offers.owed) for _, _, endpoint in every),
            [(w, zone) for w, zone, _ in every if zone not in self._advances[w]],
            [(kind, fault, times) for (kind, fault), times in sorted(injected.items())],
        )

    def _take_parcel(self, parcel: Parcel) -> None:
        w, zone, message, is_refused = parcel
        endpoint = self._endpoints[w].get(zone)
        if endpoint is None:
            return
        first, last = _POINTS.get(type(message), ("", ""))
        self._visit(first, zone)
        if is_refused and isinstance(message, Prepare):
            reaction = endpoint.refuse(message)
        else:
            reaction = endpoint.on_message(message)
        if reaction.advance is not None:
            self._advances[w][zone] = reaction.advance
        self._post.send(w, reaction.messages)
        self._visit(last, zone)

    def _visit(self, point: str, zone: int) -> None:
        if self._crashes is not None and point:
            self._crashes.zone(point, zone)

    def _complete(self, w: int) -> Sequence[Done]:
        """DONE goes to the coordinator by the post, and not with the report."""
        if self._crashes is not None:
            for zone in self._endpoints[w]:
                self._crashes.zone("before DONE", zone)
        self._post.send(w, super()._complete(w))
        return ()

    def _send(self, w: int, message: Message) -> None:
        self._post.send(w, (message,))

    def _told(self, state: bytes) -> str:
        """The whole state: the new zone may have to be sent it, if no message brings it."""
        return state.hex()


def hosts_of(
    simulation: Simulation,
    zones: Sequence[int],  # of this node
    node_of: Sequence[int],  # zone → the node that hosts it
    hostings: Sequence[Sequence[Hosting]],
    links: Links,
    carried: Sequence[NDArray[Any]],
    generation: int,
    ticks: int,  # of a lease
    faults: str,  # a plan as JSON; empty: there is none
) -> ZoneHosts:
    """The zones of a node; see `ZoneHosts`."""
    settings, division = simulation.config.zones, simulation.division
    arguments = (
        division, zones, node_of, hostings, limits_of(settings, division.codec.schema), links,
        carried, generation, settings.check_invariants, ticks,
    )  # fmt: skip
    if not faults:
        return ZoneHosts(*arguments)
    return FaultyZoneHosts(*arguments, faults=read_faults(faults))


_POINTS: dict[type[Any], tuple[str, str]] = {
    Prepare: ("PREPARE arrives", "ACK sent"),
    Step: ("STEP arrives", "lease taken"),
}


class _Dying:
    """Runs the phases of zones whose process dies at some of them."""

    def __init__(self, plain: Executor, zones: Sequence[int], crashes: Crashes) -> None:
        self._plain, self._zones, self._crashes = plain, zones, crashes

    def each(self, phase: str, *arguments: Any) -> None:
        self._plain.each(phase, *arguments)
        if phase in PHASES:
            for zone in self._zones:
                self._crashes.zone(phase, zone)
