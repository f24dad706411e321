"""`BridgedWorld`: a world and its bridge, which is another thread of this process."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from tempfile import TemporaryDirectory
from threading import Thread
from typing import Any, Literal, Self

from cavmarl.core.errors import CavmarlError
from cavmarl.cosim.followers.followed_world import FollowedWorld
from cavmarl.cosim.followers.follower_client import Follower
from cavmarl.cosim.followers.follower_connection import Address
from cavmarl.cosim.ros2.ros_bridge import RosBridge, RosOptions
from cavmarl.cosim.time_master import OwnTicks, Pacer
from cavmarl.env.parallel import CavEnv

_STARTS_S = 30.0
_ENDS_S = 10.0


class BridgedWorld:
    """A followed world with a bridge, for a `with` statement.

    Args:
        env: the world, which the caller closes.
        vehicles: agents to drive.
        options: options of the bridge.
        pacer: pace by the wall clock; None: as fast as possible.
        own_ticks: handling of ticks of the bridge; see `FollowedWorld`.
        follow: makes the bridge's connection to an address; None: a `Follower` of the vehicles.

    Attributes:
        world: the world.
        report: figures of the bridge, after the `with` statement.

    Raises:
        CavmarlError: the error of the bridge if it has failed, otherwise the error of the world.
    """

    def __init__(
        self,
        env: CavEnv,
        vehicles: Sequence[str],
        options: RosOptions,
        *,
        pacer: Pacer | None = None,
        own_ticks: OwnTicks = "refuse",
        follow: Callable[[Address], Follower] | None = None,
    ) -> None:
        self.report: dict[str, Any] = {}
        self._options = options
        self._follow = follow or (
            lambda address: Follower(address, vehicles, "ros2", truth=options.truth)
        )
        self._errors: list[Exception] = []
        self._folder = TemporaryDirectory(prefix="cavmarl-ros2-")
        on_drift: Literal["error", "record"] = "error" if own_ticks == "refuse" else "record"
        try:
            self.world = FollowedWorld(
                env,
                f"{self._folder.name}/world.sock",
                timeout_s=options.ready_s + options.deadline_s + _STARTS_S,
                pacer=pacer,
                own_ticks=own_ticks,
                on_drift=on_drift,
                truth=options.truth,
            )
        except BaseException:
            self._folder.cleanup()
            raise
        self._thread = Thread(target=self._run, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        try:
            while not self.world.seats and self._thread.is_alive():
                self.world.admit(0.2)
            if self._errors:
                raise self._errors[0]
        except BaseException:
            self._close()
            raise
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        self._close()
        if self._errors and (error is None or isinstance(error, CavmarlError)):
            raise self._errors[0] from None  # the reason for which the world has stopped

    def _close(self) -> None:
        self.world.close()
        self._thread.join(self._options.deadline_s + _ENDS_S)
        self._folder.cleanup()

    def _run(self) -> None:
        try:
            with self._follow(self.world.address) as follower:
                bridge = RosBridge(follower, self._options)
                bridge.run()
                self.report |= bridge.report()
        except Exception as error:  # raised in the thread that runs the world
            self._errors.append(error)
