"""Breadth-first search over all states of coordinator and hosts (the parties) in a small world.

As in docs/model/handoff.pml, sent messages are in a set, the "soup". Each message may arrive at any
later time, any number of times, or never. Hosts and the coordinator may die between any two events,
and a living host may be taken for dead. Vehicles may be in any zone after a tick. The state of a
vehicle is the pair (vehicle, tick), so that a wrong state is detected at once.

The search never changes a party; it replaces the party by a changed copy. Equal parties are stored
once under a number, and so are the effects of messages on parties. Most steps of the search are
therefore look-ups.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields, is_dataclass
from itertools import product
from typing import Any, NamedTuple

from cavmarl.core.errors import ProtocolError
from cavmarl.ownership.decisions import Decisions
from cavmarl.ownership.directory import Directory
from cavmarl.ownership.endpoint import Endpoint
from cavmarl.ownership.ledger import SeenIds, row_hash, state_digest, tally, world_digest
from cavmarl.ownership.limits import Limits
from cavmarl.ownership.messages import (
    COORDINATOR,
    Abort,
    Birth,
    Done,
    Message,
    Need,
    Output,
    Prepare,
    Record,
    Step,
)
from cavmarl.ownership.offers import Approach, Offers
from cavmarl.ownership.planning import OwnershipPlan
from cavmarl.ownership.readiness import Readiness
from cavmarl.ownership.replicas import Replicas
from cavmarl.ownership.table import Table

RUN = bytes(16)
CHANGING = (
    Directory, Decisions, Endpoint, Offers, OwnershipPlan, Readiness, Replicas, SeenIds, Table,
)  # fmt: skip
APART = ("dropped", "refusals", "_store")  # fields that do not count as state
DEAD = -1
ONE_TICK = Limits(deferral=1)
Place = tuple[int, bool]
"""Zone of a vehicle after the tick in progress, and whether it approaches other zones."""


@dataclass(frozen=True)
class Small:
    """A small world.

    A message leaves the soup after `window` ticks. Hosts die only after the first commit, because
    no vehicle changes its zone earlier. Zones are interchangeable, so vehicles enter new zones in
    order.
    """

    zones: int = 2
    vehicles: int = 1
    ticks: int = 2
    crashes: int = 0
    false_alarms: int = 0
    coordinator_crashes: int = 0
    window: int = 0
    turns_away: bool = True
    limits: Limits = ONE_TICK


class Node(NamedTuple):
    """A state of the whole world, with the numbers of parties and messages."""

    directory: int
    endpoints: tuple[int, ...]
    soup: frozenset[tuple[int, int]]
    places: tuple[Place, ...]
    writers: tuple[int, ...]  # zone that has advanced each vehicle in this tick, or -1
    visited: int  # number of zones that vehicles have visited
    budget: tuple[
        int, int, int
    ]  # remaining crashes of hosts, false alarms, crashes of the coordinator


class Versions:
    """The committed store of a coordinator, in which the state of a vehicle is (vehicle, tick).

    Attributes:
        tick: tick of the coordinator that reads the store.
    """

    tick = 0

    def state(self, vehicle: int) -> bytes:
        return version(vehicle, self.tick)

    def digest_of(self, vehicle: int) -> bytes:
        return state_digest(self.state(vehicle))


class Explorer:
    """Visits all states of a small world."""

    def __init__(self, small: Small) -> None:
        self.small = small
        self._store = Versions()
        self._parties: list[Any] = []
        self._logs: dict[int, tuple[Record, ...]] = {}
        self._numbers: dict[Any, int] = {}
        self._messages: list[Message] = []
        self._message_numbers: dict[Message, int] = {}
        self._known: dict[Any, Any] = {}

    def run(self, most: int = 10**7) -> tuple[int, int]:
        """Visit all states; return their number, and how many of them can reach an end state.

        Raises:
            ProtocolError: an invariant does not hold in a state.
        """
        numbers: dict[Node, int] = {}
        before: list[list[int]] = []
        ends: list[int] = []
        queue: deque[Node] = deque()

        def visit(node: Node, origin: int) -> None:
            number = numbers.setdefault(node, len(before))
            if number == len(before):
                before.append([])
                queue.append(node)
                self._check(node)
                if self._tick(node) == self.small.ticks:
                    ends.append(number)
            if number != origin:
                before[number].append(origin)

        visit(self._first(), 0)
        while queue:
            node = queue.popleft()
            if len(before) > most:
                raise AssertionError(f"more than {most} states")
            if self._tick(node) < self.small.ticks:
                number = numbers[node]
                for following in self._next(node):
                    visit(following, number)
        return len(before), len(_reached(before, ends))

    # Possible events

    def _first(self) -> Node:
        small = self.small
        directory = Directory(RUN, range(small.zones), self._store, small.limits)
        log = list(directory.reset().records)
        for zone in range(small.zones):
            log += directory.host(zone, zone).records
        endpoints = tuple(self._endpoint(directory, zone) for zone in range(small.zones))
        budget = (small.crashes, small.false_alarms, small.coordinator_crashes)
        number = self._keep_directory(directory, tuple(log))
        return Node(number, endpoints, frozenset(), (), (-1,) * small.vehicles, 1, budget)

    def _next(self, node: Node) -> Iterator[Node]:
        directory: Directory = self._parties[node.directory]
        if directory.table.plan is None:
            yield from self._begin(node)
        elif not directory.waiting_for():
            yield self._commit(node)
        for destination, number in node.soup:
            if destination == COORDINATOR:
                yield self._deliver_to_coordinator(node, number)
            elif node.endpoints[destination] != DEAD:
                yield self._deliver_to_host(node, destination, number)
        crashes, alarms, restarts = node.budget
        if directory.table.tick == 0:
            return
        for zone, endpoint in enumerate(node.endpoints):
            if endpoint == DEAD:
                yield self._rehost(node, zone)
                continue
            if crashes:
                dead = (*node.endpoints[:zone], DEAD, *node.endpoints[zone + 1 :])
                yield node._replace(endpoints=dead, budget=(crashes - 1, alarms, restarts))
            if alarms:
                said = self._receive_all(node, zone)
                yield self._rehost(said._replace(budget=(crashes, alarms - 1, restarts)), zone)
        if restarts:
            yield self._restart(node._replace(budget=(crashes, alarms, restarts - 1)))

    def _begin(self, node: Node) -> Iterator[Node]:
        small, nears = self.small, (True, False) if self.small.turns_away else (True,)
        number, sent = self._begun(node.directory, node.places)
        soup, writers = node.soup | sent, (-1,) * small.vehicles
        zones = range(min(small.zones, node.visited + 1))
        paths = product(product(zones, nears), repeat=small.vehicles)
        if self._tick(node) == small.ticks - 1:  # positions after the last tick have no effect
            paths = iter([tuple((0, True) for _ in range(small.vehicles))])
        for places in paths:
            visited = max(node.visited, *(zone + 1 for zone, _ in places))
            yield node._replace(
                directory=number, places=places, writers=writers, soup=soup, visited=visited
            )

    def _begun(self, number: int, places: tuple[Place, ...]) -> tuple[int, frozenset[Any]]:
        def decide(directory: Directory) -> Output:
            owners = directory.table.owners
            vehicles = range(0 if directory.table.tick else self.small.vehicles)
            births = [Birth(vehicle, 0, version(vehicle, 0)) for vehicle in vehicles]
            return directory.begin([(vehicle, places[vehicle][0]) for vehicle in owners], births)

        return self._changed(number, ("begin", places), decide)

    def _commit(self, node: Node) -> Node:
        def commit(directory: Directory) -> Output:
            return directory.commit({zone: done.rows for zone, done in directory.dones.items()})

        number, _ = self._changed(node.directory, "commit", commit)
        table = self._parties[number].table
        for vehicle, (zone, _) in table.owners.items():
            if node.writers[vehicle] != zone:
                raise ProtocolError(f"I1: zone {node.writers[vehicle]} advanced v{vehicle}")
        soup = frozenset(item for item in node.soup if self._stays_in_soup(item[1], table.tick))
        return node._replace(directory=number, soup=soup)

    def _deliver_to_coordinator(self, node: Node, message: int) -> Node:
        number, sent = self._changed(
            node.directory, message, lambda directory: directory.on_message(self._messages[message])
        )
        return node._replace(directory=number, soup=node.soup | sent)

    def _deliver_to_host(self, node: Node, zone: int, message: int) -> Node:
        key = (node.endpoints[zone], message, node.places)
        if key not in self._known:
            self._known[key] = self._reaction(*key, zone)
        number, sent, advanced = self._known[key]
        if number == key[0] and sent <= node.soup and not advanced:
            return node
        writers = node.writers
        for vehicle in advanced:
            if writers[vehicle] not in (-1, zone):
                raise ProtocolError(f"I1: zones {writers[vehicle]} and {zone} advance v{vehicle}")
            writers = (*writers[:vehicle], zone, *writers[vehicle + 1 :])
        endpoints = (*node.endpoints[:zone], number, *node.endpoints[zone + 1 :])
        return node._replace(endpoints=endpoints, soup=node.soup | sent, writers=writers)

    def _reaction(
        self, number: int, message: int, places: tuple[Place, ...], zone: int
    ) -> tuple[int, frozenset[Any], tuple[int, ...]]:
        endpoint: Endpoint = fork(self._parties[number])
        tick = endpoint.tick
        reaction = endpoint.on_message(self._messages[message])
        sent, advanced = list(reaction.messages), ()
        if any(isinstance(answer, Need) for answer in sent):
            raise ProtocolError(f"I4: zone {zone} is to promote a state that it does not hold")
        if reaction.advance is not None:
            if reaction.advance.tick <= tick:
                raise ProtocolError(f"I1: zone {zone} executes tick {tick} again")
            for vehicle, state in reaction.advance.enter:
                if state != version(vehicle, tick):
                    raise ProtocolError(f"I4: v{vehicle} is promoted from another state")
            advanced = tuple(sorted(endpoint.owned))
            rows = {vehicle: version(vehicle, tick + 1) for vehicle in advanced}
            digest = world_digest(row_hash(vehicle, row) for vehicle, row in rows.items())
            sent.append(endpoint.complete(digest))
            if tick + 1 < self.small.ticks:
                sent += endpoint.offer(
                    Approach(vehicle, target, rows[vehicle])
                    for vehicle in sorted(endpoint.owned)
                    for target in range(self.small.zones)
                    if target != zone and places[vehicle][1]
                )
        return self._keep(endpoint), self._soup_of(sent), advanced

    def _rehost(self, node: Node, zone: int) -> Node:
        def replace(directory: Directory) -> Output:
            fence, host = directory.fence(zone), directory.host(zone, zone)
            return Output(fence.records + host.records, host.messages)

        number, sent = self._changed(node.directory, ("host", zone), replace)
        fresh = self._endpoint(self._parties[number], zone)
        endpoints = (*node.endpoints[:zone], fresh, *node.endpoints[zone + 1 :])
        return node._replace(directory=number, endpoints=endpoints, soup=node.soup | sent)

    def _receive_all(self, node: Node, zone: int) -> Node:
        """Deliver all messages to a host that is wrongly taken for dead, and keep its answers."""
        zombie = node
        for destination, number in sorted(node.soup):
            if destination == zone:
                zombie = self._deliver_to_host(zombie, zone, number)
        return zombie._replace(writers=node.writers, endpoints=node.endpoints)

    def _restart(self, node: Node) -> Node:
        small, log = self.small, self._logs[node.directory]
        directory = Directory.restore(log, range(small.zones), self._store, small.limits)
        self._store.tick = directory.table.tick
        sent = self._soup_of(directory.resend().messages)
        return node._replace(directory=self._keep_directory(directory, log), soup=node.soup | sent)

    def _changed(self, number: int, what: Any, change: Any) -> tuple[int, frozenset[Any]]:
        """Return the number of the coordinator after a change, and the messages that it sends."""
        key = (number, what)
        if key not in self._known:
            directory = fork(self._parties[number])
            self._store.tick = directory.table.tick
            output = change(directory)
            log = self._logs[number] + output.records
            sent = self._soup_of(output.messages)
            self._known[key] = (self._keep_directory(directory, log), sent)
        found: tuple[int, frozenset[Any]] = self._known[key]
        return found

    # Invariants

    def _check(self, node: Node) -> None:
        table = self._parties[node.directory].table
        for switch in () if table.plan is None else table.plan.record.switches:
            if node.endpoints[switch.source] == DEAD:
                continue
            source = self._parties[node.endpoints[switch.source]]
            if switch.vehicle not in source.owned and switch.vehicle not in source.retained:
                raise ProtocolError(f"I3: v{switch.vehicle} is dropped before the commit")

    def _check_directory(self, directory: Directory) -> None:
        table = directory.table
        if table.tick and len(table.owners) != self.small.vehicles:
            raise ProtocolError(f"I6: vehicles {sorted(table.owners)} are left")
        for zone, expected in table.tallies.items():
            owned = {v: epoch for v, (owner, epoch) in table.owners.items() if owner == zone}
            if tally(RUN, owned) != expected:
                raise ProtocolError(f"I6: the ledger of zone {zone} is not that of its vehicles")
        if any(ticks > self.small.limits.deferral for ticks in table.deferred.values()):
            raise ProtocolError(f"I5: a vehicle waits too long: {table.deferred}")

    # Numbers for parties and messages

    def _tick(self, node: Node) -> int:
        tick: int = self._parties[node.directory].table.tick
        return tick

    def _keep(self, party: Any) -> int:
        number = self._numbers.setdefault(freeze(party), len(self._parties))
        if number == len(self._parties):
            self._parties.append(party)
        return number

    def _keep_directory(self, directory: Directory, log: tuple[Record, ...]) -> int:
        known = len(self._parties)
        number = self._keep(directory)
        if number == known:
            self._logs[number] = log
            self._check_directory(directory)
        return number

    def _endpoint(self, directory: Directory, zone: int) -> int:
        hosting = directory.hosting(zone)
        return self._keep(Endpoint(hosting, self.small.limits))

    def _soup_of(self, sent: Iterable[Message]) -> frozenset[tuple[int, int]]:
        """Return messages as items of the soup, each to its first destination only."""
        items = []
        for message in sent:
            number = self._message_numbers.setdefault(message, len(self._messages))
            if number == len(self._messages):
                self._messages.append(message)
            items.append((message.destinations()[0], number))
        return frozenset(items)

    def _stays_in_soup(self, number: int, tick: int) -> bool:
        message = self._messages[number]
        if isinstance(message, Step | Done | Need):
            return message.tick > tick
        oldest = tick - self.small.window
        return (
            message.tick >= oldest if isinstance(message, Prepare | Abort) else message.tick >= tick
        )


def version(vehicle: int, tick: int) -> bytes:
    return struct.pack("<qq", vehicle, tick)


def fork(party: Any) -> Any:
    """Return a copy of a party that shares no mutable object with the party."""
    return _fork(party, {})


def _fork(party: Any, forked: dict[int, Any]) -> Any:
    """Copy recursively; `forked` maps the `id` of an original to its copy."""
    if isinstance(party, dict):
        copied = party.copy()
        for key, inner in party.items():
            if isinstance(inner, dict | list | set):
                copied[key] = inner.copy()
        return copied
    if isinstance(party, list | set):
        return party.copy()
    kind = type(party)
    if kind not in CHANGING:
        return party
    if id(party) in forked:
        return forked[id(party)]
    copied = forked[id(party)] = kind.__new__(kind)
    for name in _names(party):
        value = getattr(party, name)
        setattr(copied, name, value if name in APART else _fork(value, forked))
    return copied


def freeze(value: Any) -> Any:
    """Return a hashable form of a party; equal states have equal forms."""
    if isinstance(value, dict):
        return frozenset((key, freeze(inner)) for key, inner in value.items())
    if isinstance(value, set):
        return frozenset(value)
    if isinstance(value, list):
        return tuple(value)
    if type(value) not in CHANGING:
        return value
    return tuple(freeze(getattr(value, name)) for name in _names(value) if name not in APART)


def _names(value: Any) -> tuple[str, ...]:
    if is_dataclass(value):
        return tuple(field.name for field in fields(value))
    return tuple(vars(value))


def _reached(before: list[list[int]], ends: list[int]) -> set[int]:
    """Return the states from which an end state can be reached; `before` has predecessors."""
    found, stack = set(ends), list(ends)
    while stack:
        for origin in before[stack.pop()]:
            if origin not in found:
                found.add(origin)
                stack.append(origin)
    return found
