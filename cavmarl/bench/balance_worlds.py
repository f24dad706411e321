"""Traces of loads of an environment: generated on its map, or recorded while it runs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from cavmarl.bench.load_traces import LoadTrace, generated_trace, recorded_trace
from cavmarl.bench.shard_costs import measure_rounds
from cavmarl.bench.sharded_worlds import world_maker
from cavmarl.core.errors import ConfigError
from cavmarl.engine.world_setup import find_map
from cavmarl.roads.cache import load_network
from cavmarl.zones.partition.zone_file import named_zones

__all__ = ["generated_traces", "recorded_traces"]

ROUND_S = 10  # simulated seconds of a recorded round
BEFORE_S = 20  # simulated seconds before the first one
AFTER_S = 1  # so that no episode ends within the last one


def generated_traces(
    env: str,
    *,
    zones: int,
    layout: str,
    workers: int,
    rounds: int,
    seeds: Sequence[int],
    overrides: Mapping[str, Any],
) -> Iterator[LoadTrace]:
    """A crowd on the environment's map for each seed.

    Raises:
        ConfigError: settings, which nothing here could follow; more zones than the map can hold.
    """
    if overrides:
        raise ConfigError("--set: a generated crowd has no settings; give --recorded with it")
    network = load_network(find_map(env))
    partition = named_zones(network, layout, zones)
    for seed in seeds:
        yield generated_trace(network, partition, rounds=rounds, workers=workers, seed=seed)


def recorded_traces(
    env: str,
    *,
    zones: int,
    layout: str,
    workers: int,
    rounds: int,
    seeds: Sequence[int],
    overrides: Mapping[str, Any],
) -> Iterator[LoadTrace]:
    """What zones cost while the built-in driver is in all seats, for each seed."""
    for seed in seeds:
        simulation = world_maker(
            env,
            layout=layout,
            seconds=BEFORE_S + rounds * ROUND_S + AFTER_S,
            seed=seed,
            overrides=overrides,
        )(zones)
        clock = simulation.config.clock
        steps = max(round(ROUND_S / clock.ctrl_dt_s), 1)
        before = max(round(BEFORE_S / clock.ctrl_dt_s), 1)
        yield recorded_trace(
            simulation.network,
            simulation.partition,
            list(measure_rounds(simulation, rounds, steps, before=before)),
            ticks=steps * clock.ticks_per_step,
            workers=workers,
            seed=seed,
        )
