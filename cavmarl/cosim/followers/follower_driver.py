"""`StackDriver`: one stack per vehicle, from snapshots to controls."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from cavmarl.core.errors import ConfigError, FollowerError
from cavmarl.cosim.followers.follower_client import FollowerView
from cavmarl.cosim.followers.follower_messages import VehicleView, Welcome
from cavmarl.cosim.stack.hd_map import HdMap
from cavmarl.cosim.stack.stack import Stack, StackConfig, sensor_of, vehicle_of
from cavmarl.cosim.stack.stack_types import Mission
from cavmarl.roads.network import RoadNetwork


class StackDriver:
    """Drives the vehicles of a follower.

    `network`: the map, which must be the world's. `welcome`: the world's clock, and the sensors of
    the vehicles.

    Attributes:
        stacks: stacks of the present vehicles, by agent.

    Raises:
        ConfigError: the map differs, a stage lacks a sensor, or the actions are not continuous.
    """

    def __init__(
        self, network: RoadNetwork, welcome: Welcome, config: StackConfig | None = None
    ) -> None:
        if welcome.map_hash != network.source_hash:
            raise ConfigError(
                f"{welcome.environment} is on another map than '{network.name}'; give the stack "
                "the environment or the map file that the world was made from, and its keys of "
                "`map` (--set map.buildings=…)"
            )
        if welcome.action != "continuous":
            raise ConfigError(
                f"action.kind = {welcome.action}: the stack needs continuous controls"
            )
        self._edges = {name: row for row, name in enumerate(network.edge_ids)}
        sensors = [sensor_of(view.name, view.settings) for view in welcome.sensors]
        step_s = welcome.dt_s * welcome.ticks_per_step
        self._config = StackConfig() if config is None else config
        self._vehicle = vehicle_of(HdMap(network), sensors, step_s, self._config.cloud)
        self._scale = (welcome.acceleration_mps2, welcome.steering_rad)
        self._driven: dict[str, tuple[int, int]] = {}
        self.stacks: dict[str, Stack] = {}
        Stack(self._vehicle, self._config)  # reports missing sensors before the first snapshot

    def drive(self, snapshot_view: FollowerView) -> dict[str, list[float]]:
        """Return the controls of a snapshot's vehicles; a new vehicle gets a new stack."""
        signals = snapshot_view.sensors.get("", {}).get("signals")
        shown = None if signals is None else np.asarray(signals.values[-1], dtype=np.uint8)
        controls = {}
        for agent, view in snapshot_view.snapshot.vehicles.items():
            stack = self._stack_of(agent, snapshot_view.snapshot.episode, view.vehicle_id)
            mission = self._mission(view)
            readings = snapshot_view.sensors.get(agent, {})
            driven = stack.drive(readings, shown, mission, snapshot_view.snapshot.time_s)
            numbers = np.array(driven) / self._scale
            controls[agent] = np.clip(numbers, -1.0, 1.0).tolist()
        return controls

    def report(self) -> Mapping[str, Mapping[str, float]]:
        """Return mean and maximum wall time of each stage in ms, over the present stacks."""
        found: dict[str, dict[str, float]] = {}
        for stack in self.stacks.values():
            for stage, seconds in stack.times.wall_s.items():
                row = found.setdefault(stage, {"steps": 0, "mean_wall_ms": 0.0, "worst_wall_ms": 0})
                row["steps"] += stack.times.steps
                row["mean_wall_ms"] += 1e3 * seconds
                worst = 1e3 * stack.times.worst_wall_s[stage]
                row["worst_wall_ms"] = max(row["worst_wall_ms"], worst)
        for row in found.values():
            row["mean_wall_ms"] /= max(row["steps"], 1)
        return found

    def _stack_of(self, agent: str, episode: int, vehicle_id: int) -> Stack:
        if self._driven.get(agent) != (episode, vehicle_id):
            self._driven[agent] = (episode, vehicle_id)
            self.stacks[agent] = Stack(self._vehicle, self._config)
        return self.stacks[agent]

    def _mission(self, view: VehicleView) -> Mission:
        if view.goal_edge not in self._edges:
            raise FollowerError(f"goal '{view.goal_edge[:80]}': this map has no such edge")
        return Mission(self._edges[view.goal_edge], view.vclass, view.length_m, view.width_m)
