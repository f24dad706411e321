"""`WorldViews`: what can be read of running worlds, between two steps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.core.errors import ConfigError
from cavmarl.core.records.arrays import DepartureQueue, Outputs, TripTables, Worlds
from cavmarl.engine.component import Component
from cavmarl.engine.rig_component import RigComponent
from cavmarl.engine.tick import Tick
from cavmarl.engine.traffic_stats import TrafficStats, count_traffic
from cavmarl.engine.v2x_component import V2xComponent
from cavmarl.engine.zone_hosting import ZoneHosting
from cavmarl.handoff.coordinator.coordinator import Coordinator
from cavmarl.handoff.division import ZonedShards
from cavmarl.roads.network import RoadNetwork
from cavmarl.shards.shard import Shard
from cavmarl.traffic.scenarios.scene import Scene
from cavmarl.traffic.sumo.sumo_traffic import SumoTraffic
from cavmarl.v2x.bus import Bus
from cavmarl.zones.partition.zone_partition import ZonePartition


class WorldViews:
    """Read access to W worlds that run; `Simulation` makes and steps them.

    Attributes:
        zones: where the zones are, and which processes run them.
    """

    def __init__(
        self, config: EnvConfig, network: RoadNetwork, tick: Tick, zones: ZoneHosting
    ) -> None:
        self.config = config
        self.network = network
        self.zones = zones
        self._tick = tick
        self._shards = tick.shards

    @property
    def num_worlds(self) -> int:
        """W."""
        return self._tick.division.num_worlds

    @property
    def partition(self) -> ZonePartition:
        """Where the zones are now."""
        return self.zones.partition

    @property
    def _shard(self) -> Shard:
        """The first shard; what all shards have in common is read from it."""
        return self._shards[0]

    @property
    def shards(self) -> Sequence[Shard]:
        """One a zone, for the caller that runs their phases."""
        return self._shards

    @property
    def capacity(self) -> int:
        return int(self._shard.worlds.rows.shape[1])

    @property
    def outputs(self) -> Outputs:
        """What the agents got at the end of the last step; arrays that the next step overwrites."""
        return self._tick.shared.outputs

    @property
    def messages(self) -> Bus:
        """What vehicles and roadside units tell each other."""
        for part in self._tick.attached:
            if isinstance(part, V2xComponent):
                return part.bus
        raise ConfigError("no messages are sent here: set v2x.enabled to true")

    @property
    def departures(self) -> DepartureQueue:
        """Departures waiting in each world, and counts since its reset; resets may replace it."""
        return self._tick.departures

    @property
    def goal_edges(self) -> NDArray[np.int32]:
        """EDGE rows (M, G) of the goals, by MAP row and `VEHICLE["goal"]`."""
        return self._tick.traffic.goal_edges

    @property
    def types(self) -> NDArray[np.void]:
        """VTYPE (num_types,), by `VEHICLE["vtype"]`."""
        return self._shard.travel.types

    @property
    def travel(self) -> TripTables:
        """Types and ways of all vehicles."""
        return self._shard.travel

    @property
    def scene(self) -> Scene | None:
        """What is played to the agent of each world."""
        return self._tick.traffic.scene

    @property
    def plans(self) -> NDArray[np.void]:
        """PLAN (G, L): the ways of agents, by `VEHICLE["goal"]`."""
        return self._tick.traffic.plans

    @property
    def division(self) -> ZonedShards:
        """The shards together, and the rows that go between them."""
        return self._tick.division

    def vehicles(self, world: int = 0) -> NDArray[np.void]:
        """The live vehicles of one world, VEHICLE records in no order.

        A view, or, where the world is divided, a copy.
        """
        return self._tick.division.vehicles(world)

    def running(self) -> NDArray[np.int64]:
        return self._tick.division.running()

    @property
    def migrations(self) -> int:
        """How many vehicles have changed their owner since the worlds were made."""
        return sum(coordinator.switched for coordinator in self.coordinators)

    @property
    def coordinators(self) -> tuple[Coordinator, ...]:
        """The coordinators, one a world; none where all is one zone."""
        return self._tick.coordination.coordinators

    @property
    def attached(self) -> tuple[Component, ...]:
        """What acts in each tick beside the traffic."""
        return self._tick.attached

    @property
    def worlds(self) -> Worlds:
        """The vehicles and signals of all worlds, for tools that measure; each tick swaps them.

        A copy where worlds are divided.
        """
        return self._tick.division.whole()

    @property
    def mounted(self) -> RigComponent | None:
        """The rigs of the agents; None: they have none."""
        rigs = (part for part in self._tick.attached if isinstance(part, RigComponent))
        return next(rigs, None)

    def agent_arrays(self) -> list[NDArray[Any]]:
        """What is kept of agents, (W, A, …); over nodes each has it of the vehicles it has."""
        rig = () if self.mounted is None else self.mounted.arrays()
        return [self._tick.shards[0].worlds.pending, self.outputs.observations, *rig]

    def signal_phases(self, world: int = 0) -> NDArray[np.int32]:
        """PHASE rows that are on, (num_signals,)."""
        phases: NDArray[np.int32] = self._shard.worlds.signal_phase[world]
        return phases

    def ticks(self) -> NDArray[np.int64]:
        return self._shard.worlds.ticks

    @property
    def sumo(self) -> SumoTraffic | None:
        """SUMO beside these worlds; None where `traffic.source` is native."""
        return self._tick.sumo.traffic

    def agents_to_come(self) -> NDArray[np.bool_]:
        tick = self._tick
        longest = int(tick.departures.num_queue.max(initial=0))
        if longest == 0:
            return np.zeros(self.num_worlds, dtype=np.bool_)
        waiting = np.arange(longest) < tick.departures.num_queue[:, None]
        found = np.any(waiting & (tick.departures.queue["agent"][:, :longest] >= 0), axis=1)
        return np.asarray(found, dtype=np.bool_)

    def traffic_stats(self, world: int = 0) -> TrafficStats:
        return count_traffic(self._tick.departures, self._tick.division, world)
