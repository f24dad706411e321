"""What messages cost in a tick: several channels side by side, on the vehicles of one world.

The world itself is run without messages. After each of its ticks every bus takes the same rows and
sends and receives, with a clock on it; so all of them, and the tick, see the same machine.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np

from cavmarl.bench.sharded_worlds import DrivenWorld
from cavmarl.bench.step_speed import one_core
from cavmarl.core.errors import ConfigError
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.world_setup import load_world
from cavmarl.evaluate.provenance.machine import describe_hardware

__all__ = ["CHANNELS", "ChannelCost", "V2xSpeed", "measure_v2x"]

# As exponent and spread that of Cheng et al. (JSAC 2007) in a suburb; the air as of IEEE 802.11p.
CHANNELS: Mapping[str, Mapping[str, Any]] = {
    "ideal": {},
    "range 300 m": {"v2x.channel.range_m": 300.0},
    "path loss": {"v2x.channel.range_m": 300.0, "v2x.channel.path_loss_exponent": 2.75},
    "path loss, busy air": {
        "v2x.channel.range_m": 300.0,
        "v2x.channel.path_loss_exponent": 2.75,
        "v2x.channel.data_rate_mbps": 6.0,
        "v2x.channel.latency_ticks": 2,
    },
}


@dataclass(frozen=True)
class ChannelCost:
    """One channel.

    Attributes:
        name: of `CHANNELS`.
        tick_ms: of the bus, each tick.
        median_ms: of them.
        reachable: receivers within reach of a packet, a tick.
        reception_ratio: share of them that received.
        busy_ratio: of the channel.
    """

    name: str
    tick_ms: tuple[float, ...]
    median_ms: float
    reachable: float
    reception_ratio: float
    busy_ratio: float


@dataclass(frozen=True)
class V2xSpeed:
    """All of them.

    Attributes:
        env: whose map it is.
        vehicles: that send, mean.
        receivers: of them, agents.
        rate_hz: messages a vehicle and second.
        world_ms: a tick of the world without messages, median.
        rows: the channels.
        hardware: what it ran on.
    """

    env: str
    vehicles: float
    receivers: int
    rate_hz: float
    world_ms: float
    rows: tuple[ChannelCost, ...]
    hardware: dict[str, Any]

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


def measure_v2x(
    env: str,
    *,
    vehicles: int,
    receivers: int,
    ticks: int,
    warmup: int,
    seed: int,
    say: Callable[[str], None] = lambda text: None,
) -> V2xSpeed:
    """Measure on one core.

    Args:
        env: name, folder or map file of an environment.
        vehicles: as many as there is room for, up to that.
        receivers: how many of them are agents, and receive.
        ticks: that are timed.
        warmup: ticks before.
        seed: of the world.
        say: told what is going on.

    Raises:
        ConfigError: numbers that cannot be.
    """
    if not 1 <= receivers <= vehicles <= 100_000 or ticks < 1 or warmup < 0:
        raise ConfigError(
            f"vehicles = {vehicles}, receivers = {receivers}, ticks = {ticks}, warmup = {warmup}: "
            "must be at least 1 receiver among the vehicles, and 1 tick"
        )
    shape = {"population.mode": "seats", "clock.ctrl_dt_s": 0.05, "sensors.lidar.rays": 0}
    counts = {"agents": receivers, "background": vehicles - receivers}
    say("making the world")
    config, network, demand, partition = load_world(env, **counts, overrides=shape)
    rate_hz = config.v2x.cam.rate_hz
    with one_core():
        simulation = Simulation(config, network, 1, demand, partition)
        simulation.seed(seed)
        simulation.reset()
        buses = {}
        for name, channel in CHANNELS.items():
            with_messages = shape | {"v2x.enabled": True} | dict(channel)
            buses[name] = simulation.listen(load_world(env, **counts, overrides=with_messages)[0])
        world = DrivenWorld(simulation)
        world_ms: list[float] = []
        bus_ms: dict[str, list[float]] = {name: [] for name in CHANNELS}
        running: list[int] = []
        for tick in range(warmup + ticks):
            if tick == warmup:
                say("measuring")
            commands = world.commands()
            world_ms.append(_timed_ms(partial(world.step, commands)))
            running.append(int(simulation.running()[0]))
            for name, (_, exchange) in buses.items():
                bus_ms[name].append(_timed_ms(exchange))
    rows = []
    for name, (bus, _) in buses.items():
        found = bus.statistics()
        timed = bus_ms[name][warmup:]
        rows.append(
            ChannelCost(
                name,
                tuple(timed),
                median(timed),
                found.reachable / (warmup + ticks),
                found.reception_ratio,
                found.busy_mean,
            )
        )
    mean = float(np.mean(running[warmup:]))
    middle = median(world_ms[warmup:])
    return V2xSpeed(env, mean, receivers, rate_hz, middle, tuple(rows), describe_hardware())


def _timed_ms(run: Callable[[], None]) -> float:
    began = perf_counter()
    run()
    return 1e3 * (perf_counter() - began)
