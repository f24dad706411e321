"""`SessionRecordings`: recordings and replays of the clients of a session."""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from cavmarl.cosim.carla.call_arguments import CallRefused
from cavmarl.cosim.carla.carla_actors import ActorTable, CarlaActor
from cavmarl.cosim.carla.carla_geometry import CarlaPose, compose
from cavmarl.cosim.carla.carla_recorder import CarlaRecorder
from cavmarl.cosim.carla.carla_replay import CarlaRecording, CarlaReplay
from cavmarl.cosim.carla.hosted_world import EndedVehicle

if TYPE_CHECKING:
    from cavmarl.cosim.carla.carla_session import CarlaSession


class SessionRecordings:
    """The recording that a session makes, or the recording that it shows instead of its world.

    `session`: the session. `folder`: folder of the recordings; None: clients cannot record.
    """

    def __init__(self, session: CarlaSession, folder: Path | None) -> None:
        self._session = session
        self._recorder = CarlaRecorder(folder, session.limits.max_recorded)
        self._key = secrets.token_hex(8)  # no other session has it
        self._live: _LiveActors | None = None  # the actors of the world during a replay
        self._factor = 1.0

    def start(self, name: str) -> Path:
        """Begin a recording. Raises the errors of `CarlaRecorder.start`."""
        self.refuse_in_replay()
        return self._recorder.start(self._session, self._key, name)

    def stop(self) -> None:
        """End the recording, if there is one."""
        self._recorder.stop()

    def open(self, name: str) -> CarlaRecording:
        """Open a recording.

        Raises:
            CallRefused: the name is not allowed, or this recording is being made.
            RecordingError: there is no such recording, or it is damaged.
        """
        return CarlaRecording(self._recorder.finished(name))

    def note_tick(self, ended: Sequence[EndedVehicle]) -> None:
        """Record the state after a tick, or let the spectator follow its actor.

        `ended`: the agents' vehicles that have left in this tick.
        """
        if self._live is None:
            self._recorder.take(self._session, ended)
        else:
            self._live.follow(self._session.actors)

    def refuse_in_replay(self) -> None:
        """Raise CallRefused if a recording is being replayed."""
        if self._live is not None:
            raise CallRefused(
                "a recording is being replayed, and the world is paused; call stop_replayer, or "
                "wait for its end"
            )

    def begin_replay(
        self,
        recording: CarlaRecording,
        start_s: float,
        duration_s: float,
        follow: int,
        offset: CarlaPose,
    ) -> CarlaReplay:
        """Show a recording instead of the world, which is paused until the end.

        Args:
            recording: the recording.
            start_s: its first second; a negative one counts from the end.
            duration_s: length of the part; 0: up to the end.
            follow: recorded number of the actor that the spectator follows; 0: none.
            offset: pose of the spectator relative to this actor.

        Raises:
            CallRefused: a recording is being made, or there is no such actor.
            RecordingError: the world cannot show this recording.
        """
        if self._recorder.is_on:
            raise CallRefused("a recording is being made; call stop_recorder first")
        session, recorded = self._session, recording.session
        simulation = session.world.simulation
        recording.check_map(session.map.network, session.map.name)
        if follow and follow not in {one.number for one in recorded.actors.values()}:
            raise CallRefused(f"actor {follow} is not in the recording; 0 follows none")
        replay = CarlaReplay(recording, start_s, duration_s, simulation.types, simulation.capacity)
        replay.factor = self._factor
        self.end_replay()
        before = session.actors
        # Clients of the recorded session know these numbers; in other sessions they may be taken.
        is_same = (recorded.session, recorded.episode) == (self._key, session.episode)
        first = before.next_number
        known = {
            vehicle: one.actor(one.number if is_same else first + place)
            for place, (vehicle, one) in enumerate(recorded.actors.items())
        }
        numbers = {recorded.actors[vehicle].number: one.number for vehicle, one in known.items()}
        session.world.replay = replay
        shown = ActorTable(session.world, before.spectator.number, first + len(known), known)
        shown.spectator.pose = before.spectator.pose
        session.actors = shown
        self._live = _LiveActors(before, numbers.get(follow, 0), offset)
        self._live.share_attached(shown)
        self._live.follow(shown)
        return replay

    def set_replay_factor(self, factor: float) -> None:
        """Set the recorded time per simulated time, for this replay and later replays."""
        self._factor = factor
        replay = self._session.world.replay
        if replay is not None:
            replay.factor = factor

    def end_replay(self, only_if_over: bool = False) -> None:
        """Show the world again, if a recording is being shown.

        `only_if_over`: if the recording has not reached its end, keep showing it.
        """
        session = self._session
        replay = session.world.replay
        if replay is None or self._live is None or (only_if_over and not replay.is_over):
            return
        live, self._live = self._live, None
        session.world.replay = None
        shown, session.actors = session.actors, live.actors
        for actor in live.take_back(shown):
            session.forget(actor)
        session.actors.take(session.world)


class _LiveActors:
    """The actors of the world while a recording is shown.

    `actors`: the actors of the world. `followed`: number of the shown actor that the spectator
    follows, or 0. `offset`: its pose relative to that actor.
    """

    def __init__(self, actors: ActorTable, followed: int, offset: CarlaPose) -> None:
        self.actors = actors
        self._followed, self._offset = followed, offset
        self._shared: set[int] = set()

    def share_attached(self, shown: ActorTable) -> None:
        """Keep sensors whose parents are shown, and sensors without a parent."""
        for actor in self.actors.attached():
            if not actor.parent or actor.parent in shown.actors:
                shown.actors[actor.number] = actor
                shown.move_attached(actor)
                self._shared.add(actor.number)

    def follow(self, shown: ActorTable) -> None:
        """Move the spectator with the actor that it follows."""
        actor = shown.actors.get(self._followed)
        if actor is not None:
            shown.spectator.pose = compose(shown.pose_of(actor), self._offset)

    def take_back(self, shown: ActorTable) -> list[CarlaActor]:
        """Take over the clients' changes; return the sensors that have lost their parents."""
        self.actors.spectator.pose = shown.spectator.pose
        self.actors.skip_to(shown.next_number)
        for number in self._shared - shown.actors.keys():
            self.actors.remove(number)
        gone = []
        for actor in list(shown.attached()):
            if actor.parent and actor.parent not in self.actors.actors:
                gone.append(actor)
            else:
                self.actors.actors[actor.number] = actor
        return gone
