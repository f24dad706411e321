"""The coordinator's side of the protocol: the current and the next owner of each vehicle.

Each method returns an `Output`: records to append to the log, then messages to send. Only
`Table.apply` carries out a record, so a coordinator that replays its log (`restore`) repeats all
decisions.

The cost of a tick grows with its changes: vehicles that keep their owner are not visited.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

from cavmarl.core.errors import JournalError, LostTickError, ProtocolError
from cavmarl.ownership.decisions import CommittedStates, Decisions, Neighbours
from cavmarl.ownership.ledger import world_digest
from cavmarl.ownership.limits import Limits
from cavmarl.ownership.messages import (
    Ack,
    Begin,
    Birth,
    Commit,
    Done,
    Fence,
    Host,
    In,
    Message,
    Nack,
    Need,
    Output,
    Record,
    Refusal,
    Reset,
    Step,
    Switch,
    ZoneLedger,
)
from cavmarl.ownership.planning import all_removed, check_done
from cavmarl.ownership.reactions import Hosting
from cavmarl.ownership.readiness import Readiness
from cavmarl.ownership.table import Table
from cavmarl.ownership.transitions import State

SILENCE = Output()


class ZonesError(ProtocolError):
    """Zones have sent no DONE, or a wrong DONE.

    Attributes:
        zones: the zones at fault.
    """

    def __init__(self, text: str, zones: tuple[int, ...]) -> None:
        super().__init__(text)
        self.zones = zones


class StoreError(ZonesError):
    """The rows in the store differ from the rows that zones reported.

    The zones need a new host, which repeats the tick.
    """

    def __init__(self, zones: tuple[int, ...]) -> None:
        text = f"zones {list(zones)}: stored and reported rows differ; host them anew"
        super().__init__(text, zones)


class Directory:
    """Decides the owners in the next tick, and checks the results of the zones.

    Attributes:
        table: owners, hosts and the tick in progress, according to the log.
        dropped: (kind, reason) → number of dropped messages or entries.
        refusals: reason → number of refused states.
    """

    def __init__(
        self,
        run: bytes,
        zones: Iterable[int],
        store: CommittedStates,
        limits: Limits | None = None,
        neighbours: Neighbours | None = None,  # None: all zones are neighbours
    ) -> None:
        self.run = run
        self.table = Table(zones)
        self.dones: dict[int, Done] = {}  # zone → its DONE for the tick in progress
        self.is_quiet = False  # whether the tick in progress began with `begin_quiet`
        self.readiness = Readiness()  # acknowledgements of targets
        self.dropped: Counter[tuple[str, str]] = Counter()
        self.refusals: Counter[Refusal] = Counter()
        self._payloads: Mapping[int, bytes] = {}
        self._store = store
        self._limits = Limits() if limits is None else limits
        self._decisions = Decisions(self.readiness, store, self._limits, neighbours)

    @classmethod
    def restore(
        cls,
        records: Sequence[Record],
        zones: Iterable[int],
        store: CommittedStates,
        limits: Limits | None = None,
        neighbours: Neighbours | None = None,
    ) -> Directory:
        """Restore the coordinator that wrote these records. Send the messages of `resend` first."""
        if not records or not isinstance(records[0], Reset):
            raise JournalError("a log must begin with a RESET, which has the id of the run")
        directory = cls(records[0].run, zones, store, limits, neighbours)
        for record in records:
            directory.table.apply(record)
        return directory

    def set_neighbours(self, neighbours: Neighbours) -> None:
        """Set the zones between which vehicles may change their owner."""
        self._decisions.neighbours = neighbours

    # Episodes and hosts

    def reset(self) -> Output:
        """Begin an episode. A tick in progress becomes void."""
        table = self.table
        tick = table.tick + self.is_quiet if table.plan is None else table.plan.record.tick
        episode = table.episode + 1
        self.dones, self.is_quiet = {}, False
        return self._logged(Reset(episode, tick, self.run))

    def host(self, zone: int, worker: int) -> Output:
        """Give a zone to a new host in process `worker`; the host must load `hosting(zone)`.

        During a tick, the zone must be fenced first. The new host receives the STEP again.
        """
        table = self.table
        if table.plan is not None:
            if table.states[zone] is State.HOSTED:
                raise ProtocolError(f"zone {zone} has a host during a tick; fence it first")
            if table.repeats[zone] >= self._limits.repeats:
                raise LostTickError(table.plan.record.tick, table.repeats[zone] + 1, zone)
        incarnation = table.hosts[zone][1] + 1
        output = self._logged(Host(table.episode, table.tick, zone, incarnation, worker))
        return Output(output.records, self.resend((zone,)).messages)

    def fence(self, zone: int) -> Output:
        """Drop all further messages of the zone's process. Repeated calls do nothing."""
        if self.table.states[zone] is State.FENCED:
            return SILENCE
        self.dones.pop(zone, None)
        incarnation = self.table.hosts[zone][1]
        return self._logged(Fence(self.table.episode, self.table.tick, zone, incarnation))

    def hosting(self, zone: int) -> Hosting:
        """Return the data to load the zone's current host. This visits all vehicles."""
        table = self.table
        owned = {vehicle: at[1] for vehicle, at in table.owners.items() if at[0] == zone}
        return Hosting(
            self.run, table.episode, table.tick, zone, table.hosts[zone][1], owned
        )  # fmt: skip

    # A tick

    def begin(
        self,
        # (vehicle, zone that contains it) of exactly the vehicles that are outside of their
        # owner's zone by more than the hysteresis
        movers: Iterable[tuple[int, int]],
        births: Iterable[Birth] = (),
        inputs: bytes = b"",  # digest of the actions
        payloads: Mapping[int, bytes] | None = None,  # zone → payload of its STEP
    ) -> Output:
        """Decide the owners in the next tick: BEGIN, then a STEP for every zone."""
        table = self.table
        if table.plan is not None or self.is_quiet:
            raise ProtocolError(f"tick {table.tick + 1} is not committed; commit it first")
        new = tuple(sorted(births))
        self.check_births(new)
        switches, deferred, teleports = self._decisions.switches(table, movers)
        decided = (switches, deferred, new, inputs, teleports)
        begun = self._logged(Begin(table.episode, table.tick + 1, *decided))
        return Output(begun.records, self.resend(payloads=payloads or {}).messages)

    def check_births(self, births: Sequence[Birth]) -> None:
        """Check the ids and the zones of new vehicles.

        Raises:
            ProtocolError: an id has been in the episode, or a zone does not exist.
        """
        self._decisions.check_births(self.table, births)

    def resend(
        self,
        zones: Iterable[int] | None = None,  # zones that receive their STEP again; None: all
        # zone → payload of its STEP, needed after `restore`; None: the payloads given to `begin`
        payloads: Mapping[int, bytes] | None = None,
    ) -> Output:
        """Return the STEPs of zones that have not answered, to send them again."""
        if payloads is not None:
            self._payloads = payloads
        asked = self.waiting_for() if zones is None else tuple(zones)
        if self.table.plan is None:
            return SILENCE
        return Output(
            messages=tuple(
                self._step(zone) for zone in asked if self.table.states[zone] is State.HOSTED
            )
        )

    def waiting_for(self) -> tuple[int, ...]:
        """Return the zones without a DONE for the tick in progress."""
        if self.table.plan is None:
            return ()
        if len(self.dones) == len(self.table.hosts):
            return ()
        return tuple(zone for zone in self.table.hosts if zone not in self.dones)

    def commit(
        self,
        rows: Mapping[int, int],  # zone → digest of the tick's rows in the store
    ) -> Output:
        """Commit the tick in progress, after all zones are done, and check their tallies.

        Raises:
            StoreError: the stored rows of a zone differ from its report. Fence it and host it anew.
            ZonesError: a zone has not sent a DONE, or it does not fit the decisions of this tick.
        """
        table = self.table
        if table.plan is None or self.waiting_for():
            raise ZonesError(
                f"no tick is complete: zones {list(self.waiting_for())} have not answered",
                self.waiting_for(),
            )
        self._check_dones(rows)
        dones = [self.dones[zone] for zone in table.hosts]
        zones = tuple(
            ZoneLedger(done.zone, done.incarnation, done.owned, done.rows) for done in dones
        )
        begin, world = table.plan.record, world_digest(done.rows for done in dones)
        output = self._logged(Commit(begin.episode, begin.tick, all_removed(dones), zones, world))
        self.dones = {}
        self.readiness.forget(table.tick)
        return output

    def begin_quiet(self) -> bool:
        """Begin a quiet tick, in which no vehicle changes its owner or is new.

        No STEP is sent and no DONE is needed: `Endpoint.go_on` and `rest` replace them. Only a
        coordinator without a log may call this.

        Returns:
            Whether the tick can be quiet; if not, no tick has begun.
        """
        table = self.table
        self.is_quiet = table.plan is None and not table.deferred
        return self.is_quiet

    def commit_quiet(self) -> None:
        """Commit a quiet tick."""
        self.is_quiet = False
        self.table.settle(self.table.tick + 1)
        self.readiness.forget(self.table.tick)

    def break_quiet(self) -> Output:
        """Turn a quiet tick into a usual one, as if all zones had received a STEP."""
        self.is_quiet = False
        return Output(self.begin(()).records)

    def answer_for_silent(self) -> None:
        """Add a DONE without changes for each zone without an answer, after `break_quiet`."""
        table, plan = self.table, self.table.planned
        for zone in self.waiting_for():
            self.dones[zone] = Done(
                self.run, table.episode, plan.record.tick, zone, table.hosts[zone][1],
                owned=plan.expected[zone],
            )  # fmt: skip

    def on_message(self, message: Message) -> Output:
        """Process a message. Late messages and messages of other runs are dropped and counted."""
        reason = self._reason_to_drop(message)
        if reason is not None:
            self.dropped[type(message).__name__, reason] += 1
            return SILENCE
        match message:
            case Done():
                self.dones[message.zone] = message
            case Ack():
                self._on_ack(message)
            case Nack():
                self.refusals.update(entry.reason for entry in message.entries)
            case Need():
                return self._on_need(message)
        return SILENCE

    # Internal

    def _reason_to_drop(self, message: Message) -> str | None:
        table = self.table
        if message.run != self.run:
            return "run"
        if message.episode != table.episode:
            return "episode"
        if not isinstance(message, (Done, Ack, Nack, Need)):
            return "kind"
        if message.zone not in table.hosts:
            return "zone"
        if not table.alive(message.zone, message.incarnation):
            return "incarnation"
        current = table.plan is not None and message.tick == table.tick + 1
        if isinstance(message, (Ack, Nack)):
            current = current or (self.is_quiet and message.tick == table.tick + 1)
            return None if current or message.tick == table.tick else "tick"
        if isinstance(message, Done) and message.zone in self.dones:
            return "answered"
        return None if current else "tick"

    def _on_ack(self, ack: Ack) -> None:
        births = {} if self.table.plan is None else self.table.plan.births
        for vehicle, epoch, digest in ack.entries:
            if vehicle in self.table.owners or vehicle in births:
                self.readiness.note(ack, vehicle, epoch, digest)
            else:
                self.dropped["Ack", "unknown"] += 1

    def _on_need(self, need: Need) -> Output:
        plan = self.table.planned
        for vehicle in need.vehicles:
            switch = plan.switches.get(vehicle)
            if switch is not None and switch.target == need.zone:
                plan.attach.add(vehicle)
            else:
                self.dropped["Need", "unknown"] += 1
        return self.resend((need.zone,))

    def _check_dones(self, rows: Mapping[int, int]) -> None:
        wrong = tuple(zone for zone, done in self.dones.items() if rows.get(zone) != done.rows)
        for zone in wrong:
            del self.dones[zone]
        if wrong:
            raise StoreError(tuple(sorted(wrong)))
        for done in self.dones.values():
            try:
                check_done(self.run, self.table.planned, done, self.table.owners)
            except ProtocolError as error:
                raise ZonesError(str(error), (done.zone,)) from error

    def _step(self, zone: int) -> Step:
        return make_step(self.table, zone, self._store, self._payloads.get(zone, b""))

    def _logged(self, record: Record) -> Output:
        self.table.apply(record)
        return Output((record,))


def make_step(table: Table, zone: int, store: CommittedStates, payload: bytes) -> Step:
    """Return the STEP for a zone's current host in the tick in progress.

    States are attached for vehicles whose switch is forced or whose state must be sent again.
    """
    plan = table.planned
    enter = tuple(
        _entry(switch, store, switch.vehicle in plan.attach) for switch in plan.enter.get(zone, ())
    )
    return Step(
        table.run, table.episode, plan.record.tick, zone, table.hosts[zone][1], table.tick,
        enter, tuple(plan.leave.get(zone, ())), tuple(plan.spawn.get(zone, ())),
        plan.expected[zone], payload,
    )  # fmt: skip


def _entry(switch: Switch, store: CommittedStates, attached: bool) -> In:
    carried = store.state(switch.vehicle) if attached else b""
    return In(switch.vehicle, switch.epoch, attached, store.digest_of(switch.vehicle), carried)
