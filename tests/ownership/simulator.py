"""The whole protocol in one thread: real coordinator and hosts, with a seeded network and crashes.

`Simulator.run` advances the toy world tick by tick. The function `crashes` decides which party (the
coordinator or a host) dies at which point of which tick. `trace` has all events, and `log` has the
log of the coordinator as text.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

from cavmarl.ownership.directory import Directory, StoreError
from cavmarl.ownership.endpoint import Endpoint
from cavmarl.ownership.ledger import row_hash, world_digest
from cavmarl.ownership.limits import Limits
from cavmarl.ownership.log_records import LogChain
from cavmarl.ownership.messages import (
    COORDINATOR,
    Birth,
    Commit,
    Message,
    Output,
    Prepare,
    Removed,
    Step,
)
from cavmarl.ownership.offers import Approach
from cavmarl.ownership.reactions import Advance
from tests.ownership.protocol_invariants import Monitor
from tests.ownership.recorded_trace import Trace, check_trace
from tests.ownership.toy import ToyWorld
from tests.support.lossy_network import FaultPlan, Network
from tests.support.memory_store import MemoryStore

RUN = bytes(range(16))
APPROACH = 4

COORDINATOR_POINTS = ("torn log", "BEGIN logged", "STEP sent", "all done", "COMMIT logged")
ZONE_POINTS = (
    "before STEP", "lease taken", "half written", "before DONE", "DONE sent", "before ACK",
    "ACK sent", "false alarm",
)  # fmt: skip

Crashes = Callable[[int, str, int], bool]
"""Return whether a party (a zone or COORDINATOR) dies, from (tick, point, party)."""


class Stalled(AssertionError):
    """Raised if a tick does not end."""


class Died(Exception):
    """Raised at the point where a zone host dies."""


@dataclass
class ZoneHost:
    """The state of a process that hosts a zone: its endpoint and its rows."""

    endpoint: Endpoint
    rows: dict[int, bytes]
    frozen: dict[int, bytes] = field(default_factory=dict)
    episode: int = 0


class Simulator:
    """A divided toy world whose zones exchange messages over a faulty network."""

    def __init__(
        self,
        world: ToyWorld,
        *,
        plan: FaultPlan | None = None,
        crashes: Crashes = lambda tick, point, party: False,
        limits: Limits | None = None,
        patience: int = 400,
    ) -> None:
        self.world, self.limits = world, limits or Limits()
        self.network = Network(plan)
        self.store = MemoryStore()
        self.trace, self.monitor = Trace(), Monitor(self.limits)
        self.log, self.chain, self.log_tick = "", LogChain(), 0
        self.digests: list[int] = []
        self.deaths: Counter[str] = Counter()
        self.switches, self.forced, self.deferred = 0, 0, 0
        self.hosts: dict[int, ZoneHost] = {}
        self.zombies: list[ZoneHost] = []
        self.next_id, self.patience = 0, patience
        self._crashes, self._struck = crashes, set[tuple[int, str, int]]()
        self.directory = Directory(RUN, world.zones, self.store, self.limits)
        self._do(self.directory.reset())
        for zone in world.zones:
            self._host(zone)

    def run(self, ticks: int) -> None:
        """Run some ticks, then check the whole trace."""
        for _ in range(ticks):
            self.step()
        self.judge()

    def judge(self) -> None:
        check_trace(self.trace.entries, self.limits.deferral, self.limits.lifetime)

    def step(self) -> None:
        """Run one tick."""
        tick = self.directory.table.tick + 1
        self._begin(tick)
        for wait in range(1, self.patience + 1):
            self._phase()
            if not self.directory.waiting_for() and self._offered():
                if self._dies("all done", COORDINATOR):
                    self._restart()
                elif self._commit():
                    return
            if wait % 3 == 0:
                self._do(self.directory.resend())
                for host in self.hosts.values():
                    self.network.send(host.endpoint.offer_again())
        raise Stalled(f"tick {tick} waits for zones {self.directory.waiting_for()}")

    def reset(self) -> None:
        """Begin another episode, at any time."""
        self._do(self.directory.reset())
        self.store.reset(self.directory.table.tick)
        self.next_id = 0

    def open_handoffs(self) -> list[int]:
        """Return the vehicles that are outside of the zone that owns them."""
        owners = self.directory.table.owners
        states = self.store.committed
        return [v for v, (zone, _) in owners.items() if self.world.zone(states[v]) != zone]

    # The coordinator

    def _begin(self, tick: int) -> None:
        born = self.world.births(tick, self.next_id)
        self.next_id += len(born)
        self._decide(born)
        if self._dies(
            "torn log", COORDINATOR
        ):  # the log ends inside its last record, which no party has used yet
            self.log = self.log[: -len(self.log.splitlines()[-1]) // 2]
            self.trace.entries.pop()
            self._restart()
            self._decide(born)
        if self._dies("BEGIN logged", COORDINATOR):
            self._restart()
        else:
            self.network.send(self._outbox)
        if self._dies("STEP sent", COORDINATOR):
            self._restart()
        for zone in self.world.zones:
            if self._dies("false alarm", zone):
                self.zombies.append(self.hosts[zone])
                self._replace(zone)
        record = self.directory.table.planned.record
        self.deferred += len(record.deferred)
        self.switches += len(record.switches)
        self.forced += sum(switch.forced for switch in record.switches)

    def _decide(self, born: list[tuple[int, bytes]]) -> None:
        owners = self.directory.table.owners
        states = self.store.committed
        movers = [(v, self.world.zone(states[v])) for v, (zone, _) in owners.items()
                  if self.world.zone(states[v]) != zone]  # fmt: skip
        births = [Birth(vehicle, self.world.zone(state), state) for vehicle, state in born]
        output = self.directory.begin(movers, births)
        self._write(output)
        self._outbox = output.messages

    def _commit(self) -> bool:
        incarnations = {zone: host[1] for zone, host in self.directory.table.hosts.items()}
        rows = {zone: self.store.digest(zone, inc) for zone, inc in incarnations.items()}
        try:
            output = self.directory.commit(rows)
        except StoreError as error:
            for zone in error.zones:
                self.deaths["wrong rows"] += 1
                self._replace(zone)
            return False
        self._write(output)
        if self._dies("COMMIT logged", COORDINATOR):
            self._restart()
        self._flip()
        self.monitor.committed(self.last_commit.world, self.store)
        self.monitor.check(self.directory, self._endpoints(), self.store)
        self.digests.append(self.store.world())
        return True

    def _flip(self) -> None:
        if self.store.tick < self.directory.table.tick:
            commit = self.last_commit
            self.store.commit(commit.tick, {z.zone: z.incarnation for z in commit.zones})

    def _restart(self) -> None:
        self.deaths["coordinator"] += 1
        self.log = whole_lines(self.log)
        self.chain = LogChain()
        records = tuple(self.chain.read(line) for line in self.log.splitlines())
        zones, limits = self.world.zones, self.limits
        self.directory = Directory.restore(records, zones, self.store, limits)
        self._flip()
        for zone in zones:
            if zone not in self.hosts:
                self._replace(zone)
        self._do(self.directory.resend())

    def _do(self, output: Output) -> None:
        self._write(output)
        self.network.send(output.messages)

    def _write(self, output: Output) -> None:
        for record in output.records:
            self.log += self.chain.write(record)
            if isinstance(record, Commit):
                self.last_commit = record
        self.trace.logged(output.records)

    def _host(self, zone: int) -> None:
        output = self.directory.host(zone, worker=self.chain.sequence)
        self._write(output)
        hosting = self.directory.hosting(zone)
        rows = {vehicle: self.store.state(vehicle) for vehicle in hosting.owned}
        endpoint = Endpoint(hosting, self.limits)
        self.hosts[zone] = ZoneHost(endpoint, rows, episode=hosting.episode)
        self.network.send(output.messages)

    def _replace(self, zone: int) -> None:
        self.hosts.pop(zone, None)
        self._do(self.directory.fence(zone))
        self._host(zone)

    # A phase

    def _phase(self) -> None:
        for zone in self.world.zones:
            if zone not in self.hosts:
                self._replace(zone)
        for destination, message, refused in self.network.deliver():
            self.trace.delivered(destination, message)
            if destination == COORDINATOR:
                self._do(self.directory.on_message(message))
            else:
                self._deliver(destination, message, refused)
        self.monitor.check(self.directory, self._endpoints(), self.store)

    def _deliver(self, zone: int, message: Message, refused: bool) -> None:
        for zombie in [host for host in self.zombies if host.endpoint.zone == zone]:
            self._react(zombie, message, refused, zombie=True)
            if zombie.endpoint.tick > self.directory.table.tick:
                self.zombies.remove(zombie)  # the replaced process has sent all its messages
        host = self.hosts.get(zone)
        if host is None:
            return
        try:
            self._react(host, message, refused)
        except Died:
            self.deaths["zone"] += 1
            del self.hosts[zone]

    def _react(self, host: ZoneHost, message: Message, refused: bool, zombie: bool = False) -> None:
        endpoint = host.endpoint
        if isinstance(message, Step):
            self._may_die("before STEP", host, zombie)
        if isinstance(message, Prepare):
            self._may_die("before ACK", host, zombie)
        if refused and isinstance(message, Prepare):
            reaction = endpoint.refuse(message)
        else:
            reaction = endpoint.on_message(message)
        self.network.send(reaction.messages)
        if isinstance(message, Prepare):
            self._may_die("ACK sent", host, zombie)
        if reaction.advance is not None:
            self._advance(host, reaction.advance, zombie)

    def _may_die(self, point: str, host: ZoneHost, zombie: bool) -> None:
        if not zombie and self._dies(point, host.endpoint.zone):
            raise Died(point)

    # A zone's work

    def _advance(self, host: ZoneHost, work: Advance, zombie: bool) -> None:
        endpoint, store = host.endpoint, self.store
        zone, incarnation = endpoint.zone, endpoint.incarnation
        self._may_die("lease taken", host, zombie)
        if work.episode != host.episode:
            host.rows, host.episode = {}, work.episode
        for vehicle in work.leave:
            if vehicle not in endpoint.owned:
                host.rows.pop(vehicle)
        host.rows.update(work.enter)
        host.rows.update(work.spawn)
        if not zombie:
            self.monitor.advanced(zone, incarnation, work.tick, endpoint.owned)
        births = self.directory.table.planned.record.births
        born = {entry.vehicle: entry.state for entry in births}
        near = store.committed | born | host.rows
        after = {v: self.world.advance(v, row, near, work.tick) for v, row in host.rows.items()}
        store.clear(zone, incarnation)
        for count, (vehicle, row) in enumerate(sorted(after.items())):
            if count == len(after) // 2:
                self._may_die("half written", host, zombie)
            if row is not None:
                store.write(zone, incarnation, vehicle, row)
        host.rows = {vehicle: row for vehicle, row in after.items() if row is not None}
        self._may_die("before DONE", host, zombie)
        removed = [Removed(vehicle, 1) for vehicle, row in after.items() if row is None]
        rows = world_digest(row_hash(vehicle, row) for vehicle, row in host.rows.items())
        self.network.send((endpoint.complete(rows, removed),))
        self.network.send(endpoint.offer(self._approaches(host)))
        self._may_die("DONE sent", host, zombie)

    def _approaches(self, host: ZoneHost) -> list[Approach]:
        return [
            Approach(vehicle, target, row)
            for vehicle, row in sorted(host.rows.items())
            for target in sorted(self.world.near(row, APPROACH) - {host.endpoint.zone})
        ]

    def _offered(self) -> bool:
        """Return whether each offer of the tick is answered or has no attempts left."""
        tick = self.directory.table.planned.record.tick
        return all(
            not host.endpoint.offers.unanswered
            or host.endpoint.tick != tick
            or host.endpoint.offers.attempts >= self.limits.attempts
            for host in self.hosts.values()
        )

    def _endpoints(self) -> dict[int, Endpoint]:
        return {zone: host.endpoint for zone, host in self.hosts.items()}

    def _dies(self, point: str, party: int) -> bool:
        tick = self.directory.table.tick + (self.directory.table.plan is not None)
        key = (tick, point, party)
        if key in self._struck or not self._crashes(tick, point, party):
            return False
        self._struck.add(key)
        return True


def whole_lines(text: str) -> str:
    """Return a log without an incomplete last line, which no party has used."""
    return text[: text.rfind("\n") + 1]
