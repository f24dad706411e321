"""A run of a demand in SUMO, measured like the run in cavmarl.

libsumo supports one simulation per process, and a second start silently replaces the first.
Therefore every run has its own process.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import defusedxml.ElementTree
import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError, require
from cavmarl.core.records.codes import SIGNAL_NONE
from cavmarl.driving.vehicles import VEHICLE, blank_vehicle
from cavmarl.evaluate.traffic.traffic_metrics import TrafficCounts, TrafficMeter, TrafficRun
from cavmarl.roads.cache import load_network
from cavmarl.roads.network import SIGNAL_STATES, RoadNetwork
from cavmarl.roads.sumo_net.xml_source import limit
from cavmarl.traffic.sumo.sumo_child import limit_memory
from cavmarl.traffic.sumo.sumo_input import SumoInput, command_words, free_libsumo
from cavmarl.traffic.sumo.sumo_process import MAX_SUMO_BYTES, MEMORY_LIMIT


@dataclass(frozen=True)
class SumoJob:
    """One run."""

    map_file: Path  # a SUMO network
    demand: SumoInput  # vehicles and flows
    seconds: int  # duration from `demand.begin_s`
    dt_s: float  # step length
    seed: int  # seed of SUMO's random numbers
    # whether SUMO may teleport vehicles that are stopped for too long (300 s, or as configured in
    # the demand)
    teleports: bool = True
    # vehicles and flows that cavmarl drives, too; SUMO removes all others, and persons, when they
    # enter. None: nothing is removed
    shared: frozenset[str] | None = None

    def is_shared(self, vehicle: str) -> bool:
        """Return whether cavmarl drives this vehicle, or its flow, too."""
        if self.shared is None:
            return True
        return vehicle in self.shared or vehicle.rpartition(".")[0] in self.shared


def run_seeds(job: SumoJob, more_seeds: Sequence[int]) -> tuple[TrafficRun, list[TrafficRun]]:
    """Run the job, then further seeds without counting contacts, in one new process."""
    with sumo_process(job) as process:
        run = process.submit(_measure, job, True).result()
        others = (replace(job, seed=seed) for seed in more_seeds)
        return run, [process.submit(_measure, other, False).result() for other in others]


@contextmanager
def sumo_process(job: SumoJob) -> Iterator[ProcessPoolExecutor]:
    """Return an executor with a new process for one simulation of SUMO."""
    require("libsumo", "sumo")
    most_bytes = limit(MEMORY_LIMIT, MAX_SUMO_BYTES)
    start = get_context("spawn")
    with ProcessPoolExecutor(1, start, limit_memory, (most_bytes,)) as process:
        try:
            yield process
        except BrokenProcessPool as error:
            raise ConfigError(
                f"{job.map_file}: SUMO ended its process on this demand; if it needs more than "
                f"{most_bytes / 2**30:g} GiB of memory, set {MEMORY_LIMIT} (in bytes)"
            ) from error
        except MemoryError as error:
            raise ConfigError(
                f"{job.map_file}: SUMO needs more than {most_bytes / 2**30:g} GiB of memory for "
                f"this demand: use less of it, or set {MEMORY_LIMIT} (in bytes)"
            ) from error


def start_sumo(job: SumoJob, folder: Path, *more: str) -> Any:
    """Load the job into this process's libsumo and return it; `more` are options of SUMO.

    SUMO's log and copies of additional files go into the folder.
    """
    libsumo: Any = free_libsumo()
    log = folder / "errors.log"
    options = {"error-log": str(log)}
    if not job.teleports:
        options["time-to-teleport"] = "-1"
    words = command_words(job.map_file, job.demand, folder, job.dt_s, job.seed, options)
    try:
        libsumo.start(["sumo", *words, *more])
    except libsumo.TraCIException as error:
        raise _refusal(job, log, error) from None  # SUMO's exceptions cannot be pickled
    return libsumo


def _refusal(job: SumoJob, log: Path, error: Exception) -> ConfigError:
    said = log.read_text(encoding="utf-8", errors="replace") if log.exists() else ""
    lines = [line.removeprefix("Error: ") for line in said.splitlines() if line.strip()]
    own = f", {job.demand.net_file}" if job.demand.net_file else ""
    return ConfigError(
        f"{job.map_file}: SUMO refuses this demand: {' '.join(lines) or error}\n"
        f"Cure: give a demand that was made for this map, or the map of this demand{own}"
    )


def _measure(job: SumoJob, contacts: bool) -> TrafficRun:
    network = load_network(job.map_file)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        trips = folder / "trips.xml"
        libsumo = start_sumo(job, folder, f"--tripinfo-output={trips}")
        meter = TrafficMeter(network)
        reader = VehicleReader(libsumo, network)
        departed = arrived = teleports = 0
        ticks_per_s = round(1.0 / job.dt_s)
        try:
            for tick in range(1, job.seconds * ticks_per_s + 1):
                libsumo.simulationStep()
                departed += _keep_shared(libsumo, job)
                arrived += sum(map(job.is_shared, libsumo.simulation.getArrivedIDList()))
                teleports += libsumo.simulation.getStartingTeleportNumber()
                full_second = tick % ticks_per_s == 0
                if not (contacts or full_second):
                    continue
                rows = reader.rows()
                if contacts:
                    meter.see(rows)
                if full_second:
                    reader.fill_lanes(rows)
                    meter.sample(rows, reader.signal_codes())
        except libsumo.TraCIException as error:
            raise _refusal(job, folder / "errors.log", error) from None
        waiting = sum(map(job.is_shared, libsumo.simulation.getPendingVehicles()))
        libsumo.close()
        delays = [
            float(trip.attrib["timeLoss"])
            for trip in defusedxml.ElementTree.parse(trips).iter("tripinfo")
            if job.is_shared(trip.attrib["id"])
        ]
    delay = math.fsum(delays) / len(delays) if delays else None
    return meter.result(TrafficCounts(departed, waiting, arrived, delay, teleports))


def _keep_shared(libsumo: Any, job: SumoJob) -> int:
    """Remove new vehicles that are not shared; return how many shared vehicles have entered."""
    entered = libsumo.simulation.getDepartedIDList()
    for vehicle in entered:
        if not job.is_shared(vehicle):
            libsumo.vehicle.remove(vehicle)
    if job.shared is not None:
        for person in libsumo.simulation.getDepartedPersonIDList():
            libsumo.person.removeStages(person)
    return sum(map(job.is_shared, entered))


class VehicleReader:
    """Reads SUMO's vehicles as VEHICLE records.

    SUMO reports the middle of the front bumper, and angles in degrees clockwise from north.
    """

    def __init__(self, libsumo: Any, network: RoadNetwork) -> None:
        self._libsumo = libsumo
        self._network = network
        self._lane_row = {name: row for row, name in enumerate(network.lane_ids)}
        self._known: dict[str, NDArray[np.void]] = {}
        self._names: list[str] = []

    def rows(self) -> NDArray[np.void]:
        """Return VEHICLE rows with place, heading and size of all vehicles on the road."""
        vehicle = self._libsumo.vehicle
        self._names = list(vehicle.getIDList())
        rows = np.zeros(len(self._names), VEHICLE)
        if not self._names:
            return rows
        places = np.empty((len(self._names), 4))
        for i, name in enumerate(self._names):
            rows[i] = self._blank(name)[0]
            places[i, :3] = vehicle.getPosition3D(name)
            places[i, 3] = vehicle.getAngle(name)
        heading = 0.5 * math.pi - np.radians(places[:, 3])
        rows["heading"] = np.arctan2(np.sin(heading), np.cos(heading))
        rows["x"] = places[:, 0] - 0.5 * rows["length"] * np.cos(heading)
        rows["y"] = places[:, 1] - 0.5 * rows["length"] * np.sin(heading)
        rows["z"] = places[:, 2]
        return rows

    def fill_lanes(self, rows: NDArray[np.void]) -> None:
        """Add speed and lane position to the last result of `rows()`."""
        vehicle = self._libsumo.vehicle
        for i, name in enumerate(self._names):
            rows[i]["speed"] = vehicle.getSpeed(name)
            rows[i]["lane"] = self._lane_row.get(vehicle.getLaneID(name), -1)
            rows[i]["s"] = vehicle.getLanePosition(name) - 0.5 * rows[i]["length"]

    def signal_codes(self) -> NDArray[np.uint8]:
        """Return (num_links,) the signal states of the links."""
        links = self._network.links
        codes = np.full(len(links), SIGNAL_NONE, dtype=np.uint8)
        for row, name in enumerate(self._network.signal_ids):
            state = self._libsumo.trafficlight.getRedYellowGreenState(name)
            letters = np.array([SIGNAL_STATES.index(letter) for letter in state], dtype=np.uint8)
            mine = np.flatnonzero(links["signal"] == row)
            codes[mine] = letters[links["signal_index"][mine]]
        return codes

    def _blank(self, name: str) -> NDArray[np.void]:
        """Return the initial VEHICLE (1,) of this vehicle, with a number instead of its name."""
        if name not in self._known:
            vehicle = self._libsumo.vehicle
            row = blank_vehicle()
            row["id"] = len(self._known)
            row["length"] = vehicle.getLength(name)
            row["width"] = vehicle.getWidth(name)
            row["height"] = vehicle.getHeight(name)
            self._known[name] = row
        return self._known[name]
