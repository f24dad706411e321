"""What acts in each tick beside the traffic: mounted sensors, messages, scripts, other simulators.

Each part is made by `tick_setup.attach`, keeps its state in arrays (W, …) and is asked at fixed
points of a tick. It reads the rows of all shards and writes only what is its own, so that nothing
depends on how a world is divided.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.core.memory import Zeros
from cavmarl.core.records.arrays import Outputs, TripTables
from cavmarl.handoff.division import ZonedShards
from cavmarl.roads.network import RoadNetwork
from cavmarl.sensors.mounted.frames import Frames
from cavmarl.shards.shard import Commands, Shard


class ComponentContext(NamedTuple):
    """What a part is attached to."""

    config: EnvConfig
    network: RoadNetwork
    num_worlds: int  # W
    shards: Sequence[Shard]  # one a zone; their rows are what a part reads
    division: ZonedShards  # all of them together
    travel: TripTables
    outputs: Outputs  # what the agents get
    zeros: Zeros  # makes the arrays that outlive a tick
    frames: Frames  # what the rigs of the agents get


class Component(Protocol):
    """A part that acts in each tick of W worlds.

    A tick may be begun again, with everything in `arrays` as it was before.

    Attributes:
        reads_all: the names of those calls, `begin` or `end`, that read vehicles of all zones; the
            others read those of zones in this process and what these see, and what is in `arrays`
            of an agent is kept where its vehicle is.
    """

    reads_all: tuple[str, ...]

    def reset(self, chosen: NDArray[np.bool_]) -> None:
        """Begin an episode in the chosen worlds (W,): vehicles and signals are in their places."""
        ...

    def begin(self, commands: Commands) -> None:
        """Begin a tick: the rows are those of tick t, and their ownership is settled."""
        ...

    def end(self) -> None:
        """The rows and the signals are those of t + 1; agents sense after this."""
        ...

    def arrays(self) -> Iterator[NDArray[Any]]:
        """All that outlives a tick, always the same arrays (W, …); the state's hash is over them.

        An item of one world must not say how it is divided or where its rows lie, and records have
        no gaps between their fields: what stands there is not kept.
        """
        ...

    def wrong(self, saved: Sequence[NDArray[Any]]) -> str:
        """What is wrong with saved arrays of the shapes of `arrays`; empty: nothing."""
        ...
