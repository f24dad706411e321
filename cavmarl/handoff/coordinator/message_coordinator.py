"""`MessageCoordinator`: the coordinator of a world in which other simulators run some zones.

All zones are in this process, but another simulator can refuse a vehicle, be late or die. So each
zone has an endpoint of the ownership protocol, and all messages are sent. A vehicle that has
crossed a border is offered with its state (PREPARE). Its new zone accepts or refuses it (ACK,
NACK). The coordinator decides (BEGIN, STEP). The new zone confirms the vehicle (DONE), and the
coordinator commits the tick (COMMIT).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ProtocolError
from cavmarl.handoff.coordinator.coordinator import Coordinator, Near
from cavmarl.handoff.coordinator.journal import Journal
from cavmarl.handoff.division import ZonedShards
from cavmarl.handoff.shard_setup import neighbours_of
from cavmarl.ownership.directory import Directory
from cavmarl.ownership.endpoint import Endpoint
from cavmarl.ownership.ledger import state_digest
from cavmarl.ownership.limits import Limits
from cavmarl.ownership.messages import (
    COORDINATOR,
    Begin,
    Birth,
    Message,
    Output,
    Prepare,
    Refusal,
    Removed,
    Switch,
)
from cavmarl.ownership.offers import Approach
from cavmarl.ownership.transfers import TransferLog

if TYPE_CHECKING:
    from cavmarl.handoff.coordinator.invariant_monitor import Departed
    from cavmarl.handoff.coordinator.saved_ownership import SavedOwnership


class ZoneGate(Protocol):
    """Interface of coordinators to the simulators that run zones.

    Attributes:
        zones: the zones that simulators run.
    """

    zones: frozenset[int]

    def check(self, w: int) -> None:
        """Raise ZoneSimulatorError if a simulator of the world has ended."""
        ...

    def refusals(
        self,
        w: int,
        zone: int,
        vehicles: NDArray[np.void],  # VEHICLE (n,)
        is_last: bool = False,  # whether a refusal is a failure of the simulator
    ) -> Mapping[int, str]:
        """Ask the simulator of a zone which vehicles may enter; return the reasons for refusals.

        Raises ZoneSimulatorError if the simulator fails, unless cavmarl takes the zone back.
        """
        ...


class CrossingStates:
    """The states of vehicles that have crossed a border, which decisions need."""

    def __init__(self) -> None:
        self.states: dict[int, bytes] = {}

    def state(self, vehicle: int) -> bytes:
        return self.states[vehicle]

    def digest_of(self, vehicle: int) -> bytes:
        return state_digest(self.states[vehicle])


class MessageCoordinator(Coordinator):
    """A coordinator that decides ownership by messages between the zones of this process."""

    def __init__(
        self,
        run: bytes,
        journal: Journal | None,  # stores the records; None: they are not stored
        division: ZonedShards,
        world: int,
        limits: Limits,
        transfers: TransferLog,  # receives all records and messages
        gate: ZoneGate,
    ) -> None:
        self._states = CrossingStates()
        zones, near = range(division.count), neighbours_of(division)
        super().__init__(Directory(run, zones, self._states, limits, near), journal)
        self._division, self._world, self._gate = division, world, gate
        self._limits, self._transfers = limits, transfers
        self._endpoints: dict[int, Endpoint] = {}
        self._returned: set[int] = set()  # zones that simulators have lost in this episode
        self._is_open = False
        self.watch(transfers)

    @property
    def is_open(self) -> bool:
        return self._is_open

    def reset(self) -> None:
        """Begin an episode without vehicles. Simulators get back the zones that they have lost."""
        directory = self._directory
        self.resume()
        self._is_open = False
        returned, self._returned = self._returned, set()
        for zone in sorted(returned):
            self._write(directory.fence(zone))
        self._write(directory.reset())
        for zone, (_, incarnation) in directory.table.hosts.items():
            if incarnation == 0 or zone in returned:
                self._write(directory.host(zone, worker=self._worker_of(zone)))
            self._endpoints[zone] = Endpoint(directory.hosting(zone), self._limits)

    def _worker_of(self, zone: int) -> int:
        """Return the worker of a zone in the records: 0 for cavmarl, 1 + zone for a simulator."""
        return 1 + zone if zone in self._gate.zones and zone not in self._returned else 0

    def save(self) -> None:
        """Return None: a saved state has no offers, so ownership begins anew after loading."""

    def go_on(self, saved: SavedOwnership, rows: Mapping[int, tuple[int, int]]) -> list[Departed]:
        """Raise ProtocolError: `OwnershipRuntime.resumes` is false."""
        raise ProtocolError("ownership with simulators of zones begins anew with a loaded state")

    def begin(self, check_all: bool, inputs: bytes = b"") -> None:
        """Offer the vehicles outside of their owner's zone, and decide; see `Coordinator.begin`.

        Raises:
            ZoneSimulatorError: the simulator of a zone has ended, or refuses a vehicle for too
                long.
        """
        self._gate.check(self._world)
        births, self._births = tuple(sorted(self._births)), []
        movers = self._movers(check_all, births)
        self._offer(movers)
        for zone, vehicles in self._overdue(movers).items():
            self._gate.refusals(self._world, zone, self._rows(vehicles), is_last=True)
        pairs = [(near.vehicle, near.target) for near in movers]
        output = self._directory.begin(pairs, births, inputs)
        self._is_open = True
        self._write(output)
        self._deliver(output.messages)
        row_of = {near.vehicle: near.row for near in movers}
        for record in output.records:
            if isinstance(record, Begin):
                self._hand_over(record.switches, row_of)

    def _movers(self, check_all: bool, births: Sequence[Birth]) -> list[Near]:
        """Return the vehicles that have crossed a border, and keep their states."""
        division, w = self._division, self._world
        new = {birth.vehicle for birth in births}  # they keep their owner in their first tick
        movers = [
            near
            for near in division.changes.near(w, check_all)
            if near.crossed and near.vehicle not in new
        ]
        self._states.states = {
            near.vehicle: division.changes.state(w, near.source, near.row) for near in movers
        }
        return movers

    def _offer(self, movers: Sequence[Near]) -> None:
        """Send PREPARE for vehicles beyond a border, and ABORT for vehicles that turned back."""
        approaches: dict[int, list[Approach]] = {zone: [] for zone in self._endpoints}
        for near in movers:
            state = self._states.states[near.vehicle]
            approaches[near.source].append(Approach(near.vehicle, near.target, state))
        for zone, endpoint in self._endpoints.items():
            if approaches[zone] or endpoint.offers.open:
                self._deliver(endpoint.offer(approaches[zone]))

    def _overdue(self, movers: Sequence[Near]) -> dict[int, list[int]]:
        """Return the vehicles that must be handed over now, although their target has refused."""
        table = self._directory.table
        found: dict[int, list[int]] = {}
        for near in movers:
            waited = table.deferred.get(near.vehicle, 0)
            held = self._endpoints[near.target].replicas.held
            if waited >= self._limits.deferral and near.vehicle not in held:
                found.setdefault(near.target, []).append(near.vehicle)
        return found

    def _rows(self, vehicles: Sequence[int]) -> NDArray[np.void]:
        """Return the committed rows VEHICLE (n,) of vehicles."""
        division, w = self._division, self._world
        found = [division.changes.find(w, vehicle) for vehicle in vehicles]
        return np.array([division.owned(w, zone)[row] for zone, row in found])

    def _hand_over(self, switches: Sequence[Switch], row_of: Mapping[int, int]) -> None:
        for switch in switches:
            self._division.changes.hand_over(self._world, switch, row_of[switch.vehicle])
        self.switched += len(switches)

    def rehost(self, zone: int) -> None:
        """Record that cavmarl has taken a zone back from a simulator that has failed."""
        directory = self._directory
        self._returned.add(zone)
        self._write(directory.fence(zone))
        output = directory.host(zone, self._worker_of(zone))
        self._endpoints[zone] = Endpoint(directory.hosting(zone), self._limits)
        self._write(output)
        self._deliver(output.messages)

    def end(self, rows: Callable[[int], int]) -> None:
        """Confirm and commit the tick; see `Coordinator.end`."""
        gone = sorted((*self._gone, *self._removed))
        self._gone, self._removed, self._is_open = [], [], False
        removed: dict[int, list[Removed]] = {zone: [] for zone in self._endpoints}
        for one in gone:
            removed[self._owner(one.vehicle)].append(one)
        digests = {zone: rows(zone) for zone in self._endpoints}
        for zone, endpoint in self._endpoints.items():
            self._deliver([endpoint.complete(digests[zone], removed[zone])])
        self._write(self._directory.commit(digests))
        self._check(self._births, self._division.counts(self._world))

    def _owner(self, vehicle: int) -> int:
        for zone, endpoint in self._endpoints.items():
            if vehicle in endpoint.owned:
                return zone
        raise ProtocolError(f"vehicle {vehicle} has left the world, but no zone owned it")

    def in_flight(self) -> list[tuple[int, int, int, str]]:
        """Return (vehicle, owner, zone that has refused it so far, "offered"), between ticks."""
        return sorted(
            (vehicle, zone, target, "offered")
            for zone, endpoint in self._endpoints.items()
            for vehicle, target in endpoint.offers.open
        )

    def _write(self, output: Output) -> None:
        self._record(*output.records)

    def _deliver(self, messages: Iterable[Message]) -> None:
        """Deliver messages, and all answers to them."""
        for message in messages:
            for destination in message.destinations():
                self._transfers.delivered(destination, message)
                if destination == COORDINATOR:
                    output = self._directory.on_message(message)
                    self._write(output)
                    self._deliver(output.messages)
                elif isinstance(message, Prepare):
                    self._prepare(destination, message)
                else:
                    self._deliver(self._endpoints[destination].on_message(message).messages)

    def _prepare(self, zone: int, message: Prepare) -> None:
        """Deliver a PREPARE; the simulator of the zone, if any, may refuse vehicles."""
        vehicles = [offer.vehicle for offer in message.entries]
        refused = self._gate.refusals(self._world, zone, self._rows(vehicles))
        self._deliver(answers_to(message, refused, self._endpoints[zone]))


def answers_to(
    message: Prepare, refused: Mapping[int, str], endpoint: Endpoint
) -> tuple[Message, ...]:
    """Deliver a PREPARE to a zone whose simulator refuses some vehicles; return the answers."""
    taken = tuple(offer for offer in message.entries if offer.vehicle not in refused)
    left = tuple(offer for offer in message.entries if offer.vehicle in refused)
    answers: tuple[Message, ...] = ()
    if taken:
        answers = endpoint.on_message(replace(message, entries=taken)).messages
    if left:
        refusal = endpoint.refuse(replace(message, entries=left), Refusal.SIMULATOR)
        answers = (*answers, *refusal.messages)
    return answers
