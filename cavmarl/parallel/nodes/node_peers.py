"""`NodePeers`: the exchange with the other nodes of the same worlds; see `engine.peers.Peers`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from cavmarl.core.compiled import specialized
from cavmarl.core.errors import MessageError
from cavmarl.core.huge_pages import forget
from cavmarl.core.records.arrays import DepartureQueue, Outputs, Worlds
from cavmarl.core.records.codes import (
    COUNT_REROUTED,
    LANE_FIRST,
    LANE_GIVEN,
    LANE_RANDOM,
    POS_LAST,
)
from cavmarl.engine.peers import Peers
from cavmarl.engine.simulation import Simulation
from cavmarl.parallel.network.transport import Bytes
from cavmarl.parallel.nodes.agent_stream import AgentStream
from cavmarl.parallel.nodes.index_check import IndexCheck
from cavmarl.parallel.nodes.link import FrameKind, NodeFrame
from cavmarl.parallel.nodes.links import Links, RecoveryOrderedError
from cavmarl.parallel.nodes.peer_faults import LinkLostError, check_indices, reading
from cavmarl.parallel.nodes.row_stream import RowStream, forecast_of, passing_of
from cavmarl.zones.kernels.agent_frames import UNOWNED
from cavmarl.zones.kernels.row_frames import Passing, count_own

Array = NDArray[Any]
_SHARE = FrameKind.SHARE
SHARE_BITS = 32  # low bits of the number of a share; the higher bits are the generation
PIECES = ("terms", "terminated", "present", "acted", "events", "vehicle_ids", "places")


class NodePeers(Peers):
    """Exchanges shares with the other nodes.

    A share is the data of a part of a tick. For each share, each node sends one frame to each other
    node.

    Attributes:
        own: (W, A) agents whose newest observation this node has computed.
        stepped: (W, A) `own` at the end of the last step, before the autoreset.
        checks: refuses bad rows of other nodes.
        owner: (W · A,) node that has computed each agent's newest observation; `UNOWNED`: none.
    """

    are_none = False

    def __init__(
        self,
        simulation: Simulation,
        links: Links,  # connections to all other nodes
        zones: Sequence[Sequence[int]],  # zones of each node
        number: int,  # number of this node
        generation: int = 0,  # number of changes of nodes
    ) -> None:
        super().__init__(simulation.division)
        shard = simulation.shards[0]
        self._zoned = shard.zoned
        self._of_rows = (self._zoned.step, self._zoned.step_at, self._zoned.outer)
        self._mine = np.array(zones[number], dtype=np.int64)
        self._foreign = np.array(
            [zone for n, some in enumerate(zones) if n != number for zone in some], dtype=np.int64
        )
        self._links = links
        self._number = number
        self._others = [n for n, some in enumerate(zones) if some and n != number]
        self._zones = [np.array(some, dtype=np.int64) for some in zones]
        self._num_worlds = simulation.num_worlds
        self._has_controllers = bool(shard.worlds.controllers.shape[1])
        self._detected_s = shard.worlds.detected_s
        self._seen_s = self._detected_s.copy()
        self._running = np.zeros(self._num_worlds, dtype=np.int64)
        self._rerouted = np.zeros(self._num_worlds, dtype=np.int64)
        mine = (self._zoned, self._mine)
        clock = simulation.config.clock
        self.checks = checks = IndexCheck(simulation)
        bounds = checks.of_rows, checks.of_ghosts
        law = forecast_of(shard.roads, clock.sim_dt_s, clock.ticks_per_step, *bounds)
        self._rows = {
            n: RowStream(*mine, self._zones[n], self._running, self._rerouted, law)
            for n in self._others
        }
        self._count_own = specialized(count_own)
        self._agents = AgentStream([getattr(simulation.outputs, name) for name in PIECES])
        self._sent = generation << SHARE_BITS  # number of the last share
        self._is_stepping = False
        self._gate: DepartureQueue | None = None
        self._leaving: Passing  # vehicles that leave through the departure queue `_gate`
        self.own: Array = np.zeros_like(simulation.outputs.present)
        self.stepped = self.own.copy()
        self.owner: NDArray[np.int32] = np.full(self.own.size, UNOWNED, dtype=np.int32)

    def begin_step(self) -> None:
        """Note that the next outputs belong to a step."""
        self._is_stepping = True

    def drop_foreign_rows(self, chosen: NDArray[np.bool_]) -> None:
        zoned = self._zoned
        for zone in self._foreign.tolist():
            for numbers in (zoned.num_owned, zoned.num_rows, zoned.num_near, zoned.num_through):
                numbers[zone, chosen] = 0
            zoned.num_contacts[zone, chosen] = 0
            zoned.num_outer[zone, chosen] = -1
        for zone in range(len(zoned.num_rows)):
            for w in np.flatnonzero(chosen).tolist():
                # Release unused rows: a reset puts all vehicles into the first zone at first.
                num = zoned.num_rows.item(zone, w)
                for array in (*zoned.rows[:, zone, w], *(each[zone, w] for each in self._of_rows)):
                    forget(array[num:])
        self._rerouted[chosen] = 0

    def resume_from(self, departures: DepartureQueue, side: int) -> None:
        self._rerouted[:] = departures.counts[:, COUNT_REROUTED]
        self._seen_s[...] = self._detected_s
        self.own[...] = False
        for zone in self._mine.tolist():
            for w, num in enumerate(self._zoned.num_owned[zone].tolist()):
                agents = self._zoned.rows["agent"][side, zone, w, :num]
                self.own[w, agents[agents >= 0]] = True
        mine = np.flatnonzero(self.own.reshape(-1))
        self.owner[:] = UNOWNED
        self.owner[mine] = self._number
        for number, data in self._swap([mine.data]):
            with reading(number):
                agents = np.frombuffer(data, np.int64)
                check_indices("agent", agents, self.owner.size)
                if (self.owner[agents] != UNOWNED).any():
                    raise MessageError("it owns agents of other nodes")
            self.owner[agents] = number

    def share_rows(self, departures: DepartureQueue, side: int) -> None:
        if departures is not self._gate:
            self._gate, self._leaving = departures, passing_of(departures)
        passing, send = self._leaving, self._links.send
        self._sent = due = self._sent + 1
        for to, rows in self._rows.items():
            send(to, _SHARE, due, (rows.packed(side, passing),))
        for number, rows in self._rows.items():
            data = self._share_of(number)
            with reading(number):
                rows.read(data, side, passing)

    def running(self) -> NDArray[np.int64]:
        if not self._others:
            self._count_own(self._zoned.num_owned, self._mine, self._running)
        return self._running

    def clear_ranks(self, departures: DepartureQueue) -> None:
        longest = int(departures.num_queue.max(initial=0))
        departures.ranks[:, :longest] = -1
        departures.last_s[:, :longest] = -np.inf

    def share_ranks(self, departures: DepartureQueue) -> None:
        longest = int(departures.num_queue.max(initial=0))
        queue = departures.queue[:, :longest]
        asks = ~np.isin(queue["lane_code"], (LANE_GIVEN, LANE_FIRST, LANE_RANDOM))
        asks |= queue["pos_code"] == POS_LAST
        asks &= np.arange(longest) < departures.num_queue[:, None]
        if not asks.any():
            return
        ranks, last_s = departures.ranks[:, :longest][asks], departures.last_s[:, :longest][asks]
        for number, data in self._swap([ranks.data, last_s.data]):
            with reading(number):
                theirs, at = _read(data, 0, ranks.dtype, ranks.size)
                theirs_s, at = _read(data, at, last_s.dtype, last_s.size)
                _check_end(data, at)
            np.maximum(ranks, theirs.reshape(ranks.shape), out=ranks)
            np.maximum(last_s, theirs_s.reshape(last_s.shape), out=last_s)
        departures.ranks[:, :longest][asks] = ranks
        departures.last_s[:, :longest][asks] = last_s

    def share_proposals(self, departures: DepartureQueue) -> None:
        places = [
            departures.places[w, :num] for w, num in enumerate(departures.num_passing.tolist())
        ]
        pieces = [*self._passing(departures), np.concatenate(places).data]
        for number, data in self._swap(pieces):
            before = departures.num_passing.copy()
            with reading(number):
                at = self._add_passing(departures, data, 0)
                for w in range(self._num_worlds):
                    first, last = int(before[w]), int(departures.num_passing[w])
                    found, at = _read(data, at, np.int64, last - first)
                    check_indices("place in the queue", found, int(departures.num_queue[w]))
                    departures.places[w, first:last] = found
                _check_end(data, at)

    def share_leavers(self, departures: DepartureQueue) -> None:
        for number, data in self._swap(self._passing(departures)):
            with reading(number):
                _check_end(data, self._add_passing(departures, data, 0))

    def _passing(self, departures: DepartureQueue) -> list[Bytes]:
        """Return the number of leaving vehicles of each world, and their rows."""
        counts = departures.num_passing.copy()
        rows = [departures.passing[w, :num] for w, num in enumerate(counts.tolist()) if num]
        return [counts.data, *map(_bytes, rows)]

    def _add_passing(self, departures: DepartureQueue, data: memoryview, at: int) -> int:
        counts, at = _read(data, at, np.int64, self._num_worlds)
        for w, num in enumerate(counts.tolist()):
            first = departures.num_passing.item(w)
            check_indices(
                "row of the departure queue", [num], 1 + departures.passing.shape[1] - first
            )
            if num:
                rows, at = _read(data, at, departures.passing.dtype, num)
                self.checks.check(rows)
                departures.passing[w, first : first + num] = rows
                departures.num_passing[w] = first + num
        return at

    def share_detections(self, worlds: Worlds) -> None:
        if not self._has_controllers:
            return
        seen = worlds.detected_s
        changed = np.flatnonzero(seen.reshape(-1) != self._seen_s.reshape(-1))
        times = seen.reshape(-1)[changed]
        pieces: list[Bytes] = [np.int64(changed.size).tobytes(), changed.data, times.data]
        for number, data in self._swap(pieces):
            with reading(number):
                (num,), at = _read(data, 0, np.int64, 1)
                where, at = _read(data, at, np.int64, int(num))
                check_indices("detector", where, seen.size)
                found, at = _read(data, at, np.float64, int(num))
                _check_end(data, at)
            seen.reshape(-1)[where] = found
        self._seen_s[...] = seen

    def share_outputs(self, outputs: Outputs, chosen: NDArray[np.bool_]) -> None:
        frame = self._agents.packed(outputs.present, chosen, self._number, self.own, self.owner)
        if self._is_stepping:
            self._is_stepping = False
            self.stepped[...] = self.own
        for number, data in self._swap([frame]):
            with reading(number):
                agents = self._agents.read(data, number, self.owner)
                if not outputs.present.reshape(-1)[agents].all():
                    raise MessageError("it sends agents that are absent")

    @contextmanager
    def all_zones(self, departures: DepartureQueue, side: int) -> Iterator[None]:
        """Context in which the first zone of each other node has the vehicles of that node."""
        before = departures.counts[:, COUNT_REROUTED].copy()
        with self._rows_of_all(side):
            yield
        self._rerouted += departures.counts[:, COUNT_REROUTED] - before

    @contextmanager
    def whole(self, simulation: Simulation) -> Iterator[None]:
        """Context in which each node has the whole worlds; all nodes have to enter it together."""
        arrays = simulation.agent_arrays()
        mine = self._agents_of(simulation.division.side)
        with self._rows_of_all(simulation.division.side):
            pieces: list[Bytes] = [np.int64(len(mine)).tobytes(), mine.data]
            pieces += [_bytes(_by_agent(array)[mine]) for array in arrays]
            for number, data in self._swap(pieces):
                with reading(number):
                    (num,), at = _read(data, 0, np.int64, 1)
                    agents, at = _read(data, at, np.int64, int(num))
                    check_indices("agent", agents, self.own.size)
                    for array in map(_by_agent, arrays):
                        size = math.prod(array.shape[1:])
                        found, at = _read(data, at, array.dtype, int(num) * size)
                        array[agents] = found.reshape(int(num), *array.shape[1:])
                    _check_end(data, at)
            yield

    def _agents_of(self, side: int) -> Array:
        """Return (n,) agents whose vehicles are here, as indices into (W · A,) arrays."""
        zoned, num_agents = self._zoned, self.own.shape[1]
        found = [
            agents[agents >= 0].astype(np.int64) + w * num_agents
            for zone in self._mine.tolist()
            for w in range(self._num_worlds)
            for agents in [zoned.rows["agent"][side, zone, w, : zoned.num_owned[zone, w]]]
        ]
        return np.concatenate(found)

    @contextmanager
    def _rows_of_all(self, side: int) -> Iterator[None]:
        zoned = self._zoned
        owned = [
            zoned.rows[side, zone, w, : zoned.num_owned[zone, w]]
            for w in range(self._num_worlds)
            for zone in self._mine.tolist()
        ]
        numbers = [array[self._mine].sum(axis=0) for array in (zoned.num_owned, zoned.num_contacts)]
        pieces = [*map(_bytes, numbers), *map(_bytes, filter(len, owned))]
        for number, data in self._swap(pieces):
            zone = self._zones[number][0]
            with reading(number):
                owned_there, at = _read(data, 0, np.int64, self._num_worlds)
                contacts, at = _read(data, at, np.int64, self._num_worlds)
                check_indices("row", owned_there, 1 + zoned.rows.shape[3])
                for w, num in enumerate(owned_there.tolist()):
                    rows, at = _read(data, at, zoned.rows.dtype, num)
                    self.checks.check(rows)
                    zoned.rows[side, zone, w, :num] = rows
                _check_end(data, at)
            zoned.num_owned[zone], zoned.num_contacts[zone] = owned_there, contacts
        try:
            yield
        finally:
            for array in (zoned.num_owned, zoned.num_contacts):
                array[self._foreign] = 0

    def _swap(self, pieces: Sequence[Bytes]) -> Iterator[tuple[int, memoryview]]:
        """Send pieces to all other nodes, and yield their pieces in ascending order of nodes."""
        self._sent += 1
        for to in self._others:
            self._links.send(to, _SHARE, self._sent, pieces)
        for number in self._others:
            yield number, self._share_of(number)

    def _share_of(self, number: int) -> memoryview:
        """Receive the current share of another node.

        Raises:
            RecoveryOrderedError: the other node has already received an order to recover.
        """
        kind, which, data = self._links.receive_next(number)
        if kind is _SHARE and which == self._sent:
            return data
        if kind is FrameKind.SYNC and which << SHARE_BITS > self._sent:
            self._links.unread(number, NodeFrame(kind, which, data))
            raise RecoveryOrderedError(None, number)
        error = MessageError(f"it is at {kind.name} {which}, not at share {self._sent}")
        raise LinkLostError(number, error)


def _by_agent(array: Array) -> Array:
    """Return (W, A, …) as (W · A, …), a view."""
    return array.reshape(array.shape[0] * array.shape[1], *array.shape[2:])


def _bytes(array: Array) -> Bytes:
    flat: NDArray[np.uint8] = array.reshape(-1).view(np.uint8)
    return flat.data


def _check_end(data: memoryview, at: int) -> None:
    """Raise MessageError if the data do not end at `at`."""
    if at != len(data):
        raise MessageError(f"a share has {len(data)} bytes, not {at}")


def _read(data: memoryview, at: int, kind: DTypeLike, num: int) -> tuple[Array, int]:
    """Return an array (num,) of a frame, as a view, and where it ends.

    Raises:
        MessageError: the frame is too short.
    """
    dtype = np.dtype(kind)
    if not 0 <= num <= (len(data) - at) // dtype.itemsize:
        raise MessageError(
            f"{len(data)} bytes are too short for {num} items of {dtype.itemsize} bytes at {at}"
        )
    return np.frombuffer(data, dtype, num, at) if num else np.zeros(0, dtype), at + (
        num * dtype.itemsize
    )
