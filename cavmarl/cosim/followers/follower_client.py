"""`Follower`: a stack's end of the connection to a world."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ClockError, FollowerError
from cavmarl.cosim.followers.follower_connection import Address, call
from cavmarl.cosim.followers.follower_messages import (
    ActorPoses,
    ActorRequest,
    Control,
    FollowerRefusal,
    FollowerSnapshot,
    Hello,
    PoseView,
    Say,
    Ticked,
    Welcome,
    read_payload,
)
from cavmarl.cosim.followers.framed_socket import Frame

CALL_S = 10.0


@dataclass(frozen=True)
class Samples:
    """The samples of one sensor since the last snapshot."""

    values: NDArray[Any]  # (n, …) one sample per row, the newest last
    stamps_s: NDArray[np.float64]  # (n,) time of each, in simulated time since the reset
    lost: NDArray[np.bool_]  # (n,) which samples were lost; their values are 0


@dataclass(frozen=True)
class FollowerView:
    """One snapshot, with its arrays by vehicle and sensor."""

    snapshot: FollowerSnapshot  # the clock, and the vehicles to drive
    # sensors with new samples, by vehicle and sensor name. Data of the whole map have the vehicle
    # name "".
    sensors: Mapping[str, Mapping[str, Samples]]


class Follower:
    """Follows a world's clock: waits for snapshots and answers them.

        with Follower("/tmp/town.sock", vehicles=["car_0"]) as follower:
            for view in follower:
                follower.answer({"car_0": [0.2, 0.0]})

    `address`: path of a Unix socket, or a port of this machine. `vehicles`: agents to drive; none:
    it only follows the clock and answers with {}. `joins_s`: maximum time until the world accepts
    the follower, which happens between two steps; None: no limit. `secret`: secret of the world, if
    it listens at a port. `truth`: whether snapshots contain all vehicles of the world, which the
    world has to allow. `actors`: vehicles, people or roadside units to bring into the world; they
    leave with the follower. `waits`: whether the world waits for the answers; if not, the follower
    may send poses and controls at any time, and misses snapshots while earlier snapshots are
    unread. `leads`: whether each step of the world waits for a `tick` of this follower.

    Attributes:
        welcome: the world's clock and sensors.

    Raises:
        FollowerLostError: no process listens there.
        FollowerError: the world refuses this follower, or uses another version of the protocol.
    """

    def __init__(
        self,
        address: Address,
        vehicles: Sequence[str] = (),
        name: str = "follower",
        joins_s: float | None = 60.0,
        secret: str = "",
        truth: bool = False,
        actors: Sequence[ActorRequest] = (),
        waits: bool = True,
        leads: bool = False,
    ) -> None:
        self._line = call(address, CALL_S)
        self._waits = waits
        hello = Hello(name, list(vehicles), secret, truth, list(actors), waits, leads)
        try:
            self._line.say(Say.HELLO, hello, within_s=CALL_S)
            self.welcome = read_payload(Welcome, self._expect(joins_s, Say.WELCOME).payload)
        except BaseException:
            self._line.close()
            raise
        self._frame: int | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __iter__(self) -> Iterator[FollowerView]:
        """Yield snapshots until the world sends goodbye; answer each unless its episode is over.

        Raises FollowerLostError: the world has ended without a goodbye; FollowerError: the world
        refuses this follower, its message is invalid, or a frame is missing.
        """
        while (view := self.wait()) is not None:
            yield view

    def wait(self) -> FollowerView | None:
        """Return the next snapshot without time limit; None: the world has sent goodbye.

        Raises FollowerError: as in `__iter__`.
        """
        frame = self._expect(None, Say.SNAPSHOT, Say.GOODBYE)
        if frame.kind is Say.GOODBYE:
            return None
        snapshot, arrays = self._line.take(frame)
        if self._waits and self._frame is not None and snapshot.frame != self._frame + 1:
            raise FollowerError(f"frame {snapshot.frame} follows {self._frame}; a frame is missing")
        self._frame = snapshot.frame
        return sight_of(snapshot, arrays)

    def answer(
        self,
        controls: Mapping[str, Any] | None = None,
        poses: Mapping[str, Sequence[PoseView]] | None = None,
    ) -> None:
        """Send the controls of the last snapshot's vehicles for the next step.

        Args:
            controls: by vehicle or actor: two numbers in [-1, 1], or the number of a choice.
            poses: new poses by actor.

        Raises:
            FollowerLostError: the world has ended.
            FollowerError: there has been no snapshot.
        """
        if self._frame is None:
            raise FollowerError("answer() before the first snapshot; call wait()")
        plain = {vehicle: _plain(given) for vehicle, given in (controls or {}).items()}
        listed = {actor: list(given) for actor, given in (poses or {}).items()}
        self._line.say(Say.CONTROL, Control(self._frame, plain, listed))

    def send_poses(self, poses: Mapping[str, Sequence[PoseView]]) -> None:
        """Send poses of actors, at any time, at a rate of their own.

        Raises FollowerLostError: the world has ended.
        """
        self._line.say(
            Say.POSES, ActorPoses({actor: list(given) for actor, given in poses.items()})
        )

    def tick(self) -> Ticked:
        """Advance the world by a step if this follower leads; otherwise, try to do so.

        A follower that leads calls it once after each snapshot, after its answer.

        Raises ClockError: the world's master refuses.
        """
        self._line.say(Say.TICK)
        ticked = read_payload(Ticked, self._expect(None, Say.TICKED).payload)
        if ticked.refused:
            raise ClockError(ticked.refused)
        return ticked

    def leave(self) -> None:
        """Send goodbye instead of an answer: the built-in driver takes over the vehicles."""
        self._line.say(Say.GOODBYE)
        self._line.close()

    def close(self) -> None:
        self._line.close()

    def _expect(self, within_s: float | None, *kinds: Say) -> Frame:
        frame = self._line.hear(within_s)
        if frame.kind in kinds:
            if frame.kind is not Say.SNAPSHOT:
                self._line.skip(frame)
            return frame
        if frame.kind is Say.REFUSAL:
            self._line.skip(frame)
            raise FollowerError(read_payload(FollowerRefusal, frame.payload).reason)
        raise FollowerError(f"{self._line.name} sent {frame.kind.name}, which is not expected now")


def sight_of(snapshot: FollowerSnapshot, arrays: Sequence[NDArray[Any]]) -> FollowerView:
    sensors: dict[str, dict[str, Samples]] = {vehicle: {} for vehicle in snapshot.vehicles}
    for view, array in zip(snapshot.arrays, arrays, strict=True):
        samples = Samples(array, np.array(view.stamps_s), np.array(view.lost, dtype=np.bool_))
        sensors.setdefault(view.vehicle, {})[view.name] = samples
    return FollowerView(snapshot, sensors)


def _plain(given: Any) -> list[float] | int:
    array = np.asarray(given)
    return int(array) if array.ndim == 0 else [float(number) for number in array]
