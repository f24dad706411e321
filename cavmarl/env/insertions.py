"""Vehicles that a user adds to running worlds, kept until the next step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.core.errors import ActionError, CapacityError, ConfigError
from cavmarl.core.records.codes import INSERT_NONE, INSERT_VEHICLE
from cavmarl.roads.network import CARS, RoadNetwork
from cavmarl.shards.shard import Commands

INSERTED = "inserted"  # kind of a frame event

Asked = tuple[tuple[str, str], ...]
"""Kind and detail of the insertions into a world in one step, in the form of `WorldFrame.asked`."""


class Insertions:
    """Vehicles to insert into W worlds: at most `population.insertions` per world and episode.

    Args:
        config: configuration of the worlds.
        network: map of the worlds.
        num_worlds: number of worlds, W.
    """

    def __init__(self, config: EnvConfig, network: RoadNetwork, num_worlds: int) -> None:
        self._most = config.population.insertions
        self._network = network
        self._lanes = {name: k for k, name in enumerate(network.lane_ids)} if self._most else {}
        self._rows = np.zeros((num_worlds, self._most, 3))
        self._waiting = np.zeros(num_worlds, dtype=np.int64)
        self._used = np.zeros(num_worlds, dtype=np.int64)  # in the episode, waiting ones included
        self._last: list[Asked] = [()] * num_worlds  # insertions of the last step

    @property
    def memory(self) -> tuple[NDArray[Any], ...]:
        """Waiting insertions, their number, and the number in the episode."""
        return self._rows, self._waiting, self._used

    @memory.setter
    def memory(self, memory: tuple[NDArray[Any], ...]) -> None:
        self._rows[:], self._waiting[:], self._used[:] = memory

    def wrong(self, memory: Sequence[NDArray[Any]]) -> str:
        """Return what is wrong with a loaded `memory`; empty if it is valid."""
        rows, waiting, used = memory
        if ((waiting < 0) | (waiting > used) | (used > self._most)).any():
            return "the number of insertions is out of range"
        is_waiting = np.arange(self._most) < waiting[:, np.newaxis]
        if (rows[~is_waiting] != (INSERT_NONE, INSERT_NONE, INSERT_NONE)).any():
            return "an unused row of insertions is not empty"
        return wrong_insertions(rows[is_waiting], self._network.lanes)

    def vehicle(self, world: int, lane: str, position_m: float) -> None:
        """Let a car enter on a lane, with its front bumper at a given position.

        Raises:
            ActionError: there is no such world, lane or position, or cars may not drive there.
            CapacityError: the episode already has all insertions that are allowed.
            ConfigError: these worlds allow no insertions.
        """
        row = self._lane(world, lane)
        length_m = float(self._network.lanes["length_m"][row])
        if not 0.0 <= position_m <= length_m:
            raise ActionError(
                f"position_m = {position_m:g}: lane {lane} is {length_m:.1f} m long; give a "
                "position on it"
            )
        self._add(world, [(INSERT_VEHICLE, row, position_m)])

    def _check(self, world: int) -> None:
        if not self._most:
            raise ConfigError(
                "these worlds allow no insertions: set population.insertions to the number of "
                "vehicles that may be inserted in an episode"
            )
        if not 0 <= world < len(self._used):
            raise ActionError(f"world {world}: must be from 0 to {len(self._used) - 1}")

    def _lane(self, world: int, lane: str) -> int:
        self._check(world)
        row, lanes = self._lanes.get(lane, -1), self._network.lanes
        if row < 0:
            raise ActionError(f"lane {lane!r}: the map has no such lane; give the id of one")
        if lanes["internal"][row] or not lanes["permissions"][row] & CARS:
            raise ActionError(f"lane {lane!r}: cars cannot enter there; give a car lane of a road")
        return row

    def _add(self, world: int, rows: list[tuple[int, int, float]]) -> None:
        used, waiting = int(self._used[world]), int(self._waiting[world])
        if used + len(rows) > self._most:
            raise CapacityError(
                f"world {world}: cannot insert {len(rows)} more, because population.insertions = "
                f"{self._most} and {used} are used in this episode; increase "
                "population.insertions, or reset"
            )
        self._rows[world, waiting : waiting + len(rows)] = rows
        self._waiting[world] += len(rows)
        self._used[world] += len(rows)

    def add_to(self, commands: Commands) -> Commands:
        """Return the commands with the waiting insertions, which are kept until `clear`."""
        return replace(commands, inserted=self._rows.copy()) if self._most else commands

    def clear(self) -> None:
        """Drop the waiting insertions after the step that executed them."""
        if self._most:
            self._last = [self._texts(w, count) for w, count in enumerate(self._waiting.tolist())]
            self._rows[:] = INSERT_NONE
            self._waiting[:] = 0

    def _texts(self, world: int, count: int) -> Asked:
        """Return the waiting insertions as kind and text, for `WorldFrame.asked`."""
        ids = self._network.lane_ids
        rows = self._rows[world, :count].tolist()
        return tuple((INSERTED, f"{ids[int(lane)]} {place!r}") for _, lane, place in rows)

    def last(self, world: int) -> Asked:
        """Return the insertions into a world in the last step."""
        return self._last[world]

    def forget(self, chosen: NDArray[np.bool_]) -> None:
        """Begin an episode in the chosen worlds (W,)."""
        self._used[chosen] = 0
        self._rows[chosen] = INSERT_NONE
        self._waiting[chosen] = 0
        for world in np.flatnonzero(chosen).tolist():
            self._last[world] = ()


def wrong_insertions(rows: NDArray[np.float64], lanes: NDArray[np.void]) -> str:
    """Return what is wrong with insertions; empty if they are valid.

    `rows`: (n, 3) used rows of `Commands.inserted`. `lanes`: LANE (L,) of the map.
    """
    kind, lane, position_m = rows.T
    if not (kind == INSERT_VEHICLE).all():
        return "an insertion has an unknown kind"
    if not np.isin(lane, np.arange(len(lanes))).all():
        return "an insertion is on a lane that does not exist"
    if not ((position_m >= 0.0) & (position_m <= lanes["length_m"][lane.astype(int)])).all():
        return "an insertion is before the start or beyond the end of its lane"
    return ""
