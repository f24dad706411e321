"""The table of owners and hosts, which results from the log.

Only records change the table. So a coordinator that replays its log restores its former table, and
any other reader that replays the log obtains all owners.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import TypeAlias

from cavmarl.core.errors import JournalError, ProtocolError
from cavmarl.ownership.ledger import OwnedTally, SeenIds
from cavmarl.ownership.messages import (
    RUN_BYTES,
    Begin,
    Birth,
    Commit,
    Fence,
    Host,
    Record,
    Removed,
    Reset,
    Switch,
)
from cavmarl.ownership.planning import OwnershipPlan, make_plan
from cavmarl.ownership.transitions import Event, Party, State, after

_Move: TypeAlias = tuple[int, int, int, bool]
"""(vehicle, zone, epoch, True if it enters the zone and False if it leaves it)."""


class Table:
    """The state that results from a log.

    Attributes:
        run: the id of the run, from the first record.
        tick: the committed tick. It never decreases, not even at a reset.
        episode: the number of resets - 1; -1 before the first reset.
        owners: vehicle → (zone, epoch) at the committed tick.
        deferred: vehicle → ticks since it left its owner's zone.
        hosts: zone → (worker, incarnation); incarnation 0: never hosted.
        counts: zone → number of owned vehicles at the committed tick.
    """

    def __init__(self, zones: Iterable[int]) -> None:
        self.run, self.tick, self.episode = b"", 0, -1
        self.owners: dict[int, tuple[int, int]] = {}
        self.deferred: dict[int, int] = {}
        self.hosts = dict.fromkeys(sorted(zones), (-1, 0))
        self.states = dict.fromkeys(self.hosts, State.UNHOSTED)  # zone → UNHOSTED, HOSTED or FENCED
        self.seen = SeenIds()  # vehicle ids that have been used in the episode
        self.repeats: Counter[int] = Counter()  # zone → number of new hosts in the current tick
        self.plan: OwnershipPlan | None = None  # plan of the tick in progress, if any
        self.counts = dict.fromkeys(self.hosts, 0)
        self._tallies = dict.fromkeys(self.hosts, OwnedTally())
        self._moves: list[_Move] = []  # moves that the tallies do not include yet

    @property
    def tallies(self) -> dict[int, OwnedTally]:
        tallies, run = self._tallies, self.run
        if len(self._moves) > len(self.owners):
            tallies.update(dict.fromkeys(self.hosts, OwnedTally()))
            self._moves = [(v, zone, epoch, True) for v, (zone, epoch) in self.owners.items()]
        for vehicle, zone, epoch, comes in self._moves:
            tally = tallies[zone]
            change = tally.plus if comes else tally.minus
            tallies[zone] = change(run, vehicle, epoch)
        self._moves.clear()
        return tallies

    @property
    def planned(self) -> OwnershipPlan:
        if self.plan is None:
            raise ProtocolError("no tick is in progress; call begin first")
        return self.plan

    def state(self, vehicle: int) -> State:
        """Return UNKNOWN, OWNED, SWITCHING or REMOVED."""
        if vehicle not in self.owners:
            return State.REMOVED if vehicle in self.seen else State.UNKNOWN
        switching = self.plan is not None and vehicle in self.plan.switches
        return State.SWITCHING if switching else State.OWNED

    def settle(
        self,
        tick: int,  # the later tick
        switches: Iterable[Switch] = (),  # changes of owner up to this tick
        births: Iterable[Birth] = (),
        removed: Iterable[Removed] = (),  # vehicles that left the world, possibly from `births`
    ) -> None:
        """Reach a later tick at once, as a BEGIN and a COMMIT with the same contents would.

        The calling coordinator must have checked the changes, and must have written them to
        its log, if any.
        """
        if self.plan is not None or self.deferred:
            raise ProtocolError(f"tick {self.tick + 1} is in progress; commit it first")
        owners, counts, moves = self.owners, self.counts, self._moves
        for vehicle, zone, _ in births:
            self.seen.add(vehicle)
            owners[vehicle] = (zone, 0)
            counts[zone] += 1
            moves.append((vehicle, zone, 0, True))
        for vehicle, source, target, epoch, _ in switches:
            owner = owners.get(vehicle)
            if owner != (source, epoch - 1):
                raise ProtocolError(
                    f"vehicle {vehicle} changed from zone {source} to {target} by tick {tick}, "
                    f"but its owner on record was {owner}"
                )
            owners[vehicle] = (target, epoch)
            counts[source] -= 1
            counts[target] += 1
            moves.append((vehicle, source, epoch - 1, False))
            moves.append((vehicle, target, epoch, True))
        for vehicle, _ in removed:
            if vehicle not in owners:
                raise ProtocolError(f"vehicle {vehicle} has left the world, but no zone owned it")
            zone, epoch = owners.pop(vehicle)
            counts[zone] -= 1
            moves.append((vehicle, zone, epoch, False))
        # If there are more moves than vehicles, `tallies` counts the vehicles and does not read the
        # moves. So only the length of the list matters, and one move too many is enough: later, it
        # stays longer than the number of vehicles, because each new vehicle also adds a move.
        del moves[len(owners) + 1 :]
        self.tick = tick

    def go_on(
        self,
        run: bytes,
        episode: int,  # -1: no episode has begun
        tick: int,  # the committed tick
        owners: dict[int, tuple[int, int]],  # owners at `tick`
        seen: SeenIds,
    ) -> None:
        """Resume as the table of a coordinator whose zones are all in one process.

        Each zone has been hosted once, when the first episode began.
        """
        has_begun = episode >= 0
        self.run, self.tick, self.episode = run, tick, episode
        self.owners, self.seen = owners, seen
        self.deferred, self.plan = {}, None
        self.hosts = dict.fromkeys(self.hosts, (0, 1) if has_begun else (-1, 0))
        self.states = dict.fromkeys(self.hosts, State.HOSTED if has_begun else State.UNHOSTED)
        self.repeats.clear()
        found = Counter(zone for zone, _ in owners.values())
        self.counts = {zone: found[zone] for zone in self.hosts}
        self._tallies = dict.fromkeys(self.hosts, OwnedTally())
        self._moves = [(v, zone, epoch, True) for v, (zone, epoch) in owners.items()]

    def alive(self, zone: int, incarnation: int) -> bool:
        """Return whether the process of this incarnation hosts the zone now."""
        return self.states[zone] is State.HOSTED and self.hosts[zone][1] == incarnation

    def apply(self, record: Record) -> None:
        """Apply one record.

        Raises:
            JournalError: a correct coordinator does not write this record here.
            ProtocolError: the record is wrong for one vehicle or zone.
        """
        match record:  # frequent records first
            case Begin():
                self._begin(record)
            case Commit():
                self._commit(record)
            case Reset():
                self._reset(record)
            case Fence():
                self._move(record, Event.FENCE)
            case Host():
                self._host(record)

    def _reset(self, record: Reset) -> None:
        if len(record.run) != RUN_BYTES:
            raise JournalError(f"the id of the run has {len(record.run)} bytes, not {RUN_BYTES}")
        self.run, self.tick, self.episode = record.run, record.tick, record.episode
        self.owners, self.deferred, self.plan = {}, {}, None
        self.counts = dict.fromkeys(self.hosts, 0)
        self._tallies = dict.fromkeys(self.hosts, OwnedTally())
        self._moves.clear()
        self.seen = SeenIds()
        self.repeats.clear()

    def _begin(self, record: Begin) -> None:
        if self.plan is not None or record.tick != self.tick + 1:
            raise JournalError(
                f"BEGIN of tick {record.tick} after tick {self.tick}, or during a tick"
            )
        if record.switches or record.births:
            self._check_zones(switch.target for switch in record.switches)
            self._check_zones(birth.zone for birth in record.births)
        for vehicle, source, _, epoch, _ in record.switches:
            after(Party.VEHICLE, self.state(vehicle), Event.SWITCH)
            if self.owners[vehicle] != (source, epoch - 1):
                raise JournalError(
                    f"BEGIN of tick {record.tick} takes vehicle {vehicle} from zone {source}, "
                    f"which does not own it at epoch {epoch - 1}"
                )
        for vehicle, _, _ in record.births:
            after(Party.VEHICLE, self.state(vehicle), Event.SPAWN)
            self.seen.add(vehicle)
        self.plan = make_plan(self.run, record, self.tallies)

    def _commit(self, record: Commit) -> None:
        plan = self.planned
        if record.tick != plan.record.tick:
            raise JournalError(f"COMMIT of tick {record.tick}, but {plan.record.tick} was begun")
        zones = [entry.zone for entry in record.zones]
        if zones != list(self.hosts):
            raise JournalError(f"COMMIT of tick {record.tick} has the zones {zones}")
        for vehicle, zone in plan.births.items():
            self.owners[vehicle] = (zone, 0)
        for vehicle, _ in record.removed:
            after(Party.VEHICLE, self.state(vehicle), Event.REMOVE)
            del self.owners[vehicle]
        for vehicle, switch in plan.switches.items():
            if vehicle in self.owners:
                after(Party.VEHICLE, self.state(vehicle), Event.COMMIT)
                self.owners[vehicle] = (switch.target, switch.epoch)
        deferred = plan.record.deferred
        self.deferred = {vehicle: ticks for vehicle, ticks in deferred if vehicle in self.owners}
        self._tallies = {entry.zone: entry.owned for entry in record.zones}
        self.counts = {entry.zone: entry.owned.vehicles for entry in record.zones}
        self.tick, self.plan = record.tick, None
        self.repeats.clear()

    def _host(self, record: Host) -> None:
        self._move(record, Event.HOST)
        self.hosts[record.zone] = (record.worker, record.incarnation)
        if self.plan is not None:
            self.repeats[record.zone] += 1
            self.plan.attach.update(entry.vehicle for entry in self.plan.enter.get(record.zone, ()))

    def _check_zones(self, zones: Iterable[int]) -> None:
        unknown = sorted(set(zones) - self.hosts.keys())
        if unknown:
            raise JournalError(f"zones {unknown} do not exist")

    def _move(self, record: Fence | Host, event: Event) -> None:
        self._check_zones((record.zone,))
        self.states[record.zone] = after(Party.ZONE, self.states[record.zone], event)
