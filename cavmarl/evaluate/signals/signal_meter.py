"""`SignalMeter`: what a controller of signals achieves in one world, sampled every second."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.records.codes import SIGNAL_GREEN_MAJOR, SIGNAL_GREEN_MINOR
from cavmarl.driving.vehicle_emissions import emissions_of
from cavmarl.roads.network import RoadNetwork

STANDING_MPS = 0.1
LATE_S = 600  # length of the final period whose arrivals show whether a run jams

# Trips of all departed vehicles; the index is the vehicle's id.
_TRIP = np.dtype(
    [
        ("departed_s", np.float64),  # NaN: not seen
        ("late_s", np.float64),  # delay of the departure
        ("lost_s", np.float64),  # time of the trip so far, minus the time at the desired speed
        ("waited_s", np.float64),  # time below 0.1 m/s
        ("stops", np.int64),
        ("stands", np.bool_),  # whether stopped at the last sample
    ],
    align=True,
)


@dataclass(frozen=True)
class SignalFigures:
    """The figures of one run; None: not measured."""

    departed: int  # vehicles that have entered
    never_departed: int  # vehicles whose departure was due, but that have not entered
    arrived: int  # vehicles that have reached the end of their trip
    delay_s: float | None  # mean over arrived vehicles: time lost against the desired speed
    # RESCO's delay: time lost plus delay of the departure, mean over all trips, including
    # unfinished trips and vehicles that never entered
    delay_of_all_s: float
    trip_s: float | None  # mean over arrived vehicles
    waiting_s: float  # mean over departed vehicles: time below 0.1 m/s
    stops: float  # mean over departed vehicles
    queue: float | None  # vehicles below 0.1 m/s on lanes that end at a signal, mean of the samples
    most_queued: int | None  # maximum of `queue` over the samples
    co2_g_per_km: float | None  # emissions of a petrol car, see `emissions_of`
    switches_per_h: float | None  # changes of the green of a signal, mean over signals
    longest_red_s: float | None  # longest time for which a lane was red with a stopped vehicle
    jams: bool | None  # see `is_jammed`


def is_jammed(arrived: int, arrived_late: int, seconds: float) -> bool | None:
    """Return whether traffic had broken down at the end of a run.

    Traffic has broken down if fewer than half as many vehicles per second arrived in the last
    `LATE_S` as before. None: the run is shorter than twice `LATE_S`.

    Args:
        arrived: vehicles that arrived in the run.
        arrived_late: vehicles that arrived in the last `LATE_S`.
        seconds: length of the run.
    """
    if seconds < 2 * LATE_S:
        return None
    return 2 * arrived_late * (seconds - LATE_S) < (arrived - arrived_late) * LATE_S


class SignalMeter:
    """Measures one world.

    Args:
        network: map of the world.
        dt_s: length of a tick.
    """

    def __init__(self, network: RoadNetwork, dt_s: float) -> None:
        links = network.links[network.links["signal"] >= 0]
        self._links = np.flatnonzero(network.links["signal"] >= 0)
        self._lanes = np.unique(links["from_lane"])
        self._lane_of = np.full(len(network.lanes), -1)
        self._lane_of[self._lanes] = np.arange(len(self._lanes))
        self._of_link = self._lane_of[links["from_lane"]]
        self._dt_s = dt_s
        self._trips = np.zeros(0, _TRIP)
        self._red_s = np.zeros(len(self._lanes))
        self._longest_red_s = 0.0
        self._samples = self._queued = self._most_queued = 0
        self._co2_g = self._metres = 0.0

    def sample(
        self,
        rows: NDArray[np.void],
        tick: int,
        due_ticks: NDArray[np.int64],
        codes: NDArray[np.uint8],
    ) -> None:
        """Add the sample of a second.

        Args:
            rows: VEHICLE (n,) all vehicles.
            tick: ticks since the reset.
            due_ticks: (num_orders,) ticks at which vehicles of the demand were due to depart.
            codes: (num_links,) states of the links' signals; see `roads.shown_signals`.
        """
        ids, speed = rows["id"], np.abs(rows["speed"])
        self._grow(int(ids.max(initial=-1)) + 1)
        is_new = ids[np.isnan(self._trips["departed_s"][ids])]
        order = rows["order"]
        known = order >= 0
        due = rows["departed"].copy()
        due[known] = due_ticks[order[known]]
        self._trips["departed_s"][ids] = rows["departed"] * self._dt_s
        self._trips["late_s"][ids] = (rows["departed"] - due) * self._dt_s
        self._trips["lost_s"][ids] = (tick - rows["departed"]) * self._dt_s - rows["free_s"]
        self._trips["stands"][is_new] = False
        stands = speed < STANDING_MPS
        self._trips["waited_s"][ids] += stands
        self._trips["stops"][ids] += stands & ~self._trips["stands"][ids]
        self._trips["stands"][ids] = stands
        cars = np.zeros(len(rows), np.int64)
        self._co2_g += float(emissions_of(rows, cars, 1.0)[:, 1].sum())
        self._metres += float(speed.sum())
        self._sample_lanes(self._lane_of[rows["lane"][stands]], codes)
        self._samples += 1

    def _sample_lanes(self, standing: NDArray[np.int64], codes: NDArray[np.uint8]) -> None:
        """Add the lanes of stopped vehicles, -1 for lanes that do not end at a signal."""
        standing = standing[standing >= 0]
        self._queued += standing.size
        self._most_queued = max(self._most_queued, standing.size)
        shown = codes[self._links]
        is_open = (shown == SIGNAL_GREEN_MAJOR) | (shown == SIGNAL_GREEN_MINOR)
        opened = np.bincount(self._of_link, is_open, len(self._lanes)) > 0
        queued = np.bincount(standing, minlength=len(self._lanes)) > 0
        self._red_s = np.where(opened | ~queued, 0.0, self._red_s + 1.0)
        self._longest_red_s = max(self._longest_red_s, float(self._red_s.max(initial=0.0)))

    def _grow(self, count: int) -> None:
        if count > len(self._trips):
            grown = np.zeros(max(count, 2 * len(self._trips)), _TRIP)
            grown["departed_s"] = np.nan
            grown[: len(self._trips)] = self._trips
            self._trips = grown

    def result(
        self,
        *,
        arrived: int,
        trip_s: float,
        delay_s: float,
        waiting_s: NDArray[np.float64],
        switches_per_h: float | None,
        jams: bool | None,
    ) -> SignalFigures:
        """Return the figures.

        Args:
            arrived: vehicles that have arrived.
            trip_s: mean of their trips.
            delay_s: mean of their delays.
            waiting_s: (n,) for each vehicle that is due but has not departed, the time since then.
            switches_per_h: mean over signals.
            jams: see `is_jammed`.
        """
        trips = self._trips[~np.isnan(self._trips["departed_s"])]
        count = len(trips) + len(waiting_s)
        lost_s = trips["lost_s"].sum() + trips["late_s"].sum() + waiting_s.sum()
        return SignalFigures(
            departed=len(trips),
            never_departed=len(waiting_s),
            arrived=arrived,
            delay_s=delay_s if arrived else None,
            delay_of_all_s=float(lost_s) / max(count, 1),
            trip_s=trip_s if arrived else None,
            waiting_s=float(trips["waited_s"].mean()) if len(trips) else 0.0,
            stops=float(trips["stops"].mean()) if len(trips) else 0.0,
            queue=self._queued / max(self._samples, 1),
            most_queued=self._most_queued,
            co2_g_per_km=1e3 * self._co2_g / self._metres if self._metres else None,
            switches_per_h=switches_per_h,
            longest_red_s=self._longest_red_s,
            jams=jams,
        )
