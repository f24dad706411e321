"""Check of a trace by the rules of docs/explanation/ownership.md, without the protocol's code.

The check accepts the traces of correct runs. It refuses a trace if a vehicle has two owners or
none; if a switch begins before its target has the exact state (PREPARE < ACK < SWITCH < CONFIRM <
RELEASE); if a message is sent before its record is logged; or if a tick is committed before the
current hosts have computed it.

The cost of a tick grows with its changes: vehicles that keep their owner are not visited.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

from cavmarl.core.errors import ProtocolError
from cavmarl.ownership.ledger import OwnedTally, SeenIds, state_digest
from cavmarl.ownership.messages import (
    COORDINATOR,
    Abort,
    Ack,
    Begin,
    Commit,
    Done,
    Fence,
    Host,
    Message,
    Prepare,
    Record,
    Removed,
    Reset,
    Step,
)
from cavmarl.ownership.trace import TraceEntry

Holding = tuple[int, int, int, int, bytes]
"""(zone, incarnation, vehicle, epoch, digest) of a state at a host."""


class KnownOwners(Protocol):
    """The state that results from a log; see `ownership.table`, which the check does not use."""

    @property
    def hosts(self) -> Mapping[int, tuple[Any, int]]: ...

    @property
    def episode(self) -> int: ...

    @property
    def tick(self) -> int: ...

    @property
    def run(self) -> bytes: ...

    @property
    def owners(self) -> Mapping[int, Any]: ...

    @property
    def seen(self) -> Any: ...

    @property
    def tallies(self) -> Mapping[Any, Any]: ...


Owner = tuple[int, int]
"""(zone, epoch) of a vehicle."""


class OwnerStep(NamedTuple):
    """The owner of a vehicle before and after a tick; None: the vehicle is not in the world."""

    vehicle: int
    before: Owner | None
    after: Owner | None


@dataclass(slots=True)
class _Orders:
    """The decisions of a BEGIN for one zone."""

    entered: set[tuple[int, int]] = field(default_factory=set)
    left: set[tuple[int, int]] = field(default_factory=set)
    born: set[int] = field(default_factory=set)


def _require(holds: bool, problem: str) -> None:
    if not holds:
        raise ProtocolError(problem)


class TraceChecker:
    """Checks a trace entry by entry; `take` raises ProtocolError at the first wrong entry."""

    def __init__(
        self,
        longest_deferral: int,  # ticks for which a vehicle may keep an owner whose zone it has left
        lifetime: int,  # ticks after which a state that is not refreshed is forgotten
        # whether zones and coordinator are in one process. The trace then has only records, and
        # possibly only records of ticks with changes
        is_direct: bool = False,
        near: Sequence[Container[int]] | None = None,  # zone → its neighbours; None: all
    ) -> None:
        self._is_direct, self.near = is_direct, near
        self.owners: dict[int, Owner] = {}  # vehicle → owner at the committed tick
        self.changes: list[OwnerStep] = []  # changes in the last COMMIT
        self._longest, self._lifetime = longest_deferral, lifetime
        self._run, self._episode, self._tick = b"", -1, 0
        self._tallies: defaultdict[int, OwnedTally] = defaultdict(OwnedTally)
        self._deferred: dict[int, int] = {}
        self._born = SeenIds()
        self._incarnations: dict[int, int] = {}
        self._fenced: set[int] = set()
        self._fences: dict[tuple[int, int], tuple[int, int]] = {}
        self._fenced_at: defaultdict[int, set[tuple[int, int]]] = defaultdict(set)  # tick → fences
        self._holdings: defaultdict[int, set[Holding]] = defaultdict(set)  # tick → holdings
        self._ready: set[tuple[int, int, int, int, int]] = set()  # states of ACKs, and their tick
        self._begun: Begin | None = None
        self._orders: defaultdict[int, _Orders] = defaultdict(_Orders)  # zone → its orders
        self._dones: dict[int, Done] = {}
        self._checks: dict[type, Callable[[Any], None]] = {
            Reset: self._reset, Host: self._host, Fence: self._fence, Begin: self._begin,
            Commit: self._commit, Step: self._step, Prepare: self._prepare, Abort: self._abort,
            Ack: self._ack, Done: self._done,
        }  # fmt: skip

    def take(self, entry: TraceEntry) -> None:
        item = entry.item
        check = self._checks.get(type(item))
        if isinstance(item, Record):
            _require(check is not None, "unknown record")
        elif self._is_foreign(item) or (type(item) is Ack and entry.destination != COORDINATOR):
            return
        if check is not None:
            check(item)

    def _is_foreign(self, message: Message) -> bool:
        return message.run != self._run or message.episode != self._episode

    def _reset(self, record: Reset) -> None:
        _require(record.episode == self._episode + 1, f"after episode {self._episode}")
        _require(record.tick >= self._tick, f"the tick goes back from {self._tick}")
        self._run, self._episode, self._tick = record.run, record.episode, record.tick
        self.owners, self.changes, self._deferred, self._born = {}, [], {}, SeenIds()
        self._tallies.clear()
        self._begun, self._dones = None, {}
        self._fences, self._ready = {}, set()
        self._fenced_at.clear()
        self._holdings.clear()

    def go_on(self, table: KnownOwners) -> None:
        """Resume with the table of a coordinator without messages."""
        self._incarnations = {zone: number for zone, (_, number) in table.hosts.items() if number}
        self._episode, self._tick = table.episode - 1, 0
        self._reset(Reset(table.episode, table.tick, table.run))
        self.owners = dict(table.owners)
        self._born = SeenIds(table.seen.floor, table.seen.above)
        self._tallies.update(table.tallies)

    def _host(self, record: Host) -> None:
        zone, before = record.zone, self._incarnations.get(record.zone, 0)
        _require(record.incarnation == before + 1, f"after incarnation {before}")
        moved = self._begun is not None and before > 0 and zone not in self._fenced
        _require(not moved, "a zone moves in the middle of a tick")
        self._incarnations[zone] = record.incarnation
        self._fenced.discard(zone)
        self._dones.pop(zone, None)
        self._fences = {key: fence for key, fence in self._fences.items() if key[0] != zone}

    def _fence(self, record: Fence) -> None:
        known = self._incarnations.get(record.zone) == record.incarnation
        _require(known, "fences an unknown process")
        self._fenced.add(record.zone)
        self._dones.pop(record.zone, None)

    def _begin(self, record: Begin) -> None:
        _require(self._begun is None, "a tick is decided twice")
        if self._is_direct and record.tick > self._tick:
            self._tick = record.tick - 1
        _require(record.tick == self._tick + 1, f"follows tick {self._tick}")
        for vehicle, source, target, epoch, forced in record.switches:
            owner = self.owners.get(vehicle)
            _require(owner == (source, epoch - 1), f"v{vehicle} is owned by {owner}")
            known = self.near is None or target in self.near[source]
            _require(known or vehicle in record.teleports, f"{target} is no neighbour of {source}")
            waited = self._deferred.get(vehicle, 0)
            if forced:
                _require(waited >= self._longest, f"v{vehicle} is forced after {waited} ticks")
            else:
                self._require_ready(vehicle, target, epoch - 1)
        for vehicle, ticks in record.deferred:
            follows = ticks == self._deferred.get(vehicle, 0) + 1
            _require(follows and vehicle in self.owners, f"v{vehicle}: wrong deferral {ticks}")
            _require(ticks <= self._longest, f"v{vehicle} is deferred too long")
        for vehicle, _, _ in record.births:
            _require(vehicle not in self._born, f"v{vehicle} is born twice")
            self._born.add(vehicle)
        self._begun = record
        self._orders = defaultdict(_Orders)
        for vehicle, source, target, epoch, _ in record.switches:
            self._orders[target].entered.add((vehicle, epoch))
            self._orders[source].left.add((vehicle, epoch - 1))
        for vehicle, zone, _ in record.births:
            self._orders[zone].born.add(vehicle)

    def _require_ready(self, vehicle: int, target: int, epoch: int) -> None:
        _require(target not in self._fenced, f"zone {target} has no host")
        if self._is_direct:
            return
        process = (target, self._incarnations.get(target, 0))
        _require(
            (*process, vehicle, epoch, self._tick) in self._ready,
            f"v{vehicle} switches to {target} without an ACK of tick {self._tick}",
        )

    def _step(self, step: Step) -> None:
        begun = self._begun
        newest = self._tick if begun is None else begun.tick
        _require(step.tick <= newest, "was sent before it was logged")
        if begun is None or step.tick != begun.tick:
            return
        _require(step.committed == self._tick, "refers to a tick that is not committed")
        orders = self._orders[step.zone]
        _require(
            {(entry.vehicle, entry.epoch) for entry in step.enter} == orders.entered
            and {(entry.vehicle, entry.epoch) for entry in step.leave} == orders.left
            and {entry.vehicle for entry in step.spawn} == orders.born,
            "contradicts its BEGIN",
        )

    def _prepare(self, message: Prepare) -> None:
        process = (message.target, self._incarnations.get(message.target, 0))
        for vehicle, epoch, digest, state in message.entries:
            if state_digest(state) == digest and self._raise_fence(
                message.target, vehicle, epoch, message.tick
            ):
                self._holdings[message.tick].add((*process, vehicle, epoch, digest))

    def _abort(self, message: Abort) -> None:
        for vehicle, epoch in message.entries:
            self._raise_fence(message.target, vehicle, epoch, message.tick)

    def _raise_fence(self, zone: int, vehicle: int, epoch: int, tick: int) -> bool:
        newest = self._fences.get((zone, vehicle), (-1, -1))
        kept = self._fences[zone, vehicle] = max(newest, (epoch, tick))
        self._fenced_at[kept[1]].add((zone, vehicle))
        return (epoch, tick) > newest

    def _ack(self, message: Ack) -> None:
        process = (message.zone, message.incarnation)
        if self._incarnations.get(message.zone) != message.incarnation:
            return  # sent by a replaced process, whose further messages the trace does not have
        for vehicle, epoch, digest in message.entries:
            holding = (*process, vehicle, epoch, digest)
            known = holding in self._holdings.get(message.tick, ())
            expired = message.tick < self._tick - self._lifetime
            _require(known or expired, f"acknowledges an unknown state of v{vehicle}")
            self._ready.add((*process, vehicle, epoch, message.tick))

    def _done(self, message: Done) -> None:
        current = self._incarnations.get(message.zone) == message.incarnation
        alive = current and message.zone not in self._fenced
        if self._begun is not None and message.tick == self._begun.tick and alive:
            self._dones.setdefault(message.zone, message)

    def _commit(self, record: Commit) -> None:
        begun = self._begun
        if begun is None or record.tick != begun.tick:
            raise ProtocolError("commits a tick that was not begun")
        zones = [ledger.zone for ledger in record.zones]
        _require(zones == sorted(self._incarnations), f"has the zones {zones}")
        changed = self._planned(begun)
        if self._is_direct:
            changed.update((entry.vehicle, None) for entry in record.removed)
        else:
            removed: list[Removed] = []
            for zone in zones:
                removed += self._confirmed(zone, changed)
            _require(record.removed == tuple(sorted(removed)), "differs from the zones' removals")
        self.changes = [
            OwnerStep(vehicle, self.owners.get(vehicle), after)
            for vehicle, after in changed.items()
        ]
        self._change_owners()
        for ledger in record.zones:
            own = ledger if self._is_direct else self._dones[ledger.zone]
            exact = ledger.owned == own.owned == self._tallies[ledger.zone]
            _require(exact, f"zone {ledger.zone} does not own the expected vehicles")
        self._tick, self._begun, self._dones = record.tick, None, {}
        self._deferred = {v: ticks for v, ticks in begun.deferred if v in self.owners}
        self._forget()

    @staticmethod
    def _planned(begun: Begin) -> dict[int, Owner | None]:
        changed: dict[int, Owner | None] = {s.vehicle: (s.target, s.epoch) for s in begun.switches}
        changed.update((b.vehicle, (b.zone, 0)) for b in begun.births)
        return changed

    def _confirmed(self, zone: int, changed: dict[int, Owner | None]) -> tuple[Removed, ...]:
        """Add the removals of a zone's DONE to the changes, and return them."""
        done = self._dones.get(zone)
        if done is None:
            raise ProtocolError(f"zone {zone} has sent no DONE")
        confirmed = {(entry.vehicle, entry.epoch) for entry in done.confirmed}
        _require(
            confirmed == self._orders[zone].entered,
            f"zone {zone} did not CONFIRM the vehicles that entered",
        )
        for entry in done.removed:
            owner = changed.get(entry.vehicle, self.owners.get(entry.vehicle))
            mine = owner is not None and owner[0] == zone
            _require(mine, f"zone {zone} removed v{entry.vehicle}, which it does not own")
            changed[entry.vehicle] = None
        return done.removed

    def _change_owners(self) -> None:
        tallies = self._tallies
        for vehicle, before, after in self.changes:
            if before is not None:
                tallies[before[0]] = tallies[before[0]].minus(self._run, vehicle, before[1])
                del self.owners[vehicle]
            if after is not None:
                tallies[after[0]] = tallies[after[0]].plus(self._run, vehicle, after[1])
                self.owners[vehicle] = after

    def _forget(self) -> None:
        oldest = self._tick - self._lifetime
        for tick in [tick for tick in self._holdings if tick < oldest]:
            del self._holdings[tick]
        for tick in [tick for tick in self._fenced_at if tick < oldest]:
            for key in self._fenced_at.pop(tick):
                if self._fences.get(key, (0, oldest))[1] < oldest:
                    del self._fences[key]
        self._ready = {ready for ready in self._ready if ready[4] >= self._tick}
