"""Controls of vehicles from ROS messages.

A command has the steering angle of the front wheels, and an acceleration or a speed. The vehicle
approaches the speed with the time constant `SPEED_TIME_S`. Steering angles and yaw rates refer to
`base_link`, the middle of the rear axle.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from cavmarl.cosim.followers.follower_messages import Welcome
from cavmarl.cosim.ros2.ros_types import RosTypes, ns_of

SPEED_TIME_S = 0.5  # time constant of the approach to a commanded speed
NEVER = -(1 << 62)  # ns; earlier than any time
_STANDS_MPS = 0.05  # below this speed, a commanded yaw rate means full steering


class Command(NamedTuple):
    """The command of a message."""

    stamp_ns: int
    steering_rad: float
    acceleration_mps2: float | None  # None: `speed_mps` is the target
    speed_mps: float  # target speed, if there is no acceleration
    limit_mps2: float = math.inf  # largest acceleration towards `speed_mps`


def _ackermann(message: Any, wheelbase_m: float) -> Command:
    drive = message.drive
    limit = abs(float(drive.acceleration)) or math.inf  # 0: as fast as possible
    stamp_ns = ns_of(message.header.stamp)
    return Command(stamp_ns, float(drive.steering_angle), None, float(drive.speed), limit)


def _twist(message: Any, wheelbase_m: float) -> Command:
    speed, yaw_rate = float(message.twist.linear.x), float(message.twist.angular.z)
    if abs(speed) > _STANDS_MPS:
        steering = math.atan(wheelbase_m * yaw_rate / speed)
    else:
        steering = math.copysign(0.5 * math.pi, yaw_rate) if yaw_rate else 0.0
    return Command(ns_of(message.header.stamp), steering, None, speed)


def _autoware(message: Any, wheelbase_m: float) -> Command:
    given = message.longitudinal
    acceleration = float(given.acceleration) if given.is_defined_acceleration else None
    steering = float(message.lateral.steering_tire_angle)
    return Command(ns_of(message.stamp), steering, acceleration, float(given.velocity))


_READERS: dict[str, Callable[[Any, float], Command]] = {
    "ackermann_msgs/msg/AckermannDriveStamped": _ackermann,
    "geometry_msgs/msg/TwistStamped": _twist,
    "autoware_control_msgs/msg/Control": _autoware,
}


def control_topics(vehicle: str, is_plain: bool) -> dict[str, str]:
    """Return the topics from which a vehicle takes commands, with their types."""
    if not is_plain:
        return {"/control/command/control_cmd": "autoware_control_msgs/msg/Control"}
    return {
        f"/{vehicle}/cmd_ackermann": "ackermann_msgs/msg/AckermannDriveStamped",
        f"/{vehicle}/cmd_vel": "geometry_msgs/msg/TwistStamped",
    }


@dataclass
class ControlCounts:
    """Counts of the commands of a vehicle."""

    received: int = 0  # messages
    used: int = 0  # steps with a command for their time
    held: int = 0  # steps with an older command, or without any (the vehicle brakes)
    late: int = 0  # steps in which no command arrived before the deadline
    old: int = 0  # messages older than the newest one before them
    invalid: int = 0  # messages with NaN, infinity, or bytes that are not a message
    limited: int = 0  # steps in which a command was beyond the limits of the vehicle


class VehicleControls:
    """The commands of one vehicle.

    `vehicle`: id of its agent. `types`: message types. `welcome`: the world's first message.
    `is_plain`: whether topics have the names of the profile `plain`.
    """

    def __init__(self, vehicle: str, types: RosTypes, welcome: Welcome, is_plain: bool) -> None:
        self.topics = control_topics(vehicle, is_plain)
        self.counts = ControlCounts()
        self.steering_rad = 0.0  # steering angle of the last control
        self._types = types
        self._most = welcome.acceleration_mps2, welcome.steering_rad
        self._last: Command | None = None

    @property
    def stamp_ns(self) -> int:
        """Time of the newest command; `NEVER`: there is none."""
        return NEVER if self._last is None else self._last.stamp_ns

    def take(self, topic: str, data: bytes, wheelbase_m: float) -> None:
        """Read a message in CDR. Invalid and older messages are counted."""
        kind = self.topics[topic]
        self.counts.received += 1
        try:
            command = _READERS[kind](self._types.decode(kind, data), wheelbase_m)
        except (ValueError, AttributeError):
            self.counts.invalid += 1
            return
        numbers = command.steering_rad, command.speed_mps, command.acceleration_mps2 or 0.0
        if not all(map(math.isfinite, numbers)) or math.isnan(command.limit_mps2):
            self.counts.invalid += 1
        elif command.stamp_ns < self.stamp_ns:
            self.counts.old += 1
        else:
            self._last = command

    def forget(self) -> None:
        """Forget the commands of another episode or vehicle."""
        self._last = None
        self.steering_rad = 0.0

    def control(self, due_ns: int, speed_mps: float) -> list[float]:
        """Return throttle and steering in [-1, 1]; count whether they are used, held or limited.

        `ControlCounts` explains the counts. `due_ns`: a command with an earlier time stamp counts
        as held. `speed_mps`: speed of the vehicle.
        """
        if self._last is None:
            self.counts.held += 1
            return [-1.0, 0.0]
        if self._last.stamp_ns >= due_ns:
            self.counts.used += 1
        else:
            self.counts.held += 1
        command, (most_mps2, most_rad) = self._last, self._most
        acceleration = command.acceleration_mps2
        if acceleration is None:
            limit = min(command.limit_mps2, most_mps2)
            wanted = (max(command.speed_mps, 0.0) - speed_mps) / SPEED_TIME_S
            acceleration = min(max(wanted, -limit), limit)
        given = acceleration / most_mps2, command.steering_rad / most_rad
        found = [min(max(one, -1.0), 1.0) for one in given]
        self.counts.limited += found != list(given) or command.speed_mps < 0.0
        self.steering_rad = found[1] * most_rad
        return found
