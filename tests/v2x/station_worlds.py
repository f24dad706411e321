"""Worlds whose vehicles stand at positions that a test chooses, with their message bus."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.records.codes import DRIVER_AGENT
from cavmarl.driving.vehicles import VEHICLE, blank_vehicle
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.world_setup import load_world
from cavmarl.roads.kernels.backdrop_pieces import WALL
from cavmarl.v2x.bus import Bus

CLOCK = {"clock.sim_dt_s": 0.1, "clock.ctrl_dt_s": 0.1}


class StationWorld:
    """A world with a message bus; the test writes the rows of vehicles.

    Args:
        agents: number of agents; agent k drives vehicle k < agents.
        env: environment that gives the map.
        rays: number of rays of the agents' lidar.
        walls: (n, 4) ends of buildings' walls: ax, ay, bx, by.
        settings: values of keys under `v2x`.
    """

    def __init__(
        self,
        agents: int,
        env: str = "grid4x4",
        rays: int = 0,
        walls: Sequence[tuple[float, float, float, float]] = (),
        **settings: Any,
    ) -> None:
        overrides = {f"v2x.{key.replace('__', '.')}": value for key, value in settings.items()}
        config, network, demand, partition = load_world(
            env,
            agents=agents,
            background=80,
            overrides=CLOCK
            | {"population.mode": "respawn", "v2x.enabled": True}
            | overrides
            | {"sensors.lidar.rays": rays},
        )
        if walls:
            network = replace(network, walls=np.array([(*wall, 9.0, 0) for wall in walls], WALL))
        self.config = config
        self.agents = agents
        self.simulation = Simulation(config, network, 1, demand, partition)
        self.simulation.seed(3)
        self.simulation.reset()
        self.worlds = self.simulation.shards[0].worlds
        self.bus: Bus = self.simulation.messages
        self.bus.reset(np.ones(1, dtype=np.bool_))

    def put(self, places: NDArray[np.float64], **fields: Any) -> NDArray[np.void]:
        """Replace all vehicles by standing vehicles at (n, 2) positions; vehicle k has the id k."""
        rows = np.zeros(len(places), VEHICLE)
        rows[:] = blank_vehicle()
        rows["id"] = np.arange(len(places))
        rows["x"], rows["y"] = places.T
        rows["agent"][: self.agents] = np.arange(self.agents)
        rows["driver"][: self.agents] = DRIVER_AGENT
        for name, values in fields.items():
            rows[name] = values
        return self.write(rows)

    def write(self, rows: NDArray[np.void]) -> NDArray[np.void]:
        """Replace all vehicles; the order of rows does not matter."""
        self.worlds.rows[0, : len(rows)] = rows
        self.worlds.num_owned[0] = self.worlds.num_rows[0] = len(rows)
        return rows

    def tick(self) -> int:
        """Let all stations send and receive for a tick; return the tick."""
        self.worlds.ticks[0] += 1
        self.bus.exchange(self.simulation.shards[0].side)
        return int(self.worlds.ticks[0])

    def key(self) -> int:
        """Return the key of the world's random numbers."""
        return int(self.worlds.keys[0])
