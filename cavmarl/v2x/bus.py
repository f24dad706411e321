"""`Bus`: the messages of W worlds, for all zones of each world.

The bus reads the rows of all shards in the order of ids, and has one state per world. The range of
messages is independent of a zone's sensing range. So results do not depend on the division of a
world.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.config.v2x import V2xConfig, period_ticks
from cavmarl.core.compiled import specialized
from cavmarl.core.errors import ConfigError
from cavmarl.core.math.elementary_arrays import hypot_all
from cavmarl.core.math.neighbors import make_grid
from cavmarl.core.math.walls import make_walls
from cavmarl.core.records.arrays import RoadArrays, SharedState, ZoneState
from cavmarl.roads.network import RoadNetwork
from cavmarl.v2x.channel import make_channel
from cavmarl.v2x.kernels.v2x_exchange import exchange_messages, hand_out
from cavmarl.v2x.kernels.v2x_records import (
    CAUSE_NONE,
    CAUSE_ROAD_CLOSED,
    COUNT_NO_ACCESS,
    COUNT_OVERFLOW,
    COUNT_REACHABLE,
    COUNT_RECEIVED,
    COUNT_SENT,
    LAST_CAM,
    MAX_DELAYS,
    MAX_NEAR,
    NUM_BANDS,
    NUM_COUNTS,
    NUM_KINDS,
    PACKET,
    RECEIVER,
    REPORT,
    STATION,
    Air,
    HeardCams,
    Mail,
    Sending,
    V2xScratch,
)
from cavmarl.v2x.v2x_messages import (
    RECEPTION,
    Exchange,
    NetworkSimulator,
    cause_code,
    check_external,
    check_receptions,
    make_units,
)

Zeros = Callable[..., NDArray[Any]]
Watch = Callable[[int, int, NDArray[np.void], NDArray[np.void]], None]
"""A function of a world, a tick, and views of the tick's packets (PACKET) and reports (REPORT)."""

CELL_M = 100.0  # cell size of the grid of a tick's packets
CLOSURE_RANGE_M = 500.0  # a roadside unit reports closed roads that begin within this distance
BODY_CELL_M = 25.0  # cell size of the grid of perceived vehicles


class Bus:
    """Sends, transmits and stores the messages of W worlds.

    `config`: the environment; `v2x.enabled` is set. `zoned`: vehicles of all zones. `common`:
    clocks, keys and signals. `zeros`: allocates the arrays that outlive a tick.

    Attributes:
        units: UNIT (num_units,), the roadside units.
        mail: inboxes, counts and packets in flight.
    """

    def __init__(
        self,
        config: EnvConfig,
        network: RoadNetwork,
        types: NDArray[np.void],
        zoned: ZoneState,
        common: SharedState,
        zeros: Zeros = np.zeros,
    ) -> None:
        v2x, dt = config.v2x, config.clock.sim_dt_s
        self._config = v2x
        self._dt_s = dt
        self._num_agents = config.population.num_ids
        self._zoned = zoned
        self._common = common
        self._types = types
        self._roads: RoadArrays = network.arrays
        self.units = make_units(v2x.roadside, network)
        self._sending = _make_sending(v2x, config.signals.decide_s, dt)
        walls = np.stack([network.walls[name] for name in ("ax", "ay", "bx", "by")], axis=1)
        self._channel = make_channel(v2x.channel, dt, make_walls(walls))
        num_worlds, capacity = zoned.rows.shape[2:]
        num_receivers = self._num_agents + len(self.units)
        self.mail = _make_mail(v2x, num_worlds, capacity, num_receivers, len(self.units), zeros)
        self._scratch = _make_scratch(network, self.mail, zoned, num_receivers)
        self._network: NetworkSimulator | None = None
        self._watchers: tuple[Watch, ...] = ()
        # closed lanes of a world, and the closed roads that each unit reports
        self._closures: dict[int, tuple[NDArray[np.bool_], tuple[NDArray[np.float64], ...]]] = {}
        self._exchange = specialized(exchange_messages)
        self._hand_out = specialized(hand_out)
        self.mail.owner[:] = -1
        self._empty(np.ones(num_worlds, dtype=np.bool_))

    def connect(self, network: NetworkSimulator) -> None:
        """Let a network simulator decide receptions.

        Raises ConfigError: `v2x.channel.external` is not set.
        """
        check_external(self._config)
        self._network = network

    @contextmanager
    def muted(self) -> Iterator[None]:
        """Suspend the network simulator: in the context, it is not called and delivers nothing."""
        before, self._network = self._network, _Silence()
        try:
            yield
        finally:
            self._network = before

    def watch(self, watch: Watch) -> None:
        """Call `watch` with the messages of each further tick, and again if a tick is repeated."""
        self._watchers = (*self._watchers, watch)

    def reset(self, chosen: NDArray[np.bool_]) -> None:
        """Discard all messages of the chosen worlds (W,)."""
        for array in self.mail:
            array[chosen] = np.zeros((), array.dtype)
        self.mail.owner[chosen] = -1
        self._empty(chosen)

    def _empty(self, chosen: NDArray[np.bool_]) -> None:
        for box in (self.mail.objects, self.mail.events, self.mail.signals):
            for name in ("subject", "sender"):
                box[name][chosen] = -1

    def exchange(self, side: int) -> None:
        """Send the messages due in the current tick, and receive arriving messages.

        Args:
            side: 0 or 1, the half of `ZoneState.rows` with the state at the current tick.

        Raises:
            ConfigError: the channel is external, but no network simulator is connected.
            MessageError: the answer of the network simulator is invalid.
        """
        num_worlds = len(self._common.ticks)
        if not self._config.channel.external:
            self._run(side, 0, num_worlds)
            return
        if self._network is None:
            raise ConfigError(
                "v2x.channel.external: connect a network simulator before the first step "
                "(worlds.connect_network)"
            )
        for world in range(num_worlds):
            self._run(side, world, world + 1)
            self._receive_from(self._network, world)

    def _run(self, side: int, first: int, last: int) -> None:
        self._exchange(
            self._sending, self._channel, self._roads, self._types, self.units, self._common,
            self._zoned, side, first, last, self.mail, self._scratch,
        )  # fmt: skip
        if self._watchers:
            self._show(first, last)

    def _show(self, first: int, last: int) -> None:
        mail = self.mail
        for world in range(first, last):
            tick = self._common.ticks.item(world)
            slot = tick % (self._sending.latency + 1)
            packets = mail.packets[world, slot, : mail.num_packets[world, slot]]
            reports = mail.reports[world, slot, : mail.num_reports[world, slot]]
            for watch in self._watchers:
                watch(world, tick, packets, reports)

    def _receive_from(self, network: NetworkSimulator, world: int) -> None:
        mail, latency = self.mail, self._sending.latency
        tick = self._common.ticks.item(world)
        slot = tick % (latency + 1)
        packets = mail.packets[world, slot, : mail.num_packets[world, slot]]
        sent = Exchange(world, tick, packets, self._scratch.receivers)
        answer = network.exchange(sent)
        receptions = check_receptions(answer, sent, latency, mail.num_packets[world])
        self._hand_out(receptions, tick, latency, mail, world, self._scratch)

    def arrays(self) -> Iterator[NDArray[Any]]:
        """Yield all arrays that outlive a tick, (W, …)."""
        mail = self.mail
        yield from (mail.objects, mail.events, mail.signals, mail.owner, mail.declared)
        yield from (mail.counts, mail.delays, mail.bands, mail.busy)
        if self._sending.latency > 0:
            yield from (mail.packets, mail.num_packets, mail.reports, mail.num_reports)
        if self._sending.cam_triggered:
            yield from (mail.last_cams, mail.num_last)

    def wrong(self, saved: Sequence[NDArray[Any]]) -> str:
        """Return the first error in saved arrays, shaped as in `arrays`, or an empty string."""
        found = {id(own): array for own, array in zip(self.arrays(), saved, strict=True)}
        mail, packets = self.mail, found.get(id(self.mail.packets))
        for numbers, most in (
            (mail.num_packets, mail.packets.shape[2]),
            (mail.num_reports, mail.reports.shape[2]),
            (mail.num_last, mail.last_cams.shape[1]),
        ):
            counts = found.get(id(numbers))
            if counts is not None and ((counts < 0) | (counts > most)).any():
                return "there are more messages than v2x.capacity allows"
        if packets is None:
            return ""
        sent = np.arange(packets.shape[2]) < found[id(mail.num_packets)][:, :, np.newaxis]
        first, count = packets["first"][sent], packets["count"][sent]
        outside = (first < 0) | (count < 0) | (first + count > mail.reports.shape[2])
        outside |= (packets["kind"][sent] < 0) | (packets["kind"][sent] >= NUM_KINDS)
        return "a message refers to missing reports" if outside.any() else ""

    def declare(self, causes: NDArray[np.int32]) -> None:
        """Set the events that agents report in the next tick.

        Args:
            causes: (W, A) ETSI cause codes; 0: no event.
        """
        declared = self.mail.declared[:, : self._num_agents]
        np.copyto(declared, causes, where=causes != 0)

    def receiver_of_unit(self, unit: int) -> int:
        """Return a roadside unit's row in `mail.objects[world]` and in the other inboxes.

        Raises ConfigError: there is no such unit.
        """
        if not 0 <= unit < len(self.units):
            raise ConfigError(f"roadside unit {unit}: there are only {len(self.units)} units")
        return self._num_agents + unit

    def declare_of_unit(self, world: int, unit: int, cause: str) -> None:
        """Let a roadside unit report an event in the next tick.

        Raises ConfigError: the unit or the cause does not exist.
        """
        self.mail.declared[world, self.receiver_of_unit(unit)] = cause_code(cause)

    def tell_closures(self, world: int, closed: NDArray[np.bool_]) -> None:
        """Let the roadside units that are due in this tick report a closed road near them.

        The closed roads near a unit take turns. A unit that declares its own event reports that
        event instead.

        `closed`: (L,) lanes that are closed.
        """
        self.mail.closures[world] = 0.0
        period = self._sending.denm_period
        if not period or not len(self.units) or not closed.any():
            return
        near = self._closures_near(world, closed)
        tick, declared = self._common.ticks.item(world), self.mail.declared[world]
        for unit, places in enumerate(near):
            turn, rest = divmod(tick + 1 + unit, period)
            receiver = self._num_agents + unit
            if rest == 0 and len(places) and declared[receiver] == CAUSE_NONE:
                declared[receiver] = CAUSE_ROAD_CLOSED
                self.mail.closures[world, unit] = places[turn % len(places)]

    def _closures_near(
        self, world: int, closed: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float64], ...]:
        """Return the closed roads near each unit: x, y, z, heading, EDGE row + 1 (0 is no road)."""
        known = self._closures.get(world)
        if known is None or not np.array_equal(known[0], closed):
            lanes, points = self._roads.lanes, self._roads.points
            rows = np.flatnonzero(closed & ~lanes["internal"])
            rows = rows[np.unique(lanes["edge"][rows], return_index=True)[1]]
            begin = points[lanes["first_point"][rows]]
            places = np.stack(
                [*(begin[name] for name in ("x", "y", "z", "heading")), lanes["edge"][rows] + 1.0],
                axis=1,
            )
            found = []
            for unit in self.units:
                away_m = hypot_all(places[:, 0] - unit["x"], places[:, 1] - unit["y"])
                found.append(places[away_m <= CLOSURE_RANGE_M])
            known = closed.copy(), tuple(found)
            self._closures[world] = known
        return known[1]

    def statistics(self, world: int = 0) -> V2xStatistics:
        """Return the message statistics of a world since its reset."""
        return statistics_of(self.mail, world, self._dt_s)


class _Silence:
    """A network simulator that delivers nothing."""

    def exchange(self, sent: Exchange) -> NDArray[np.void]:
        return np.zeros(0, RECEPTION)


def _make_sending(v2x: V2xConfig, decide_s: float, dt: float) -> Sending:
    def ticks(seconds: float) -> int:
        return max(1, round(seconds / dt))

    has_units = bool(v2x.roadside.signals)
    return Sending(
        dt_s=dt,
        equipped=v2x.equipped,
        cam_period=period_ticks(v2x.cam.rate_hz, dt),
        cam_triggered=v2x.cam.triggered,
        denm_period=period_ticks(v2x.denm.rate_hz, dt),
        hard_braking_mps2=v2x.denm.hard_braking_mps2,
        stationary_s=v2x.denm.stationary_s,
        denm_ticks=ticks(v2x.denm.validity_s),
        cpm_period=period_ticks(v2x.perception.rate_hz, dt),
        cpm_range_m=v2x.perception.range_m,
        cpm_objects=v2x.perception.objects,
        spat_period=period_ticks(v2x.roadside.rate_hz, dt) if has_units else 0,
        unit_cpm_period=period_ticks(v2x.roadside.perception_hz, dt) if has_units else 0,
        unit_range_m=v2x.roadside.range_m,
        memory_ticks=ticks(v2x.inbox.memory_s),
        latency=v2x.channel.latency_ticks,
        decide=ticks(decide_s),
    )


def _make_mail(
    v2x: V2xConfig, num_worlds: int, capacity: int, num_receivers: int, num_units: int, zeros: Zeros
) -> Mail:
    stations = capacity + num_units
    most = v2x.capacity or 3 * stations
    # A CAM, DENM or SPAT has one report; a CPM has one report per perceived vehicle.
    sees = v2x.perception.rate_hz > 0.0 or v2x.roadside.perception_hz > 0.0
    most_reports = most + (min(most, stations) * (v2x.perception.objects - 1) if sees else 0)
    slots = v2x.channel.latency_ticks + 1
    memory = capacity if v2x.cam.triggered else 0
    boxes = (num_worlds, num_receivers)
    return Mail(
        objects=zeros((*boxes, v2x.inbox.objects), dtype=REPORT),
        events=zeros((*boxes, v2x.inbox.events), dtype=REPORT),
        signals=zeros((*boxes, v2x.inbox.signals), dtype=REPORT),
        owner=zeros(boxes, dtype=np.int64),
        declared=zeros(boxes, dtype=np.int32),
        closures=zeros((num_worlds, num_units, 5)),
        packets=zeros((num_worlds, slots, most), dtype=PACKET),
        num_packets=zeros((num_worlds, slots), dtype=np.int64),
        reports=zeros((num_worlds, slots, most_reports), dtype=REPORT),
        num_reports=zeros((num_worlds, slots), dtype=np.int64),
        last_cams=zeros((num_worlds, memory), dtype=LAST_CAM),
        num_last=zeros(num_worlds, dtype=np.int64),
        counts=zeros((num_worlds, NUM_COUNTS), dtype=np.int64),
        delays=zeros((num_worlds, MAX_DELAYS), dtype=np.int64),
        bands=zeros((num_worlds, NUM_BANDS, 2), dtype=np.int64),
        busy=zeros((num_worlds, 3), dtype=np.float64),
    )


def _make_scratch(
    network: RoadNetwork, mail: Mail, zoned: ZoneState, num_receivers: int
) -> V2xScratch:
    capacity, most = zoned.rows.shape[3], mail.packets.shape[2]
    largest = max(box.shape[2] for box in (mail.objects, mail.events, mail.signals))

    def air() -> Air:
        cells = make_grid(network.extent_m, CELL_M, 0)._replace(cell=np.zeros(most, np.int32))
        return Air(
            cells,
            x=np.zeros(most),
            y=np.zeros(most),
            sender=np.zeros(most, np.int64),
            word=np.zeros(most, np.uint64),
            which=np.zeros(most, np.int32),
        )

    return V2xScratch(
        stations=np.zeros(capacity, STATION),
        spare=np.zeros(capacity, STATION),
        receivers=np.zeros(num_receivers, RECEIVER),
        bodies=make_grid(network.room_m, BODY_CELL_M, capacity, len(network.maps) > 1),
        vehicles=np.zeros(capacity, zoned.rows.dtype),
        next_cams=np.zeros(mail.last_cams.shape[1], mail.last_cams.dtype),
        near=np.zeros(MAX_NEAR, np.int32),
        near_squared=np.zeros(MAX_NEAR),
        seen=np.zeros(MAX_NEAR, np.int32),
        cams=air(),
        others=air(),
        kinds=np.zeros(NUM_KINDS, np.int64),
        access=np.zeros(most, np.bool_),
        cam_of=np.zeros(1 << (2 * capacity).bit_length(), np.int32),
        heard=HeardCams(
            place=np.zeros(most + 1, np.int32),
            squared=np.zeros(most + 1),
            word=np.zeros(most + 1, np.uint64),
            distance=np.zeros(most + 1),
            number=np.zeros(most + 1),
        ),
        tally=np.zeros(2 * NUM_BANDS, np.int64),
        squared=np.zeros(largest),
    )


@dataclass(frozen=True)
class V2xStatistics:
    """Counts and ratios of one world; receivers are the agents and the roadside units."""

    sent: tuple[int, ...]  # number of packets by kind: CAM, DENM, CPM, SPAT
    overflow: int  # packets beyond `v2x.capacity`
    no_access: int  # packets that never got channel access
    reachable: int  # pairs of a packet and a receiver within reach
    received: int  # pairs in which the packet was received
    delays: NDArray[np.int64]  # (65,) number of receptions by delay in ticks
    mean_latency_s: float  # mean latency of the receptions
    # (40, 2) reachable and received pairs, by distance in bands of `BAND_M`; lossy channels only
    bands: NDArray[np.int64]
    busy_mean: float  # channel busy ratio, mean over receivers and ticks
    busy_max: float  # largest channel busy ratio

    @property
    def reception_ratio(self) -> float:
        """Packet reception ratio; 1 if nothing could be received."""
        return self.received / self.reachable if self.reachable else 1.0

    def to_dict(self) -> dict[str, float]:
        """Return the numbers for a report, with the names of `traffic_stats`."""
        return {
            "v2x_sent": float(sum(self.sent)),
            "v2x_received": float(self.received),
            "v2x_lost": float(self.reachable - self.received),
            "v2x_dropped": float(self.overflow + self.no_access),
            "v2x_reception_ratio": self.reception_ratio,
            "v2x_latency_s": self.mean_latency_s,
            "v2x_busy_ratio": self.busy_mean,
        }


def statistics_of(mail: Mail, world: int, tick_s: float) -> V2xStatistics:
    counts = mail.counts[world]
    delays = mail.delays[world].copy()
    busy_sum, busy_number, busy_max = mail.busy[world].tolist()
    total = int(delays.sum())
    late = int((delays * np.arange(len(delays))).sum())
    return V2xStatistics(
        sent=tuple(counts[COUNT_SENT : COUNT_SENT + NUM_KINDS].tolist()),
        overflow=int(counts[COUNT_OVERFLOW]),
        no_access=int(counts[COUNT_NO_ACCESS]),
        reachable=int(counts[COUNT_REACHABLE]),
        received=int(counts[COUNT_RECEIVED]),
        delays=delays,
        mean_latency_s=tick_s * late / total if total else 0.0,
        bands=mail.bands[world].copy(),
        busy_mean=busy_sum / busy_number if busy_number else 0.0,
        busy_max=busy_max,
    )
