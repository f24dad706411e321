"""`ExternalAgents`: external vehicles that observe, as agents of a PettingZoo environment.

They carry the sensors of `rig`. Samples are computed from the whole world after each step, with the
kernels of the agents' sensors, so samples do not depend on zones, workers or nodes. For this, a
copy of the rows is used in which the observing external vehicles are the only agents.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.config.population import PopulationConfig
from cavmarl.core.errors import ActionError, ConfigError
from cavmarl.core.math.neighbors import make_grid
from cavmarl.core.records.codes import DRIVER_AGENT, DRIVER_BACKGROUND, DRIVER_EXTERNAL
from cavmarl.driving.vehicle_types import agent_types
from cavmarl.driving.vehicles import VEHICLE
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.spaces import frames_space
from cavmarl.env.step_session import StepSession
from cavmarl.sensors.mounted.backdrop import make_backdrop
from cavmarl.sensors.mounted.frames import Frames, SensorFrames
from cavmarl.sensors.mounted.mounted_sensor import Platform, SensedScene
from cavmarl.sensors.mounted.sensor_rig import Rig
from cavmarl.sensors.registry import frame_layout, frames_in

_CELL_M = 32.0
_PREFIX = "external_"


def external_id(slot: int) -> str:
    """Return PettingZoo's id of the external vehicle of a slot."""
    return f"{_PREFIX}{slot}"


class ExternalAgents:
    """The observing external vehicles of one world.

    Args:
        session: the session of one world; `population.external_agents` is true.

    Attributes:
        ids: PettingZoo's ids of all slots (E,).
        shown: ids of the agents in the world after the last step.
    """

    def __init__(self, session: StepSession) -> None:
        config = self._config = session.config
        num_slots = config.population.external
        self._session = session
        self.ids = tuple(map(external_id, range(num_slots)))
        self._slot_of = {agent: slot for slot, agent in enumerate(self.ids)}
        self._vehicles = np.full((1, num_slots), -1, dtype=np.int64)
        self.frames: Frames = frames_in(
            {
                name: np.zeros((1, num_slots, *shape[2:]), dtype=kind)
                for name, (kind, shape) in frame_layout(config, 1).items()
            }
        )
        self.shown: list[str] = []
        self._sensing: _Sensing | None = None

    def __contains__(self, agent: object) -> bool:
        return agent in self._slot_of

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_sensing": None}

    def observation_spaces(self) -> dict[str, spaces.Space[Any]]:
        """Return the space of each agent's observation: a Dict with a Box for each sensor."""
        return dict.fromkeys(self.ids, frames_space(self._config))

    def action_spaces(self) -> dict[str, spaces.Space[Any]]:
        """Return the space of each agent's action: throttle and steering."""
        return dict.fromkeys(self.ids, spaces.Box(-1.0, 1.0, (2,), np.float32))

    def check(self, agent: str, action: Any) -> None:
        """Raise the ActionError of an action that is not two numbers in [-1, 1]."""
        try:
            given = np.asarray(action)
        except ValueError:  # nested lists of different lengths
            given = np.zeros(0)
        is_number = given.dtype.kind in "fiu" and given.shape == (2,)
        if not is_number or not (np.abs(given) <= 1.0).all():
            raise ActionError(
                f"{agent}: the action is {str(action)[:80]}: must be two numbers from -1 to 1, "
                "throttle and steering"
            )

    def check_all(self, actions: Mapping[str, Any]) -> None:
        """Check the actions of a step.

        Raises:
            ActionError: an agent is not in the world, or an action is invalid.
        """
        for agent, action in actions.items():
            if agent not in self.shown:
                raise ActionError(f"{agent}: is not in the world; give an id of env.agents")
            self.check(agent, action)

    def drive(self, actions: Mapping[str, Any]) -> None:
        """Drive the agents that have an action; the others keep their last command."""
        scale = self._config.action.acceleration_mps2, self._config.action.steering_rad
        for agent, action in actions.items():
            throttle, steering = (float(number) for number in action)
            self._session.external.drive(
                self._slot_of[agent], throttle * scale[0], steering * scale[1]
            )

    def prepare(self) -> None:
        """Store the poses before the first step of a copied environment.

        Otherwise, do nothing: `reset` and `sense` have stored the poses before the next step.
        """
        if self._sensing is None:
            self._sense_with(self._session.present()).rig.begin(self._scenes())

    def reset(self) -> None:
        """Begin an episode, in which there are no external vehicles yet."""
        self._vehicles[:] = -1
        for frames in self.frames.values():
            for array in frames:
                array[...] = 0
        self.shown = []
        sensing = self._sense_with(self._session.present())
        sensing.rig.reset(self._scenes(), np.ones(1, dtype=np.bool_))
        sensing.rig.begin(self._scenes())

    def sense(self) -> None:
        """Take the samples that are due at the end of a step."""
        sensing = self._sense_with(self._session.present())
        scenes = self._scenes()
        sensing.rig.end(scenes)
        sensing.rig.begin(scenes)
        self.shown = [self.ids[slot] for slot in np.flatnonzero(self._vehicles[0] >= 0).tolist()]

    def observations(self, agents: Iterable[str]) -> dict[str, dict[str, NDArray[Any]]]:
        """Return a copy of the latest samples of agents."""
        found = {}
        for agent in agents:
            slot = self._slot_of[agent]
            data = {name: frames.data[0, slot] for name, frames in self.frames.items()}
            found[agent] = {
                name: (array if len(array) > 1 else array[0]).copy() for name, array in data.items()
            }
        return found

    def infos(self, agents: Iterable[str]) -> dict[str, dict[str, Any]]:
        """Return the info of agents: `active` and `vehicle_id`."""
        ids = self._vehicles[0].tolist()
        return {
            agent: {
                "active": float(ids[self._slot_of[agent]] >= 0),
                "vehicle_id": ids[self._slot_of[agent]],
            }
            for agent in agents
        }

    def frames_of(self, slot: int) -> dict[str, SensorFrames]:
        """Return the samples of the last step of the vehicle in a slot, by sensor."""
        return {name: frames.of(0, slot) for name, frames in self.frames.items()}

    def _sense_with(self, simulation: Simulation) -> _Sensing:
        if self._sensing is None:
            self._sensing = _Sensing(self._config, simulation)
            self._sensing.rig = Rig(
                self._config.rig, self._sensing.platform, self.frames, self._vehicles
            )
        self._sensing.simulation = simulation
        return self._sensing

    def _scenes(self) -> list[SensedScene]:
        assert self._sensing is not None
        return [self._sensing.scene()]


class _Sensing:
    """The rig of the external vehicles, and the scene that they sense."""

    rig: Rig

    def __init__(self, config: EnvConfig, simulation: Simulation) -> None:
        network = simulation.network
        capacity, slots = simulation.capacity, config.population.external
        self.simulation = simulation
        self.platform = Platform(
            network=network,
            bodies=agent_types(["car"] * slots),
            population=PopulationConfig(mode="closed", agents=slots, background=0),
            num_worlds=1,
            num_agents=slots,
            sim_dt_s=config.clock.sim_dt_s,
            ticks_per_step=config.clock.ticks_per_step,
            capacity=capacity,
            backdrop=make_backdrop(network, simulation.types),
        )
        self._grid = make_grid(network.extent_m, _CELL_M, capacity)
        self._rows = np.zeros((1, capacity), dtype=VEHICLE)

    def scene(self) -> SensedScene:
        """Return the current scene, in which only observing external vehicles are agents."""
        simulation = self.simulation
        present = simulation.vehicles(0)
        count = len(present)
        rows = self._rows[0]
        rows[:count] = present[np.argsort(present["id"])]
        own = rows[:count]
        is_external = own["driver"] == DRIVER_EXTERNAL
        observes = np.zeros(count, dtype=np.bool_)
        slots = own["order"][is_external]
        observes[is_external] = simulation.external.held[0]["observes"][slots] > 0.0
        own["driver"][own["driver"] == DRIVER_AGENT] = DRIVER_BACKGROUND
        own["agent"] = np.where(observes, own["order"], -1)
        own["driver"][observes] = DRIVER_AGENT
        shard = simulation.shards[0]
        whole, num = simulation.worlds, np.array([count], dtype=np.int64)
        return SensedScene(
            roads=shard.roads,
            lane_grid=shard.lane_grid,
            plans=shard.plans,
            travel=shard.travel,
            worlds=whole._replace(
                rows=self._rows, next_rows=self._rows, num_owned=num, num_rows=num
            ),
            grid=self._grid,
            before=self.rig.before,
        )


def check_external_rig(config: EnvConfig, names: Iterable[str]) -> None:
    """Check the sensors that an external vehicle is to carry.

    Raises:
        ActionError: `rig` has no such sensor.
        ConfigError: external vehicles cannot observe in this world.
    """
    for name in names:
        if not config.population.external_agents:
            raise ConfigError(
                "external vehicles carry no sensors here: set population.external_agents = true"
            )
        if name not in config.rig:
            raise ActionError(
                f"no sensor '{name[:80]}'; the sensors of rig are {', '.join(config.rig)}"
            )
