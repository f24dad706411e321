"""`NodeCoordinator`: decides which zone owns which vehicle, without the rows of vehicles."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence

from cavmarl.core.errors import MessageError, ProtocolError
from cavmarl.handoff.coordinator.invariant_monitor import OwnersOnRecord
from cavmarl.handoff.coordinator.journal import Journal
from cavmarl.handoff.zone_view import TransferInFlight
from cavmarl.ownership.decisions import Neighbours
from cavmarl.ownership.directory import Directory, ZonesError
from cavmarl.ownership.ledger import DIGEST_BYTES
from cavmarl.ownership.limits import Limits
from cavmarl.ownership.messages import Ack, Begin, Birth, Message, Nack, Output
from cavmarl.ownership.reactions import Hosting
from cavmarl.ownership.transfers import TransferLog
from cavmarl.parallel.nodes.link import FrameKind, NodeFrame
from cavmarl.parallel.nodes.links import AwaitedOffer, Links, SilenceError
from cavmarl.parallel.nodes.peer_faults import LinkLostError, check_indices, reading
from cavmarl.parallel.nodes.zone_endpoints import NOTHING, Report, packed, unpacked
from cavmarl.shards.row_check import MOST_IDS


class CrossingDigests:
    """Digests of the states of vehicles that have crossed a border, from their owners."""

    def __init__(self) -> None:
        self.digests: dict[int, bytes] = {}

    def digest_of(self, vehicle: int) -> bytes:
        return self.digests[vehicle]

    def state(self, vehicle: int) -> bytes:
        """Raise ProtocolError: a node asks for a state that it has already acknowledged."""
        raise ProtocolError(
            f"vehicle {vehicle}: its new zone does not have the state that it acknowledged"
        )


class _World:
    """Ownership in one world."""

    def __init__(
        self,
        run: bytes,
        zones: int,
        limits: Limits,
        journal: Journal | None,
        is_checked: bool,
    ) -> None:
        self.states = CrossingDigests()
        self.directory = Directory(run, range(zones), self.states, limits)
        self.journal = journal
        self.log = TransferLog(limits.lifetime)
        self.movers: list[tuple[int, int]] = []
        self.births: list[Birth] = []
        self.answered: set[tuple[int, int]] = set()
        self.refused: set[tuple[int, int]] = set()  # refused offers, a part of `answered`
        self.has_stepped = False  # whether each zone has received a STEP in the current episode
        self.has_begun = False  # whether the first reset is done; before it, rows are of no episode
        self.on_record = OwnersOnRecord(zones, limits) if is_checked else None

    def check_owned(self, w: int, reports: Sequence[Report]) -> None:
        """Compare the vehicles that each zone owns according to its rows with the records.

        Raises:
            ZonesError: the vehicles, or their epochs, differ.
        """
        self.has_begun |= any(report.began for report in reports)
        if self.on_record is None or not self.has_begun:
            return
        sums = self.on_record.sums(self.births).tolist()
        due = dict(self.directory.table.counts)
        for birth in self.births:
            due[birth.zone] += 1
        for zone, num, total in (owned for report in reports for owned in report.owned):
            if (num, total) != (due[zone], sums[zone]):
                raise ZonesError(
                    f"world {w}, tick {self.directory.table.tick}: zone {zone} has {num} vehicles, "
                    f"and {due[zone]} according to the records; if the numbers are equal, ids or "
                    "epochs differ; zones.journal shows the records",
                    (zone,),
                )

    def is_silent(self, births: Sequence[Birth]) -> bool:
        """Return whether the next tick needs no message and no record."""
        is_watched = self.journal is not None or self.on_record is not None
        return self.has_stepped and not (births or self.movers or is_watched)

    def write(self, output: Output) -> int:
        """Write records; return the number of vehicles whose owner the records change."""
        if not output.records:
            return 0
        if self.journal is not None:
            self.journal.append(output.records)
        self.log.logged(output.records)
        if self.on_record is not None:
            self.on_record.logged(output.records)
        return sum(len(r.switches) for r in output.records if isinstance(r, Begin))


class NodeCoordinator:
    """Decides about ownership in W worlds.

    Attributes:
        worlds: ownership in each world.
        switched: number of changes of owner so far.
        is_late: whether a vehicle without a record has crossed a border: a lease of 0 ticks is due.
    """

    def __init__(
        self,
        runs: Sequence[bytes],  # run of each world
        node_of: Sequence[int],  # zone → node
        limits: Limits,
        links: Links,  # connections to all nodes
        journals: Sequence[Journal | None],  # journal of each world
        is_checked: bool = False,  # whether to compare rows of vehicles with the records
    ) -> None:
        self.worlds = [
            _World(run, len(node_of), limits, journal, is_checked)
            for run, journal in zip(runs, journals, strict=True)
        ]
        self._node_of = node_of
        self._links = links
        self.switched, self.is_late = 0, False
        self._has_recovered = False  # whether there was a recovery since the last commit
        self._has_differed = False  # whether the rows of a zone have differed from the records

    def host(self, neighbours: Neighbours) -> list[list[Hosting]]:
        """Start; return the hostings of all zones, by worlds."""
        self.set_neighbours(neighbours)
        for world in self.worlds:
            world.write(world.directory.reset())
            for zone, node in enumerate(self._node_of):
                world.write(world.directory.host(zone, worker=node))
        return self._hostings()

    def set_neighbours(self, neighbours: Neighbours) -> None:
        """From now on, allow changes of owner only between these pairs of zones."""
        self._neighbours = neighbours
        for world in self.worlds:
            world.directory.set_neighbours(neighbours)

    def recover(self, node_of: Sequence[int], switched: int) -> list[list[Hosting]]:
        """Go back to a kept state, with zones on other nodes; open transfers are void.

        Args:
            node_of: zone → node, from now on.
            switched: number of changes of owner in the kept state.

        Returns:
            the hostings of all zones, by worlds.
        """
        for world in self.worlds:
            moved = [z for z, node in enumerate(node_of) if node != self._node_of[z]]
            for zone in moved:
                world.write(world.directory.fence(zone))
            world.write(world.directory.reset())
            for zone in moved:
                world.write(world.directory.host(zone, worker=node_of[zone]))
            world.births, world.movers = [], []
            world.answered.clear()
            world.refused.clear()
            world.has_stepped = False
        self._node_of, self.switched, self.is_late = node_of, switched, False
        self._has_recovered = True
        return self._hostings()

    def _hostings(self) -> list[list[Hosting]]:
        zones = range(len(self._node_of))
        return [[world.directory.hosting(zone) for zone in zones] for world in self.worlds]

    def receive(self, number: int, frame: NodeFrame) -> None:
        """Apply acknowledgements as soon as they arrive.

        Raises:
            MessageError: the frame has another message, or is about a zone of another node.
        """
        messages = unpacked(frame.data)
        self.check(number, messages)
        for w, message in messages:
            self._take(w, message)

    def _take(self, w: int, message: Message) -> None:
        """Apply a message of a node. Raises MessageError: it does not match the tick."""
        dropped = self.worlds[w].directory.dropped
        before = dropped.total()
        self._apply(w, message)
        if dropped.total() > before:
            raise MessageError(
                f"a {type(message).__name__} of tick {message.tick} does not fit tick "
                f"{self.worlds[w].directory.table.tick} of world {w}"
            )

    def check(
        self,
        number: int,  # number of a node
        messages: Sequence[tuple[int, Message]],
        reports: Sequence[Report] = (),  # one report for each world, or no reports
    ) -> None:
        """Check messages of a node.

        Raises:
            MessageError: the messages are about a zone of another node, or have unknown numbers.
        """
        check_indices("world", (w for w, _ in messages), len(self.worlds))
        for report in reports:
            self._check_report(number, report)
        for _, message in messages:
            zone = getattr(message, "zone", -1)
            if not 0 <= zone < len(self._node_of) or self._node_of[zone] != number:
                raise MessageError(f"node {number} sends for zone {zone}, which it does not host")

    def _check_report(self, number: int, report: Report) -> None:
        zones = [zone for _, zone in report.births] + [zone for zone, *_ in report.owned]
        check_indices("zone", zones, len(self._node_of))
        check_indices("zone", (zone for _, zone, _ in report.movers), len(self._node_of))
        if any(self._node_of[zone] != number for zone in zones):
            raise MessageError(f"node {number} reports vehicles of a zone that it does not host")
        check_indices("vehicle", (vehicle for vehicle, _ in report.births), MOST_IDS)
        for vehicle, _, digest in report.movers:
            if len(bytes.fromhex(digest)) != DIGEST_BYTES:
                raise MessageError(f"{digest!r} is not a digest of vehicle {vehicle}")

    def _take_report(self, number: int, w: int, report: Report) -> None:
        """Register the new vehicles of a node.

        Raises:
            ProtocolError: the node offers or reports vehicles that it cannot have.
        """
        world = self.worlds[w]
        owners = world.directory.table.owners
        for vehicle, target, _ in report.movers:
            if vehicle not in owners or self._node_of[owners[vehicle][0]] != number:
                raise MessageError(f"node {number} offers vehicle {vehicle}, which it does not own")
            self._neighbours.is_teleport(vehicle, owners[vehicle][0], target)
        if len({vehicle for vehicle, *_ in report.movers}) < len(report.movers):
            raise MessageError(f"node {number} offers a vehicle twice")
        world.births += [Birth(vehicle, zone, b"") for vehicle, zone in report.births]
        if report.births:
            world.directory.check_births(world.births)

    def _apply(self, w: int, message: Message) -> None:
        world = self.worlds[w]
        table = world.directory.table
        is_present = message.episode == table.episode and message.tick >= table.tick
        if isinstance(message, Ack | Nack) and is_present:
            pairs = {(entry.vehicle, message.zone) for entry in message.entries}
            world.answered |= pairs
            if isinstance(message, Nack):
                world.refused |= pairs
        output = world.directory.on_message(message)
        world.write(output)
        if output.messages:
            self.lease(self._by_node([(w, answer) for answer in output.messages]), 1)

    def commit(self, reports: Mapping[int, tuple[list[tuple[int, Message]], list[Report]]]) -> None:
        """Commit a tick that all nodes have reported."""
        if any(messages for messages, _ in reports.values()):
            self._apply_all({number: messages for number, (messages, _) in reports.items()})
        every = [report for _, report in reports.values() if report]
        self._check_late({number: report for number, (_, report) in reports.items()})
        for w, world in enumerate(self.worlds):
            reported = [report[w] for report in every]
            if world.directory.is_quiet:
                world.directory.commit_quiet()
                if not reported:
                    continue
            elif world.directory.table.plan is not None:
                self._commit(world)
            if any(report.began for report in reported):
                self._check_began(
                    {n: bool(all_of) and all_of[w].began for n, (_, all_of) in reports.items()}
                )
                world.write(world.directory.reset())
                world.births, world.has_stepped = [], False
            for number, (_, report) in reports.items():
                with reading(number):
                    self._take_report(number, w, report[w] if report else NOTHING)
            movers = [mover for report in reported for mover in report.movers]
            world.movers = [(vehicle, target) for vehicle, target, _ in movers]
            digests = {v: bytes.fromhex(digest) for v, _, digest in movers}
            world.states.digests = digests
            self._check_owned(w, world, reported)
        self._has_recovered = False

    def _check_late(self, reports: Mapping[int, Sequence[Report]]) -> None:
        """Note whether a lease of 0 ticks is due.

        Raises:
            LinkLostError: vehicles of a node have no record, although the previous lease should
                have created the missing records.
        """
        late = [number for number, report in reports.items() if any(one.is_late for one in report)]
        if late and self.is_late:
            raise LinkLostError(late[0], MessageError("it has not reported new vehicles"))
        self.is_late = bool(late)

    def _check_began(self, began: Mapping[int, bool]) -> None:
        """Raise LinkLostError if a node wrongly reports that an episode has begun, or has not.

        An episode begins in all nodes or in none, and in all of them after a recovery.
        """
        is_usual = self._has_recovered or 2 * sum(began.values()) > len(began)
        for number, has_begun in began.items():
            if has_begun != is_usual:
                what = "a" if has_begun else "no"
                raise LinkLostError(number, MessageError(f"it wrongly reports {what} new episode"))

    def _check_owned(self, w: int, world: _World, reports: Sequence[Report]) -> None:
        """Compare the vehicles that each zone owns according to its rows with the records.

        Raises:
            LinkLostError: the vehicles differ for the first time, so the report may be wrong.
            ProtocolError: they differ again.
        """
        try:
            world.check_owned(w, reports)
        except ZonesError as error:
            if self._has_differed:
                raise
            self._has_differed = True
            node = self._node_of[error.zones[0]]
            raise LinkLostError(node, MessageError(str(error))) from error

    def _commit(self, world: _World) -> None:
        """Commit a tick of a world. Raises LinkLostError: the DONE of a node is wrong."""
        try:
            world.write(world.directory.commit(dict.fromkeys(range(len(self._node_of)), 0)))
        except ZonesError as error:
            raise LinkLostError(self._node_of[error.zones[0]], MessageError(str(error))) from error

    def _apply_all(self, messages_of: Mapping[int, Sequence[tuple[int, Message]]]) -> None:
        """Apply messages about a tick; zones without a message have changed nothing."""
        worlds = {w for messages in messages_of.values() for w, _ in messages}
        disturbed = [w for w in worlds if self.worlds[w].directory.is_quiet]
        for w in disturbed:
            self.worlds[w].write(self.worlds[w].directory.break_quiet())
        for number, messages in messages_of.items():
            with reading(number):
                for w, message in messages:
                    self._take(w, message)
        for w in disturbed:
            self.worlds[w].directory.answer_for_silent()

    def begin(self, timeout_s: float) -> dict[int, bytes]:
        """Wait until all offers are answered, then decide the ownership in the next ticks.

        Returns:
            node → its lease: the STEP messages of its zones, for worlds with changes.

        Raises:
            SilenceError: an offer is not answered in time.
        """
        until_s = self._links.now_s() + timeout_s
        for w, world in enumerate(self.worlds):
            while missing := set(world.movers) - world.answered:
                if self._links.now_s() > until_s:
                    offers = [self._awaited(w, *mover) for mover in missing]
                    raise SilenceError(f"offers are not answered within {timeout_s:g} s", offers)
                self._links.pump(1e3 * timeout_s)
            self._check_answers(w, world)
        lease, messages = dict.fromkeys(self._node_of, b""), self._decide()
        return lease | self._by_node(messages) if messages else lease

    def _check_answers(self, w: int, world: _World) -> None:
        """Raise LinkLostError if a node has offered a state that differs from its report."""
        held = world.directory.readiness.held.get(world.directory.table.tick, {})
        for vehicle, zone in world.movers:
            answer = held.get((vehicle, zone))
            if answer is not None and answer[2] != world.states.digest_of(vehicle):
                source = self._awaited(w, vehicle, zone).source
                why = f"it has offered another state of vehicle {vehicle} than it has reported"
                raise LinkLostError(source, MessageError(why))

    def _awaited(self, w: int, vehicle: int, zone: int) -> AwaitedOffer:
        source, _ = self.worlds[w].directory.table.owners[vehicle]
        return AwaitedOffer(w, vehicle, zone, self._node_of[source], self._node_of[zone])

    def _decide(self) -> list[tuple[int, Message]]:
        messages = []
        for w, world in enumerate(self.worlds):
            births, world.births = world.births, []
            world.answered.clear()
            world.refused.clear()
            if world.is_silent(births) and world.directory.begin_quiet():
                continue
            output = world.directory.begin(world.movers, births)
            world.has_stepped = True
            self.switched += world.write(output)
            messages += [(w, message) for message in output.messages]
        return messages

    @property
    def transfers(self) -> tuple[TransferLog, ...]:
        """Changes of owner of each world."""
        return tuple(world.log for world in self.worlds)

    def in_flight(self, w: int) -> list[TransferInFlight]:
        """Return the vehicles of a world whose next zone has acknowledged their state."""
        world = self.worlds[w]
        owners = world.directory.table.owners
        return [
            TransferInFlight(vehicle, owners[vehicle][0], zone, "prepared")
            for vehicle, zone in sorted(world.answered - world.refused)
            if vehicle in owners and owners[vehicle][0] != zone
        ]

    def lease(self, messages: Mapping[int, bytes], ticks: int) -> None:
        """Send leases, as `begin` returns them; `ticks`: 0 if they have 0 ticks, else any other."""
        for node, data in messages.items():
            self._links.send(node, FrameKind.LEASE, ticks, [data])

    def _by_node(self, messages: Sequence[tuple[int, Message]]) -> dict[int, bytes]:
        by_node: defaultdict[int, list[tuple[int, Message]]] = defaultdict(list)
        for w, message in messages:
            for zone in message.destinations():
                by_node[self._node_of[zone]].append((w, message))
        return {node: packed(some) for node, some in by_node.items()}

    def close(self) -> None:
        for world in self.worlds:
            if world.journal is not None:
                world.journal.close()
