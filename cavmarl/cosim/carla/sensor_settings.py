"""The attributes of an attached sensor, and its view of the world."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cavmarl.cosim.carla.call_arguments import CallRefused
from cavmarl.cosim.carla.carla_actors import PROP_TAG, CarlaActor
from cavmarl.cosim.carla.sensed_surroundings import Surroundings

if TYPE_CHECKING:
    from cavmarl.cosim.carla.carla_session import CarlaSession


class SensorSettings:
    """The attributes of a sensor as numbers. Raises CallRefused for other values.

    `order`: number of earlier sensors in the episode, which selects the random numbers.
    """

    def __init__(self, actor: CarlaActor, order: int) -> None:
        self._actor, self._order = actor, order

    def number(self, name: str, low: float = -math.inf, high: float = math.inf) -> float:
        written = self._actor.attribute(name)
        try:
            value = float(written)
        except ValueError:
            value = math.nan
        if not (low <= value <= high and math.isfinite(value)):
            raise CallRefused(
                f"{self._actor.type_id}: {name} = {written!r}: must be a number from {low:g} to "
                f"{high:g}"
            )
        return value

    def whole(self, name: str, low: int, high: int) -> int:
        return int(self.number(name, low, high))

    def generator(self) -> np.random.Generator:
        """Return the random numbers of a sensor, which are the same in each episode."""
        seed = self.whole("noise_seed", 0, 1 << 31)
        return np.random.default_rng([seed, self._order])


class SensorContext:
    """The world of a session, for its sensors."""

    def __init__(self, session: CarlaSession) -> None:
        self.session = session
        self._surroundings: Surroundings | None = None

    @property
    def surroundings(self) -> Surroundings:
        """The view of the current world."""
        world = self.session.world
        if self._surroundings is None or self._surroundings.world is not world:
            self._surroundings = Surroundings(world)
        return self._surroundings

    def carrier_of(self, actor: CarlaActor) -> int:
        """Return the id of the vehicle that an actor is attached to, or -1."""
        parent = self.session.actors.actors.get(actor.parent)
        return -1 if parent is None else parent.vehicle

    def hidden_carrier_of(self, actor: CarlaActor) -> int:
        """Return the id of the vehicle that a camera in or above it does not show, or -1."""
        parent = self.session.actors.actors.get(actor.parent)
        if parent is None or actor.local is None:
            return -1
        apart = np.abs(actor.local.place[:2])
        return parent.vehicle if (apart <= parent.half_m[:2]).all() else -1

    def numbers_of(self, vehicles: NDArray[np.int64]) -> NDArray[np.uint32]:
        """Return the actor number (n,) of each vehicle id (n,); 0: no actor."""
        ids, places = np.unique(vehicles, return_inverse=True)
        actors = [self.session.actors.of_vehicle(one) for one in ids.tolist()]
        numbers = [0 if actor is None else actor.number for actor in actors]
        found: NDArray[np.uint32] = np.array(numbers, np.uint32)[places]
        return found

    def tagged(self, tags: NDArray[np.uint8], vehicles: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Return tags (n,) of vehicles (n,), with props' tags replaced by `PROP_TAG`."""
        props = self.session.actors.props
        if not props.size:
            return tags
        return np.where(np.isin(vehicles, props), np.uint8(PROP_TAG), tags)

    def velocities_of(self, vehicles: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the velocity (n, 3) in m/s of each vehicle id (n,); zero: no actor."""
        ids, places = np.unique(vehicles, return_inverse=True)
        speeds = np.zeros((len(ids), 3))
        for row, vehicle in enumerate(ids.tolist()):
            actor = self.session.actors.of_vehicle(vehicle)
            state = None if actor is None else self.session.actors.state_of(actor)
            if state is not None:
                speeds[row] = state["velocity"]
        found: NDArray[np.float64] = speeds[places]
        return found
