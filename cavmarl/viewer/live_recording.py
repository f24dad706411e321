"""A recorded episode for pages: playback, seeking along the time line, pause."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from cavmarl.core.errors import RecordingError
from cavmarl.engine.world_frame import WorldFrame
from cavmarl.recordings.recording import Recording
from cavmarl.viewer.frame_publisher import ASKED, TIME_LINE, FramePublisher
from cavmarl.viewer.recorded_sensors import RecordedSensors
from cavmarl.viewer.run_clock import RunClock
from cavmarl.viewer.vehicle_details import hello_of_map, vehicle_state
from cavmarl.viewer.viewed_world import Stage, first_stage

MOST_SHOWN = 500  # largest number of events shown of an episode
QUIET = frozenset({"arrived", "transferred"})  # dropped first if there are more events
MOST_STEPS_AHEAD = 20  # largest number of frames per turn


class ShownRecording:
    """Shows an episode of a recording; playback pauses at its end.

    Args:
        recording: the recording.
        world: index of the world.
        episode: index of the episode.
        stage: stage from `recording_stages`.

    Raises:
        RecordingError: the episode has no frames, or a part is missing or damaged.
    """

    def __init__(self, recording: Recording, world: int, episode: int, stage: Stage) -> None:
        self._recording = recording
        self._world, self._episode = world, episode
        self._ticks = recording.ticks(world, episode)
        self._sensors = RecordedSensors(recording, world, episode)
        self._agents = list(stage.hello["agents"])
        self._audience = stage.audience
        self._place = 0
        self._has_told = False
        self.clock = RunClock()
        self.publisher = FramePublisher(stage.audience, stage.encoder, has_events=False)
        self.step_s = recording.head.step_s

    def turn(self) -> float:
        """Handle requests, advance and publish as due; return how long to wait then, in s."""
        for _, request in self._audience.requests():
            if request.kind == "play" and self._place == len(self._ticks) - 1:
                self._go_to(0)
            if request.kind == "seek" and request.number is not None:
                found = int(np.searchsorted(self._ticks, request.number, side="right")) - 1
                self._go_to(max(0, found))
            self.clock.handle(request)
        if not self._audience.wishes.watchers:
            self.clock.wait_s(time.monotonic())
            return 1.0
        self._send_all_events()
        wait_s = self._go_on()
        self.publisher.publish(time.monotonic(), self.clock, self._frame, self._details)
        return wait_s

    def _go_on(self) -> float:
        """Take the due steps; return the time until the next step."""
        now = time.monotonic()
        for _ in range(MOST_STEPS_AHEAD):
            wait_s = self.clock.wait_s(now)
            if wait_s:
                return wait_s
            self.clock.tick(now, self.step_s)
            if self._place + 1 < len(self._ticks):
                self._go_to(self._place + 1)
            else:
                self.clock.is_paused = True
        return 0.0

    def _go_to(self, place: int) -> None:
        self._place = place
        self.publisher.is_new = True

    def _frame(self, ghosts: bool) -> WorldFrame:
        frame = self._recording.at(self._ticks[self._place], self._world, self._episode)
        self._recording.check_on_map(frame)
        return frame

    def _details(self, frame: WorldFrame, vehicle: int, sensors: bool) -> dict[str, Any]:
        found = vehicle_state(self._recording.network, self._agents, frame, vehicle)
        if found["here"] and found["agent"] >= 0:
            found |= self._sensors.of(frame.tick, vehicle, sensors)
        return found

    def _send_all_events(self) -> None:
        """Send the whole time line at once; pages that join later get it from the audience."""
        if self._has_told:
            return
        self._has_told = True
        events = [
            list(found.event)
            for found in self._recording.events(self._world)
            if found.episode == self._episode and found.event.kind in TIME_LINE | ASKED
        ]
        if len(events) > MOST_SHOWN:
            events = [event for event in events if event[1] not in QUIET]
        if events:
            self._audience.send_events(events[:MOST_SHOWN])


def recording_stages(recording: Recording) -> list[tuple[int, int, Stage]]:
    """Return world, episode and stage of each episode.

    Raises:
        RecordingError: there is no episode, or the map is missing.
    """
    head = recording.head
    network, partition = recording.network, recording.partition
    hello = hello_of_map(head.environment, network, partition, head.step_s)
    hello["may"] = [*hello["may"], "seek"]
    first = first_stage("", network, hello)
    stages = []
    for world in recording.worlds:
        for episode in recording.episodes(world):
            ticks = recording.ticks(world, episode)
            stage = first.named(f"world {world}, episode {episode}")
            agents = _agents_of(recording.at(ticks[0], world, episode))
            more = {"span": [ticks[0], ticks[-1]], "tick_s": head.sim_dt_s, "agents": agents}
            stages.append((world, episode, stage.telling(more)))
    if not stages:
        raise RecordingError(f"{recording.path}: the recording has no frames; record the run again")
    return stages


def _agents_of(frame: WorldFrame) -> list[str]:
    most = int(frame.vehicles["agent"].max(initial=-1))
    return [f"car_{agent}" for agent in range(most + 1)]
