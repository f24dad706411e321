"""Times at which frames, details and events are sent; the test sets the clock and the events."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from cavmarl.engine.world_frame import FrameEvent
from cavmarl.viewer import frame_publisher
from cavmarl.viewer.frame_publisher import FramePublisher
from cavmarl.viewer.run_clock import RunClock
from cavmarl.viewer.subscribers import Wishes


class World:
    """A substitute for a world, with lists of the messages to its watchers."""

    def __init__(self, has_events: bool = True) -> None:
        self.frames: list[int] = []  # ticks of the frames
        self.details: list[tuple[int, int, bool]] = []  # (tick, vehicle, has sensors)
        self.events: list[list[Any]] = []
        self.ghosts: list[bool] = []
        self.tick = 0
        self.clock = RunClock()
        self.audience: Any = SimpleNamespace(
            wishes=Wishes(watchers=1, vehicles=frozenset({7})),
            publish=self.frames.append,
            send_events=self.events.append,
            send_vehicle=lambda vehicle, details: self.details.append(details),
        )
        encoder: Any = SimpleNamespace(publication=lambda frame, **_: frame.tick)
        self.publisher = FramePublisher(self.audience, encoder, has_events)

    def publish(self, now_s: float, *, is_new: bool = True) -> None:
        def frame_of(with_ghosts: bool) -> Any:
            self.ghosts.append(with_ghosts)
            return SimpleNamespace(tick=self.tick)

        def details_of(frame: Any, vehicle: int, sensors: bool) -> Any:
            return frame.tick, vehicle, sensors

        self.tick += 1
        self.publisher.is_new |= is_new
        self.publisher.publish(now_s, self.clock, frame_of, details_of)


def test_at_most_twenty_frames_and_five_details_are_sent_per_second() -> None:
    world = World(has_events=False)
    for now_s in (10.0, 10.04, 10.06, 10.12, 10.18, 10.21, 10.24, 10.3, 10.46, 10.47):
        world.publish(now_s)
    assert world.frames == [1, 3, 4, 5, 7, 8, 9]
    assert world.publisher.published == 7
    assert [tick for tick, _, _ in world.details] == [1, 7, 9]


def test_an_unchanged_world_is_sent_again_when_a_page_asks_for_more() -> None:
    world = World(has_events=False)
    world.publish(10.0)
    world.publish(10.1, is_new=False)
    assert world.frames == [1]
    world.audience.wishes = Wishes(1, frozenset({7, 8}), frozenset({8}), (2,))
    world.publish(10.15, is_new=False)
    assert world.frames == [1, 3]
    assert sorted(world.details) == [(1, 7, False), (3, 7, False), (3, 8, True)]
    assert world.ghosts == [False, True]
    world.clock.is_paused = True
    world.publish(10.25, is_new=False)
    world.clock.pace = 4.0
    world.publish(10.35, is_new=False)
    world.publish(10.45, is_new=False)
    assert world.frames == [1, 3, 4, 5]


def test_a_world_without_watchers_is_not_encoded() -> None:
    world = World()
    world.audience.wishes = Wishes()
    world.publish(10.0)
    assert (world.frames, world.ghosts, world.publisher.published) == ([], [], 0)


def test_at_most_fifty_events_are_sent_with_a_frame(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    happened = [FrameEvent(2, "departed", 0, -1, "")]
    happened += [FrameEvent(2, "arrived", number, -1, "") for number in range(51)]
    monkeypatch.setattr(frame_publisher, "events_between", lambda before, frame: happened)
    world = World()
    world.publish(10.0)
    assert world.events == [], "events before the first frame"
    world.publish(10.1)
    (sent,) = world.events
    assert sent == [[2, "arrived", number, -1, ""] for number in range(50)]
    silent = World(has_events=False)
    silent.publish(10.0)
    silent.publish(10.1)
    assert silent.events == []


def test_a_new_episode_is_reported_when_the_tick_decreases(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(frame_publisher, "events_between", lambda before, frame: [])
    world = World()
    world.publish(10.0)
    world.tick -= 1
    world.publish(10.1)
    assert world.events == []
    world.tick -= 2
    world.publish(10.2)
    assert world.events == [[[0, "episode", -1, -1, ""]]]
