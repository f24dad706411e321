"""`FramePublisher`: sends the watchers of one world the data that they have requested, when due."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from cavmarl.engine.world_frame import WorldFrame, events_between
from cavmarl.viewer.frame_messages import FrameEncoder
from cavmarl.viewer.run_clock import RunClock
from cavmarl.viewer.subscribers import Audience, Wishes

FRAMES_HZ = 20.0
DETAILS_HZ = 5.0
# Events on the time line; departures and signal changes are too frequent.
TIME_LINE = frozenset({"collision", "off_road", "red_light", "arrived", "wrong_way", "transferred"})
ASKED = frozenset({"inserted", "closed", "opened"})  # results of requests of pages, sent at once
MOST_EVENTS = 50  # largest number of events sent with a frame

FrameSource = Callable[[bool], WorldFrame]
"""Returns the present frame; the argument says whether to include ghosts."""
DetailsSource = Callable[[WorldFrame, int, bool], dict[str, Any]]
"""Returns the details of a vehicle by id; the last argument says whether to include sensors."""


class FramePublisher:
    """Publishes at most `FRAMES_HZ` frames per second, and none without watchers.

    Attributes:
        is_new: whether the world has changed since the last frame.
        published: number of frames so far.
    """

    def __init__(self, audience: Audience, encoder: FrameEncoder, has_events: bool = True) -> None:
        self._audience = audience
        self._encoder = encoder
        self._has_events = has_events
        self._last: WorldFrame | None = None
        self._shown: tuple[Wishes, bool, float] | None = None  # wishes, pause, pace
        self._published_s = self._detailed_s = 0.0
        self.is_new = True
        self.published = 0

    def keep(self, frame: WorldFrame, clock: RunClock) -> None:
        """Publish a frame even without watchers, so that the next watcher sees it first."""
        shown = self._encoder.publication(frame, paused=clock.is_paused, pace=clock.pace)
        self._audience.publish(shown)

    def publish(
        self, now_s: float, clock: RunClock, frame_of: FrameSource, details_of: DetailsSource
    ) -> None:
        """Show the world to its watchers, if there are any and a frame is due."""
        wishes = self._audience.wishes
        if not wishes.watchers or now_s - self._published_s < 1.0 / FRAMES_HZ:
            return
        showing = wishes, clock.is_paused, clock.pace
        if not self.is_new and self._shown == showing:
            return
        frame = frame_of(bool(wishes.ghosts_of))
        self._audience.publish(
            self._encoder.publication(
                frame, paused=clock.is_paused, pace=clock.pace, ghosts_of=wishes.ghosts_of
            )
        )
        if self._has_events:
            self._send_events(frame)
        if now_s - self._detailed_s >= 1.0 / DETAILS_HZ or self._shown != showing:
            self._detailed_s = now_s
            for vehicle in wishes.vehicles:
                details = details_of(frame, vehicle, vehicle in wishes.sensed)
                self._audience.send_vehicle(vehicle, details)
        self._last, self._shown, self.is_new = frame, showing, False
        self._published_s = now_s
        self.published += 1

    def _send_events(self, frame: WorldFrame) -> None:
        before = self._last
        if before is None:
            return
        if frame.tick < before.tick:
            self._audience.send_events([[frame.tick, "episode", -1, -1, ""]])
            return
        found = [list(event) for event in events_between(before, frame) if event.kind in TIME_LINE]
        if found:
            self._audience.send_events(found[:MOST_EVENTS])
