"""`TrafficStats`: counts and sums of one world's traffic."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cavmarl.core.records.arrays import DepartureQueue
from cavmarl.core.records.codes import (
    COUNT_ARRIVED,
    COUNT_DEPARTED,
    COUNT_REMOVED,
    COUNT_REROUTED,
    SUM_DELAY_S,
    SUM_DISTANCE_M,
    SUM_TIME_S,
)
from cavmarl.handoff.division import ZonedShards


@dataclass(frozen=True)
class TrafficStats:
    """Traffic of one world since its reset; agents count as vehicles."""

    departed: int  # vehicles that have entered, including those placed at reset
    waiting: int  # departures that wait for a safe gap
    running: int  # vehicles in the world
    arrived: int  # vehicles that reached their goal
    contacts: int  # vehicles that began to touch another vehicle
    removed: int  # vehicles that left without reaching their goal, for example after a collision
    rerouted: int  # changes of route; one vehicle may count several times
    mean_speed_mps: float  # mean over the vehicles in the world now
    mean_trip_m: float  # mean over the arrived vehicles
    mean_trip_s: float  # mean over the arrived vehicles
    # mean over the arrived vehicles: trip time minus the time that the trip takes at the speed that
    # limit, driver and type allow
    mean_delay_s: float


def count_traffic(departures: DepartureQueue, division: ZonedShards, world: int) -> TrafficStats:
    """Return the traffic statistics of one world since its reset."""
    counts, sums = departures.counts[world], departures.sums[world]
    rows = division.vehicles(world)
    arrived = int(counts[COUNT_ARRIVED])
    trips = max(arrived, 1)
    return TrafficStats(
        departed=int(counts[COUNT_DEPARTED]),
        waiting=int(departures.num_queue[world]),
        running=len(rows),
        arrived=arrived,
        contacts=int(division.contacts()[world]),
        removed=int(counts[COUNT_REMOVED]),
        rerouted=int(counts[COUNT_REROUTED]),
        mean_speed_mps=float(np.sort(rows["speed"]).mean()) if len(rows) else 0.0,
        mean_trip_m=float(sums[SUM_DISTANCE_M]) / trips,
        mean_trip_s=float(sums[SUM_TIME_S]) / trips,
        mean_delay_s=float(sums[SUM_DELAY_S]) / trips,
    )
