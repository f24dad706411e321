"""`Barrier` sends each follower a snapshot and waits for the controls of all followers."""

from __future__ import annotations

import selectors
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from cavmarl.core.errors import ActionError, ClockError, FollowerError, FollowerLostError
from cavmarl.cosim.actors.client_actors import ClientActor, ClientActors
from cavmarl.cosim.actors.pose_track import PoseSample
from cavmarl.cosim.followers.follower_connection import FollowerConnection
from cavmarl.cosim.followers.follower_messages import (
    MAX_POSES,
    ActorPoses,
    Control,
    PoseView,
    Say,
    Ticked,
    read_payload,
)
from cavmarl.cosim.followers.follower_snapshots import SnapshotTime, see_actors, take_snapshot
from cavmarl.cosim.time_master import TimeFollower
from cavmarl.env.parallel import CavEnv

READS_S = 0.5  # time to read a snapshot if the world does not wait for the follower
MOST_MESSAGES = 1000  # limit per step for a follower for which the world does not wait
BadControls = Literal["error", "hold"]


@dataclass(eq=False)
class FollowerSeat:
    """A follower as seen by the world."""

    line: FollowerConnection
    clock: TimeFollower  # its view of the master's clock
    agents: tuple[int, ...]  # indices of the agents that it drives, ascending
    truth: bool = False  # whether it receives the true state of all vehicles
    actors: tuple[ClientActor, ...] = ()  # actors that it has brought into the world
    waits: bool = True  # whether the world waits for its answers
    leads: bool = False  # whether its ticks release the steps of the world
    has_ticked: bool = False  # whether it has released the next step
    frame: int = -1  # frame of the last snapshot sent to the follower; -1: none yet
    held: dict[str, Any] = field(default_factory=dict)  # last controls of its vehicles
    answers: int = 0  # number of controls sent in time
    late: int = 0  # number of answers to earlier snapshots, which are discarded
    bad: int = 0  # number of invalid controls of a vehicle
    wait_wall_s: float = 0.0  # time that the world has waited for the follower, wall clock
    slowest: int = 0  # number of steps in which it was the last to answer
    unseen: int = 0  # number of snapshots not sent, because earlier snapshots were unread

    @property
    def rank(self) -> tuple[float, str]:
        """Sort key of followers: their first agent, then the name."""
        return (self.agents[0] if self.agents else float("inf"), self.clock.name)


@dataclass
class BarrierOutcome:
    """The result of one barrier."""

    actions: dict[str, Any] = field(default_factory=dict)  # by agent
    # followers with which the world cannot continue, and the reasons
    failed: dict[FollowerSeat, FollowerError] = field(default_factory=dict)
    left: list[FollowerSeat] = field(default_factory=list)  # followers that have sent goodbye


class Barrier:
    """Sends snapshots and waits for the followers' answers.

    `timeout_s`: maximum time for all of them together, by the wall clock. `bad_controls`:
    `error`: a follower that sends invalid controls fails; `hold`: the last valid controls are used.
    """

    def __init__(
        self, env: CavEnv, actors: ClientActors, timeout_s: float, bad_controls: BadControls
    ) -> None:
        self._env = env
        self._actors = actors
        self._timeout_s = timeout_s
        self._bad_controls = bad_controls

    def pass_through(self, seats: Sequence[FollowerSeat], moment: SnapshotTime) -> BarrierOutcome:
        """Send each follower its snapshot and receive its controls.

        `seats`: in the order of service. `moment`: time of the snapshots.
        """
        found = BarrierOutcome()
        asked: dict[FollowerSeat, list[str]] = {}
        rows = self._actors.rows() if any(seat.actors for seat in seats) else {}
        for seat in seats:
            seat.frame = moment.frame
            if not seat.waits and not seat.line.can_send():
                seat.unseen += 1
                continue
            actors = see_actors(self._env, seat.actors, rows)
            snapshot, arrays = take_snapshot(
                self._env, seat.agents, moment, truth=seat.truth, actors=actors
            )
            if seat.waits:
                asked[seat] = list(snapshot.vehicles)
            try:
                within_s = self._timeout_s if seat.waits else min(self._timeout_s, READS_S)
                seat.line.say(Say.SNAPSHOT, snapshot, arrays, within_s)
            except FollowerLostError as error:
                if error.is_late:  # otherwise, the messages read below may contain its goodbye
                    found.failed[seat] = error
                    asked.pop(seat, None)
        if moment.is_over or not asked:
            return found
        answers = self._collect(asked, moment, found)
        for seat in asked:
            if seat in answers:
                try:
                    found.actions |= self._checked(seat, answers[seat], asked[seat])
                    seat.answers += 1
                except FollowerError as error:
                    found.failed[seat] = error
        return found

    def hear_others(self, seats: Sequence[FollowerSeat], moment: SnapshotTime) -> BarrierOutcome:
        """Receive messages of the followers for which the world does not wait.

        A follower that has closed its connection has left. `moment`: time of the last snapshot.
        """
        found = BarrierOutcome()
        for seat in seats:
            answers: dict[FollowerSeat, Mapping[str, Any]] = {}
            try:
                for _ in range(MOST_MESSAGES):
                    if not seat.line.has_come():
                        break
                    if self._receive(seat, moment, answers, found, self._timeout_s):
                        if seat in found.left:
                            break
                        self._checked(seat, answers.pop(seat), [])
                        seat.answers += 1
            except FollowerLostError:
                found.left.append(seat)
            except FollowerError as error:
                found.failed[seat] = error
        return found

    def await_tick(self, seat: FollowerSeat, moment: SnapshotTime) -> BarrierOutcome:
        """Wait until the follower that leads releases the next step.

        `moment`: time of the last snapshot.
        """
        found = BarrierOutcome()
        answers: dict[FollowerSeat, Mapping[str, Any]] = {}
        began = time.monotonic()
        try:
            while not seat.has_ticked and seat not in found.left:
                left_s = began + self._timeout_s - time.monotonic()
                if left_s <= 0.0:
                    raise seat.line.too_late("answered with a tick", self._timeout_s)
                if self._receive(seat, moment, answers, found, left_s) and seat in answers:
                    self._checked(seat, answers.pop(seat), [])
        except FollowerError as error:
            found.failed[seat] = error
        seat.wait_wall_s += time.monotonic() - began
        return found

    def confirm_tick(self, seat: FollowerSeat) -> None:
        """Tell the follower that leads that its step has been made.

        Raises FollowerLostError: the follower does not read, or has ended.
        """
        seat.has_ticked = False
        tick = int(seat.clock.master.world_ticks[0])
        seat.line.say(Say.TICKED, Ticked(True, "", tick), within_s=self._timeout_s)

    def _collect(
        self, asked: Mapping[FollowerSeat, list[str]], moment: SnapshotTime, found: BarrierOutcome
    ) -> dict[FollowerSeat, Mapping[str, Any]]:
        """Receive the controls of all followers in the order in which they arrive."""
        answers: dict[FollowerSeat, Mapping[str, Any]] = {}
        began = time.monotonic()
        with selectors.DefaultSelector() as selector:
            for seat in asked:
                selector.register(seat.line, selectors.EVENT_READ, seat)
            while waiting := [key.data for key in selector.get_map().values()]:
                left_s = max(began + self._timeout_s - time.monotonic(), 0.0)
                ready = [key.data for key, _ in selector.select(left_s)]
                for seat in ready or waiting:
                    try:
                        if not ready:
                            raise seat.line.too_late("answered", self._timeout_s)
                        if not self._receive(seat, moment, answers, found, left_s):
                            continue
                    except FollowerError as error:
                        found.failed[seat] = error
                    seat.wait_wall_s += time.monotonic() - began
                    selector.unregister(seat.line)
                    last = seat
        last.slowest += 1
        return answers

    def _receive(
        self,
        seat: FollowerSeat,
        moment: SnapshotTime,
        answers: dict[FollowerSeat, Mapping[str, Any]],
        found: BarrierOutcome,
        within_s: float,
    ) -> bool:
        """Receive one frame of a follower; return whether the follower is done.

        Raises FollowerError: the world cannot continue with this follower.
        """
        # A frame that arrived just before the deadline is still read.
        within_s = max(within_s, 1e-3)
        frame = seat.line.hear(within_s)
        seat.line.skip(frame)
        match frame.kind:
            case Say.TICK if seat.leads:
                if seat.has_ticked:
                    raise FollowerError(f"{seat.line.name} ticks twice; wait for TICKED first")
                seat.has_ticked = True
                return False
            case Say.TICK:
                self._answer_tick(seat, within_s)
                return False
            case Say.GOODBYE:
                found.left.append(seat)
                return True
            case Say.POSES:
                self._take_poses(seat, moment, read_payload(ActorPoses, frame.payload).poses)
                return False
            case Say.CONTROL:
                control = read_payload(Control, frame.payload)
            case kind:
                raise FollowerError(
                    f"{seat.line.name} sent {kind.name}; controls of frame {moment.frame} are due"
                )
        if control.frame > moment.frame:
            raise FollowerError(
                f"{seat.line.name} answers frame {control.frame}; the last is {moment.frame}"
            )
        if control.frame < moment.frame and seat.waits:
            seat.late += 1
            return False
        self._take_poses(seat, moment, control.poses)
        answers[seat] = control.controls
        return True

    def _take_poses(
        self, seat: FollowerSeat, moment: SnapshotTime, poses: Mapping[str, Sequence[PoseView]]
    ) -> None:
        """Take the poses of a follower's actors.

        Raises FollowerError: a pose is invalid, and `bad_controls` is `error`.
        """
        actors = {actor.name: actor for actor in seat.actors}
        now_s = moment.tick * self._env.config.clock.sim_dt_s
        for name, views in poses.items():
            if name not in actors:
                raise FollowerError(
                    f"{seat.line.name} sent poses of {name[:80]}, which is not its actor"
                )
            if len(views) > MAX_POSES:
                raise FollowerError(
                    f"{seat.line.name}: {len(views)} poses of {name} in a message; the limit is "
                    f"{MAX_POSES}"
                )
            for view in views:
                try:
                    self._actors.add_pose(actors[name], PoseSample(**vars(view)), now_s)
                except ActionError as error:
                    self._note_bad(seat, error)

    def _note_bad(self, seat: FollowerSeat, error: Exception) -> None:
        """Count invalid controls or an invalid pose; raise FollowerError if it is an error."""
        seat.bad += 1
        if self._bad_controls == "error":
            raise FollowerError(f"{seat.line.name}: {error}") from error

    def _answer_tick(self, seat: FollowerSeat, within_s: float) -> None:
        done, refused = False, ""
        try:
            done = seat.clock.tick()
        except ClockError as error:
            refused = str(error)
        tick = int(seat.clock.master.world_ticks[0])
        seat.line.say(Say.TICKED, Ticked(done, refused, tick), within_s=within_s)

    def _checked(
        self, seat: FollowerSeat, controls: Mapping[str, Any], vehicles: Sequence[str]
    ) -> dict[str, Any]:
        """Return the actions of a follower's vehicles.

        Raises FollowerError: an action is invalid, and `bad_controls` is `error`.
        """
        actors = {actor.name: actor for actor in seat.actors}
        unknown = controls.keys() - set(vehicles) - actors.keys()
        if unknown:
            raise FollowerError(
                f"{seat.line.name}: controls of {min(unknown)[:80]}, which is not in the frame"
            )
        for name in controls.keys() & actors.keys():
            try:
                self._actors.drive(actors[name], controls[name])
            except ActionError as error:
                self._note_bad(seat, error)
        checked: dict[str, Any] = {}
        for vehicle in vehicles:
            try:
                action = _action(vehicle, controls)
                self._env.check_action(vehicle, action)
                checked[vehicle] = action
            except (FollowerError, ActionError) as error:
                self._note_bad(seat, error)
                if vehicle in seat.held:
                    checked[vehicle] = seat.held[vehicle]
        seat.held = checked
        return checked


def _action(vehicle: str, controls: Mapping[str, Any]) -> Any:
    """Return one vehicle's action.

    Raises FollowerError: the action is missing.
    """
    if vehicle not in controls:
        raise FollowerError(f"no controls of {vehicle}, which is in the frame")
    given = controls[vehicle]
    return np.asarray(given, dtype=np.float32) if isinstance(given, list) else given
