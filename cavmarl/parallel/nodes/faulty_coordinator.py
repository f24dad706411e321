"""`FaultyNodeCoordinator`: leads the phases in which a plan of faults harms messages."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

from cavmarl.config.zones import ZonesConfig
from cavmarl.core.errors import MessageError, ProtocolError
from cavmarl.handoff.coordinator.coordinator_setup import WorldRun
from cavmarl.handoff.coordinator.journal import Journal
from cavmarl.handoff.fault_injection.fault_plan import Faults
from cavmarl.handoff.fault_injection.message_coordinator import PATIENCE
from cavmarl.handoff.shard_setup import limits_of
from cavmarl.ownership.ledger import state_digest
from cavmarl.ownership.messages import Message
from cavmarl.ownership.reactions import Hosting
from cavmarl.parallel.nodes.fault_phases import (
    Parcel,
    PhasedPost,
    Said,
    Told,
    packed_parcels,
    unpacked_parcels,
)
from cavmarl.parallel.nodes.link import Bytes
from cavmarl.parallel.nodes.links import LinkLostError, Links
from cavmarl.parallel.nodes.node_coordinator import CrossingDigests, NodeCoordinator
from cavmarl.parallel.nodes.zone_hosts import Report

Pieces: TypeAlias = Mapping[int, Sequence[Bytes]]  # node → what a frame to it is made of
Exchange: TypeAlias = Callable[[Pieces], Mapping[int, memoryview]]
"""What sends each node a frame of a phase, and waits for the answers of all."""


class CrossingStates(CrossingDigests):
    """Whole states of vehicles that have crossed a border, as their owners said."""

    def digest_of(self, vehicle: int) -> bytes:
        return state_digest(self.told[vehicle])

    def state(self, vehicle: int) -> bytes:
        return self.told[vehicle]


class FaultyNodeCoordinator(NodeCoordinator):
    """Sends nothing at once: all messages go in phases, and again where nothing is answered."""

    states = CrossingStates
    may_be_quiet = False

    def __init__(self, *arguments: Any, faults: Faults, exchange: Exchange) -> None:
        super().__init__(*arguments)
        self._faults, self._exchange = faults, exchange
        self._ticks = 0  # that have been leased, also those that were done again
        self._begin_phases()

    def _begin_phases(self) -> None:
        self._post = PhasedPost(self._faults, len(self._worlds))
        self._harms = True
        self._owed = 0
        self._unleased: list[tuple[int, int]] = []

    def recover(self, node_of: Sequence[int], switched: int) -> list[list[Hosting]]:
        self._begin_phases()
        return super().recover(node_of, switched)

    def begin(self, timeout_s: float) -> dict[int, bytes]:
        """Decide, and lease the next ticks to all zones; they begin when `lease` says so.

        To a lease of no ticks nothing happens: a vehicle that comes onto the road behind a border,
        or is there when all have gone back to a state, changes its owner with it.
        """
        self._harms = not self.is_late
        self._ticks += self._harms
        for w, message in self._decide():
            self._post.send(w, (message,))
        self._deliver()
        for _ in range(PATIENCE):
            if not self._unleased:
                return {}
            zones: defaultdict[int, list[int]] = defaultdict(list)
            for w, zone in self._unleased:
                zones[w].append(zone)
            for w, some in zones.items():
                self._post.send(w, self._worlds[w].directory.resend(some).messages)
            self._deliver()
        raise self._unanswered(self._unleased)

    def lease(self, messages: Mapping[int, bytes], ticks: int) -> None:
        super().lease(dict.fromkeys(sorted(set(self._node_of)), b""), ticks)

    def commit(self, reports: Mapping[int, tuple[list[tuple[int, Message]], list[Report]]]) -> None:
        if any(world.directory.table.plan is not None for world in self._worlds):
            self._await_done()
        super().commit(reports)

    def _await_done(self) -> None:
        """Wait for the DONE of all zones; what is offered is offered again a few times."""
        self._deliver()
        attempts = 1
        for _ in range(PATIENCE):
            missing = [
                (w, zone)
                for w, world in enumerate(self._worlds)
                for zone in world.directory.waiting_for()
            ]
            again = self._owed > 0 and attempts < self._limits.attempts
            if not missing and not again:
                return
            attempts += again
            for w, world in enumerate(self._worlds):
                self._post.send(w, world.directory.resend().messages)
            self._deliver(again)
        raise self._unanswered(missing)

    def _deliver(self, again: bool = False) -> None:
        """Let phases follow each other until one brings nothing.

        Raises:
            LinkLostError: a node is lost, or to one messages come without end, as it says.
        """
        for _ in range(PATIENCE):
            self._post.begin(self._harms)
            due: defaultdict[int, list[Parcel]] = defaultdict(list)
            for parcel in self._post.deliver():
                due[self._node_of[parcel.destination]].append(parcel)
            head = Told(self._post.phase, again, self._harms, self._ticks)
            told = {node: packed_parcels(head, due[node]) for node in set(self._node_of)}
            arrived = self._owed = busy = 0
            self._unleased, again = [], False
            for node, data in self._exchange(told).items():
                said, parcels = self._read(node, data)
                if said.arrived or parcels:
                    busy, arrived = node, arrived + 1
                self._owed += said.owed
                self._unleased += said.unleased
                for kind, fault, times in said.injected:
                    self.injected[kind, fault] += times
                for parcel in parcels:
                    self._take(parcel.w, parcel.message)
            self.injected += self._post.take_injected()
            if not arrived:
                return
        raise LinkLostError(busy, MessageError(f"messages have come in {PATIENCE} phases"))

    def _read(self, node: int, data: memoryview) -> tuple[Said, list[Parcel]]:
        """What a node has said. Raises LinkLostError: it is not what it could say."""
        try:
            head, parcels = unpacked_parcels(data)
            said = Said(*head)  # type: ignore[arg-type]
            self.check(node, [(parcel.w, parcel.message) for parcel in parcels])
            unleased = [(w, zone) for w, zone in said.unleased if self._node_of[zone] == node]
            return said._replace(unleased=unleased), parcels
        except (TypeError, ValueError, LookupError, MessageError) as error:
            raise LinkLostError(node, MessageError(f"no phase: {error}")) from error

    def _send(self, messages: Sequence[tuple[int, Message]]) -> None:
        for w, message in messages:
            self._post.send(w, (message,))

    def _unanswered(self, missing: Sequence[tuple[int, int]]) -> ProtocolError:
        return ProtocolError(
            f"zones {missing} (world, zone) do not answer, asked {PATIENCE} times: STEP and DONE "
            "must arrive now and then"
        )


def coordinator_of(
    settings: ZonesConfig,
    runs: Sequence[WorldRun],  # of each world
    node_of: Sequence[int],  # zone → the node that hosts it
    links: Links,  # to all nodes
    faults: Faults | None,  # what happens to messages
    exchange: Exchange,
) -> NodeCoordinator:
    """The coordinator of worlds over nodes."""
    journals = [None if r.journal is None else Journal(r.journal, anew=True) for r in runs]
    arguments = (
        [run.run for run in runs], node_of, limits_of(settings), links, journals,
        settings.check_invariants,
    )  # fmt: skip
    if faults is None:
        return NodeCoordinator(*arguments)
    return FaultyNodeCoordinator(*arguments, faults=faults, exchange=exchange)
