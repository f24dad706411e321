"""`ClientActors`: the actors that clients and traces bring into the one world of an environment.

They are external vehicles (`population.external`), so drivers, sensors and contacts see them. An
actor enters with the next step, is moved by poses or controls, and leaves with its client.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cavmarl.core.errors import ActionError, CavmarlError
from cavmarl.cosim.actors.pose_track import PoseSample, PoseTrack
from cavmarl.env.external_agents import check_external_rig
from cavmarl.env.parallel import CavEnv

POSES, CONTROLS, NOTHING = MOVERS = ("poses", "controls", "nothing")
MOST_NAME = 80


@dataclass(frozen=True)
class ActorOrder:
    """An actor to bring into a world.

    Attributes:
        name: unique among the actors of its client.
        vtype: `car`, `truck`, `bus`, `pedestrian`, `cyclist`, `roadside_unit`, or a type of the
            world.
        x, y: position of the centre at the start, in m.
        heading: heading in rad, counter-clockwise from east.
        z: height of the ground below the centre, in m; None: the lane's height.
        size_m: length, width and height in m; None: the type's size.
        speed: speed at the start, in m/s.
        moved_by: `poses`, `controls`, or `nothing`: it does not move.
        rate_hz: rate of its poses; 0: unknown.
        extrapolation_s: largest time for which a pose is extrapolated.
        rig: names of the sensors that it carries; the world's key `rig` defines them.
    """

    name: str
    vtype: str
    x: float
    y: float
    heading: float
    z: float | None = None
    size_m: tuple[float, float, float] | None = None
    speed: float = 0.0
    moved_by: str = POSES
    rate_hz: float = 0.0
    extrapolation_s: float = 0.5
    rig: tuple[str, ...] = ()


@dataclass(eq=False)
class ClientActor:
    """An actor in a world.

    Attributes:
        client: name of the client or the trace.
        order: the actor that the client has requested.
        track: poses of the actor.
        slot: slot of the external vehicle; -1: not in the world.
    """

    client: str
    order: ActorOrder
    track: PoseTrack
    slot: int = -1
    controls: tuple[float, float] | None = None  # controls of the next step, in [-1, 1]

    @property
    def name(self) -> str:
        """The name that the client has given the actor."""
        return self.order.name

    def report(self) -> dict[str, Any]:
        """Return the actor's name, type and counts of poses, for a report."""
        return {
            "client": self.client,
            "name": self.name,
            "type": self.order.vtype,
            "moved_by": self.order.moved_by,
            **self.track.counts.to_dict(),
        }


class ClientActors:
    """The actors of one environment.

    Args:
        env: the environment.

    Attributes:
        reports: reports of the actors that have left.
    """

    def __init__(self, env: CavEnv) -> None:
        self._env = env
        self._actors: list[ClientActor] = []
        self.reports: list[dict[str, Any]] = []
        action = env.config.action
        self._scale = action.acceleration_mps2, action.steering_rad

    @property
    def actors(self) -> Sequence[ClientActor]:
        """The present actors, in the order of their arrival."""
        return tuple(self._actors)

    def join(self, client: str, orders: Iterable[ActorOrder]) -> list[ClientActor]:
        """Bring actors into the world with the next step, or with the first reset.

        If the world refuses one of the actors, none of them is added.

        Raises:
            ActionError: a name, type, place, size, rate or sensor is invalid, or the place is
                occupied.
            CapacityError: all `population.external` places are taken.
            ConfigError: `population.external` is 0, or the world has no sensors for actors.
        """
        came: list[ClientActor] = []
        try:
            for order in orders:
                if any(order.name == actor.name for actor in came):
                    raise ActionError(f"actor '{order.name}' is named twice; name each once")
                actor = ClientActor(client, order, self._checked(order))
                if self._env.is_ready:
                    self._enter(actor)
                came.append(actor)
        except CavmarlError:
            for actor in came:
                self._leave(actor)
            raise
        self._actors += came
        return came

    def part(self, actors: Iterable[ClientActor]) -> None:
        """Remove actors with the next step."""
        for actor in actors:
            if actor in self._actors:
                self._actors.remove(actor)
                self.reports.append(actor.report())
                self._leave(actor)

    def begin_episode(self) -> dict[ClientActor, CavmarlError]:
        """Bring all actors into the new episode, at the places where they began.

        Return the actors that the world refuses and therefore removes, with the reasons.
        """
        refused: dict[ClientActor, CavmarlError] = {}
        for actor in self.actors:
            actor.slot, actor.controls = -1, None
            actor.track.clear()
            try:
                self._enter(actor)
            except CavmarlError as error:
                refused[actor] = error
        self.part(refused)
        return refused

    def add_pose(self, actor: ClientActor, sample: PoseSample, now_s: float) -> None:
        """Add a pose of an actor.

        Raises:
            ActionError: the actor is not moved by poses, or the pose is invalid or in the future.
        """
        if actor.order.moved_by != POSES:
            raise ActionError(
                f"'{actor.name}' takes no poses, because it is moved by {actor.order.moved_by}; "
                "request the actor with moved_by = poses"
            )
        actor.track.add(sample, now_s, self._env.step_s)

    def drive(self, actor: ClientActor, controls: Any) -> None:
        """Drive an actor from the next step on.

        Args:
            actor: an actor that is moved by controls.
            controls: throttle and steering in [-1, 1], scaled as the controls of agents.

        Raises:
            ActionError: the actor is not moved by controls, or the controls are not two numbers.
        """
        if actor.order.moved_by != CONTROLS:
            raise ActionError(
                f"'{actor.name}' takes no controls, because it is moved by {actor.order.moved_by}; "
                "request the actor with moved_by = controls"
            )
        given = np.asarray(controls, dtype=np.float64)
        if given.shape != (2,) or not (np.abs(given) <= 1.0).all():
            raise ActionError(
                f"controls of '{actor.name}' are {str(controls)[:MOST_NAME]}: must be two numbers "
                "from -1 to 1, throttle and steering"
            )
        actor.controls = float(given[0]), float(given[1])

    def act(self, now_s: float) -> dict[ClientActor, ActionError]:
        """Give the commands for the next step to the environment.

        Return the actors whose poses lead out of the map, with the reasons.
        """
        end_s = now_s + self._env.step_s
        refused: dict[ClientActor, ActionError] = {}
        for actor in self._actors:
            if actor.controls is not None:
                throttle, steering = actor.controls
                self._env.external.drive(
                    actor.slot, throttle * self._scale[0], steering * self._scale[1]
                )
                actor.controls = None
            pose = actor.track.at(end_s)
            if pose is not None:
                x, y, heading, z, pitch, speed = pose[1:]
                try:
                    self._env.external.pose(
                        actor.slot, x, y, heading, z=z, pitch=pitch, speed=speed
                    )
                except ActionError as error:
                    refused[actor] = error
        return refused

    def rows(self) -> Mapping[int, np.void]:
        """Return the VEHICLE row of each slot with an actor that has entered."""
        if not self._actors:
            return {}
        return {int(row["order"]): row for row in self._env.external.vehicles()}

    def report(self) -> list[dict[str, Any]]:
        """Return the counts of poses of all actors, present and past."""
        return [*self.reports, *(actor.report() for actor in self._actors)]

    def _checked(self, order: ActorOrder) -> PoseTrack:
        """Return the track of a new actor. Raises ActionError or ConfigError."""
        if not order.name or len(order.name) > MOST_NAME or not order.name.isprintable():
            raise ActionError(
                f"an actor's name is {order.name[:MOST_NAME]!r}: must be 1 to {MOST_NAME} "
                "printable characters"
            )
        if order.name in self._env.possible_agents:
            raise ActionError(f"an actor's name is '{order.name}', an agent's; use another")
        if len(order.vtype) > MOST_NAME:
            raise ActionError(
                f"an actor's type has {len(order.vtype)} characters; the limit is {MOST_NAME}"
            )
        if order.moved_by not in MOVERS:
            raise ActionError(
                f"moved_by = {order.moved_by[:MOST_NAME]!r}: must be one of {', '.join(MOVERS)}"
            )
        check_external_rig(self._env.config, order.rig)
        return PoseTrack(order.rate_hz, order.extrapolation_s)

    def _enter(self, actor: ClientActor) -> None:
        order, external = actor.order, self._env.external
        actor.slot = external.spawn(
            order.x,
            order.y,
            order.heading,
            z=order.z,
            vtype=order.vtype,
            size_m=order.size_m,
            speed=order.speed if order.moved_by != NOTHING else 0.0,
            observes=bool(order.rig),
        )

    def _leave(self, actor: ClientActor) -> None:
        if actor.slot >= 0:
            self._env.external.remove(actor.slot)
            actor.slot = -1
