"""What a caller or a node needs of the system: a clock, connections, and the worlds of a recipe."""

from __future__ import annotations

import os
import select
import socket
import time
from collections.abc import Mapping
from typing import Any, Protocol, TypeAlias

from cavmarl.parallel.journaled_worlds import unwatched
from cavmarl.parallel.local_worlds import LocalWorlds
from cavmarl.parallel.network.listener import Listener, call
from cavmarl.parallel.nodes.leases import late_ticks
from cavmarl.parallel.recipe import world_of

LOOKS = 25  # of about a microsecond each

Place: TypeAlias = tuple[str, int]


class Poll(Protocol):
    """As `select.poll` makes it."""

    def register(self, one: Any, events: int) -> None: ...

    def modify(self, one: Any, events: int) -> None: ...

    def unregister(self, one: Any) -> None: ...

    def poll(self, timeout_ms: float | None) -> list[tuple[int, int]]: ...


class NodeListener(Protocol):
    """As `Listener`."""

    @property
    def place(self) -> Place: ...

    def fileno(self) -> int: ...

    def admit(self) -> list[tuple[int, socket.socket]]: ...

    def close(self) -> None: ...


class NodeSystem(Protocol):
    """`cavmarl.verify` has one beside this machine's, in which all processes are threads of one."""

    looks: int  # that a node takes for what another one sends before it sleeps

    def now_s(self) -> float:
        """A clock that never goes back; of this process alone."""
        ...

    def poll(self) -> Poll: ...

    def listen(self, address: str, secret: bytes) -> NodeListener: ...

    def call(
        self, place: Place, secret: bytes, number: int, answer_s: float | None
    ) -> socket.socket: ...

    def worlds_of(
        self,
        recipe: Mapping[str, Any],
        trouble: str,  # what it means if its files differ
        num_worlds: int,
        in_next_step: bool,  # when worlds begin anew
    ) -> LocalWorlds: ...


class Machine:
    """This machine's."""

    looks = LOOKS if (os.cpu_count() or 1) > 1 else 0
    now_s = staticmethod(time.monotonic)

    def poll(self) -> Poll:
        return select.poll()

    def listen(self, address: str, secret: bytes) -> NodeListener:
        return Listener(address, secret)

    def call(
        self, place: Place, secret: bytes, number: int, answer_s: float | None
    ) -> socket.socket:
        return call(place, secret, number, answer_s)

    def worlds_of(
        self, recipe: Mapping[str, Any], trouble: str, num_worlds: int, in_next_step: bool
    ) -> LocalWorlds:
        world = world_of(recipe, trouble)
        late = late_ticks(world.config)
        world = unwatched(world)
        return LocalWorlds(world, num_worlds, warm=True, in_next_step=in_next_step, late_ticks=late)


MACHINE = Machine()
