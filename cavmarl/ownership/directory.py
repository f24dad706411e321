"""The coordinator's side of the protocol: the owner of each vehicle, and its next one.

Each method answers with an `Output`: records to append to the log, then messages to send. What a
record changes is done by `Table.apply` and nowhere else, so a coordinator that replays its log
(`restore`) decides nothing anew.

A tick costs what changes in it: vehicles that stay where they are are never looked at.
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


class StoreError(ProtocolError):
    """What is stored is not what the zones say they stored."""

    def __init__(self, zones: tuple[int, ...]) -> None:
        super().__init__(f"zones {list(zones)} stored other rows than they told: host them anew")
        self.zones = zones  # those that have to be hosted anew and step again


class Directory:
    """Decides the owners in the next tick, and sees it done.

    Attributes:
        table: owners, hosts and the tick in progress, as the log has them.
        dropped: (kind, reason) → messages or entries that did not count.
        refusals: reason → how often a target did not hold a state.
    """

    def __init__(
        self,
        run: bytes,
        zones: Iterable[int],
        store: CommittedStates,
        limits: Limits | None = None,
        neighbours: Neighbours | None = None,  # None: each zone has all others
    ) -> None:
        self.run = run
        self.table = Table(zones)
        self.dones: dict[int, Done] = {}  # zone → its DONE for the tick in progress
        self.is_quiet = False  # the tick in progress is one of `begin_quiet`
        self.readiness = Readiness()  # what targets have acknowledged
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
        """The coordinator that wrote these records. Send what `resend` says before all else."""
        if not records or not isinstance(records[0], Reset):
            raise JournalError("a log begins with a RESET, which names the run")
        directory = cls(records[0].run, zones, store, limits, neighbours)
        for record in records:
            directory.table.apply(record)
        return directory

    def know(self, neighbours: Neighbours) -> None:
        """From now on let vehicles change between neighbours only."""
        self._decisions.neighbours = neighbours

    # Episodes and hosts

    def reset(self) -> Output:
        """Begin an episode, the first one or another. Whatever is under way is void."""
        table = self.table
        tick = table.tick + self.is_quiet if table.plan is None else table.plan.record.tick
        episode = table.episode + 1
        self.dones, self.is_quiet = {}, False
        return self._logged(Reset(episode, tick, self.run))

    def host(self, zone: int, worker: int) -> Output:
        """Give a zone to a new process of `worker`, which has to be loaded with `hosting(zone)`.

        In the middle of a tick the zone has to be fenced first; its STEP is sent again.
        """
        table = self.table
        if table.plan is not None:
            if table.states[zone] is State.HOSTED:
                raise ProtocolError(f"zone {zone} moves in the middle of a tick: fence it first")
            if table.repeats[zone] >= self._limits.repeats:
                raise LostTickError(table.plan.record.tick, table.repeats[zone] + 1, zone)
        incarnation = table.hosts[zone][1] + 1
        output = self._logged(Host(table.episode, table.tick, zone, incarnation, worker))
        return Output(output.records, self.resend((zone,)).messages)

    def fence(self, zone: int) -> Output:
        """The zone's process is dead to us; whatever it still says is dropped. Once is enough."""
        if self.table.states[zone] is State.FENCED:
            return SILENCE
        self.dones.pop(zone, None)
        incarnation = self.table.hosts[zone][1]
        return self._logged(Fence(self.table.episode, self.table.tick, zone, incarnation))

    def hosting(self, zone: int) -> Hosting:
        """What the zone's present host has to be loaded with. Looks at every vehicle."""
        table = self.table
        owned = {vehicle: at[1] for vehicle, at in table.owners.items() if at[0] == zone}
        return Hosting(
            self.run, table.episode, table.tick, zone, table.hosts[zone][1], owned
        )  # fmt: skip

    # A tick

    def begin(
        self,
        # (vehicle, zone that contains it) for the vehicles outside their owner's zone by more than
        # the hysteresis, and for no others
        movers: Iterable[tuple[int, int]],
        births: Iterable[Birth] = (),
        inputs: bytes = b"",  # digest of the actions
        payloads: Mapping[int, bytes] | None = None,  # zone → what rides with its STEP
    ) -> Output:
        """Decide the way to the next tick: BEGIN, then a STEP for every zone."""
        table = self.table
        if table.plan is not None or self.is_quiet:
            raise ProtocolError(f"tick {table.tick + 1} is not committed")
        new = tuple(sorted(births))
        self.check_births(new)
        switches, deferred, teleports = self._decisions.switches(table, movers)
        decided = (switches, deferred, new, inputs, teleports)
        begun = self._logged(Begin(table.episode, table.tick + 1, *decided))
        return Output(begun.records, self.resend(payloads=payloads or {}).messages)

    def check_births(self, births: Sequence[Birth]) -> None:
        """See that new vehicles are new.

        Raises:
            ProtocolError: an id that the episode has seen, or a zone that does not exist.
        """
        self._decisions.check_births(self.table, births)

    def resend(
        self,
        zones: Iterable[int] | None = None,  # only these
        # as in `begin`, whose payloads are kept; needed after `restore`
        payloads: Mapping[int, bytes] | None = None,
    ) -> Output:
        """The STEPs once more, of zones that have not answered."""
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
        """Zones without a DONE for the tick in progress."""
        if self.table.plan is None:
            return ()
        if len(self.dones) == len(self.table.hosts):
            return ()
        return tuple(zone for zone in self.table.hosts if zone not in self.dones)

    def commit(
        self,
        rows: Mapping[int, int],  # zone → digest of the rows that the store holds for the tick
    ) -> Output:
        """Make the tick in progress the truth: every zone is done, and the ledger is exact.

        Raises:
            StoreError: the store holds other rows than a zone told of. Fence and host it anew.
        """
        table = self.table
        if table.plan is None or self.waiting_for():
            raise ProtocolError(f"nothing to commit: zones {list(self.waiting_for())} are at work")
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
        """Begin a tick of which there is nothing to say: no vehicle changes its owner, none is new.

        No STEP is sent, and no DONE is awaited: `Endpoint.go_on` and `rest` stand for them. For a
        coordinator without a log.

        Returns:
            whether there can be such a tick; else nothing has begun.
        """
        table = self.table
        self.is_quiet = table.plan is None and not table.deferred
        return self.is_quiet

    def commit_quiet(self) -> None:
        """Make a quiet tick the truth: no zone has anything to say of it."""
        self.is_quiet = False
        self.table.settle(self.table.tick + 1)
        self.readiness.forget(self.table.tick)

    def break_quiet(self) -> Output:
        """A zone has something to say: the tick goes on as if all had been told by STEP."""
        self.is_quiet = False
        return Output(self.begin(()).records)

    def answer_for_silent(self) -> None:
        """Zones that say nothing of a tick that was quiet have changed nothing in it."""
        table, plan = self.table, self.table.planned
        for zone in self.waiting_for():
            self.dones[zone] = Done(
                self.run, table.episode, plan.record.tick, zone, table.hosts[zone][1],
                owned=plan.expected[zone],
            )  # fmt: skip

    def on_message(self, message: Message) -> Output:
        """Take a message in. One that comes late or from elsewhere is dropped and counted."""
        reason = self._misfit(message)
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

    # Inside

    def _misfit(self, message: Message) -> str | None:
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
            check_done(self.run, self.table.planned, done, self.table.owners)

    def _step(self, zone: int) -> Step:
        return make_step(self.table, zone, self._store, self._payloads.get(zone, b""))

    def _logged(self, record: Record) -> Output:
        self.table.apply(record)
        return Output((record,))


def make_step(table: Table, zone: int, store: CommittedStates, payload: bytes) -> Step:
    """The lease of a zone's present host for the tick in progress.

    States ride along for vehicles whose switch is forced, and for those that have to be sent again.
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
