"""`CarlaSession`: the state that all clients of a server share, and the ticks of its world."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from cavmarl.core.errors import ClockError, ConfigError
from cavmarl.cosim.carla.attached_sensors import SensorSuite
from cavmarl.cosim.carla.call_arguments import CallRefused
from cavmarl.cosim.carla.call_table import Caller
from cavmarl.cosim.carla.carla_actors import ActorTable, CarlaActor
from cavmarl.cosim.carla.carla_blueprints import BLUEPRINTS, PROP, UNAVAILABLE, Blueprint
from cavmarl.cosim.carla.carla_geometry import CarlaPose, compose
from cavmarl.cosim.carla.carla_map import CarlaMap
from cavmarl.cosim.carla.carla_snapshots import frame_head, snapshot_body
from cavmarl.cosim.carla.carla_streams import EPISODE_STREAM, StreamHub
from cavmarl.cosim.carla.carla_versions import ClientVersion
from cavmarl.cosim.carla.external_vehicles import ExternalBody
from cavmarl.cosim.carla.hosted_world import (
    STEP_S,
    EndedVehicle,
    HostedWorld,
    WorldSource,
)
from cavmarl.cosim.carla.session_recordings import SessionRecordings

log = logging.getLogger("cavmarl.carla")

_SAME_S = 1e-6  # step lengths that differ by less are equal
_NOWHERE = CarlaPose(0.0, 0.0, 0.0)
_WEATHER = [0.0] * 12 + [0.0331, 0.0]  # the fields of CARLA's `WeatherParameters`, in order


@dataclass(frozen=True)
class EpisodeSettings:
    """CARLA's `WorldSettings`; `others`: values of the fields that have no effect, as sent."""

    synchronous: bool = False
    no_rendering: bool = False
    fixed_delta_s: float | None = None
    others: tuple[Any, ...] = (True, 0.01, 10, 0.0, True, 3000.0, 2000.0, True)

    def packed(self) -> list[Any]:
        fixed = [False] if self.fixed_delta_s is None else [True, self.fixed_delta_s]
        return [self.synchronous, self.no_rendering, fixed, *self.others]


@dataclass(frozen=True)
class SessionLimits:
    """Limits of what clients may demand.

    Attributes:
        max_message: bytes of a message.
        max_clients: number of RPC connections.
        max_actors: actors that clients have spawned.
        max_unsent: bytes that wait for a client that does not read.
        max_recorded: vehicles of a recording, summed over its ticks.

    Raises ConfigError: a limit is not above 0.
    """

    max_message: int = 1 << 26
    max_clients: int = 64
    max_actors: int = 1024
    max_unsent: int = 1 << 26
    max_recorded: int = 100_000_000

    def __post_init__(self) -> None:
        for name, limit in vars(self).items():
            if limit < 1:
                raise ConfigError(f"{name} = {limit}: must be at least 1")


DEFAULT_LIMITS = SessionLimits()
OtherTicks = Literal["obey", "refuse", "follow"]


class CarlaSession:
    """A hosted world, its actors, and the settings of its clients.

    Args:
        source: loads the world.
        version: version of the clients.
        streams: where snapshots and sensor frames are sent.
        limits: limits of what clients may demand.
        step_s: length of a step of the first world.
        other_ticks: what happens in a synchronous world if a client other than the time master
            ticks. The time master is the client that ticked first, until it disconnects. `obey`:
            the world advances, as in CARLA. `refuse`: the client gets an error. `follow`: the
            client waits for the next tick of the master.
        recordings: folder of the recordings that clients make; None: they can make none.

    Attributes:
        frame: number of ticks since the server has started; it numbers the snapshots.
        episode: number of the episode; it grows when a client loads a map.
        managers: ports and hosts of the clients' traffic managers.
        weather, gravity: values that clients have set; they have no effect.
        recordings: recordings and replays of clients.
    """

    def __init__(
        self,
        source: WorldSource,
        version: ClientVersion,
        streams: StreamHub,
        limits: SessionLimits = DEFAULT_LIMITS,
        step_s: float = STEP_S,
        other_ticks: OtherTicks = "obey",
        recordings: Path | None = None,
    ) -> None:
        self.source, self.version, self.streams, self.limits = source, version, streams, limits
        self.settings = EpisodeSettings()
        self.other_ticks = other_ticks
        self._ticking: Caller | None = None
        self.weather, self.gravity = list(_WEATHER), 9.81
        self.managers: dict[int, str] = {}
        self.frame = 0
        self.episode = 1
        self.time_s = 0.0
        self.first_step_s = step_s
        self.world: HostedWorld = source.load("", step_s)
        self.actors = ActorTable(self.world, 1)
        self.sensors = SensorSuite(self, streams)
        streams.first_frames[EPISODE_STREAM] = self._snapshot
        self._map_changed = True
        self._told: set[str] = set()
        self.recordings = SessionRecordings(self, recordings)

    @property
    def map(self) -> CarlaMap:
        return self.world.map

    @property
    def delta_s(self) -> float:
        """Simulated time of a tick."""
        fixed = self.settings.fixed_delta_s
        return self.world.step_s if fixed is None else fixed

    def tick(self, actions: Mapping[str, Any] | None = None) -> int:
        """Advance the world by one tick and send its frames; return the number of the frame.

        `actions`: actions of agents that no client drives; None: actions of the built-in driver.
        """
        self.frame += 1
        self.time_s += self.delta_s
        all_ended: list[EndedVehicle] = []
        for _ in range(max(1, round(self.delta_s / self.world.step_s))):
            all_ended += self.world.step(actions)
        for ended in all_ended:
            self._tell_end(ended)
        self.recordings.end_replay(only_if_over=True)
        for actor in self.actors.take(self.world):
            self.forget(actor)
        self.recordings.note_tick(all_ended)
        self.publish()
        return self.frame

    def tick_for(self, caller: Caller) -> int:
        """Handle the tick of a client; return the number of the frame that the client waits for.

        Ticks of other clients than the time master are recorded as events of the `TimeMaster`.

        Raises CallRefused: another client is the time master, and `other_ticks` is `refuse`.
        """
        if self._ticking is None:
            self._ticking = caller
        if caller is not self._ticking:
            follower = self.world.master.follow(caller.name)
            with suppress(ClockError):  # the event is recorded
                follower.tick()
            follower.leave()
            self.tell(f"{caller.name} ticks, but {self._ticking.name} has ticked first")
            if self.other_ticks == "refuse":
                raise CallRefused(
                    f"{caller.name} ticks, but {self._ticking.name} is the time master: wait for "
                    "its ticks (wait_for_tick), or start the server with --other-ticks follow"
                )
            if self.other_ticks == "follow":
                return self.frame + 1
        return self.tick()

    def _tell_end(self, ended: EndedVehicle) -> None:
        """Log why a vehicle that a client drives has left, and report its collision."""
        actor = self.actors.of_agent(ended.agent)
        if actor is None:
            return
        if ended.was_driven:
            log.warning("actor %d (car_%d) leaves: %s", actor.number, ended.agent, ended.reason)
        if ended.has_collided:
            self._send(self.sensors.last_collisions(actor))

    def publish(self) -> None:
        """Send the snapshot of the current frame, then the frames of sensors."""
        keep = self.settings.synchronous
        if self.streams.is_wanted(EPISODE_STREAM):
            self.streams.send(EPISODE_STREAM, *self._snapshot(), keep)
            self._map_changed = False
        self._send(self.sensors.sense())

    def _snapshot(self) -> tuple[bytes, bytes]:
        """Return the head and the body of the snapshot of the current frame.

        A client also gets it when it begins to listen: in a synchronous world, it would otherwise
        wait for a frame that was sent before its connection was open.
        """
        head = frame_head(self.version.snapshot_kind, self.frame, self.time_s, _NOWHERE)
        states = self.actors.states()
        return head, snapshot_body(self.episode, self.delta_s, self._map_changed, states)

    def _send(self, frames: Iterable[tuple[int, CarlaActor, int, bytes]]) -> None:
        for stream, actor, kind, body in frames:
            head = frame_head(kind, self.frame, self.time_s, actor.pose)
            self.streams.send(stream, head, body, self.settings.synchronous)

    def change_settings(self, settings: EpisodeSettings) -> None:
        """Apply settings; a step length that does not fit the world restarts the world.

        Actors that clients have spawned are kept; all other vehicles are new.

        Raises CavmarlError: the world cannot have steps of this length. Nothing has changed.
        """
        wanted = settings.fixed_delta_s or self.first_step_s
        steps = wanted / self.world.step_s
        is_whole = round(steps) >= 1 and abs(steps - round(steps)) * self.world.step_s < _SAME_S
        if not is_whole:
            log.info("the world restarts with steps of %g s", wanted)
            self._restart(wanted)
        self.settings = settings

    def _restart(self, step_s: float) -> None:
        self.recordings.end_replay()
        self.recordings.stop()
        before, controls = self.actors, self.world.external.controls
        driven = {
            actor.number: controls[actor.slot]
            for actor in before.actors.values()
            if actor.slot in controls
        }
        self.world = self.source.load("", step_s)
        self.actors = ActorTable(self.world, before.spectator.number, before.next_number)
        for actor in self.actors.keep_spawned(self.world, before):
            log.warning("actor %d (%s) could not be kept", actor.number, actor.type_id)
            self.forget(actor)
        self.sensors.await_listeners()
        for number, control in driven.items():
            if number in self.actors.actors:
                self.world.external.control(self.actors.actors[number].slot, control)

    def load(self, name: str, reset_settings: bool) -> None:
        """Begin a new episode on a map; raise CavmarlError if there is no such map."""
        short = name.rpartition("/")[2]
        world = self.source.load(short, self.world.step_s)
        self.recordings.end_replay()
        self.recordings.stop()
        if reset_settings:
            self.settings = EpisodeSettings(no_rendering=self.settings.no_rendering)
        self.episode += 1
        self.time_s = 0.0
        self._map_changed = True
        self._take_world(world)
        self.sensors.begin_episode()

    def _take_world(self, world: HostedWorld) -> None:
        for actor in list(self.actors.attached()):
            self.sensors.remove(actor)
        self.world = world
        self.actors = ActorTable(world, self.actors.next_number)

    def spawn(
        self, type_id: str, attributes: dict[str, str], pose: CarlaPose, parent: int = 0
    ) -> CarlaActor:
        """Add an actor; `pose` is relative to the parent, if there is one.

        Raises CallRefused: there is no such blueprint or parent, or no room for the actor.
        """
        blueprint = BLUEPRINTS.get(type_id)
        if blueprint is None:
            raise CallRefused(f"actor definition not found: {type_id}")
        if type_id in UNAVAILABLE:
            raise CallRefused(f"{type_id} is not available")
        if sum(1 for _ in self.actors.spawned()) >= self.limits.max_actors:
            raise CallRefused(f"{self.limits.max_actors} actors are spawned; destroy some first")
        if parent and parent not in self.actors.actors:
            raise CallRefused("unable to attach actor: parent actor not found")
        if type_id.startswith(("sensor.", "controller.")):
            return self._attach(blueprint, attributes, pose, parent)
        self.recordings.refuse_in_replay()
        there = compose(self.actors.pose_of(self.actors.actors[parent]), pose) if parent else pose
        if parent and blueprint.base_type == PROP:
            raise CallRefused(f"{type_id}: props cannot be attached; spawn it at a place")
        body = ExternalBody(type_id, blueprint.base_type, there, blueprint.size_m)
        slot, size_m = self.world.external.spawn(body)
        return self.actors.add_spawned(blueprint, attributes, there, slot, size_m)

    def _attach(
        self, blueprint: Blueprint, attributes: dict[str, str], pose: CarlaPose, parent: int
    ) -> CarlaActor:
        actor = self.actors.add(
            blueprint.type_id,
            pose,
            attributes=dict(attributes),
            parent=parent,
            local=pose if parent else None,
        )
        try:
            self.sensors.add(actor)
        except CallRefused:
            self.actors.remove(actor.number)
            raise
        self.actors.move_attached(actor)
        return actor

    def destroy(self, number: int) -> None:
        """Remove an actor that a client has spawned; raise CallRefused for other actors."""
        actor = self.actors.actors.get(number)
        if actor is None:
            raise CallRefused("unable to destroy actor: not found")
        if actor.slot >= 0:
            self.world.external.destroy(actor.slot)
        elif not actor.is_attached:
            raise CallRefused(f"unable to destroy actor: {actor.type_id} belongs to the world")
        for one in self.actors.remove(number):
            self.forget(one)

    def release(self, caller: Caller) -> None:
        """Let the built-in driver drive the agents of a client that has left."""
        if caller is self._ticking:
            self._ticking = None
        for agent in caller.agents:
            self.world.controls.pop(agent, None)

    def tell(self, message: str) -> None:
        """Log a fault of a client; equal messages are logged once."""
        if message not in self._told and len(self._told) < self.limits.max_actors:
            self._told.add(message)
            log.warning("%s", message)

    def close(self) -> None:
        self.recordings.stop()
        self.source.close()

    def forget(self, actor: CarlaActor) -> None:
        """End the sensor of an actor that has been removed."""
        self.sensors.remove(actor)
