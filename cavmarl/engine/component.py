"""Components that act in each tick besides the traffic: mounted sensors, messages, scripts.

`tick_setup.attach` makes the components. A component keeps its state in arrays (W, …) and is called
at fixed points of a tick. It reads the rows of all shards and writes only its own arrays, so its
results do not depend on the division of a world.
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
from cavmarl.traffic.lane_plans import LanePlans


class ComponentContext(NamedTuple):
    """The worlds to which a component is attached."""

    config: EnvConfig
    network: RoadNetwork
    num_worlds: int  # W
    shards: Sequence[Shard]  # one per zone; components read their rows
    division: ZonedShards  # all shards together
    travel: TripTables
    outputs: Outputs  # outputs of the agents
    zeros: Zeros  # allocates the arrays that outlive a tick
    frames: Frames  # samples of the agents' rigs
    lane_plans: LanePlans | None = None  # plans of worlds whose lanes may differ from the map
    # (W,) the tick in which lanes last changed, -1: never; see `NativeTraffic`
    changed_at: NDArray[np.int64] = np.zeros(0, dtype=np.int64)
    num_persons: int = 0  # slots of SUMO's persons
    # EXTERNAL (K, L) of the replayed road users of a logged scene, see `logged_commands`
    replayed: NDArray[np.void] | None = None


class Component(Protocol):
    """A part of W worlds that acts in each tick.

    A method that a component does not define does nothing. A tick may be repeated: then `arrays`
    are restored to their state before the tick.

    Attributes:
        reads_all: names of the methods (`reset`, `begin` or `end`) that read the vehicles of all
            zones. This attribute is read again before each call. All other methods read only the
            vehicles and ghosts of the zones in this process. The process that has an agent's
            vehicle keeps the agent's part of `arrays`.
    """

    @property
    def reads_all(self) -> tuple[str, ...]:
        return ()

    def reset(self, chosen: NDArray[np.bool_]) -> None:
        """Begin an episode in the chosen worlds (W,), after vehicles and signals are placed."""
        return

    def begin(self, commands: Commands) -> None:
        """Begin a tick. The rows have the state of tick t, and their owners are decided."""
        return

    def end(self) -> None:
        """End a tick. The rows and the signals have the state of t + 1; agents sense afterwards."""
        return

    def arrays(self) -> Iterator[NDArray[Any]]:
        """Return all arrays (W, …) that outlive a tick. Each call returns the same arrays.

        The hash of the state covers them. They must not depend on the division of a world or on
        the places of its rows. Records must have no padding, because padding is not saved.
        """
        return iter(())

    def wrong(self, saved: Sequence[NDArray[Any]]) -> str:
        """Return the fault of saved arrays with the shapes of `arrays`; empty if they are valid."""
        return ""
