"""`MessageCoordinator`: the coordinator that sends messages to the hosts of zones."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from typing import Protocol, TypeAlias

from cavmarl.core.errors import ProtocolError
from cavmarl.handoff.coordinator.coordinator import ArrivingVehicle, Coordinator, Near
from cavmarl.handoff.coordinator.journal import AnyJournal, MemoryJournal
from cavmarl.ownership.decisions import Neighbours
from cavmarl.ownership.directory import SILENCE, Directory
from cavmarl.ownership.endpoint import Endpoint
from cavmarl.ownership.limits import Limits
from cavmarl.ownership.messages import (
    COORDINATOR,
    Begin,
    Message,
    Output,
    Prepare,
    Record,
    Removed,
)
from cavmarl.ownership.offers import Approach
from cavmarl.ownership.reactions import Advance
from cavmarl.ownership.safeguards import ALL_ON, Safeguards

PATIENCE = 10_000
"""So often a tick asks a zone that does not answer, before it gives up."""


Parcel: TypeAlias = tuple[int, Message, bool]
"""A message at its destination, and whether it is to be refused; see `transport.Delivery`."""


class Post(Protocol):
    """Carries messages; `ownership.transport.Network` is the one that loses some of them."""

    def send(self, messages: Iterable[Message]) -> None:
        """Take messages; each goes to all of its destinations."""
        ...

    def deliver(self) -> Sequence[Parcel]: ...


class States(Protocol):
    """Rows of vehicles at the committed tick."""

    def forget(self) -> None: ...

    def look(self, everybody: bool) -> Sequence[Near]:
        """Vehicles near a border; see `Division.near`."""
        ...

    def near(self, entry: Near) -> bytes:
        """The whole state of a vehicle near a border, whose row is known."""
        ...

    def state(self, vehicle: int) -> bytes: ...

    def digest_of(self, vehicle: int) -> bytes: ...

    def change(self, entries: Sequence[ArrivingVehicle]) -> None: ...


class MessageCoordinator(Coordinator):
    """Runs the protocol of one world over messages.

    Attributes:
        resent: phase → messages that were sent again, since no answer had come: PREPARE; STEP, for
            a lease not taken; DONE, STEPs for an answer that had not come.
    """

    def __init__(
        self,
        run: bytes,  # 16 bytes that no other run has
        zones: int,
        states: States,  # of vehicles at the committed tick
        limits: Limits,
        post: Post,  # carries the messages
        journal: AnyJournal | None = None,  # takes the records; None: not kept
        safeguards: Safeguards = ALL_ON,  # remedies of the protocol; tests take one away
        neighbours: Neighbours | None = None,  # between which zones vehicles may change
    ) -> None:
        directory = Directory(run, range(zones), states, limits, safeguards, neighbours)
        super().__init__(directory, journal)
        self.endpoints: dict[int, Endpoint] = {}  # zone → its host's side
        self.post = post  # what carries the messages
        self.resent: Counter[str] = Counter()
        self._states = states
        self._limits = limits
        self._safeguards = safeguards
        self._dropped: Counter[tuple[str, str]] = Counter()  # by those that have died since
        self._leases: dict[int, Advance] = {}

    @property
    def is_open(self) -> bool:
        return self.directory.table.plan is not None

    def dropped(self) -> Counter[tuple[str, str]]:
        """(kind, reason) → messages or entries that did not count, at any of the parties."""
        total = self._dropped + self.directory.dropped
        for endpoint in self.endpoints.values():
            total += endpoint.dropped
        return total

    # Between ticks

    def reset(self) -> None:
        self.resume()
        self._leases = {}
        self._do(self.directory.reset())
        for zone in self.directory.table.hosts:
            if zone not in self.endpoints:
                self.host(zone)

    def host(self, zone: int) -> None:
        output = self.directory.host(zone, worker=0)
        self.endpoints[zone] = Endpoint(
            self.directory.hosting(zone), self._limits, self._safeguards
        )
        self._leases.pop(zone, None)
        self._do(output)

    def fence(self, zone: int) -> Endpoint:
        """The zone's host is dead to us; it is returned."""
        self._do(self.directory.fence(zone))
        endpoint = self.endpoints.pop(zone)
        self._dropped += endpoint.dropped
        return endpoint

    # A tick

    def begin(self, everybody: bool, inputs: bytes = b"") -> None:
        """Offer approaching vehicles, decide the way to the next tick, and lease it to every zone.

        Called again in the same tick, it goes on with what was decided; see `Coordinator.begin`.
        """
        directory, states = self.directory, self._states
        births, self._births, self._removed = self._births, [], []
        if not self.is_open:
            states.forget()
        near = states.look(everybody)
        if not self.is_open:
            self._offer(near)
            owners = directory.table.owners
            movers = [(v.vehicle, v.target) for v in near if v.crossed and v.vehicle in owners]
            self._leases = {}
            self._do(directory.begin(movers, births, inputs))
        self._until("STEP", self._unleased, lambda: directory.resend(self._unleased()))
        entries = self._entries()
        for switch, _ in entries:
            states.state(switch.vehicle)  # a STEP may be repeated after rows moved
        states.change(entries)

    def end(self, rows: Callable[[int], int], stored: Callable[[int], int] | None = None) -> None:
        """Every zone is through: DONE and COMMIT.

        Raises:
            ProtocolError: a vehicle was lost or doubled; a zone does not answer.
            StoreError: the store holds other rows than a zone told of.
        """
        self._complete(rows)
        self._until("DONE", self.directory.waiting_for, self.directory.resend)
        told = {
            zone: done.rows if stored is None else stored(zone)
            for zone, done in self.directory.dones.items()
        }
        self._do(self.directory.commit(told))
        self._gone = []

    def _complete(self, rows: Callable[[int], int]) -> None:
        table = self.directory.table
        owner, owners = table.planned.owner, table.owners
        removed: defaultdict[int, list[Removed]] = defaultdict(list)
        for entry in (*self._gone, *self._removed):
            removed[owner(entry.vehicle, owners)[0]].append(entry)
        self.post.send(
            endpoint.complete(rows(zone), removed[zone])
            for zone, endpoint in self.endpoints.items()
            if endpoint.lease is not None
        )

    def _offer(self, near: Sequence[Near]) -> None:
        """Tell the zones of approaching vehicles; what is unanswered after A attempts stays so."""
        approaches: defaultdict[int, list[Approach]] = defaultdict(list)
        for entry in near:
            if entry.vehicle in self.endpoints[entry.source].owned:
                state = self._states.near(entry)
                approaches[entry.source].append(Approach(entry.vehicle, entry.target, state))
        for zone, endpoint in self.endpoints.items():
            if approaches[zone] or endpoint.offers.open:
                self.post.send(endpoint.offer(approaches[zone]))
        self._deliver()
        for _ in range(1, self._limits.attempts):
            unanswered = [endpoint for endpoint in self.endpoints.values() if endpoint.offers.owed]
            if not unanswered:
                return
            for endpoint in unanswered:
                again = endpoint.offer_again()
                self.resent["PREPARE"] += len(again)
                self.post.send(again)
            self._deliver()

    def in_flight(self) -> list[tuple[int, int, int, str]]:
        """(vehicle, owner, zone that it was offered to, how it stands), between two ticks.

        `offered`, `prepared` once the zone has acknowledged it, and then for how many ticks it has
        waited behind the border.
        """
        table, held = self.directory.table, self.directory.readiness.held
        prepared = {pair for pairs in held.values() for pair in pairs}
        found = []
        for zone, endpoint in self.endpoints.items():
            for vehicle, target in endpoint.offers.open:
                state = "prepared" if (vehicle, target) in prepared else "offered"
                waited = table.deferred.get(vehicle, 0)
                if waited:
                    state += f", {waited} behind the border"
                found.append((vehicle, zone, target, state))
        return sorted(found)

    # Messages

    def _unleased(self) -> tuple[int, ...]:
        if len(self._leases) == len(self.endpoints):
            return ()
        return tuple(
            zone
            for zone in self.endpoints
            if zone not in self._leases and zone not in self.directory.dones
        )

    def _entries(self) -> list[ArrivingVehicle]:
        plan = self.directory.table.planned
        return [
            ArrivingVehicle(plan.switches[vehicle], state)
            for zone in sorted(self._leases)
            for vehicle, state in self._leases[zone].enter
        ]

    def _until(
        self, phase: str, missing: Callable[[], Sequence[int]], again: Callable[[], Output]
    ) -> None:
        """Deliver until no answer is missing, and ask again where nothing comes."""
        self._deliver()
        for _ in range(PATIENCE):
            if not missing():
                return
            output = again()
            self.resent[phase] += len(output.messages)
            self._do(output)
            self._deliver()
        raise ProtocolError(
            f"zones {list(missing())} do not answer in tick {self.tick + 1}, asked {PATIENCE} "
            "times: STEP and DONE must arrive now and then"
        )

    def _deliver(self) -> None:
        """Let arrive what is under way, and what that leads to, until a phase brings nothing."""
        while arrived := self.post.deliver():
            for parcel in arrived:
                self._take(parcel)

    def _take(self, parcel: Parcel) -> None:
        destination, message, refused = parcel
        for watcher in self._watchers:
            watcher.delivered(destination, message)
        if destination == COORDINATOR:
            output = self.directory.on_message(message)
            if output is not SILENCE:
                self._do(output)
            return
        endpoint = self.endpoints.get(destination)
        if endpoint is None:
            return
        if refused and isinstance(message, Prepare):
            reaction = endpoint.refuse(message)
        else:
            reaction = endpoint.on_message(message)
        if reaction.advance is not None:
            self._leases[destination] = reaction.advance
        if reaction.messages:
            self.post.send(reaction.messages)

    def _do(self, output: Output) -> None:
        if output.records:
            self._write(output)
        if output.messages:
            self.post.send(output.messages)

    def _write(self, output: Output) -> None:
        self._record(*output.records)
        self.switched += sum(len(r.switches) for r in output.records if isinstance(r, Begin))

    # Recovery

    def restart(self, records: Sequence[Record]) -> None:
        """The coordinator has died: a new one knows what its journal says.

        Then `resume` tells it what the store says, and `resend` the zones what was decided.
        """
        self._dropped += self.directory.dropped
        self._directory = self.directory.again(records)
        self.resume()

    def take_up(self, records: Sequence[Record]) -> None:
        """All parties are new, and know what another coordinator's records say."""
        self.restart(records)
        self.endpoints, self._leases = {}, {}
        for zone in self.directory.table.hosts:
            hosting = self.directory.hosting(zone)
            self.endpoints[zone] = Endpoint(hosting, self._limits, self._safeguards)
        if self.journal is not None:
            self.journal = MemoryJournal()
            self.journal.append(records)

    def resend(self) -> None:
        """Repeat what was decided, to all zones that have not answered."""
        self._do(self.directory.resend())
