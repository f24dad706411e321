"""`HostedWorld`: the environment behind a server, and the sources from which servers load worlds.

Only the time master of the environment advances it. The built-in driver drives the agents that no
client drives.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.config.registry import entries, load_config, resolve_maps
from cavmarl.config.world_spec import WorldSpec
from cavmarl.core.errors import ConfigError
from cavmarl.core.records.codes import EVENT_ARRIVED, EVENT_COLLIDED, EVENT_OFF_ROAD
from cavmarl.cosim.carla.carla_map import CarlaMap, make_carla_map
from cavmarl.cosim.carla.external_vehicles import ExternalVehicles
from cavmarl.cosim.carla.traffic_lights import TrafficLights
from cavmarl.cosim.carla.vehicle_controls import Control, action_of
from cavmarl.cosim.time_master import TimeMaster
from cavmarl.engine.world_setup import find_map
from cavmarl.env.drawn_worlds import vehicles_that_ended
from cavmarl.env.parallel import CavEnv, parallel_env
from cavmarl.maps.exports.opendrive import carla_document
from cavmarl.maps.exports.opendrive_carla import origin_of
from cavmarl.roads.sumo_net.reader import source_hash

if TYPE_CHECKING:
    from cavmarl.cosim.carla.carla_replay import CarlaReplay

GENERATED_MAP = "OpenDriveMap"  # name of the map that a client has sent
STEP_S = 0.05
_HORIZON_S = 100_000.0
_LONGEST_TICK_S = 0.1
_DIGITS = 6  # digits of a step length, which clients send as float32

# Values of a world that the command loads, unless the user gives other values.
SERVED_WORLD: dict[str, Any] = {
    "population.mode": "respawn",
    "action.kind": "continuous",
    "action.steering_rad": 1.2,  # the allowed maximum; full steer is a little more
    "action.acceleration_mps2": 8.0,
    "traffic.endless": True,  # a client's vehicle does not vanish at a goal
    "traffic.trip_horizon": 0.0,
    "population.external": 64,
    "signals.overrides": 10_000,
}


class EndedVehicle(NamedTuple):
    """An agent's vehicle that has left the world."""

    agent: int
    events: int  # EVENT_* bits: why it has left
    was_driven: bool  # whether a client drove the vehicle

    @property
    def has_collided(self) -> bool:
        return bool(self.events & EVENT_COLLIDED)

    @property
    def reason(self) -> str:
        if self.has_collided:
            return "it has collided"
        if self.events & EVENT_OFF_ROAD:
            return "it is off the road"
        return "it has reached its goal" if self.events & EVENT_ARRIVED else "its trip is over"


class HostedWorld:
    """One environment, its map, and its time master.

    Args:
        env: an undivided or divided world of this process, with continuous actions.
        carla_map: its map.
        seed: seed of the first episode, if the environment has not been reset.

    Attributes:
        controls: the clients' controls, by the index of the agent that they drive.
        external: the vehicles that clients have spawned.
        lights: the traffic lights.
        replay: a recording that is shown instead of the world, which is then paused.

    Raises:
        ConfigError: the actions are not continuous, or other processes run the world.
        ClockError: the environment has a time master.
    """

    def __init__(self, env: CavEnv, carla_map: CarlaMap, seed: int | None = None) -> None:
        if env.config.action.kind != "continuous":
            raise ConfigError(
                f"action.kind = {env.config.action.kind}: a client controls throttle and steering; "
                "set action.kind = continuous"
            )
        self.simulation = env.simulation
        self.env, self.map = env, carla_map
        self.controls: dict[int, Control] = {}
        self.external = ExternalVehicles(env)
        self.lights = TrafficLights(env, carla_map)
        self.replay: CarlaReplay | None = None
        self.master = TimeMaster(env)
        if not env.is_ready:
            self.master.reset(seed)

    @property
    def step_s(self) -> float:
        return self.env.step_s

    @property
    def rows(self) -> NDArray[np.void]:
        """VEHICLE (n,) of all vehicles now; the next step overwrites them."""
        return self.simulation.vehicles(0) if self.replay is None else self.replay.rows

    def light_states(self) -> NDArray[np.uint8]:
        """Return the state of each traffic light."""
        if self.replay is not None:
            return self.map.states_in(self.replay.signals)
        return self.lights.states()

    @property
    def present_lanes(self) -> NDArray[np.void]:
        """LANE (L,) as they are now, with limits that roadside units and callers have set."""
        # `lanes` has the map's table and, if lanes can change, then the table of the only world.
        lanes: NDArray[np.void] = self.simulation.shards[0].worlds.lanes[-1]
        return lanes

    def step(self, actions: Mapping[str, Any] | None = None) -> list[EndedVehicle]:
        """Advance the world by one step, or begin the next episode if the episode is over.

        `actions`: actions of agents that no client drives; None: actions of the built-in driver.

        Return the agents' vehicles that have left the world.
        """
        env = self.env
        if self.replay is not None:
            self.replay.advance(self.step_s)
            return []
        if not env.agents:
            self.reset()
            return []
        self.external.act()
        self.lights.advance(self.step_s)
        driven = self._driven()
        chosen = dict(driven)
        if len(driven) < len(env.agents):
            chosen = {**(env.suggest_actions() if actions is None else actions), **driven}
        self.master.step(chosen)
        self.lights.note(self.step_s)
        ended = vehicles_that_ended(env.worlds.arrays, 0)
        return [
            EndedVehicle(agent, events, self.controls.pop(agent, None) is not None)
            for agent, events in ended.tolist()
        ]

    def _driven(self) -> dict[str, NDArray[np.float32]]:
        """Return the actions of the agents that clients drive."""
        if not self.controls:
            return {}
        rows = self.rows
        present = set(self.env.agents)
        found = {}
        for row in np.flatnonzero(rows["agent"] >= 0).tolist():
            agent = int(rows["agent"][row])
            control = self.controls.get(agent)
            name = self.env.possible_agents[agent]
            if control is not None and name in present:
                wheelbase_m = float(self.simulation.types["wheelbase"][rows["vtype"][row]])
                found[name] = action_of(
                    control,
                    float(rows["speed"][row]),
                    wheelbase_m / float(rows["length"][row]),
                    self.env.config.action,
                )
        return found

    def reset(self) -> None:
        """Begin the next episode, without the vehicles of clients."""
        self.controls.clear()
        self.external.forget()
        self.lights.forget()
        self.master.reset()

    def release(self) -> None:
        """Release the environment, which keeps its state."""
        self.master.release()


class WorldSource(Protocol):
    """Loads the worlds of a server."""

    @property
    def map_names(self) -> list[str]:
        """Names of the maps that `load` accepts."""
        ...

    def load(self, name: str, step_s: float) -> HostedWorld:
        """Return a world at the start of an episode.

        Args:
            name: name of a map; empty: the current map.
            step_s: length of a step.

        Raises CavmarlError: there is no such map, or the world cannot have such steps.
        """
        ...

    def take_map(self, document: str) -> None:
        """Keep an OpenDRIVE document for `load(GENERATED_MAP)`; raise CavmarlError to refuse."""
        ...

    def close(self) -> None:
        """Close the worlds that this source has made."""
        ...


class GivenWorld:
    """The source of a server that has one world: the environment that the caller has made.

    `path`: the map file of the environment.
    """

    def __init__(self, env: CavEnv, path: Path) -> None:
        _refuse_signal_agents(env.config)
        if source_hash(path) != env.network.source_hash:
            raise ConfigError(f"{path}: not the map of {env.config.name}; name its map file")
        self._env = env
        self._map = _map_of(env, path, env.config.name)
        self._world: HostedWorld | None = None

    @property
    def map_names(self) -> list[str]:
        return [self._map.name]

    def load(self, name: str, step_s: float) -> HostedWorld:
        if name not in ("", self._map.name):
            raise ConfigError(f"Map '{name}' not found")
        if abs(step_s - self._env.step_s) > 10**-_DIGITS:
            raise ConfigError(
                f"fixed_delta_seconds = {step_s:g}: this world advances by {self._env.step_s:g} s; "
                f"use {self._env.step_s:g} or a multiple"
            )
        if self._world is None:
            self._world = HostedWorld(self._env, self._map)
        else:
            self._world.reset()
        return self._world

    def take_map(self, document: str) -> None:
        raise ConfigError("this server has one given world; start `cavmarl carla` to load maps")

    def close(self) -> None:
        if self._world is not None:
            self._world.release()


class LoadedWorlds:
    """The source of a server that loads environments by name.

    `spec`: the first world; its options also apply whenever a client loads its map again.
    """

    def __init__(self, spec: WorldSpec) -> None:
        self._first = self._spec = spec
        self._env: CavEnv | None = None
        self._folder: TemporaryDirectory[str] | None = None
        self._first_name = self._name = Path(spec.env).name.split(".")[0]
        self._file: Path | None = None

    @property
    def map_names(self) -> list[str]:
        single = (name for name in entries() if len(resolve_maps(*load_config(name))) == 1)
        return sorted({self._first_name, self._name, *single})

    def load(self, name: str, step_s: float) -> HostedWorld:
        spec, shown = self._spec, self._name
        if name == GENERATED_MAP and self._file is not None:
            spec, shown = replace(spec, env=str(self._file)), GENERATED_MAP
        elif name == self._first_name:
            spec, shown = self._first, name
        elif name not in ("", shown):
            if name not in entries():
                raise ConfigError(f"Map '{name}' not found")
            spec, shown = WorldSpec(env=name, seed=spec.seed), name
        tick_s = round(step_s, _DIGITS)
        ticks = max(1, -int(-tick_s // _LONGEST_TICK_S))
        config, _ = load_config(spec.env, overrides=spec.overrides)
        _refuse_signal_agents(config)
        if config.traffic.source == "sumo-traffic":
            served = {**SERVED_WORLD, "population.external": 0}  # SUMO would not see such vehicles
        else:
            served = SERVED_WORLD
        overrides = {
            **served,
            "horizon_s": tick_s * round(_HORIZON_S / tick_s),
            **spec.overrides,
            "clock.sim_dt_s": tick_s / ticks,
            "clock.ctrl_dt_s": tick_s,
        }
        keywords = {**spec.keywords, "overrides": overrides}
        env = parallel_env(spec.env, **keywords)
        try:
            world = HostedWorld(env, _map_of(env, find_map(spec.env), shown), spec.seed)
        except BaseException:
            env.close()
            raise
        self._close_env()
        self._env, self._spec, self._name = env, spec, shown
        return world

    def take_map(self, document: str) -> None:
        if self._folder is None:
            self._folder = TemporaryDirectory(prefix="cavmarl-carla-")
        file = Path(self._folder.name) / f"{GENERATED_MAP}.xodr"
        file.write_text(document, encoding="utf-8")
        find_map(file)  # converts the map, or refuses it
        self._file = file

    def close(self) -> None:
        self._close_env()
        if self._folder is not None:
            self._folder.cleanup()
            self._folder = None

    def _close_env(self) -> None:
        if self._env is not None:
            self._env.close()
            self._env = None


def _refuse_signal_agents(config: EnvConfig) -> None:
    if refusal := config.refusal_of_agents("a world for CARLA's clients"):
        raise ConfigError(refusal)


def _map_of(env: CavEnv, path: Path, name: str) -> CarlaMap:
    network = env.network
    return make_carla_map(network, name, carla_document(path, network), origin_of(network))
