"""Traffic metrics, computed from VEHICLE records in the same way for every simulator.

Contacts are checked after every tick; all other metrics are sampled once per simulated second. The
fields of `TrafficFigures` define the metrics.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.math.neighbors import make_grid
from cavmarl.driving.kernels.motion.contacts import find_contacts
from cavmarl.evaluate.traffic.junction_locks import JunctionLocks
from cavmarl.roads.network import RoadNetwork

STANDING_MPS = 0.1  # slower vehicles count as stopped, as in SUMO's waiting time
SAMPLES_PER_S = 1
MINUTE_S = 60
CELL_M = 10.0  # cell size of the grid for finding contacts
FOLLOWS_MPS = 1.0  # slower vehicles have no time headway
LONGEST_HEADWAY_S = 10.0  # vehicles farther behind do not follow

EDGE_MINUTE = np.dtype(
    [
        ("edge", np.int32),  # EDGE row; never inside a junction
        ("minute", np.int32),  # minutes since the beginning
        ("length_m", np.float64),  # length of the edge
        ("density_per_km", np.float64),  # vehicles per kilometre of one lane
        ("flow_per_h", np.float64),  # vehicles per hour on one lane
        ("speed_mps", np.float64),  # flow over density
    ],
    align=True,
)


@dataclass(frozen=True)
class TrafficCounts:
    """Counts of a whole run that only the simulator itself has."""

    departed: int  # vehicles that have entered
    waiting: int  # vehicles whose departure time has passed but that have not entered
    arrived: int  # vehicles that reached the end of their trip
    # mean over arrived vehicles: trip time minus the time of the same route at the desired speed;
    # None if no vehicle arrived
    mean_delay_s: float | None
    teleports: int = 0  # vehicles that were teleported because they waited too long


@dataclass(frozen=True)
class TrafficFigures:
    """The metrics of one simulator."""

    departed: int  # see `TrafficCounts`
    waiting: int  # see `TrafficCounts`
    arrived: int  # see `TrafficCounts`
    mean_speed_mps: float | None  # mean over all vehicles and samples; None without vehicles
    mean_delay_s: float | None  # see `TrafficCounts`
    # stopped vehicles (below 0.1 m/s) on lanes that end at a signal, mean of the samples
    queue: float
    contacts: int  # pairs of vehicles whose rectangles began to overlap on the same level
    longest_lock_s: float  # the longest lock of any junction, see `JunctionLocks`
    locked_junction: str  # junction of the longest lock; empty: none was locked
    teleports: int  # see `TrafficCounts`
    # vehicles per hour on one lane, mean over all lanes outside junctions and the whole run, by
    # Edie's definition
    flow_per_h: float | None = None
    # median time between the front bumpers of two successive vehicles on a lane, if it is at most
    # 10 s and the following vehicle drives at least 1 m/s
    median_headway_s: float | None = None
    distance_km: float = 0.0  # driven by all vehicles together

    @property
    def contacts_per_1000_km(self) -> float | None:
        """Contacts per 1,000 km that vehicles have driven; None if they have driven nothing."""
        return 1000.0 * self.contacts / self.distance_km if self.distance_km > 0.0 else None


@dataclass(frozen=True)
class TrafficRun:
    """The results of one run."""

    figures: TrafficFigures  # metrics of the run
    locks_s: dict[str, float]  # junction → its longest lock in s, for junctions that had one
    edge_minutes: NDArray[np.void]  # EDGE_MINUTE rows of all edges and minutes with a vehicle


class TouchCounter:
    """Counts pairs of vehicles that begin to touch, on a map of these bounds (m).

    If several vehicles touch one vehicle at once, only the pair with the lowest id counts.
    """

    def __init__(self, bounds: tuple[float, float, float, float], floating: bool = False) -> None:
        self.count = 0  # pairs so far; a pair that separates and touches again counts twice
        self._bounds = bounds
        self._floating = floating
        self._make_room(0)
        self._touching: set[tuple[int, int]] = set()

    def see(self, rows: NDArray[np.void]) -> None:
        """Add VEHICLE (num_vehicles,) of the next tick."""
        if len(rows) > len(self._hit):
            self._make_room(2 * len(rows))
        find_contacts(rows, len(rows), self._grid, self._hit)
        hitting = np.flatnonzero(self._hit[: len(rows)] >= 0)
        ids, others = rows["id"][hitting].tolist(), self._hit[hitting].tolist()
        touching = {(min(pair), max(pair)) for pair in zip(ids, others, strict=True)}
        self.count += len(touching - self._touching)
        self._touching = touching

    def _make_room(self, capacity: int) -> None:
        self._grid = make_grid(self._bounds, CELL_M, capacity, self._floating)
        self._hit = np.zeros(capacity, dtype=np.int64)


def headways_s(rows: NDArray[np.void]) -> NDArray[np.float64]:
    """Return the time headways, in s, of vehicles behind another one on their lane.

    Vehicles slower than `FOLLOWS_MPS`, and headways above `LONGEST_HEADWAY_S`, are left out.

    Args:
        rows: VEHICLE (n,) with lane, s, speed and length.
    """
    front = rows["s"] + 0.5 * rows["length"]
    order = np.lexsort((front, rows["lane"]))
    rows, front = rows[order], front[order]
    follows = rows["lane"][:-1] == rows["lane"][1:]
    follows &= rows["speed"][:-1] >= FOLLOWS_MPS
    found: NDArray[np.float64] = np.diff(front)[follows] / rows["speed"][:-1][follows]
    return found[found <= LONGEST_HEADWAY_S]


class TrafficMeter:
    """Measures one world on one map."""

    def __init__(self, network: RoadNetwork) -> None:
        self._network = network
        self._touches = TouchCounter(network.room_m, len(network.maps) > 1)
        self._locks = JunctionLocks(network)
        signalled = network.links["from_lane"][network.links["signal"] >= 0]
        self._ends_at_signal = np.zeros(len(network.lanes), dtype=np.bool_)
        self._ends_at_signal[signalled] = True
        self._samples = 0
        self._seen = 0
        self._speed_sum = 0.0
        self._queue_sum = 0
        self._seconds: list[NDArray[np.int64]] = []
        self._metres: list[NDArray[np.float64]] = []
        self._headways_s: list[NDArray[np.float64]] = []

    def see(self, rows: NDArray[np.void]) -> None:
        """Check VEHICLE (num_vehicles,) for contacts after a tick."""
        self._touches.see(rows)

    def sample(self, rows: NDArray[np.void], codes: NDArray[np.uint8]) -> None:
        """Add the sample of a second.

        Args:
            rows: VEHICLE (num_vehicles,); `lane` is -1 on lanes that the map does not have.
            codes: (num_links,) signal states of the links, as from `signal_codes`.
        """
        on_map = rows[rows["lane"] >= 0]
        lanes = on_map["lane"]
        standing = on_map["speed"] < STANDING_MPS
        self._seen += len(rows)
        self._speed_sum += float(rows["speed"].sum())
        self._queue_sum += int((standing & self._ends_at_signal[lanes]).sum())
        self._locks.sample(on_map, standing, codes)
        self._headways_s.append(headways_s(on_map))
        edges = self._network.lanes["edge"][lanes]
        if self._samples % (MINUTE_S * SAMPLES_PER_S) == 0:
            self._seconds.append(np.zeros(len(self._network.edges), dtype=np.int64))
            self._metres.append(np.zeros(len(self._network.edges)))
        self._seconds[-1] += np.bincount(edges, minlength=len(self._network.edges))
        self._metres[-1] += np.bincount(edges, on_map["speed"], len(self._network.edges))
        self._samples += 1

    def result(self, counts: TrafficCounts) -> TrafficRun:
        locks = self._locks.longest_s()
        worst = max(locks, key=lambda junction: locks[junction], default="")
        figures = TrafficFigures(
            **asdict(counts),
            mean_speed_mps=self._speed_sum / self._seen if self._seen else None,
            queue=self._queue_sum / max(self._samples, 1),
            contacts=self._touches.count,
            longest_lock_s=locks.get(worst, 0.0),
            locked_junction=worst,
            flow_per_h=self._flow_per_h(),
            median_headway_s=self._median_headway_s(),
            distance_km=self._speed_sum / SAMPLES_PER_S / 1000.0,
        )
        return TrafficRun(figures, locks, self._edge_minutes())

    def _flow_per_h(self) -> float | None:
        """Return distance over area, as `_edge_minutes` does, for all edges outside junctions."""
        edges = self._network.edges
        outside = ~edges["internal"]
        lanes_m = float((edges["length_m"] * edges["num_lanes"])[outside].sum())
        driven_m = sum(float(metres[outside].sum()) for metres in self._metres)
        if not self._samples or not lanes_m:
            return None
        return 3600.0 * driven_m / (lanes_m * self._samples)

    def _median_headway_s(self) -> float | None:
        found = np.concatenate([*self._headways_s, np.zeros(0)])
        return float(np.median(found)) if len(found) else None

    def _edge_minutes(self) -> NDArray[np.void]:
        """Return flow and density of lanes by Edie's definitions.

        In an area of road and time, density is the time that vehicles spend in it, and flow the
        distance that they cover in it, each divided by the area (Edie: "Discussion of traffic
        stream measurements and definitions", 1963).
        """
        edges = self._network.edges
        lane_km = edges["length_m"] * edges["num_lanes"] / 1000.0
        parts = []
        for minute, (seconds, metres) in enumerate(zip(self._seconds, self._metres, strict=True)):
            chosen = np.flatnonzero((seconds > 0) & ~edges["internal"])
            samples = min(self._samples - minute * MINUTE_S, MINUTE_S)
            part = np.zeros(len(chosen), EDGE_MINUTE)
            part["edge"] = chosen
            part["minute"] = minute
            part["length_m"] = edges["length_m"][chosen]
            part["density_per_km"] = seconds[chosen] / samples / lane_km[chosen]
            part["speed_mps"] = metres[chosen] / seconds[chosen]
            part["flow_per_h"] = 3.6 * part["speed_mps"] * part["density_per_km"]
            parts.append(part)
        return np.concatenate(parts) if parts else np.zeros(0, EDGE_MINUTE)
