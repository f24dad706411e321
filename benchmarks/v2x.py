"""Cost of messages per tick, for several channels with the vehicles of one world.

The world itself has no messages. After each of its ticks, one message bus for each channel (the
object that sends and receives messages) runs with the world's vehicles. So all channels are timed
under the same conditions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from statistics import fmean, median
from time import perf_counter
from typing import Annotated, Any

from benchmarks.program import run
from cavmarl.bench.harness import BenchmarkReport, Say, check_positive, one_core, silent
from cavmarl.cli.output import OptionalEnvironment, Seed, about
from cavmarl.config.env import EnvConfig
from cavmarl.core.errors import ConfigError
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.world_setup import load_world
from cavmarl.evaluate.built_in_runs import DrivenWorld
from cavmarl.shards.shard import common_of
from cavmarl.v2x.bus import Bus, V2xStatistics

# Exponent and spread of Cheng et al. (JSAC 2007) in a suburb; airtime of IEEE 802.11p.
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
SHAPE = {"population.mode": "respawn", "clock.ctrl_dt_s": 0.05, "sensors.lidar.rays": 0}


def measure(
    env: OptionalEnvironment = "town",
    vehicles: Annotated[int, about("Number of sending vehicles, as far as they fit.")] = 1000,
    receivers: Annotated[
        int | None, about("Number of agents, which receive [default: all vehicles].")
    ] = None,
    ticks: Annotated[int, about("Timed ticks.")] = 200,
    warmup: Annotated[int, about("Untimed ticks at the beginning.")] = 40,
    seed: Seed = 0,
    at_most: Annotated[
        float | None, about("Exit with 1 if any channel takes more ms per tick.")
    ] = None,
    say: Say = silent,
) -> BenchmarkReport:
    """Measure ms per tick for messages among vehicles, by channel, and for the tick itself."""
    check_positive("--at-most", at_most)
    receivers = vehicles if receivers is None else receivers
    if not 1 <= receivers <= vehicles <= 100_000 or ticks < 1 or warmup < 0:
        raise ConfigError(
            f"vehicles = {vehicles}, receivers = {receivers}, ticks = {ticks}, warmup = {warmup}: "
            "needs at least 1 receiver, at most as many as vehicles, and 1 tick"
        )
    counts = {"agents": receivers, "background": vehicles - receivers}
    say("creating the world")
    config, network, demand, partition = load_world(env, **counts, overrides=SHAPE)
    with one_core():
        simulation = Simulation(config, network, 1, demand, partition)
        simulation.seed(seed)
        simulation.reset()
        buses = {}
        for name, channel in CHANNELS.items():
            with_messages = SHAPE | {"v2x.enabled": True} | dict(channel)
            buses[name] = _bus_beside(
                simulation, load_world(env, **counts, overrides=with_messages)[0]
            )
        world = DrivenWorld(simulation)
        world_ms: list[float] = []
        bus_ms: dict[str, list[float]] = {name: [] for name in CHANNELS}
        running: list[int] = []
        say("measuring")
        for _ in range(warmup + ticks):
            world_ms.append(_timed_ms(partial(world.step, world.commands())))
            running.append(int(simulation.running()[0]))
            for name, (_, exchange) in buses.items():
                bus_ms[name].append(_timed_ms(exchange))
    rows: list[dict[str, Any]] = [
        {"name": "the world's own tick", "median_ms": median(world_ms[warmup:])}
    ]
    for name, (bus, _) in buses.items():
        rows.append(_row(name, bus.statistics(), bus_ms[name], warmup))
    mean, rate_hz = fmean(running[warmup:]), config.v2x.cam.rate_hz
    return BenchmarkReport(
        f"{env}: {mean:,.0f} vehicles at {rate_hz:g} Hz, up to {receivers:,} of them receiving; "
        "one core",
        {
            "channel": "name",
            "ms per tick": "median_ms:.2f",
            "in reach": "reachable:,.0f",
            "received": "reception_ratio:.1%",
            "busy": "busy_ratio:.1%",
        },
        rows,
        facts={"env": env, "vehicles": mean, "receivers": receivers, "rate_hz": rate_hz},
        holds=at_most is None or max(row["median_ms"] for row in rows[1:]) <= at_most,
    )


def _row(name: str, found: V2xStatistics, every_ms: list[float], warmup: int) -> dict[str, Any]:
    taken = every_ms[warmup:]
    return {
        "name": name,
        "tick_ms": taken,
        "median_ms": median(taken),
        "reachable": found.reachable / len(every_ms),
        "reception_ratio": found.reception_ratio,
        "busy_ratio": found.busy_mean,
    }


def _bus_beside(simulation: Simulation, config: EnvConfig) -> tuple[Bus, Callable[[], None]]:
    """Return a message bus beside a world, which has none, and a function that runs it once."""
    division, worlds = simulation.division, simulation.shards[0].worlds
    bus = Bus(config, simulation.network, simulation.types, division.zoned, common_of(worlds))
    return bus, lambda: bus.exchange(division.side)


def _timed_ms(step: Callable[[], None]) -> float:
    began = perf_counter()
    step()
    return 1e3 * (perf_counter() - began)


if __name__ == "__main__":
    run(measure)
