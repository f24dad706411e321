"""A world that pages watch: its clock, what they ask for, and what is published."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from cavmarl.config.env import ActionConfig
from cavmarl.core.records.codes import (
    ACTION_FASTER,
    ACTION_IDLE,
    ACTION_LANE_LEFT,
    ACTION_LANE_RIGHT,
    ACTION_SLOWER,
)
from cavmarl.engine.world_frame import WorldFrame, events_between
from cavmarl.env.parallel import CavEnv
from cavmarl.policies.policy import Policy
from cavmarl.viewer.audience import Audience, Wishes
from cavmarl.viewer.frame_messages import FrameEncoder
from cavmarl.viewer.page_requests import PageRequest
from cavmarl.viewer.vehicle_details import vehicle_details

FRAMES_HZ = 20.0
DETAILS_HZ = 5.0
IDLE_S = 0.25
HELD_S = 1.0  # after which the policy drives again if a page says nothing
LATE_S = 0.5  # a clock that is later does not catch up
# What the time line shows of `FrameEvent`; departures and signals are too many.
TIME_LINE = frozenset({"collision", "off_road", "red_light", "arrived", "wrong_way", "transferred"})
MOST_EVENTS = 50  # of a frame
PRESSED = 0.3  # of throttle or steering, from where it is a choice among meta-actions


class ShownRun:
    """Drives one environment and shows it; episodes follow one another.

    Args:
        env: driven by `policy`; pages may take seats of it.
        policy: of all agents that no page drives.
        audience: is told.
        encoder: of the world's frames.
        seed: of the first episode.
        pace: seconds of the world in one of ours; 0: as fast as it can.
    """

    def __init__(
        self,
        env: CavEnv,
        policy: Policy,
        audience: Audience,
        encoder: FrameEncoder,
        seed: int,
        pace: float = 1.0,
    ) -> None:
        self._env = env
        self._policy = policy
        self._audience = audience
        self._encoder = encoder
        self._pace = pace
        self._paused = False
        self._steps_wanted = 0
        self._due_s = time.monotonic()
        self._published_s = 0.0
        self._detailed_s = 0.0
        self._frame: WorldFrame | None = None  # the last one that was published
        self._shown: tuple[Wishes, bool, float] | None = None  # for whom, and how
        self._is_new = True  # the world has changed since
        self._seats: dict[int, int] = {}  # watchers by agent
        self._driving: dict[int, tuple[float, float, float]] = {}  # time, throttle, steering
        self.steps = 0
        self.published = 0
        self._observations, self._infos = env.reset(seed=seed)
        policy.reset(seed)

    def run(self, seconds: float | None = None) -> None:
        """Go on for so many seconds of the world, or without an end."""
        most = None if seconds is None else max(1, round(seconds / self._env.step_s))
        self._due_s = time.monotonic()
        while most is None or self.steps < most:
            self.turn()

    def turn(self) -> None:
        """Heed the pages, take a step if it is time, and publish what is due."""
        for number, request in self._audience.requests():
            self._heed(number, request)
        now = time.monotonic()
        if self._paused and not self._steps_wanted:
            self._publish(now)
            self._audience.wait(IDLE_S)
            self._due_s = time.monotonic()
            return
        if self._pace and not self._steps_wanted and now < self._due_s:
            self._publish(now)
            self._audience.wait(min(self._due_s - now, IDLE_S))
            return
        self._steps_wanted = max(0, self._steps_wanted - 1)
        if self._pace:
            self._due_s = max(self._due_s, now - LATE_S) + self._env.step_s / self._pace
        self._step()
        self._publish(time.monotonic())

    def _step(self) -> None:
        env = self._env
        self.steps += 1
        self._is_new = True
        if not env.agents:
            self._observations, self._infos = env.reset()
            return
        actions = self._policy.act(self._observations)
        self._take_seats(actions)
        self._observations, *_, self._infos = env.step(actions)

    def _take_seats(self, actions: dict[str, Any]) -> None:
        now = time.monotonic()
        for agent, watcher in self._seats.items():
            name = self._env.possible_agents[agent]
            said_s, throttle, steering = self._driving.get(watcher, (0.0, 0.0, 0.0))
            if name in actions and now - said_s < HELD_S:
                actions[name] = hand_action(self._env.config.action, throttle, steering)

    def _heed(self, number: int, request: PageRequest) -> None:
        kind = request.kind
        if kind == "pause":
            self._paused = True
        elif kind == "play":
            self._paused = False
        elif kind == "step":
            self._paused = True
            self._steps_wanted = min(self._steps_wanted + 1, 10)
        elif kind == "pace" and request.number is not None:
            self._pace = request.number
            self._due_s = time.monotonic()
        elif kind == "reset":
            self._observations, self._infos = self._env.reset()
            self._is_new = True
        elif kind == "seat":
            self._give_seat(number, request.number)
        elif kind == "drive":
            self._driving[number] = (time.monotonic(), request.throttle, request.steering)

    def _give_seat(self, watcher: int, agent: float | None) -> None:
        self._seats = {one: held for one, held in self._seats.items() if held != watcher}
        self._driving.pop(watcher, None)
        if agent is None:
            return
        reason = ""
        if agent >= len(self._env.possible_agents):
            reason = "there is no such agent"
        elif int(agent) in self._seats:
            reason = "another page drives it"
        else:
            self._seats[int(agent)] = watcher
        seat = {"kind": "seat", "agent": None if reason else int(agent), "reason": reason}
        self._audience.tell(watcher, seat)

    def _publish(self, now: float) -> None:
        """Show the world to its watchers, if there are any and it is time."""
        wishes = self._audience.wishes
        if not wishes.watchers or now - self._published_s < 1.0 / FRAMES_HZ:
            return
        showing = wishes, self._paused, self._pace
        if not self._is_new and self._shown == showing:
            return
        frame = self._env.world_frames(ghosts=bool(wishes.ghosts_of))[0]
        self._audience.publish(
            self._encoder.publication(
                frame, paused=self._paused, pace=self._pace, ghosts_of=wishes.ghosts_of
            )
        )
        self._tell_events(frame)
        if now - self._detailed_s >= 1.0 / DETAILS_HZ or self._shown != showing:
            self._detailed_s = now
            for vehicle in wishes.vehicles:
                self._audience.tell_of_vehicle(vehicle, self._details(frame, vehicle))
        self._frame, self._shown, self._is_new = frame, showing, False
        self._published_s = now
        self.published += 1

    def _details(self, frame: WorldFrame, vehicle: int) -> dict[str, Any]:
        return vehicle_details(self._env, frame, vehicle, self._observations, self._infos)

    def _tell_events(self, frame: WorldFrame) -> None:
        before = self._frame
        if before is None:
            return
        if frame.tick < before.tick:
            self._audience.tell_events([[frame.tick, "episode", -1, -1, ""]])
            return
        found = [list(event) for event in events_between(before, frame) if event.kind in TIME_LINE]
        if found:
            self._audience.tell_events(found[:MOST_EVENTS])


def hand_action(config: ActionConfig, throttle: float, steering: float) -> Any:
    """An action of an environment, from what a page holds; of a grid the nearest pair."""
    if config.kind == "continuous":
        return np.array([throttle, steering], dtype=np.float32)
    if config.kind == "grid":
        row = np.abs(np.subtract(config.grid_throttle, throttle)).argmin()
        column = np.abs(np.subtract(config.grid_steering, steering)).argmin()
        return int(row) * len(config.grid_steering) + int(column)
    if abs(steering) >= PRESSED:
        return ACTION_LANE_LEFT if steering > 0.0 else ACTION_LANE_RIGHT
    if abs(throttle) >= PRESSED:
        return ACTION_FASTER if throttle > 0.0 else ACTION_SLOWER
    return ACTION_IDLE
