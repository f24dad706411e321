"""Construction of the shards of a map, with the distance that they see beyond their borders."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cavmarl.config.env import EnvConfig
from cavmarl.config.zones import ZonesConfig
from cavmarl.core.huge_pages import huge_zeros
from cavmarl.core.memory import Zeros
from cavmarl.core.records.arrays import Outputs
from cavmarl.driving.kernels.motion.motion import MAX_SPEED_MPS
from cavmarl.handoff.division import ZonedShards
from cavmarl.networks.background_driver import background_drivers
from cavmarl.ownership.decisions import Neighbours
from cavmarl.ownership.distances import Distances, check_coverage, needed_overlap_m
from cavmarl.ownership.limits import Limits
from cavmarl.rewards.registered_terms import terms_reach_m
from cavmarl.roads.network import RoadNetwork
from cavmarl.sensors.observed import carried_from, largest_radius_m, sensing_reach_m
from cavmarl.sensors.registry import rig_reach_m
from cavmarl.shards.row_check import RowCheck
from cavmarl.shards.shard import Shard, make_zone_state
from cavmarl.shards.vehicle_codec import TransferCodec
from cavmarl.traffic.native import NativeTraffic
from cavmarl.zones.kernels.borders import Borders
from cavmarl.zones.partition.zone_partition import ZonePartition
from cavmarl.zones.reach import driving_reach_m, longest_move_m
from cavmarl.zones.visibility import Visibility

# This margin is added to the halo, so that rounding cannot make it too narrow.
_ROUNDING_M = 1e-6


def divide(
    config: EnvConfig,
    network: RoadNetwork,
    partition: ZonePartition,
    traffic: NativeTraffic,  # departures and routes
    outputs: Outputs,  # outputs of all agents
    num_worlds: int,  # W
    zeros: Zeros = huge_zeros,  # allocates the arrays that shards write
    late_ticks: int = 0,  # extra ticks that a vehicle across a border may stay with its owner
) -> tuple[list[Shard], ZonedShards]:
    """Make one shard per zone, and their division.

    Raises:
        ConfigError: `zones.halo_m` is too small for exact results.
    """
    settings, dt = config.zones, config.clock.sim_dt_s
    radius_m = largest_radius_m(traffic.travel.types)
    sensing_m = max(
        terms_reach_m(config.terms),
        sensing_reach_m(config.sensors, radius_m),
        rig_reach_m(config.rig, radius_m),
    )
    drivers = background_drivers(config.traffic)
    learned_m = max((sensing_reach_m(one.sensors, radius_m) for one in drivers), default=0.0)
    reach_m = max(driving_reach_m(network, traffic.travel), sensing_m, learned_m)
    fastest_mps = longest_move_m(network, traffic.travel, dt) / dt
    wide_m = halo_m(config, reach_m, partition.count, fastest_mps, late_ticks)
    touching_m = _needed_m(config, 2.0 * radius_m, fastest_mps, late_ticks)
    # Background vehicles have sensors only if a learned policy drives them.
    own_m = max(sensing_m if config.population.agents > 0 else 0.0, learned_m)
    sensed_m = _needed_m(config, own_m, fastest_mps, late_ticks) if own_m > 0.0 else 0.0
    near_m = max(touching_m, sensed_m, _approach_m(config, fastest_mps))
    sight = Visibility(
        network,
        traffic.travel,
        wide_m,
        near_m if _goes_by_roads(config, traffic) else wide_m,
        _needed_m(config, 0.0, fastest_mps, late_ticks),
    )
    halo = sight.halo(partition)
    zoned = make_zone_state(partition.count, num_worlds, traffic.capacity, zeros)
    shards: list[Shard] = []
    for zone in range(partition.count):
        shard = Shard(
            config,
            network,
            plans=traffic.plans_now,
            travel=traffic.travel,
            zoned=zoned,
            outputs=outputs,
            zone=zone,
            zones=partition.arrays,
            halo=halo,
            first=shards[0] if shards else None,
            zeros=zeros,
        )
        shards.append(shard)
    row_check = RowCheck(shards[0].roads, traffic, outputs.present.shape[1])
    division = ZonedShards(
        shards,
        zoned=zoned,
        partition=partition,
        halo=halo,
        sight=sight,
        touching_m=touching_m,
        borders=Borders(settings.hysteresis_m, settings.approach_ticks * dt, MAX_SPEED_MPS),
        codec=TransferCodec.of(
            shards[0].worlds, outputs, carried_from(config.sensors), row_check.wrong
        ),
        row_check=row_check,
        may_teleport=traffic.sumo is not None,
    )
    return shards, division


def halo_m(
    config: EnvConfig,  # its `zones.halo_m` is used if it is set
    reach_m: float,  # the longest distance at which a driver, sensor or term considers anything
    zones: int,  # number of zones
    fastest_mps: float = MAX_SPEED_MPS,  # longest move in a tick (with jumps) / length of a tick
    late_ticks: int = 0,  # see `divide`
) -> float:
    """Return how far zones see beyond their borders, in m.

    Raises:
        ConfigError: `zones.halo_m` is too small for exact results; the message has all numbers.
    """
    settings, dt = config.zones, config.clock.sim_dt_s
    wide_m = settings.halo_m
    if wide_m is None:
        wide_m = _needed_m(config, reach_m, fastest_mps, late_ticks)
    if zones > 1:
        check_coverage(
            Distances(_approach_m(config, fastest_mps), settings.hysteresis_m, wide_m),
            _limits_at_borders(settings, late_ticks),
            reach_m=reach_m,
            v_max_mps=fastest_mps,
            dt_s=dt,
        )
    return wide_m


def _goes_by_roads(config: EnvConfig, traffic: NativeTraffic) -> bool:
    """Return whether drivers consider only vehicles along the roads, so that halos can be smaller.

    Scripts may place vehicles beside the roads, and SUMO anywhere. A configured halo is not
    reduced.
    """
    free = traffic.scene is not None or traffic.sumo is not None
    return config.zones.halo_m is None and not free


def neighbours_of(division: ZonedShards) -> Neighbours:
    """Return the pairs of zones between which the protocol allows changes of owner."""
    near = (frozenset(np.flatnonzero(row).tolist()) for row in division.neighbours)
    return Neighbours(tuple(near), division.may_teleport)


def limits_of(settings: ZonesConfig, schema: int = 1) -> Limits:
    """Return the deadlines of the protocol; `schema` is the version of vehicles' states."""
    return Limits(
        deferral=settings.max_deferred_ticks,
        backoff=settings.backoff_ticks,
        schema=schema,
    )


def _limits_at_borders(settings: ZonesConfig, late_ticks: int) -> Limits:
    """Return the deadlines if no message is lost: a vehicle is late by `late_ticks` at most."""
    return replace(limits_of(settings), deferral=late_ticks)


def _approach_m(config: EnvConfig, fastest_mps: float) -> float:
    """Return the distance to a border within which a vehicle is offered.

    The vehicle can drive that far in `approach_ticks`, or jump that far in one tick.
    """
    dt = config.clock.sim_dt_s
    return max(config.zones.approach_ticks * MAX_SPEED_MPS * dt, fastest_mps * dt)


def _needed_m(config: EnvConfig, reach_m: float, fastest_mps: float, late_ticks: int) -> float:
    limits = _limits_at_borders(config.zones, late_ticks)
    needed_m = needed_overlap_m(
        reach_m, config.zones.hysteresis_m, limits, fastest_mps, config.clock.sim_dt_s
    )
    return needed_m + _ROUNDING_M
