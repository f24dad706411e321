"""`ExternalCommands`: vehicles that the caller poses or drives."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.core.compiled import specialized
from cavmarl.core.errors import ActionError, CapacityError, ConfigError, OccupiedPlaceError
from cavmarl.core.math.elementary import cosine, sine
from cavmarl.core.math.geometry import boxes_overlap
from cavmarl.core.math.neighbors import LEVEL_HEIGHT_M
from cavmarl.core.records.arrays import LaneGrid
from cavmarl.core.records.codes import DRIVER_EXTERNAL
from cavmarl.core.records.external_records import (
    EXTERNAL,
    EXTERNAL_DRIVEN,
    EXTERNAL_FIELDS,
    EXTERNAL_NONE,
    EXTERNAL_POSED,
    EXTERNAL_REMOVED,
)
from cavmarl.driving.kernels.motion.motion import MAX_SPEED_MPS
from cavmarl.driving.vehicles import blank_vehicle
from cavmarl.engine.external_component import LARGEST, records_of, wrong_bodies, wrong_commands
from cavmarl.engine.simulation import Simulation
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.routing import lane_grid
from cavmarl.shards.row_check import diagonals_m
from cavmarl.shards.shard import Commands
from cavmarl.traffic.kernels.external_rows import enter_at

MARGIN_M = 100.0  # vehicles may be placed within this distance of the map's lanes
KINDS = (EXTERNAL_POSED, EXTERNAL_DRIVEN, EXTERNAL_REMOVED)


class ExternalCommands:
    """The vehicles of the caller in W worlds, at most E = `population.external` in each.

    Commands to them are kept until the next step.

    Args:
        config: configuration of the worlds.
        network: map of the worlds.
        num_worlds: number of worlds, W.
        present: returns the worlds as they are now; routes of SUMO may be missing.
    """

    def __init__(
        self,
        config: EnvConfig,
        network: RoadNetwork,
        num_worlds: int,
        present: Callable[[], Simulation],
    ) -> None:
        self._most = config.population.external
        self._may_observe = config.population.external_agents
        self._network = network
        self._present = present
        self._commands = np.zeros((num_worlds, self._most, EXTERNAL_FIELDS))
        self._told = records_of(self._commands)  # EXTERNAL (W, E), a view
        self._is_used = np.zeros((num_worlds, self._most), dtype=np.bool_)  # after the last step
        self._enter_at = specialized(enter_at)

    @property
    def memory(self) -> tuple[NDArray[Any], ...]:
        """Waiting commands, and the slots with vehicles."""
        return self._commands, self._is_used

    @memory.setter
    def memory(self, memory: tuple[NDArray[Any], ...]) -> None:
        self._commands[:], self._is_used[:] = memory

    def wrong(self, memory: Sequence[NDArray[Any]]) -> str:
        """Return what is wrong with a loaded `memory`; empty if it is valid."""
        told, is_used = records_of(memory[0]), memory[1]
        is_waiting = told["kind"] != EXTERNAL_NONE
        if wrong := wrong_commands(told[is_waiting], KINDS):
            return wrong
        comes = told[is_waiting & ~is_used]
        if not len(comes):
            return ""
        return wrong_bodies(comes, self._present().types)

    def spawn(
        self,
        x: float,
        y: float,
        heading: float,
        *,
        z: float | None = None,
        vtype: str = "car",
        size_m: tuple[float, float, float] | None = None,
        speed: float = 0.0,
        observes: bool = False,
        world: int = 0,
    ) -> int:
        """Let a vehicle enter a world in the next step.

        It stays at its place until `pose` or `drive` moves it. All other vehicles and sensors see
        it. It has no route, and leaves at the end of the episode.

        Args:
            x: position of its centre, in m.
            y: position of its centre, in m.
            heading: in rad, counter-clockwise from east.
            z: height of the ground below its centre, in m; None: height of the lane.
            vtype: `car`, `truck`, `bus`, `pedestrian`, `cyclist`, `roadside_unit`, or a type of
                `population.fleet`.
            size_m: length, width and height, at most those of a bus; None: size of its type.
            speed: in m/s along its heading, negative backwards.
            observes: whether it carries the sensors of `rig`, and is an agent of a PettingZoo
                environment (`population.external_agents`).
            world: number of the world.

        Returns:
            The vehicle's slot, to be passed to the other methods.

        Raises:
            ActionError: the place is outside of the map, or an argument is invalid.
            OccupiedPlaceError: another vehicle covers the place.
            CapacityError: the world already has `population.external` such vehicles.
            ConfigError: `population.external` is 0; or `observes` is true, and
                `population.external_agents` is false.
        """
        self._check_world(world)
        if observes and not self._may_observe:
            raise ConfigError(
                "external vehicles carry no sensors here: set population.external_agents = true"
            )
        told = np.zeros(1, dtype=EXTERNAL)[0]
        told["kind"], told["observes"] = EXTERNAL_POSED, observes
        self._set_pose(told, (x, y, z, heading, None, speed))
        simulation = self._present()
        rows = simulation.type_rows
        if vtype not in rows:
            raise ActionError(f"vtype = {vtype!r}: must be one of {', '.join(rows)}")
        told["vtype"] = rows[vtype]
        kind = simulation.types[rows[vtype]]
        sizes = [kind[name] for name in ("length", "width", "height")] if size_m is None else size_m
        told["length"], told["width"], told["height"] = sizes
        body = told.reshape(1)
        if wrong_commands(body, KINDS) or wrong_bodies(body, simulation.types):
            raise ActionError(
                f"size_m = {tuple(sizes)}: must be length, width and height above 0, at most those "
                "of a bus"
            )
        self._check_free(simulation, world, told)
        free = ~self._is_used[world] & (self._told["kind"][world] == EXTERNAL_NONE)
        if not free.any():
            raise CapacityError(
                f"world {world}: all {self._most} places of population.external are in use; set "
                "it higher, or remove a vehicle and then call step"
            )
        slot = int(np.argmax(free))
        self._told[world, slot] = told
        return slot

    def pose(
        self,
        slot: int,
        x: float,
        y: float,
        heading: float,
        *,
        z: float | None = None,
        pitch: float | None = None,
        speed: float | None = None,
        world: int = 0,
    ) -> None:
        """Move a vehicle to a pose, which it reaches at the end of the next step.

        If a vehicle at 60 m/s could not reach the pose, the move is a jump: the vehicle leaves, and
        enters at the pose with a new id.

        Args:
            slot: result of `spawn`.
            x: position of its centre, in m.
            y: position of its centre, in m.
            heading: in rad, counter-clockwise from east.
            z: height of the ground below its centre, in m; None: height of the lane.
            pitch: in rad, positive uphill; None: the slope of the lane.
            speed: in m/s along its heading; None: the speed of the move.
            world: number of the world.

        Raises:
            ActionError: there is no such vehicle, the pose is outside of the map, or an argument
                is invalid.
            ConfigError: `population.external` is 0.
        """
        told = self._of(world, slot)
        given = told.copy()
        self._set_pose(given, (x, y, z, heading, pitch, speed))
        given["kind"] = EXTERNAL_POSED
        self._told[world, slot] = given

    def drive(self, slot: int, throttle_mps2: float, steering_rad: float, world: int = 0) -> None:
        """Drive a vehicle from the next step on, until the next command to it.

        It moves like an agent's vehicle, within the limits of `action` and of its type.

        Args:
            slot: result of `spawn`.
            throttle_mps2: acceleration; negative brakes, but does not reverse.
            steering_rad: angle of the front wheels, positive to the left.
            world: number of the world.

        Raises:
            ActionError: there is no such vehicle, or an argument is invalid.
            ConfigError: `population.external` is 0.
        """
        told = self._of(world, slot)
        for name, value in (("throttle_mps2", throttle_mps2), ("steering_rad", steering_rad)):
            _check_number(name, value)
        told["kind"] = EXTERNAL_DRIVEN
        told["throttle"], told["steering"] = throttle_mps2, steering_rad

    def remove(self, slot: int, world: int = 0) -> None:
        """Remove a vehicle in the next step; it does not count as arrived.

        Raises:
            ActionError: there is no such vehicle.
            ConfigError: `population.external` is 0.
        """
        told = self._of(world, slot)
        told.fill(np.zeros((), dtype=EXTERNAL))
        if self._is_used[world, slot]:
            told["kind"] = EXTERNAL_REMOVED

    def ids(self, world: int = 0) -> NDArray[np.int64]:
        """Return the vehicle id (E,) of each slot; -1: no vehicle, or it enters in the next step.

        Raises:
            ConfigError: `population.external` is 0.
        """
        self._check_world(world)
        ids: NDArray[np.int64] = self._present().external.ids[world, : self._most].copy()
        return ids

    def vehicles(self, world: int = 0) -> NDArray[np.void]:
        """Return the current external vehicles, VEHICLE (n,); `order` is the slot of each.

        Raises:
            ConfigError: `population.external` is 0.
        """
        self._check_world(world)
        rows = self._present().vehicles(world)
        is_own = (rows["driver"] == DRIVER_EXTERNAL) & (rows["order"] < self._most)
        found: NDArray[np.void] = rows[is_own].copy()
        return found

    def add_to(self, commands: Commands) -> Commands:
        """Return the commands with the waiting commands added; these are kept until `clear`."""
        return replace(commands, external=self._commands.copy()) if self._most else commands

    def clear(self) -> None:
        """Drop the waiting commands after the step that executed them."""
        if self._most:
            kind = self._told["kind"]
            self._is_used |= (kind == EXTERNAL_POSED) | (kind == EXTERNAL_DRIVEN)
            self._is_used &= kind != EXTERNAL_REMOVED
            self._commands[:] = 0.0

    def forget(self, chosen: NDArray[np.bool_]) -> None:
        """Begin an episode in the chosen worlds (W,)."""
        self._commands[chosen] = 0.0
        self._is_used[chosen] = False

    def _check_world(self, world: int) -> None:
        if not self._most:
            raise ConfigError(
                "these worlds have no external vehicles: set population.external to the number of "
                "vehicles that you want to pose or drive at the same time"
            )
        if not 0 <= world < len(self._is_used):
            raise ActionError(f"world {world}: must be from 0 to {len(self._is_used) - 1}")

    def _of(self, world: int, slot: int) -> np.void:
        """Return the waiting command of a vehicle, a view."""
        self._check_world(world)
        if 0 <= slot < self._most:
            told: np.void = self._told[world, slot]
            is_new = told["kind"] != EXTERNAL_NONE
            is_there = self._is_used[world, slot] or is_new
            if is_there and told["kind"] != EXTERNAL_REMOVED:
                return told
        raise ActionError(
            f"world {world}, external vehicle {slot}: there is no such vehicle; give a number that "
            "spawn has returned in this episode"
        )

    def _set_pose(
        self,
        told: np.void,
        pose: tuple[float, float, float | None, float, float | None, float | None],
    ) -> None:
        for name, value in zip(("x", "y", "z", "heading", "pitch", "speed"), pose, strict=True):
            if value is not None:
                _check_number(name, value)
            told[name] = math.nan if value is None else value
        if abs(told["speed"]) > MAX_SPEED_MPS:
            raise ActionError(
                f"speed = {told['speed']:g} m/s: must be from {-MAX_SPEED_MPS:g} to "
                f"{MAX_SPEED_MPS:g}"
            )
        min_x, min_y, max_x, max_y = self._network.extent_m
        inside_x = min_x - MARGIN_M <= told["x"] <= max_x + MARGIN_M
        if not (inside_x and min_y - MARGIN_M <= told["y"] <= max_y + MARGIN_M):
            raise ActionError(
                f"x = {told['x']:g}, y = {told['y']:g}: outside of the map; give a place at most "
                f"{MARGIN_M:g} m outside of x = {min_x:g} to {max_x:g}, y = {min_y:g} to {max_y:g}"
            )

    def _check_free(self, simulation: Simulation, world: int, told: np.void) -> None:
        """Raise an OccupiedPlaceError if another vehicle, present or waiting, covers the place."""
        rows = simulation.vehicles(world)
        leaves = self._told["kind"][world] == EXTERNAL_REMOVED
        leaving = simulation.external.ids[world, : self._most][leaves]
        reach_m = float(diagonals_m(simulation.types).max())
        near = np.maximum(np.abs(rows["x"] - told["x"]), np.abs(rows["y"] - told["y"])) <= reach_m
        others = [row for row in rows[near] if row["id"] not in leaving]
        is_new = ~self._is_used[world] & (self._told["kind"][world] != EXTERNAL_NONE)
        others += [self._row(entry) for entry in self._told[world, is_new]]
        own = self._row(told)
        for other in others:
            if abs(other["z"] - own["z"]) <= LEVEL_HEIGHT_M and _overlap(own, other):
                raise OccupiedPlaceError(
                    f"x = {told['x']:g}, y = {told['y']:g}: occupied by another vehicle; give a "
                    "free place"
                )

    @cached_property
    def _grid(self) -> LaneGrid:
        return lane_grid(self._network)

    def _row(self, told: np.void) -> np.void:
        """Return the VEHICLE record with which a vehicle enters."""
        row: np.void = blank_vehicle()[0]
        self._enter_at(self._network.arrays, self._grid, told, row)
        return row


def _check_number(name: str, value: float) -> None:
    """Raise an ActionError if a value is not finite, or so large that no state may contain it."""
    if not abs(value) <= LARGEST:
        raise ActionError(
            f"{name} = {value:g}: must be a finite number from {-LARGEST:g} to {LARGEST:g}"
        )


def _overlap(own: np.void, other: np.void) -> bool:
    """Return whether two bodies overlap, seen from above."""
    boxes = [
        (
            float(row["x"]),
            float(row["y"]),
            cosine(float(row["heading"])),
            sine(float(row["heading"])),
            0.5 * float(row["length"]),
            0.5 * float(row["width"]),
        )
        for row in (own, other)
    ]
    return bool(boxes_overlap(*boxes[0], *boxes[1]))
