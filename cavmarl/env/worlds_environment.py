"""`WorldsEnvironment`: the methods that all environments share; they call the session."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from gymnasium import logger
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.core.errors import ConfigError
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.world_frame import WorldFrame
from cavmarl.env.external_commands import ExternalCommands
from cavmarl.env.limit_agents import LimitAgents
from cavmarl.env.overridden_signals import SignalOverrides
from cavmarl.env.recorded_worlds import Record
from cavmarl.env.roadside_agents import RoadsideAgents
from cavmarl.env.signal_agents import SignalAgents
from cavmarl.env.step_session import StepSession
from cavmarl.env.world_copies import OwnWorlds
from cavmarl.parallel.worlds.step_arrays import SteppedWorlds
from cavmarl.roads.network import RoadNetwork


class WorldsEnvironment(OwnWorlds):
    """Base class of the environments: all methods that do not depend on the form of the results.

    Args:
        session: the session with the worlds to step.
        render_mode: `human`, `rgb_array` or None.

    Attributes:
        metadata: has `name` and `render_fps`.
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
        """The worlds that this environment steps."""
        return self._session.worlds

    @worlds.setter
    def worlds(self, worlds: SteppedWorlds) -> None:
        self._session.worlds = worlds

    @property
    def config(self) -> EnvConfig:
        """The configuration of the worlds."""
        return self._session.config

    @property
    def network(self) -> RoadNetwork:
        """The road network of the worlds."""
        return self._session.worlds.world.network

    @property
    def simulation(self) -> Simulation:
        """The worlds behind this environment, for tools that draw or measure them.

        Raises:
            ConfigError: the worlds run in worker processes.
        """
        return self._session.worlds.simulation

    @property
    def present(self) -> Simulation:
        """The worlds as they are now, for tools; if other processes run them, a copy.

        Raises:
            ConfigError: their state is not available in this process.
            EpisodeError: before the first reset.
        """
        return self._session.shown()

    @property
    def step_s(self) -> float:
        """Duration of a step in seconds."""
        return self.config.clock.ctrl_dt_s

    @property
    def is_ready(self) -> bool:
        """Whether `reset` has been called, so that the worlds have a state."""
        return self._session.is_ready

    @property
    def external(self) -> ExternalCommands:
        """The vehicles that the caller poses or drives; see `population.external`.

        Raises:
            EpisodeError: before the first reset.
        """
        self._session.refuse_idle("external")
        return self._session.external

    @property
    def signal_overrides(self) -> SignalOverrides:
        """The signals that show the caller's states; see `signals.overrides`.

        Raises:
            EpisodeError: before the first reset.
        """
        self._session.refuse_idle("signal_overrides")
        return self._session.overrides

    @property
    def signals(self) -> SignalAgents:
        """The agents of signals; see docs/reference/signal_agents.md.

        Raises:
            ConfigError: `signals.agents` is none.
        """
        if not isinstance(self._session.controlled, SignalAgents):
            raise ConfigError(
                "signals.agents = none: set it to all, or to a list of ids of signals"
            )
        return self._session.controlled

    @property
    def limits(self) -> LimitAgents:
        """The agents of speed limits; see docs/reference/limit_agents.md.

        Raises:
            ConfigError: `limits.agents` is none.
        """
        if not isinstance(self._session.controlled, LimitAgents):
            raise ConfigError("limits.agents = none: set it to all, or to names of limits.units")
        return self._session.controlled

    @property
    def roadside(self) -> RoadsideAgents | None:
        """The agents of signals or of speed limits; None: there are none."""
        return self._session.roadside

    def insert_vehicle(self, lane: str, position_m: float, world: int = 0) -> None:
        """Let a car enter a world in the next step, or as soon as there is a safe gap.

        The car counts towards `population.insertions`. It gets a goal from the generator, and is
        then one of the generator's vehicles.

        Args:
            lane: id of a lane of a road.
            position_m: position of the front bumper on the lane, in m.
            world: number of the world.

        Raises:
            ActionError: there is no such lane or position, or cars may not drive there.
            CapacityError: the episode already has all insertions that are allowed.
            ConfigError: `population.insertions` is 0.
        """
        self._session.insertions.vehicle(world, lane, position_m)

    def close_road(
        self,
        edge: str,
        lanes: Sequence[int] | None = None,
        world: int = 0,
        shuts_in: bool = False,
        contraflow: bool = False,
    ) -> None:
        """Close lanes of a road, until they are opened or the episode is over.

        From the next step on, no vehicle enters the lanes, except vehicles that cannot stop in
        time. Vehicles on the lanes leave them. Vehicles that may change their route
        (`population.reroute`) do so within a second. Vehicles without another route wait before the
        closed lanes, and vehicles that are to depart on these lanes wait in the queue. Each lane
        counts towards `map.changed_lanes`.

        Args:
            edge: id of a road.
            lanes: indices of its lanes, from the kerb; None: all of them.
            world: number of the world.
            shuts_in: whether to close the road even if it is the last way out of other roads.
            contraflow: whether to reverse the road: its lanes open in the opposite direction after
                10 s or more, as soon as no vehicle is on it. Lanes count in both directions.

        Raises:
            ActionError: there is no such world, road or lane; the road is the last way out; or
                `contraflow` is set, but the road is not in `map.contraflow`, or lanes are left out.
            CapacityError: more than `map.changed_lanes` lanes would differ from the map.
            ConfigError: `map.changed_lanes` is 0.
        """
        if contraflow:
            self._session.lane_changes.reverse(world, edge, lanes, shuts_in)
            return
        self._session.lane_changes.close(world, edge, lanes, shuts_in=shuts_in)

    def open_road(self, edge: str, lanes: Sequence[int] | None = None, world: int = 0) -> None:
        """Restore lanes of a closed, damaged or reversed road to their state on the map.

        Vehicles that wait for these lanes drive on from the next step on. A reversed road opens
        with all its lanes, once its contraflow lanes are closed and empty.

        Args:
            edge: id of a road.
            lanes: indices of its lanes, from the kerb; None: all of them.
            world: number of the world.

        Raises:
            ActionError: there is no such world, road or lane, or no lane of it has changed.
            ConfigError: `map.changed_lanes` is 0.
        """
        self._session.lane_changes.open(world, edge, lanes)

    def damage_road(
        self, edge: str, speed_mps: float, lanes: Sequence[int] | None = None, world: int = 0
    ) -> None:
        """Lower the speed limit of lanes of a road, until it is opened or the episode is over.

        From the next step on, drivers, sensors and rewards use the new limit. Each lane counts
        towards `map.changed_lanes`.

        Args:
            edge: id of a road.
            speed_mps: the limit in m/s, above 0 and at most the map's limit, which ends an earlier
                change.
            lanes: indices of its lanes, from the kerb; None: all of them.
            world: number of the world.

        Raises:
            ActionError: there is no such world, road or lane, or the limit is out of range.
            CapacityError: more than `map.changed_lanes` lanes would differ from the map.
            ConfigError: `map.changed_lanes` is 0.
        """
        self._session.lane_changes.limit(world, edge, speed_mps, lanes)

    def closed_roads(self, world: int = 0) -> tuple[str, ...]:
        """Return the ids of roads with a closed lane, including roads that close in the next step.

        Raises:
            ActionError: there is no such world.
            ConfigError: `map.changed_lanes` is 0.
        """
        return self._session.lane_changes.closed(world)

    def deadlocks(self, world: int = 0) -> tuple[tuple[int, ...], ...]:
        """Return the cycles of vehicle ids in which each vehicle waits for the next.

        All vehicles of a cycle have been stopped for at least 10 s; see `engine.waiting_cycles`.

        Raises:
            ConfigError: there is no such world, or its state is not available in this process.
            EpisodeError: before the first reset.
        """
        return self._session.deadlocks(world)

    def world_frames(self, chosen: Sequence[int] = (0,), ghosts: bool = False) -> list[WorldFrame]:
        """Return the visible state of some worlds now; see `engine.world_frame.WorldFrame`.

        If the worlds run in other processes, all of them are copied from there.

        Args:
            chosen: numbers of the worlds.
            ghosts: whether frames include each zone's ghosts of other zones' vehicles.

        Raises:
            ConfigError: there is no such world, or its state is not available in this process.
            EpisodeError: before the first reset.
        """
        return self._session.frames(chosen, ghosts)

    def way_ahead(self, vehicle: int, world: int = 0) -> NDArray[np.float64]:
        """Return points (n, 2) in m along the path of a vehicle, as in the last `world_frames`.

        Raises:
            EpisodeError: before the first reset.
        """
        return self._session.way_ahead(vehicle, world)

    def watch(self, watcher: Callable[[], None]) -> Callable[[], None]:
        """Call a function after each reset and step; return a function that stops this."""
        return self._session.watch(watcher)

    def record(self, record: Record | None) -> None:
        """Record all worlds from the next reset or step on, until `record(None)` or `close`.

        See docs/guides/recordings.md.

        Args:
            record: a new folder, or options with the optional tables; None: end the recording.

        Raises:
            ConfigError: a requested table is not available.
            EpisodeError: the worlds are being recorded already.
            RecordingError: the path exists already, or it cannot be written.
            MissingExtraError: pyarrow is not installed.
        """
        self._session.record(record)

    def _picture(self, world: int, ghosts_of: int | None = None) -> NDArray[np.uint8] | None:
        """Draw a world; without a render_mode, warn and return None, as Gymnasium does."""
        if self.render_mode is None:
            logger.warn(
                "render() without a render_mode shows nothing: make the environment with "
                "render_mode='rgb_array'"
            )
            return None
        name, fps = self.metadata["name"], self.metadata["render_fps"]
        return self._session.picture(world, ghosts_of, self.render_mode, name, fps)
