"""The keys under `v2x` of `env.yaml`: messages and the radio channel.

Messages are off by default, and the channel is ideal: each of its effects is off at 0.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from cavmarl.config.checks import Section, Whole, Within, check

MAX_RATE_HZ = 1000.0
MAX_LATENCY_TICKS = 64
EVERY_SIGNAL = "all"


@dataclass(frozen=True)
class CamConfig(Section, key="v2x.cam"):
    """Messages of a vehicle about itself, modelled on CAM (ETSI EN 302 637-2).

    Attributes:
        rate_hz: rate of a vehicle's messages about itself (CAM); the phase depends on the vehicle's
            id. 0: never.
        triggered: send a message only if the vehicle has moved 4 m, turned 4° or changed its
            speed by 0.5 m/s since its last message, or if that message is a second old.
    """

    rate_hz: Annotated[float, Within(0.0, MAX_RATE_HZ)] = 10.0
    triggered: bool = False


@dataclass(frozen=True)
class DenmConfig(Section, key="v2x.denm"):
    """Messages about events, modelled on DENM (ETSI EN 302 637-3).

    Attributes:
        rate_hz: rate at which a message about an event (DENM) is repeated while the event lasts;
            0: only events that agents declare are sent.
        hard_braking_mps2: deceleration from which braking is an event.
        stationary_s: waiting time after which a stopped vehicle is an event.
        validity_s: time for which a receiver keeps an event.
    """

    rate_hz: Annotated[float, Within(0.0, MAX_RATE_HZ)] = 10.0
    hard_braking_mps2: Annotated[float, Within(0.1, 20.0)] = 4.0
    stationary_s: Annotated[float, Within(0.1, 86_400.0)] = 30.0
    validity_s: Annotated[float, Within(0.01, 86_400.0)] = 2.0


@dataclass(frozen=True)
class PerceptionConfig(Section, key="v2x.perception"):
    """Messages about vehicles that the sender perceives, modelled on CPM (ETSI TS 103 324).

    Attributes:
        rate_hz: rate of a vehicle's messages about vehicles that it perceives (CPM); 0: never.
        range_m: range of a vehicle's perception, unless a vehicle or building is in between.
        objects: maximum number of objects in a message; the nearest are kept.
    """

    rate_hz: Annotated[float, Within(0.0, MAX_RATE_HZ)] = 0.0
    range_m: Annotated[float, Within(1.0, 300.0)] = 60.0
    objects: Annotated[int, Whole(1, 32)] = 8


@dataclass(frozen=True)
class RoadsideConfig(Section, key="v2x.roadside"):
    """Roadside units, which broadcast the state of signals (SPAT and MAP, SAE J2735).

    Attributes:
        signals: names of the signals with a unit; `[all]`: every signal.
        rate_hz: rate of a unit's messages about its signal.
        perception_hz: rate of a unit's messages about perceived vehicles; 0: none.
        range_m: range of a unit's perception, over vehicles but not through buildings.
    """

    signals: tuple[str, ...] = ()
    rate_hz: Annotated[float, Within(0.0, MAX_RATE_HZ)] = 10.0
    perception_hz: Annotated[float, Within(0.0, MAX_RATE_HZ)] = 0.0
    range_m: Annotated[float, Within(1.0, 300.0)] = 80.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self.need(
            "signals", len(set(self.signals)) == len(self.signals), "must name each signal once"
        )
        self.need(
            "signals",
            EVERY_SIGNAL not in self.signals or len(self.signals) == 1,
            f"'{EVERY_SIGNAL}' must be the only name",
        )


@dataclass(frozen=True)
class ChannelConfig(Section, key="v2x.channel"):
    """The radio channel: reception and delay; with zeros, packets arrive everywhere at once.

    Attributes:
        range_m: maximum distance of reception; 0: no limit.
        latency_ticks: time from sending to receiving; with `external`, the longest delay.
        loss: share of packets that is lost at any distance.
        path_loss_exponent: exponent of the log-distance model (about 2 to 3); 0: no path loss.
        shadowing_db: standard deviation of the received power.
        tx_power_dbm: transmitted power, antenna gains included.
        sensitivity_dbm: received power from which a packet can be decoded.
        building_db: loss if a building is in the line of sight; 0: none.
        data_rate_mbps: capacity of the channel; 0: unlimited.
        packet_bytes: length of a packet.
        external: a connected network simulator decides which receiver gets which message; see
            `connect_network` in docs/reference/v2x.md.
    """

    range_m: Annotated[float, Within(0.0, 1e6)] = 0.0
    latency_ticks: Annotated[int, Whole(0, MAX_LATENCY_TICKS)] = 0
    loss: Annotated[float, Within(0.0, 1.0)] = 0.0
    path_loss_exponent: float = 0.0
    shadowing_db: Annotated[float, Within(0.1, 20.0)] = 5.5
    tx_power_dbm: Annotated[float, Within(-30.0, 44.8)] = 23.0
    sensitivity_dbm: Annotated[float, Within(-120.0, -30.0)] = -82.0
    building_db: Annotated[float, Within(0.0, 100.0)] = 0.0
    data_rate_mbps: Annotated[float, Within(0.0, 1000.0)] = 0.0
    packet_bytes: Annotated[int, Whole(1, 2304, ", the longest frame of IEEE 802.11")] = 300
    external: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        exponent = self.path_loss_exponent
        self.need(
            "path_loss_exponent",
            exponent == 0.0 or 1.0 <= exponent <= 6.0,
            "must be 0 (off), or from 1 to 6",
        )
        self.need(
            "building_db",
            self.building_db == 0.0 or exponent > 0.0,
            "buildings add to path loss: set path_loss_exponent, too",
        )


@dataclass(frozen=True)
class InboxConfig(Section, key="v2x.inbox"):
    """The memory of a receiver: its local dynamic map.

    Attributes:
        objects: maximum number of vehicles; the nearest are kept.
        events: maximum number of events; the nearest are kept.
        signals: maximum number of signals; the nearest are kept.
        memory_s: time for which information about vehicles and signals is kept.
    """

    objects: Annotated[int, Whole(1, 64)] = 8
    events: Annotated[int, Whole(1, 64)] = 4
    signals: Annotated[int, Whole(1, 64)] = 2
    memory_s: Annotated[float, Within(0.01, 60.0)] = 1.0


@dataclass(frozen=True)
class V2xConfig(Section, key="v2x"):
    """Messages between vehicles and roadside units.

    Attributes:
        enabled: true switches messages on.
        equipped: share of the background vehicles that send, drawn by id; all agents send.
        capacity: packets that can be sent in one tick of a world. Packets of senders with larger
            ids are dropped and counted. 0: no limit.
    """

    enabled: bool = False
    equipped: Annotated[float, Within(0.0, 1.0)] = 1.0
    capacity: Annotated[int, Whole(0, 1 << 20)] = 0
    cam: CamConfig = field(default_factory=CamConfig)
    denm: DenmConfig = field(default_factory=DenmConfig)
    perception: PerceptionConfig = field(default_factory=PerceptionConfig)
    roadside: RoadsideConfig = field(default_factory=RoadsideConfig)
    channel: ChannelConfig = field(default_factory=ChannelConfig)
    inbox: InboxConfig = field(default_factory=InboxConfig)

    def check_clock(self, sim_dt_s: float) -> None:
        """Raise an error for periods that are not a whole number of ticks of `sim_dt_s`."""
        for key, rate_hz in (
            ("cam.rate_hz", self.cam.rate_hz),
            ("denm.rate_hz", self.denm.rate_hz),
            ("perception.rate_hz", self.perception.rate_hz),
            ("roadside.rate_hz", self.roadside.rate_hz),
            ("roadside.perception_hz", self.roadside.perception_hz),
        ):
            if rate_hz > 0.0:
                ticks = 1.0 / (rate_hz * sim_dt_s)
                fit = max(1, round(ticks))
                check(
                    abs(ticks - fit) < 1e-6 * fit,
                    f"v2x.{key}",
                    rate_hz,
                    f"must give a period of whole ticks of clock.sim_dt_s = {sim_dt_s:g}; "
                    f"try {1.0 / (fit * sim_dt_s):g}",
                )


def period_ticks(rate_hz: float, sim_dt_s: float) -> int:
    """Return the ticks between two messages, at a rate that passes `check_clock`; 0: never."""
    return round(1.0 / (rate_hz * sim_dt_s)) if rate_hz > 0.0 else 0
