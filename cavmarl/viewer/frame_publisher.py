"""`FramePublisher`: gives the watchers of one world what they have asked for, when it is due."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from cavmarl.engine.world_frame import WorldFrame, events_between
from cavmarl.viewer.frame_messages import FrameEncoder
from cavmarl.viewer.run_clock import RunClock
from cavmarl.viewer.subscribers import Audience, Wishes

FRAMES_HZ = 20.0
DETAILS_HZ = 5.0
# What the time line shows of `FrameEvent`; departures and signals are too many.
TIME_LINE = frozenset({"collision", "off_road", "red_light", "arrived", "wrong_way", "transferred"})
ASKED = frozenset({"inserted", "closed", "opened"})  # pages that ask for it are told at once
MOST_EVENTS = 50  # of a frame

SeeFrame = Callable[[bool], WorldFrame]
"""The present frame; whether zones' ghosts are told."""
SeeVehicle = Callable[[WorldFrame, int, bool], dict[str, Any]]
"""What a page is told of a vehicle by its id; whether also what its sensors see."""


class FramePublisher:
    """Publishes at most `FRAMES_HZ` frames a second, and none while there is no watcher.

    Attributes:
        is_new: the world has changed since the last frame.
        published: how many frames.
    """

    def __init__(
        self, audience: Audience, encoder: FrameEncoder, tells_events: bool = True
    ) -> None:
        self._audience = audience
        self._encoder = encoder
        self._tells_events = tells_events
        self._last: WorldFrame | None = None
        self._shown: tuple[Wishes, bool, float] | None = None  # with its pause and pace
        self._published_s = self._detailed_s = 0.0
        self.is_new = True
        self.published = 0

    def keep(self, frame: WorldFrame, clock: RunClock) -> None:
        """Publish a frame whether or not there are watchers; one that comes next sees it first."""
        shown = self._encoder.publication(frame, paused=clock.is_paused, pace=clock.pace)
        self._audience.publish(shown)

    def publish(self, now_s: float, clock: RunClock, see: SeeFrame, tell: SeeVehicle) -> None:
        """Show the world to its watchers, if there are any and it is time."""
        wishes = self._audience.wishes
        if not wishes.watchers or now_s - self._published_s < 1.0 / FRAMES_HZ:
            return
        showing = wishes, clock.is_paused, clock.pace
        if not self.is_new and self._shown == showing:
            return
        frame = see(bool(wishes.ghosts_of))
        self._audience.publish(
            self._encoder.publication(
                frame, paused=clock.is_paused, pace=clock.pace, ghosts_of=wishes.ghosts_of
            )
        )
        if self._tells_events:
            self._tell_events(frame)
        if now_s - self._detailed_s >= 1.0 / DETAILS_HZ or self._shown != showing:
            self._detailed_s = now_s
            for vehicle in wishes.vehicles:
                told = tell(frame, vehicle, vehicle in wishes.sensed)
                self._audience.tell_of_vehicle(vehicle, told)
        self._last, self._shown, self.is_new = frame, showing, False
        self._published_s = now_s
        self.published += 1

    def _tell_events(self, frame: WorldFrame) -> None:
        before = self._last
        if before is None:
            return
        if frame.tick < before.tick:
            self._audience.tell_events([[frame.tick, "episode", -1, -1, ""]])
            return
        found = [list(event) for event in events_between(before, frame) if event.kind in TIME_LINE]
        if found:
            self._audience.tell_events(found[:MOST_EVENTS])
