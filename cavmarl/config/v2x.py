"""The keys under `v2x` of `env.yaml`: who tells whom what over the air, and how much of it arrives.

Everything is off by default, and the channel is ideal: each of its effects is off at 0.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from cavmarl.config.checks import check, check_finite

__all__ = [
    "CamConfig",
    "ChannelConfig",
    "DenmConfig",
    "InboxConfig",
    "PerceptionConfig",
    "RoadsideConfig",
    "V2xConfig",
]

MAX_RATE_HZ = 1000.0
MAX_LATENCY_TICKS = 64
EVERY_SIGNAL = "all"


@dataclass(frozen=True)
class CamConfig:
    """Messages of a vehicle about itself, after CAM (ETSI EN 302 637-2).

    Attributes:
        rate_hz: how often one is due; vehicles take turns by id. 0: never.
        triggered: send what is due only if the vehicle has moved 4 m, turned 4° or changed its
            speed by 0.5 m/s since its last one, and once a second anyway.
    """

    rate_hz: float = 10.0
    triggered: bool = False

    def __post_init__(self) -> None:
        check_finite("v2x.cam.rate_hz", self.rate_hz, 0.0, MAX_RATE_HZ)


@dataclass(frozen=True)
class DenmConfig:
    """Messages about events, after DENM (ETSI EN 302 637-3).

    Attributes:
        rate_hz: how often an event that lasts is told again; 0: only what agents declare is sent.
        hard_braking_mps2: deceleration from which braking is an event.
        stationary_s: time from which a vehicle that stands is an event.
        validity_s: for so long a receiver keeps an event.
    """

    rate_hz: float = 10.0
    hard_braking_mps2: float = 4.0
    stationary_s: float = 30.0
    validity_s: float = 2.0

    def __post_init__(self) -> None:
        check_finite("v2x.denm.rate_hz", self.rate_hz, 0.0, MAX_RATE_HZ)
        check_finite("v2x.denm.hard_braking_mps2", self.hard_braking_mps2, 0.1, 20.0)
        check_finite("v2x.denm.stationary_s", self.stationary_s, 0.1, 86_400.0)
        check_finite("v2x.denm.validity_s", self.validity_s, 0.01, 86_400.0)


@dataclass(frozen=True)
class PerceptionConfig:
    """Messages about others that the sender sees, after CPM (ETSI TS 103 324).

    Attributes:
        rate_hz: how often vehicles send one; 0: never.
        range_m: how far a vehicle sees, where no body and no building is in between.
        objects: how many a message tells at most, the nearest ones.
    """

    rate_hz: float = 0.0
    range_m: float = 60.0
    objects: int = 8

    def __post_init__(self) -> None:
        check_finite("v2x.perception.rate_hz", self.rate_hz, 0.0, MAX_RATE_HZ)
        check_finite("v2x.perception.range_m", self.range_m, 1.0, 300.0)
        check(
            1 <= self.objects <= 32, "v2x.perception.objects", self.objects, "must be from 1 to 32"
        )


@dataclass(frozen=True)
class RoadsideConfig:
    """Units beside the road, which tell what signals show (SPAT and MAP, SAE J2735).

    Attributes:
        signals: names of the signals that have one; `[all]`: each.
        rate_hz: how often each tells its phase.
        perception_hz: how often each tells what vehicles it sees; 0: it sees none.
        range_m: how far it sees, over vehicles and not through buildings.
    """

    signals: tuple[str, ...] = ()
    rate_hz: float = 10.0
    perception_hz: float = 0.0
    range_m: float = 80.0

    def __post_init__(self) -> None:
        key = "v2x.roadside"
        check_finite(f"{key}.rate_hz", self.rate_hz, 0.0, MAX_RATE_HZ)
        check_finite(f"{key}.perception_hz", self.perception_hz, 0.0, MAX_RATE_HZ)
        check_finite(f"{key}.range_m", self.range_m, 1.0, 300.0)
        check(
            len(set(self.signals)) == len(self.signals),
            f"{key}.signals",
            self.signals,
            "must name each signal once",
        )
        check(
            EVERY_SIGNAL not in self.signals or len(self.signals) == 1,
            f"{key}.signals",
            self.signals,
            f"'{EVERY_SIGNAL}' stands alone",
        )


@dataclass(frozen=True)
class ChannelConfig:
    """How much of what is sent arrives, and when; all zero: everything, everywhere, at once.

    Attributes:
        range_m: nothing is received further away; 0: no limit.
        latency_ticks: from sending to receiving. With `external`, the longest delay.
        loss: share of packets that is lost, whatever the distance.
        path_loss_exponent: of the log-distance model (about 2 to 3); 0: distance costs nothing.
        shadowing_db: standard deviation of the received power.
        tx_power_dbm: sent, antennas included.
        sensitivity_dbm: received power from which a packet can be read.
        building_db: lost where a building stands in the line of sight; 0: they do not matter.
        data_rate_mbps: what the air can carry; 0: any amount.
        packet_bytes: length of a packet.
        external: a network simulator, connected to the bus, says who receives what.
    """

    range_m: float = 0.0
    latency_ticks: int = 0
    loss: float = 0.0
    path_loss_exponent: float = 0.0
    shadowing_db: float = 5.5
    tx_power_dbm: float = 23.0
    sensitivity_dbm: float = -82.0
    building_db: float = 0.0
    data_rate_mbps: float = 0.0
    packet_bytes: int = 300
    external: bool = False

    def __post_init__(self) -> None:
        key = "v2x.channel"
        check_finite(f"{key}.range_m", self.range_m, 0.0, 1e6)
        check(
            0 <= self.latency_ticks <= MAX_LATENCY_TICKS,
            f"{key}.latency_ticks",
            self.latency_ticks,
            f"must be from 0 to {MAX_LATENCY_TICKS}",
        )
        check_finite(f"{key}.loss", self.loss, 0.0, 1.0)
        exponent = self.path_loss_exponent
        check(
            exponent == 0.0 or 1.0 <= exponent <= 6.0,
            f"{key}.path_loss_exponent",
            exponent,
            "must be 0 (off), or from 1 to 6",
        )
        check_finite(f"{key}.shadowing_db", self.shadowing_db, 0.1, 20.0)
        check_finite(f"{key}.tx_power_dbm", self.tx_power_dbm, -30.0, 44.8)
        check_finite(f"{key}.sensitivity_dbm", self.sensitivity_dbm, -120.0, -30.0)
        check_finite(f"{key}.building_db", self.building_db, 0.0, 100.0)
        check(
            self.building_db == 0.0 or exponent > 0.0,
            f"{key}.building_db",
            self.building_db,
            "buildings weaken what the path-loss model gives: set path_loss_exponent, too",
        )
        check_finite(f"{key}.data_rate_mbps", self.data_rate_mbps, 0.0, 1000.0)
        check(
            1 <= self.packet_bytes <= 2304,
            f"{key}.packet_bytes",
            self.packet_bytes,
            "must be from 1 to 2304, the longest frame of IEEE 802.11",
        )


@dataclass(frozen=True)
class InboxConfig:
    """What a receiver keeps: its local dynamic map.

    Attributes:
        objects: vehicles, the nearest ones that it knows of.
        events: the nearest ones.
        signals: the nearest ones.
        memory_s: for so long it keeps what it has heard of vehicles and signals.
    """

    objects: int = 8
    events: int = 4
    signals: int = 2
    memory_s: float = 1.0

    def __post_init__(self) -> None:
        for name in ("objects", "events", "signals"):
            key, value = f"v2x.inbox.{name}", getattr(self, name)
            check(1 <= value <= 64, key, value, "must be from 1 to 64")
        check_finite("v2x.inbox.memory_s", self.memory_s, 0.01, 60.0)


@dataclass(frozen=True)
class V2xConfig:
    """Vehicles and roadside units that tell each other what they know.

    Attributes:
        enabled: true switches it on.
        equipped: share of the background vehicles that send, by id; agents do.
        capacity: packets that can be sent in one tick of a world; the others, those of the larger
            ids, are dropped and counted. 0: as many as there can be.
    """

    enabled: bool = False
    equipped: float = 1.0
    capacity: int = 0
    cam: CamConfig = field(default_factory=CamConfig)
    denm: DenmConfig = field(default_factory=DenmConfig)
    perception: PerceptionConfig = field(default_factory=PerceptionConfig)
    roadside: RoadsideConfig = field(default_factory=RoadsideConfig)
    channel: ChannelConfig = field(default_factory=ChannelConfig)
    inbox: InboxConfig = field(default_factory=InboxConfig)

    def __post_init__(self) -> None:
        check_finite("v2x.equipped", self.equipped, 0.0, 1.0)
        check(0 <= self.capacity <= 1 << 20, "v2x.capacity", self.capacity, "must be 0 to 1048576")

    def check_clock(self, sim_dt_s: float) -> None:
        """Refuse rates that are no whole number of ticks of `sim_dt_s`.

        Raises:
            ConfigError: such a rate.
        """
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
                    f"must be once in a whole number of ticks of clock.sim_dt_s = {sim_dt_s:g}; "
                    f"try {1.0 / (fit * sim_dt_s):g}",
                )


def period_ticks(rate_hz: float, sim_dt_s: float) -> int:
    """Ticks from one message to the next, of a rate that `check_clock` lets pass; 0: never."""
    return round(1.0 / (rate_hz * sim_dt_s)) if rate_hz > 0.0 else 0
