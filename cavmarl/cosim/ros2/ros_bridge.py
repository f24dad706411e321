"""`RosBridge`: follows the clock of a world, publishes it over ROS 2, and drives by ROS messages.

In each cycle, the bridge receives the snapshot of a tick, and publishes sensors and states with the
time of the tick, then `/clock`. It waits for commands according to `wait`, and answers. The bridge
starts no world, ticks no world, and sets no pace.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from cavmarl.core.errors import ConfigError, RosError
from cavmarl.cosim.followers.follower_client import Follower, FollowerView
from cavmarl.cosim.ros2.autoware_requests import AutowareRequests
from cavmarl.cosim.ros2.dds_node import LARGE, DdsNode
from cavmarl.cosim.ros2.ros_bag import BagWriter
from cavmarl.cosim.ros2.ros_controls import VehicleControls
from cavmarl.cosim.ros2.ros_topics import (
    CLOCK,
    Profile,
    RosClock,
    VehicleTopics,
    WorldTopics,
)
from cavmarl.cosim.ros2.ros_types import RosMessage, RosTypes

log = logging.getLogger(__name__)

Wait = Literal["stamp", "newest"]

_NODE_NAME = "cavmarl"
_LOOK_S = 0.1  # time between two counts of matched subscribers, wall time
_SETTLED_S = 0.5  # all subscriptions are found if their number is constant for this long, wall time
_REPEAT_S = 1.0  # time between two clock messages while the bridge waits, wall time

BUFFER_LIMIT = Path("/proc/sys/net/core/rmem_max")
BUFFER_BYTES = 4 << 20  # as in `fast_dds.xml`, because a large message arrives in one burst


@dataclass(frozen=True)
class RosOptions:
    """Options of a bridge.

    Attributes:
        profile: topics and frames; see `ros_topics.VehicleTopics`.
        distro: distribution whose types are used.
        domain: ROS_DOMAIN_ID.
        wait: `stamp`: each step waits for a command of its time, minus `lag_steps` steps.
            `newest`: a step takes the newest command and never waits, so results depend on the wall
            clock.
        deadline_s: a step waits at most this long, wall time; then the last command is held.
        lag_steps: a command may be this many steps old.
        ready_s: the first step waits this long for a publisher of commands of each vehicle.
        truth: whether true states are published; the world must allow it.
        names: names of topics and frames by sensor; see `ros_topics.read_names`.
        bag: folder of a bag with all published messages; None: no bag.
    """

    profile: Profile = "plain"
    distro: str = "jazzy"
    domain: int = 0
    wait: Wait = "stamp"
    deadline_s: float = 1.0
    lag_steps: int = 0
    ready_s: float = 30.0
    truth: bool = False
    names: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    bag: Path | None = None

    def __post_init__(self) -> None:
        for name in ("deadline_s", "ready_s"):
            if not 0.0 <= getattr(self, name) < float("inf"):
                raise ConfigError(f"{name} = {getattr(self, name)}: must be finite and at least 0")
        if self.lag_steps < 0:
            raise ConfigError(f"lag_steps = {self.lag_steps}: must be at least 0")


class RosBridge:
    """A follower of a world as a ROS 2 node.

    Args:
        follower: the connection to the world, with the same `truth` as `options`.
        options: settings of the bridge.

    Attributes:
        sent: number of messages by topic.
        steps: number of answered snapshots.
        wait_wall_s: wall time that was spent waiting for commands.

    Raises:
        ConfigError: actions are not continuous, no sensor measures speed, or topic names clash.
        RosError: DDS cannot be started.
        MissingExtraError: the extra `ros2` is not installed.
    """

    def __init__(self, follower: Follower, options: RosOptions) -> None:
        welcome = follower.welcome
        if welcome.vehicles and welcome.action != "continuous":
            raise ConfigError(
                f"action.kind = {welcome.action}: commands of ROS are continuous; set action.kind "
                "= continuous in the world"
            )
        has_speed = any(view.settings.get("type") == "odometry" for view in welcome.sensors)
        if welcome.vehicles and not (has_speed or options.truth):
            raise ConfigError(
                "the vehicles do not measure their speed, which speed commands need; add a "
                "sensor of type odometry to the rig, or publish the truth (--truth)"
            )
        if options.profile == "autoware" and len(welcome.vehicles) > 1:
            raise ConfigError(
                f"{len(welcome.vehicles)} vehicles: Autoware's topic names allow one vehicle per "
                "domain; start one bridge per vehicle, each with its own --domain"
            )
        self._follower, self._options = follower, options
        self._types = RosTypes(options.distro)
        vehicles = [
            VehicleTopics(name, welcome.sensors, options.profile, options.names, options.truth)
            for name in welcome.vehicles
        ]
        clock = RosClock(welcome.dt_s, welcome.ticks_per_step)
        self._topics = WorldTopics(vehicles, clock, options.truth)
        self._vehicles = {one.vehicle: one for one in vehicles}
        self._controls = {
            one.vehicle: VehicleControls(one.vehicle, self._types, welcome, one.is_plain)
            for one in vehicles
        }
        self._requests = {
            one.vehicle: AutowareRequests(self._types, options.truth)
            for one in vehicles
            if not one.is_plain
        }
        self._warned: set[str] = set()  # topics of refused requests
        self._mismatches: set[tuple[str, str]] = set()
        self._driven: dict[str, tuple[int, int]] = {}  # vehicle → episode and vehicle id
        self.sent = dict.fromkeys(self._topics.kinds, 0)
        self.steps, self.wait_wall_s = 0, 0.0
        self._looked_s = 0.0
        self._wanted: frozenset[str] = frozenset()
        self._is_first, self._is_commanded = True, False
        commands = {
            topic: kind
            for topics in (
                *(each.topics for each in self._controls.values()),
                *(each.topics for each in self._requests.values()),
            )
            for topic, kind in topics.items()
        }
        self._bag = (
            None
            if options.bag is None
            else BagWriter(options.bag, self._types, self._topics.kinds, self._topics.latched)
        )
        try:
            self._node = DdsNode(
                self._types,
                _NODE_NAME,
                options.domain,
                self._topics.kinds,
                {**commands, CLOCK: self._topics.kinds[CLOCK]},
                self._topics.latched,
            )
        except BaseException:
            self._close_bag()
            raise
        if any(kind in LARGE for kind in self._topics.kinds.values()):
            _warn_of_small_buffers()

    def run(self, steps: int | None = None) -> None:
        """Follow the world until it ends, or for a number of steps.

        Raises:
            FollowerError: the world refuses this bridge, or has ended without a goodbye.
            RosError: a subscriber does not read, or another node publishes the clock.
        """
        try:
            for view in self._follower:
                if self._is_first and view.snapshot.vehicles:
                    self._is_first = False
                    self._get_ready(view)
                self._publish(view)
                if view.snapshot.is_over:
                    continue
                self._follower.answer(self._answer(view))
                self.steps += 1
                if self.steps == steps:
                    break
        finally:
            self._node.close()
            self._close_bag()

    def report(self) -> dict[str, Any]:
        """Return figures of the run."""
        return {
            "steps": self.steps,
            "wait_wall_s": self.wait_wall_s,
            "time_s": 1e-9 * self._topics.clock.now_ns,
            "sent": {topic: count for topic, count in self.sent.items() if count},
            "type_mismatches": [list(one) for one in sorted(self._mismatches)],
            "controls": {name: asdict(each.counts) for name, each in self._controls.items()},
            "requests": {
                name: {topic: asdict(counts) for topic, counts in each.counts.items()}
                for name, each in self._requests.items()
            },
        }

    def _close_bag(self) -> None:
        if self._bag is not None:
            self._bag.close()

    def _get_ready(self, view: FollowerView) -> None:
        """Wait for publishers of commands, and for subscriptions, so that no message is missed."""
        bases = {name: seen.wheelbase_m for name, seen in view.snapshot.vehicles.items()}
        self._topics.clock.set(view.snapshot.episode, view.snapshot.tick)
        ready_s = self._options.ready_s
        self._until(ready_s, lambda: all(map(self._has_publisher, bases)), bases)
        if any(map(self._has_publisher, bases)):
            self._until(ready_s, _Settled(self._subscribers), bases)
        if silent := [name for name in bases if not self._has_publisher(name)]:
            log.warning(
                "no node publishes commands for %s on domain %d: the vehicles brake until a node "
                "publishes commands; topics: %s",
                ", ".join(silent),
                self._options.domain,
                ", ".join(self._controls[silent[0]].topics),
            )

    def _publish(self, view: FollowerView) -> None:
        self._topics.notice(view)
        now_s = time.monotonic()
        if now_s - self._looked_s > _LOOK_S:
            self._looked_s = now_s
            self._look()
        wanted = frozenset(self._topics.kinds) if self._bag is not None else self._wanted
        if not wanted and not self._topics.has_news(view):
            return
        for message in self._topics.messages(view, wanted):
            self._send(message)

    def _send(self, message: RosMessage) -> None:
        data = self._types.encode(message.kind, message.fields)
        self._node.publish(message.topic, data)
        self.sent[message.topic] += 1
        if self._bag is not None:
            self._bag.write(message, data)

    def _subscribers(self) -> tuple[int, ...]:
        return tuple(map(self._node.subscribers_of, self._topics.kinds))

    def _look(self) -> None:
        """Find the topics with subscribers, report wrong types, and refuse another clock."""
        for topic, kind in self._node.mismatches():
            if (topic, kind) not in self._mismatches:
                self._mismatches.add((topic, kind))
                log.warning(
                    "%s: a node uses this topic with the type %s, but the bridge uses %s; node and "
                    "bridge are not connected: use the type of the bridge, or another topic",
                    topic,
                    kind,
                    self._node.kind_of(topic),
                )
        # One subscription to the clock is this node's own. Latched topics are sent in any case.
        self._wanted = frozenset(
            topic
            for topic in self._topics.kinds
            if topic not in self._topics.latched
            and self._node.subscribers_of(topic) > int(topic == CLOCK)
        )
        self._is_commanded = any(map(self._has_publisher, self._controls)) or any(
            self._node.publishers_of(topic)
            for each in self._requests.values()
            for topic in each.topics
        )
        others = self._node.publishers_of(CLOCK) - 1
        if others > 0:
            raise RosError(
                f"{others} other nodes publish {CLOCK} on domain {self._options.domain}: only "
                "the bridge may publish it; stop their clocks and set use_sim_time, or choose "
                "another domain"
            )

    def _answer(self, view: FollowerView) -> dict[str, list[float]]:
        snapshot = view.snapshot
        clock = self._topics.clock
        for name, seen in snapshot.vehicles.items():
            key = snapshot.episode, seen.vehicle_id
            if self._driven.get(name) != key:
                self._driven[name] = key
                self._controls[name].forget()
        bases = {name: seen.wheelbase_m for name, seen in snapshot.vehicles.items()}
        due_ns = clock.now_ns - self._options.lag_steps * clock.step_ns
        if self._is_commanded:
            self._drain(bases)
        if self._options.wait == "stamp":
            self._await(bases, due_ns)
        answers = {}
        for name in bases:
            controls, vehicle = self._controls[name], self._vehicles[name]
            answers[name] = controls.control(due_ns, vehicle.speed_mps())
            vehicle.motion.steering_rad = controls.steering_rad
        return answers

    def _await(self, bases: Mapping[str, float], due_ns: int) -> None:
        """Wait until each vehicle has a command of this time, or until the deadline."""

        def late() -> list[str]:
            return [name for name in bases if self._controls[name].stamp_ns < due_ns]

        # If no node publishes commands for a vehicle, the step does not wait for them.
        if self._is_commanded:
            began_s = time.monotonic()
            self._until(
                self._options.deadline_s, lambda: not any(map(self._has_publisher, late())), bases
            )
            self.wait_wall_s += time.monotonic() - began_s
        for name in late():
            self._controls[name].counts.late += 1

    def _until(
        self, seconds: float, is_done: Callable[[], bool], bases: Mapping[str, float]
    ) -> None:
        """Read commands until `is_done` returns True or the time is over; repeat the clock."""
        end_s = time.monotonic() + seconds
        repeat_s = time.monotonic() + _REPEAT_S
        while not is_done() and (left_s := end_s - time.monotonic()) > 0.0:
            self._node.wait(min(left_s, _LOOK_S))
            self._drain(bases)
            if time.monotonic() > repeat_s:
                self._send(self._topics.clock_message())
                repeat_s += _REPEAT_S

    def _has_publisher(self, vehicle: str) -> bool:
        return any(map(self._node.publishers_of, self._controls[vehicle].topics))

    def _drain(self, bases: Mapping[str, float]) -> None:
        self._node.take(CLOCK)  # discard this node's own messages
        for name, wheelbase_m in bases.items():
            controls = self._controls[name]
            for topic in controls.topics:
                for received in self._node.take(topic):
                    controls.take(topic, received.data, wheelbase_m)
            if name in self._requests:
                self._take_requests(name)

    def _take_requests(self, name: str) -> None:
        requests, vehicle = self._requests[name], self._vehicles[name]
        for topic in requests.topics:
            for received in self._node.take(topic):
                refusal = requests.take(topic, received.data, vehicle.state)
                if refusal and topic not in self._warned:
                    self._warned.add(topic)
                    log.warning("%s: %s (later refusals are only counted)", name, refusal)
        vehicle.motion.turn_indicators = requests.turn_indicators
        vehicle.motion.hazard_lights = requests.hazard_lights


def _warn_of_small_buffers() -> None:
    """Warn if receive buffers on this machine are too small for large messages."""
    try:
        limit = int(BUFFER_LIMIT.read_text())
    except (OSError, ValueError):  # another operating system, whose limit is unknown
        return
    if limit < BUFFER_BYTES:
        log.warning(
            "net.core.rmem_max = %d: sockets of nodes cannot hold an image or a point cloud of "
            "some MB, and lose parts of it; allow %d bytes: sysctl -w net.core.rmem_max=%d",
            limit,
            BUFFER_BYTES,
            BUFFER_BYTES,
        )


class _Settled:
    """A condition that is true when counts have not changed for `_SETTLED_S`."""

    def __init__(self, count: Callable[[], tuple[int, ...]]) -> None:
        self._count = count
        self._last: tuple[int, ...] = ()
        self._since_s = time.monotonic()

    def __call__(self) -> bool:
        found = self._count()
        if found != self._last:
            self._last, self._since_s = found, time.monotonic()
        return time.monotonic() - self._since_s > _SETTLED_S


def join(
    address: str | int,
    vehicles: Sequence[str],
    options: RosOptions,
    *,
    secret: str = "",
    joins_s: float = 60.0,
    steps: int | None = None,
) -> dict[str, Any]:
    """Attach a bridge to a running world until it ends, and return figures; see `RosBridge`.

    Args:
        address: path of a Unix socket, or a port of this machine.
        vehicles: agents to drive.
        options: settings of the bridge.
        secret: the world's secret, if the world listens at a port.
        joins_s: maximum time for the world to accept the bridge.
        steps: number of steps; None: until the world ends.

    Raises:
        FollowerError: the world refuses the bridge.
        ConfigError, RosError: as `RosBridge`.
    """  # fmt: skip
    with Follower(address, vehicles, "ros2", joins_s, secret, options.truth) as follower:
        bridge = RosBridge(follower, options)
        bridge.run(steps)
        return bridge.report()
