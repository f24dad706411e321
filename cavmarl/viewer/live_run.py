"""A world that is driven for pages: handles requests, steps the world, and publishes frames."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from cavmarl.config.action import ActionConfig
from cavmarl.core.records.codes import (
    ACTION_FASTER,
    ACTION_IDLE,
    ACTION_LANE_LEFT,
    ACTION_LANE_RIGHT,
    ACTION_SLOWER,
)
from cavmarl.engine.world_frame import WorldFrame
from cavmarl.env.parallel import CavEnv
from cavmarl.policies.policy import Policy
from cavmarl.viewer.frame_publisher import FramePublisher
from cavmarl.viewer.inserted_here import handle_insertion
from cavmarl.viewer.page_requests import PageRequest
from cavmarl.viewer.run_clock import RunClock
from cavmarl.viewer.vehicle_details import vehicle_details
from cavmarl.viewer.viewed_world import Stage

HELD_S = 1.0  # without input for this time, the policy drives again
PRESSED = 0.3  # throttle or steering beyond this selects a meta-action


class ShownRun:
    """Drives one environment and shows it, episode after episode.

    Args:
        env: environment, driven by `policy`; pages may take over agents (seats).
        policy: policy of all agents that no page drives.
        stage: stage to show it on.
        seed: seed of the first episode.

    Attributes:
        clock: clock of the steps.
        publisher: publisher of the frames.
        steps: number of steps taken.
        seats: agents that a page drives, and the number of its watcher.
    """

    def __init__(self, env: CavEnv, policy: Policy, stage: Stage, seed: int) -> None:
        self._env = env
        self._policy = policy
        self._audience = stage.audience
        self.clock = RunClock()
        self.publisher = FramePublisher(stage.audience, stage.encoder)
        self.seats: dict[int, int] = {}
        self._driving: dict[int, tuple[float, float, float]] = {}  # time, throttle, steering
        self.steps = 0
        self._observations, _ = env.reset(seed=seed)
        policy.reset(seed)

    @property
    def step_s(self) -> float:
        """Simulated seconds per step."""
        return self._env.step_s

    def turn(self) -> float:
        """Handle requests, step and publish when due; return the time to wait afterwards, in s."""
        for number, request in self._audience.requests():
            self._handle(number, request)
        now = time.monotonic()
        wait_s = self.clock.wait_s(now)
        if not wait_s:
            self.clock.tick(now, self._env.step_s)
            self._step()
        self.publisher.publish(time.monotonic(), self.clock, self._frame, self._details)
        return wait_s

    @property
    def _tick(self) -> int:
        return int(self._env.worlds.arrays.ticks[0])

    def _frame(self, ghosts: bool) -> WorldFrame:
        return self._env.world_frames(ghosts=ghosts)[0]

    def _details(self, frame: WorldFrame, vehicle: int, sensors: bool) -> dict[str, Any]:
        return vehicle_details(self._env, 0, frame, vehicle, sensors)

    def _step(self) -> None:
        env = self._env
        self.steps += 1
        self.publisher.is_new = True
        if not env.agents:
            self._observations, _ = env.reset()
            return
        actions = self._policy.act(self._observations)
        self._apply_seats(actions)
        self._observations, *_ = env.step(actions)

    def _apply_seats(self, actions: dict[str, Any]) -> None:
        now = time.monotonic()
        for agent, watcher in self.seats.items():
            name = self._env.possible_agents[agent]
            input_s, throttle, steering = self._driving.get(watcher, (0.0, 0.0, 0.0))
            if name in actions and now - input_s < HELD_S:
                actions[name] = hand_action(self._env.config.action, throttle, steering)

    def _handle(self, number: int, request: PageRequest) -> None:
        if self.clock.handle(request):
            return
        if request.kind == "reset":
            self._observations, _ = self._env.reset()
            self.publisher.is_new = True
        elif handle_insertion(self._env, 0, self._audience, number, request, self._tick):
            return
        elif request.kind == "seat":
            self._give_seat(number, request.number)
        elif request.kind == "drive":
            self._driving[number] = (time.monotonic(), request.throttle, request.steering)

    def _give_seat(self, watcher: int, agent: float | None) -> None:
        self.seats = {one: held for one, held in self.seats.items() if held != watcher}
        self._driving.pop(watcher, None)
        if agent is None:
            return
        reason = ""
        if agent >= len(self._env.possible_agents):
            reason = "there is no such agent"
        elif int(agent) in self.seats:
            reason = "another page drives it"
        else:
            self.seats[int(agent)] = watcher
        seat = {"kind": "seat", "agent": None if reason else int(agent), "reason": reason}
        self._audience.send(watcher, seat)


def hand_action(config: ActionConfig, throttle: float, steering: float) -> Any:
    """Convert a page's throttle and steering to an action; on a grid, to the nearest pair."""
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
