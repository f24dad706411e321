"""Recording of places and near misses of agents, message counts, and energy of other vehicles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.records.arrays import Worlds
from cavmarl.driving.kernels.emissions import FUEL_PER_CO2
from cavmarl.driving.vehicle_emissions import emissions_of
from cavmarl.engine.simulation import Simulation
from cavmarl.env.vector import CavVectorEnv
from cavmarl.evaluate.kernels.near_misses import locate_agents, watch_encroachments
from cavmarl.evaluate.recorder import BACKGROUND_COLUMNS, MESSAGE_COLUMNS, Recorder
from cavmarl.roads.network import RoadNetwork


def mirrored_conflicts(network: RoadNetwork) -> NDArray[np.int32]:
    """Return for each conflict (num_conflicts,) the row of the same area on the foe's path.

    -1: the foe has no such row, or the paths merge. After a merge, both vehicles share a lane.
    This is car following, which time to collision measures, not an encroachment.
    """
    links, conflicts = network.links, network.conflicts
    link = np.repeat(np.arange(len(links)), links["num_conflicts"])
    foe = conflicts["foe"]
    rows = {pair: c for c, pair in enumerate(zip(link.tolist(), foe.tolist(), strict=True))}
    mirror = np.array(
        [rows.get(pair, -1) for pair in zip(foe.tolist(), link.tolist(), strict=True)],
        dtype=np.int32,
    )
    mirror[links["to_lane"][link] == links["to_lane"][foe]] = -1
    return mirror


class EncounterWatch:
    """Records places and least post-encroachment times of agents."""

    def __init__(self, vec: CavVectorEnv, recorder: Recorder) -> None:
        self._vec = vec
        self._ids = vec.worlds.arrays.vehicle_ids
        self._recorder = recorder
        self._mirror = mirrored_conflicts(vec.network)
        shape = (vec.num_envs, len(self._mirror))
        self._seen_s = np.full(shape, -np.inf)
        self._seen_id = np.full(shape, -1, dtype=np.int64)
        self._seen_agent = np.full(shape, -1, dtype=np.int32)

    def locate(self, worlds: Worlds) -> None:
        """Record the places of the agents in the present state of the worlds."""
        locate_agents(worlds.rows, worlds.num_owned, self._recorder.places_m)

    def encounters(
        self,
        worlds: Worlds,
        now_s: float,
        running: NDArray[np.bool_],
        mask: NDArray[np.bool_],
    ) -> None:
        """Record a step.

        Args:
            worlds: the worlds after the step.
            now_s: time of the step.
            running: (W,) the worlds to watch.
            mask: (W, A) agents that drive.
        """
        if not self._mirror.size:
            return
        watch_encroachments(
            self._vec.network.arrays,
            self._mirror,
            worlds.rows,
            worlds.num_owned,
            running,
            np.where(mask, self._ids, -1),
            now_s,
            self._vec.step_s,
            self._seen_s,
            self._seen_id,
            self._seen_agent,
            self._recorder.least_pet_s,
        )


class MessageRecord:
    """Keeps the message counts of each world up to the last step of its episode."""

    def __init__(self, vec: CavVectorEnv) -> None:
        self._sends = vec.config.v2x.enabled
        self._values = np.full((vec.num_envs, len(MESSAGE_COLUMNS)), np.nan)

    def add(self, simulation: Simulation, running: NDArray[np.bool_]) -> None:
        """Record the worlds (W,) whose episode continues."""
        if not self._sends:
            return
        for world in np.flatnonzero(running).tolist():
            found = simulation.messages.statistics(world).to_dict()
            self._values[world] = [found[name] for name in MESSAGE_COLUMNS]

    def write(self, episodes: NDArray[np.void]) -> None:
        """Fill the message columns of the first n worlds in EPISODE (n,); NaN: no messages."""
        for column, name in enumerate(MESSAGE_COLUMNS):
            episodes[name] = self._values[: len(episodes), column]


class BackgroundUse:
    """Adds up energy and CO₂ of background vehicles, in one step of each simulated second."""

    def __init__(self, vec: CavVectorEnv) -> None:
        self._step_s = vec.step_s
        self._every = max(1, round(1.0 / vec.step_s))
        self._has_engine = np.array(FUEL_PER_CO2) > 0.0
        self._sums = np.zeros((vec.num_envs, len(BACKGROUND_COLUMNS)))
        self._km = np.zeros(vec.num_envs)

    def add(self, simulation: Simulation, step: int, running: NDArray[np.bool_]) -> None:
        """Sample the running worlds (W,) before the step with the number `step`."""
        if step % self._every:
            return
        for world in np.flatnonzero(running).tolist():
            rows = simulation.vehicles(world)
            rows = rows[np.argsort(rows["id"])]  # sums do not depend on the zones
            vclass = simulation.types["vclass"][rows["vtype"]]
            counts = (rows["agent"] < 0) & self._has_engine[vclass]
            rows, vclass = rows[counts], vclass[counts]
            self._sums[world] += emissions_of(rows, vclass, self._step_s).sum(axis=0)
            self._km[world] += 1e-3 * self._step_s * np.abs(rows["speed"]).sum()

    def write(self, episodes: NDArray[np.void]) -> None:
        """Fill the background columns of the first n worlds in EPISODE (n,)."""
        km = np.where(self._km > 0.0, self._km, np.nan)
        for column, name in enumerate(BACKGROUND_COLUMNS):
            episodes[name] = (self._sums[:, column] / km)[: len(episodes)]
