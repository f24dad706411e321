"""`ZoneEndpoints`: the zones of a node as endpoints of the ownership protocol.

When a vehicle has crossed a border, its owner (the source) sends a PREPARE to the node of the zone
that contains the vehicle. That node acknowledges the offer to the coordinator and to the source.
The coordinator decides, and the next STEP of both zones contains the decision. Until then, the
source keeps the vehicle.
"""

from __future__ import annotations

import json
import struct
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import specialized
from cavmarl.core.errors import MessageError, ProtocolError
from cavmarl.core.records.arrays import DepartureQueue
from cavmarl.driving.vehicles import VEHICLE
from cavmarl.handoff.coordinator.coordinators import OwnershipRuntime
from cavmarl.handoff.coordinator.message_coordinator import ZoneGate, answers_to
from cavmarl.handoff.coordinator.saved_ownership import SavedOwnership
from cavmarl.handoff.division import ZonedShards
from cavmarl.handoff.kernels.invariant_checks import owned_sum
from cavmarl.handoff.zone_view import TransferInFlight
from cavmarl.ownership.codec import decode, encode
from cavmarl.ownership.endpoint import Endpoint
from cavmarl.ownership.ledger import state_digest
from cavmarl.ownership.limits import Limits
from cavmarl.ownership.messages import (
    COORDINATOR,
    Abort,
    Ack,
    Done,
    Message,
    Nack,
    Prepare,
    Removed,
)
from cavmarl.ownership.offers import Approach
from cavmarl.ownership.reactions import Advance, Hosting
from cavmarl.parallel.network.transport import Bytes
from cavmarl.parallel.nodes.index_check import IndexCheck
from cavmarl.parallel.nodes.link import FrameKind, NodeFrame
from cavmarl.parallel.nodes.links import Links, RecoveryOrderedError
from cavmarl.parallel.nodes.peer_faults import (
    LinkLostError,
    check_indices,
    read_json,
    reading,
)
from cavmarl.shards.shard import Commands
from cavmarl.zones.kernels.zone_lookup import zones_of

_LENGTH = struct.Struct("<II")


class Report(NamedTuple):
    """Data about a tick of a world for the coordinator, in addition to DONE."""

    # vehicle, zone that contains it, digest of its state in hex
    movers: list[tuple[int, int, str]]
    births: list[tuple[int, int]]  # vehicle, first owner
    began: bool  # whether an episode has started after the tick
    # if checked: zone, number of vehicles that it owns by its rows, sum of their `owner_hash`
    owned: list[tuple[int, int, int]]
    # whether a vehicle without a record has crossed a border, so that a lease of 0 ticks is due
    is_late: bool = False


NOTHING = Report([], [], False, [])


class ZoneEndpoints(OwnershipRuntime):
    """The endpoints of the zones of one node in W worlds."""

    needs_ghosts = True

    def __init__(
        self,
        division: ZonedShards,
        zones: Sequence[int],  # zones of this node
        node_of: Sequence[int],  # zone → node
        hostings: Sequence[Sequence[Hosting]],  # hostings of these zones, by worlds
        limits: Limits,
        links: Links,  # connections to the coordinator and to all other nodes
        carried: Sequence[NDArray[Any]],  # (W, A, …) actions and state of agents
        checks: IndexCheck,  # checks offered vehicles
        # output: world, vehicle and zone of each offer that was answered in the present or the
        # previous lease
        answered: list[tuple[int, int, int]],
        *,
        generation: int = 0,  # number of changes of nodes
        is_checked: bool = False,  # whether the caller checks which vehicles each zone owns
        ticks: int = 1,  # ticks of a lease
        gate: ZoneGate | None = None,  # the simulators of zones of this node, if any
    ) -> None:
        self._gate, self._limits = gate, limits
        # world, vehicle → number of leases in a row in which a simulator has refused it
        self._refused: Counter[tuple[int, int]] = Counter()
        self._ticks, self._left = ticks, 0
        self._generation, self._is_checked = generation, is_checked
        self._owned_sum = specialized(owned_sum)
        self._carried = carried
        # world, vehicle → node that has sent the state of its agent, and the state
        self._arrived_agents: dict[tuple[int, int], tuple[int, memoryview]] = {}
        # world, vehicle → node that has offered it last
        self._sources: dict[tuple[int, int], int] = {}
        self._division, self._checks = division, checks
        # `_num_answered`: number of entries of `answered` from before the current lease
        self._answered, self._num_answered = answered, 0
        answered.clear()
        self._zones = frozenset(zones)
        self._node_of = node_of
        self._links = links
        self._endpoints = [
            {hosting.zone: Endpoint(hosting, limits) for hosting in some} for some in hostings
        ]
        num_worlds = len(hostings)
        self._leases: list[dict[int, Advance]] = [{} for _ in range(num_worlds)]
        self._births: list[list[tuple[int, int]]] = [[] for _ in range(num_worlds)]
        self._gone: list[dict[int, int]] = [{} for _ in range(num_worlds)]
        # target zones of offered vehicles that have not left
        self._targets: list[dict[int, int]] = [{} for _ in range(num_worlds)]
        # messages for an episode that starts with the next lease, and their senders
        self._early: list[tuple[int, int, Message]] = []
        self._began = [False] * num_worlds
        self._stirred = [True] * num_worlds  # whether to search all rows for crossings
        self._is_quiet = [False] * num_worlds  # whether the lease has no STEP for the world
        self._is_open = False  # whether a lease has begun and was not reported yet

    # Called by a tick

    def begin(self, commands: Commands) -> None:
        """Wait for the lease of the next ticks, and apply its changes of owner."""
        if self._is_open and self._left:
            self._left -= 1
            return
        if self._is_open:
            self.report()
        while not all(map(self._is_leased, range(len(self._leases)))):
            frame = self._links.receive_next(COORDINATOR)
            if frame.kind is FrameKind.RECOVER:
                raise RecoveryOrderedError(frame)
            if frame.kind is not FrameKind.LEASE:
                error = MessageError(f"a frame of kind {frame.kind.name} in place of a lease")
                raise LinkLostError(COORDINATOR, error)
            with reading(COORDINATOR):
                leased = unpacked(frame.data)
            if frame.number:
                self.lease(leased)
            else:
                self.note(leased)
        self._enter_lease()
        self._left = self._ticks - 1

    def lease(self, messages: Sequence[tuple[int, Message]]) -> None:
        """Apply STEP messages; zones of worlds without a message keep their vehicles."""
        addressed = {w for w, _ in messages}
        with reading(COORDINATOR):
            check_indices("world", addressed, len(self._endpoints))
            for w, message in messages:
                self._apply(w, message)
            for w, endpoints in enumerate(self._endpoints):
                if not (w in addressed or self._leases[w] or self._is_quiet[w]):
                    self._is_quiet[w] = True
                    for endpoint in endpoints.values():
                        endpoint.go_on()
        early, self._early = self._early, []
        for number, w, message in early:
            with reading(number):
                self._receive_message(number, w, message)
        del self._answered[: self._num_answered]
        self._num_answered = len(self._answered)

    def _is_leased(self, w: int) -> bool:
        return self._is_quiet[w] or len(self._leases[w]) == len(self._zones)

    def note(self, messages: Sequence[tuple[int, Message]]) -> None:
        """Apply a lease of 0 ticks: it records new vehicles, so that they can be offered."""
        self.lease(messages)
        self._enter_lease()
        self._stirred = [True] * len(self._stirred)
        self.report()

    def _enter_lease(self) -> None:
        for w, leases in enumerate(self._leases):
            if leases:
                with reading(COORDINATOR):
                    self._change_owners(w, leases)
                self._leases[w] = {}
        self._is_open = True

    def entered(self, departures: DepartureQueue) -> None:
        division = self._division
        for w, births in enumerate(self._births):
            new = departures.passing[w, : departures.num_passing[w]]
            if len(new):
                zones = np.empty(len(new), dtype=np.int32)
                zones_of(division.zones, new, len(new), zones)
                pairs = zip(new["id"].tolist(), zones.tolist(), strict=True)
                births += [(vehicle, zone) for vehicle, zone in pairs if zone in self._zones]

    def left(self, departures: DepartureQueue) -> None:
        for w, gone in enumerate(self._gone):
            rows = departures.passing[w, : departures.num_passing[w]]
            if len(rows):
                gone.update(zip(rows["id"].tolist(), rows["events"].tolist(), strict=True))
                self._stirred[w] = True

    def reset(self, chosen: NDArray[np.bool_]) -> None:
        for w in np.flatnonzero(chosen).tolist():
            self._began[w] = True
            owned = self._division.owners(w)
            self._births[w] = [(vehicle, zone) for vehicle, zone in owned if zone in self._zones]
            self._gone[w] = {}
            self._targets[w] = {}
            self._stirred[w] = True

    def go_on(self, saved: Sequence[SavedOwnership] | None) -> None:
        """Start ownership again, with the vehicles in their current zones."""
        self.reset(np.ones(len(self._stirred), dtype=np.bool_))

    def in_flight(self, w: int) -> list[TransferInFlight]:
        return [
            TransferInFlight(vehicle, zone, target, "offered")
            for zone, endpoint in self._endpoints[w].items()
            for vehicle, target in endpoint.offers.open
        ]

    # Messages

    def report(self, more: Sequence[Bytes] = ()) -> None:
        """End the leases: send DONE of all zones, and offer vehicles that have crossed borders."""
        messages: list[tuple[int, Message]] = []
        reports, checked = [], self._is_checked
        for w in range(len(self._endpoints)):
            quiet, self._is_quiet[w] = self._is_quiet[w], False
            if quiet and self._rests(w):
                reports.append(NOTHING)
                continue
            began, self._began[w] = self._began[w], False
            messages += [(w, done) for done in self._complete(w) if done.removed or not quiet]
            movers, is_late = self._offer(w, began)
            owned = [self._owned(w, zone) for zone in self._endpoints[w]] if checked else []
            reports.append(Report(movers, self._births[w], began, owned, is_late))
            self._births[w] = []
        data = packed_report(messages, reports)
        self._links.send(COORDINATOR, FrameKind.REPORT, self._generation, [data, *more])
        self._is_open = False

    def _rests(self, w: int) -> bool:
        """Return whether a quiet lease has nothing to report; if so, end the lease."""
        endpoints = self._endpoints[w].values()
        if self._began[w] or self._stirred[w] or self._gone[w] or self._births[w]:
            return False
        if self._is_checked or self._division.changes.near(w, check_all=False):
            return False
        if any(endpoint.offers.open for endpoint in endpoints):
            return False
        for endpoint in endpoints:
            endpoint.rest()
        return True

    def _owned(self, w: int, zone: int) -> tuple[int, int, int]:
        rows = self._division.owned(w, zone)
        return zone, len(rows), int(self._owned_sum(rows, len(rows)))

    def _complete(self, w: int) -> Iterable[Done]:
        gone, self._gone[w] = self._gone[w], {}
        if gone and self._births[w]:  # vehicles that enter and leave in a lease have no record
            born = {vehicle for vehicle, _ in self._births[w]} & gone.keys()
            self._births[w] = [birth for birth in self._births[w] if birth[0] not in born]
            gone = {vehicle: reason for vehicle, reason in gone.items() if vehicle not in born}
        left: dict[int, list[Removed]] = {}
        kept: dict[int, int] = {}
        for vehicle, reason in gone.items():
            zone = next((z for z, e in self._endpoints[w].items() if vehicle in e.owned), None)
            if zone is None:  # the vehicle entered during the lease
                kept[vehicle] = reason
            else:
                left.setdefault(zone, []).append(Removed(vehicle, reason))
        self._gone[w] = kept
        for zone, endpoint in self._endpoints[w].items():
            if endpoint.lease is not None:
                yield endpoint.complete(0, left.get(zone, ()))

    def _offer(self, w: int, began: bool) -> tuple[list[tuple[int, int, str]], bool]:
        """Offer vehicles that have crossed a border to the zones that contain them.

        Returns:
            `movers` of the report, and whether vehicles without a record have crossed a border.
        """
        division, endpoints = self._division, self._endpoints[w]
        check_all, self._stirred[w] = self._stirred[w] or began, False
        approaches: dict[int, list[Approach]] = {zone: [] for zone in endpoints}
        movers, is_late = [], False
        for entry in division.changes.near(w, check_all):
            endpoint = endpoints.get(entry.source)
            if not entry.crossed or endpoint is None:
                continue
            if began or entry.vehicle not in endpoint.owned:
                is_late = True
            else:
                state = division.changes.state(w, entry.source, entry.row)
                approaches[entry.source].append(Approach(entry.vehicle, entry.target, state))
                self._targets[w][entry.vehicle] = entry.target
                movers.append((entry.vehicle, entry.target, state_digest(state).hex()))
        for zone, endpoint in endpoints.items():
            if not began and (approaches[zone] or endpoint.offers.open):
                for message in endpoint.offer(approaches[zone]):
                    self._send(w, message)
        return movers, is_late

    def receive(self, number: int, frame: NodeFrame) -> None:
        """Apply messages of another node as soon as they arrive."""
        messages = unpacked(frame.data)
        check_indices("world", (w for w, _ in messages), len(self._endpoints))
        for w, message in messages:
            self._check_zones(number, message)
            for offer in message.entries if isinstance(message, Prepare) else ():
                record = self._division.codec.record(offer.state, offer.vehicle)
                self._checks.check_state(record)
            self._receive_message(number, w, message)

    def _check_zones(self, number: int, message: Message) -> None:
        """Raise MessageError if a node must not send this message to this node."""
        if isinstance(message, Prepare | Abort):
            zone = message.source
        elif isinstance(message, Ack | Nack):
            zone = message.zone
        else:
            raise MessageError(f"it must not send messages of kind {type(message).__name__}")
        check_indices("zone", [zone], len(self._node_of))
        if self._node_of[zone] != number:
            raise MessageError(f"it sends for zone {zone}, which it does not host")
        if self._zones.isdisjoint(message.destinations()):
            raise MessageError(f"it sends for zones {message.destinations()} to another node")

    def _receive_message(self, number: int, w: int, message: Message) -> None:
        """Apply a message of another node.

        Raises:
            MessageError: the message does not match the current tick.
        """
        (zone,) = self._zones.intersection(message.destinations())
        endpoint = self._endpoints[w][zone]
        if isinstance(message, Prepare):
            if message.episode == endpoint.episode + 1:
                self._early.append((number, w, message))  # the sender received its lease first
                return
            self._sources |= {(w, offer.vehicle): number for offer in message.entries}
        elif isinstance(message, Abort):
            for vehicle, _ in message.entries:
                self._sources.pop((w, vehicle), None)
                self._refused.pop((w, vehicle), None)
        dropped = endpoint.dropped.total()
        self._apply(w, message)
        if endpoint.dropped.total() > dropped and not isinstance(message, Abort):
            raise MessageError(
                f"a {type(message).__name__} of tick {message.tick} does not fit zone {zone} at "
                f"tick {endpoint.tick}"
            )

    def _apply(self, w: int, message: Message) -> None:
        for zone in message.destinations():
            endpoint = self._endpoints[w].get(zone)
            if endpoint is None:
                continue
            if isinstance(message, Prepare) and self._is_hosted(zone):
                self._ask(w, zone, message)
                continue
            reaction = endpoint.on_message(message)
            if reaction.advance is not None:
                self._leases[w][zone] = reaction.advance
            for answer in reaction.messages:
                self._send(w, answer)

    def _is_hosted(self, zone: int) -> bool:
        """Return whether another simulator runs a zone."""
        return self._gate is not None and zone in self._gate.zones

    def _send(self, w: int, message: Message) -> None:
        """Send a message to its destination zones, in any process, and to the coordinator."""
        if isinstance(message, Ack | Nack):
            self._answered += [(w, entry.vehicle, message.zone) for entry in message.entries]
        for destination in message.destinations():
            if destination in self._zones:
                self._apply_own(w, destination, message)
            else:
                to = COORDINATOR if destination == COORDINATOR else self._node_of[destination]
                self._links.send(to, FrameKind.MESSAGES, self._generation, [packed([(w, message)])])

    def _ask(self, w: int, zone: int, message: Prepare) -> None:
        """Deliver a PREPARE to a zone whose simulator may refuse vehicles."""
        assert self._gate is not None
        codec = self._division.codec
        records = [codec.record(offer.state, offer.vehicle) for offer in message.entries]
        rows = np.frombuffer(b"".join(records), dtype=VEHICLE)
        most = self._limits.deferral
        is_last = np.array([self._refused[w, v] >= most for v in rows["id"].tolist()])
        refused: dict[int, str] = {}
        for some, is_over in ((rows[~is_last], False), (rows[is_last], True)):
            if len(some):
                refused |= self._gate.refusals(w, zone, some, is_over)
        for vehicle in rows["id"].tolist():
            if vehicle in refused:
                self._refused[w, vehicle] += 1
            else:
                self._refused.pop((w, vehicle), None)
        for answer in answers_to(message, refused, self._endpoints[w][zone]):
            self._send(w, answer)

    def _apply_own(self, w: int, zone: int, message: Message) -> None:
        if isinstance(message, Prepare) and self._is_hosted(zone):
            self._ask(w, zone, message)
            return
        reaction = self._endpoints[w][zone].on_message(message)
        for answer in reaction.messages:
            self._send(w, answer)

    def _change_owners(self, w: int, leases: dict[int, Advance]) -> None:
        division = self._division
        left = set()
        for zone, advance in leases.items():
            for vehicle in advance.leave:
                self._send_agent(w, vehicle)
                division.changes.give_up(w, zone, vehicle)
                left.add(vehicle)
        for zone, advance in leases.items():
            owned = self._endpoints[w][zone].owned
            for vehicle, state in advance.enter:
                division.changes.take_over(w, zone, vehicle, owned[vehicle], state)
                source = self._sources.pop((w, vehicle), None)
                if vehicle not in left:
                    self._await_agent(w, vehicle, source)

    def _agent(self, w: int, vehicle: int) -> int:
        """Return the agent of a vehicle; -1: none."""
        zone, row = self._division.changes.find(w, vehicle)
        return int(self._division.owned(w, zone)["agent"][row])

    def _send_agent(self, w: int, vehicle: int) -> None:
        """Send the state of an agent to the node of its vehicle, if that is another node."""
        target = self._targets[w].pop(vehicle, -1)
        if target in self._zones:
            return
        agent = self._agent(w, vehicle)
        if agent >= 0:
            kept = (np.ascontiguousarray(array[w, agent]).tobytes() for array in self._carried)
            pieces = [_LENGTH.pack(w, 0), np.int64(vehicle).tobytes(), *kept]
            self._links.send(self._node_of[target], FrameKind.AGENT, self._generation, pieces)

    def _await_agent(self, w: int, vehicle: int, source: int | None) -> None:
        """Wait for the state of an agent from the node that its vehicle comes from."""
        agent, arrived = self._agent(w, vehicle), self._arrived_agents
        if agent < 0:
            return
        if source is None:
            raise ProtocolError(f"vehicle {vehicle} enters, but no node has offered it")
        self._links.await_urgent(source, lambda: (w, vehicle) in arrived)
        number, data = arrived.pop((w, vehicle))
        if number != source:
            error = MessageError(f"it sends the agent of vehicle {vehicle}, which it does not own")
            raise LinkLostError(number, error)
        at = 0
        for array in self._carried:
            kept = array[w, agent : agent + 1]
            kept[...] = np.frombuffer(data, array.dtype, kept.size, at).reshape(kept.shape)
            at += kept.nbytes

    def receive_agent(self, number: int, frame: NodeFrame) -> None:
        """Keep the state of an agent from another node until its vehicle arrives."""
        w, _ = _LENGTH.unpack_from(frame.data)
        vehicle = int(np.frombuffer(frame.data, np.int64, 1, _LENGTH.size)[0])
        check_indices("world", [w], len(self._endpoints))
        size = sum(array[0, 0].nbytes for array in self._carried)
        if len(frame.data) != _LENGTH.size + 8 + size:
            raise MessageError(f"{len(frame.data)} bytes are not the state of an agent")
        self._arrived_agents[w, vehicle] = number, frame.data[_LENGTH.size + 8 :]


def hostings_as_json(hostings: Sequence[Sequence[Hosting]]) -> list[list[list[int]]]:
    """Return hostings as a JSON value, by worlds and zones."""
    return [[[h.episode, h.tick, h.zone, h.incarnation] for h in some] for some in hostings]


def hosting_of(run: bytes, numbers: Sequence[int]) -> Hosting:
    """Read a hosting from its JSON value."""
    episode, tick, zone, incarnation = numbers
    return Hosting(run, episode, tick, zone, incarnation, {})


def packed(messages: Sequence[tuple[int, Message]]) -> bytes:
    """Encode messages, each with its world."""
    parts: list[bytes] = []
    for w, message in messages:
        data = encode(message)
        parts += (_LENGTH.pack(w, len(data)), data)
    return b"".join(parts)


def unpacked(data: memoryview) -> list[tuple[int, Message]]:
    """Decode messages with their worlds. Raises MessageError: the bytes are damaged."""
    found, at = [], 0
    while at < len(data):
        if at + _LENGTH.size > len(data):
            raise MessageError("the messages are cut off")
        w, size = _LENGTH.unpack_from(data, at)
        at += _LENGTH.size
        found.append((w, decode(bytes(data[at : at + size]))))
        at += size
    return found


def packed_report(messages: Sequence[tuple[int, Message]], reports: Sequence[Report]) -> bytes:
    """Encode messages and the report of each world, in whole words of 8 bytes."""
    data = packed(messages)
    text = b"" if all(map(NOTHING.__eq__, reports)) else json.dumps(reports).encode()
    end = b" " * (-(len(data) + len(text)) % 8)
    return _LENGTH.pack(len(data), len(text) + len(end)) + data + text + end


def read_report(
    data: memoryview,
    num_worlds: int,
) -> tuple[list[tuple[int, Message]], list[Report], memoryview]:
    """Return the messages, the reports of all worlds (empty: no reports), and the other bytes."""
    size, length = _LENGTH.unpack_from(data)
    if not size and not length:
        return [], [], data[_LENGTH.size :]
    at = _LENGTH.size
    messages = unpacked(data[at : at + size])
    end = at + size + length
    text = bytes(data[at + size : end]).rstrip()
    reports = [NOTHING] * num_worlds
    if text:
        reports = [Report(*report) for report in read_json(text, list)]
        if len(reports) != num_worlds:
            raise MessageError(f"it has reports of {len(reports)} worlds: there are {num_worlds}")
    if len(data) < end:
        raise MessageError(f"a report of {end} bytes is cut off after {len(data)}")
    return messages, reports, data[end:]
