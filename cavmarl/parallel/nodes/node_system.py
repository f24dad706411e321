"""The system of the caller and the nodes: a clock, connections and worlds."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from typing import Any, Protocol

from cavmarl.parallel.network.tcp_transport import TcpTransport
from cavmarl.parallel.network.transport import Transport
from cavmarl.parallel.nodes.leases import late_ticks
from cavmarl.parallel.worlds.journaled_worlds import without_journals
from cavmarl.parallel.worlds.local_worlds import LocalWorlds
from cavmarl.parallel.worlds.world_message import world_of

LOOKS = 25  # polls of about a microsecond each


class NodeSystem(Transport, Protocol):
    """The system of a node: a real machine, or the simulated machine of `cavmarl.verify`."""

    looks: int  # number of times a node polls for a frame of another node before it sleeps

    def now_s(self) -> float:
        """Return the time of a monotonic clock of this process."""
        ...

    def worlds_of(
        self,
        message: Mapping[str, Any],
        trouble: str,  # error text if files differ
        num_worlds: int,
        in_next_step: bool,  # whether new episodes start a step later
    ) -> LocalWorlds:
        """Make the worlds of a message."""
        ...


class Machine:
    """The system of this machine."""

    looks = LOOKS if (os.cpu_count() or 1) > 1 else 0
    now_s = staticmethod(time.monotonic)

    def __init__(self, transport: Transport) -> None:
        self.open, self.listen, self.poll = transport.open, transport.listen, transport.poll

    def worlds_of(
        self, message: Mapping[str, Any], trouble: str, num_worlds: int, in_next_step: bool
    ) -> LocalWorlds:
        world = world_of(message, trouble)
        late = late_ticks(world.config)
        world = without_journals(world)
        return LocalWorlds(world, num_worlds, warm=True, in_next_step=in_next_step, late_ticks=late)


MACHINE = Machine(TcpTransport())
