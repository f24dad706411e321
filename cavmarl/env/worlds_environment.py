"""`WorldsEnvironment`: the methods that all environments have, each of which asks the session."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from gymnasium import logger
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.world_frame import WorldFrame
from cavmarl.env.recorded_worlds import Record
from cavmarl.env.step_session import StepSession
from cavmarl.env.world_copies import OwnWorlds
from cavmarl.parallel.worlds.step_arrays import SteppedWorlds
from cavmarl.roads.network import RoadNetwork


class WorldsEnvironment(OwnWorlds):
    """Base of the environments: what can be done with their worlds, whatever form results have.

    Args:
        session: the worlds that it steps.
        render_mode: `human`, `rgb_array` or None.

    Attributes:
        metadata: with `name` and `render_fps`.
        render_mode: `human`, `rgb_array` or None.
        possible_agents: ids of the agents of a world.
    """

    def __init__(self, session: StepSession, render_mode: str | None) -> None:
        config = session.config
        self._session = session
        self.render_mode = render_mode
        self.possible_agents = list(session.agents)
        self.metadata: dict[str, Any] = {
            "name": f"cavmarl/{config.name}-v{config.version}",
            "render_fps": max(1, round(1.0 / config.clock.ctrl_dt_s)),
        }

    @property
    def worlds(self) -> SteppedWorlds:
        """The worlds that it steps."""
        return self._session.worlds

    @worlds.setter
    def worlds(self, worlds: SteppedWorlds) -> None:
        self._session.worlds = worlds

    @property
    def config(self) -> EnvConfig:
        """What the worlds are made of."""
        return self._session.config

    @property
    def network(self) -> RoadNetwork:
        """The roads of the worlds."""
        return self._session.worlds.world.network

    @property
    def simulation(self) -> Simulation:
        """The worlds behind this view, for tools that draw or measure them.

        Raises:
            ConfigError: they live in worker processes.
        """
        return self._session.worlds.simulation

    @property
    def step_s(self) -> float:
        """Seconds a step."""
        return self.config.clock.ctrl_dt_s

    @property
    def is_ready(self) -> bool:
        """Whether there is a present moment: `reset` has been called."""
        return self._session.is_ready

    def insert_vehicle(self, lane: str, position_m: float, world: int = 0) -> None:
        """Let a car enter a world in the next step, or as soon as there is a safe gap.

        It counts in `population.insertions`, drives to a goal of the generator's and is one of its
        vehicles from then on.

        Args:
            lane: id of a lane of a road.
            position_m: on it, of the front bumper.
            world: its number.

        Raises:
            ActionError: no such lane or place, or cars may not drive there.
            CapacityError: as many have been put there in this episode as may be.
            ConfigError: `population.insertions` is 0.
        """
        self._session.insertions.vehicle(world, lane, position_m)

    def close_road(self, edge: str, world: int = 0) -> None:
        """Close a road from the next step on, until it is opened or the episode is over.

        On each of its lanes a car stands at its beginning, as soon as there is a safe gap; each
        counts in `population.insertions`. Others wait behind them, or go round where they can.

        Args:
            edge: id of a road.
            world: its number.

        Raises:
            ActionError: as of `insert_vehicle`, or it is closed already.
            CapacityError, ConfigError: as of `insert_vehicle`.
        """
        self._session.insertions.barrier(world, edge)

    def open_road(self, edge: str, world: int = 0) -> None:
        """Open a road that was closed: from the next step on the cars there drive on.

        They go to a goal of the generator's, as others that were put there; they still count in
        `population.insertions`.

        Args:
            edge: id of a road.
            world: its number.

        Raises:
            ActionError: no such road, or it is not closed.
            ConfigError: `population.insertions` is 0.
        """
        self._session.insertions.no_barrier(world, edge)

    def closed_roads(self, world: int = 0) -> tuple[str, ...]:
        """Ids of the roads that `close_road` has closed, also from the next step on."""
        return self._session.insertions.closed(world)

    def world_frames(self, chosen: Sequence[int] = (0,), ghosts: bool = False) -> list[WorldFrame]:
        """What is to be seen of some worlds now, as data; see `engine.world_frame.WorldFrame`.

        Where worlds live in other processes, all of them are copied from there.

        Args:
            chosen: numbers of worlds.
            ghosts: whether to tell what each zone sees of the others' vehicles.

        Raises:
            ConfigError: no such world, or one whose state cannot be had here.
            EpisodeError: before the first reset.
        """
        return self._session.frames(chosen, ghosts)

    def way_ahead(self, vehicle: int, world: int = 0) -> NDArray[np.float64]:
        """Points (n, 2) in m of the way of a vehicle, as of the last `world_frames`.

        Raises:
            EpisodeError: before the first reset.
        """
        return self._session.way_ahead(vehicle, world)

    def watch(self, look: Callable[[], None]) -> Callable[[], None]:
        """Have a function called after each reset and step; returns what ends that."""
        return self._session.watch(look)

    def record(self, record: Record | None) -> None:
        """Record all worlds from the next reset or step on, until `close`.

        See docs/guides/recordings.md.

        Args:
            record: a new folder, or that and what else is recorded; None: record nothing.

        Raises:
            ConfigError: something else is wanted that there is not.
            EpisodeError: a recording has begun already.
            RecordingError: there is something at `path`, or it cannot be written.
            MissingExtraError: pyarrow is not installed.
        """
        self._session.record(record)

    def _picture(self, world: int, ghosts_of: int | None = None) -> NDArray[np.uint8] | None:
        """Draw a world; None and a warning without a render_mode, as Gymnasium has it."""
        if self.render_mode is None:
            logger.warn(
                "render() without a render_mode shows nothing: make the environment with "
                "render_mode='rgb_array'"
            )
            return None
        name, fps = self.metadata["name"], self.metadata["render_fps"]
        return self._session.picture(world, ghosts_of, self.render_mode, name, fps)
