"""`WorldViews`: read access to running worlds between two steps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.core.errors import ConfigError
from cavmarl.core.records.arrays import DepartureQueue, Outputs, TripTables, Worlds
from cavmarl.engine.component import Component
from cavmarl.engine.external_component import ExternalComponent
from cavmarl.engine.limit_component import LimitComponent
from cavmarl.engine.rig_component import RigComponent
from cavmarl.engine.signal_component import SignalComponent
from cavmarl.engine.tick import Tick
from cavmarl.engine.traffic_stats import TrafficStats, count_traffic
from cavmarl.engine.v2x_component import V2xComponent
from cavmarl.engine.zone_hosting import ZoneHosting
from cavmarl.handoff.coordinator.coordinator import Coordinator
from cavmarl.handoff.division import ZonedShards
from cavmarl.roads.network import RoadNetwork
from cavmarl.shards.shard import Shard
from cavmarl.signals.controllers import SignalView
from cavmarl.traffic.scenarios.scene import Scene
from cavmarl.traffic.sumo.sumo_traffic import SumoTraffic
from cavmarl.v2x.bus import Bus
from cavmarl.zones.partition.zone_partition import ZonePartition

Part = TypeVar("Part")


class WorldViews:
    """Read access to W running worlds; `Simulation` makes and steps them.

    Attributes:
        zones: the zones, and the processes that run them.
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
        """The number W of worlds."""
        return self._tick.division.num_worlds

    @property
    def partition(self) -> ZonePartition:
        """The present zones."""
        return self.zones.partition

    @property
    def _shard(self) -> Shard:
        """The first shard, from which the state that all shards share is read."""
        return self._shards[0]

    @property
    def shards(self) -> Sequence[Shard]:
        """One shard per zone, for the caller that runs their phases."""
        return self._shards

    @property
    def capacity(self) -> int:
        return int(self._shard.worlds.rows.shape[1])

    @property
    def outputs(self) -> Outputs:
        """The agents' outputs of the last step; the next step overwrites these arrays."""
        return self._tick.shared.outputs

    @property
    def messages(self) -> Bus:
        """The bus of messages between vehicles and roadside units."""
        missing = "v2x.enabled = false: there are no messages; set it to true"
        return self._part(V2xComponent, missing).bus

    @property
    def departures(self) -> DepartureQueue:
        """Waiting departures of each world, and counts since its reset; a reset may replace it."""
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
    def type_rows(self) -> dict[str, int]:
        """VTYPE rows of the types of agents' and of the caller's vehicles, by name."""
        return self._tick.traffic.type_rows

    @property
    def external(self) -> ExternalComponent:
        """The slots of vehicles that the caller poses or drives, and of replayed vehicles."""
        missing = "population.external = 0: there is no room for such vehicles; set it higher"
        return self._part(ExternalComponent, missing)

    @property
    def signals(self) -> SignalComponent:
        """The signals that agents control."""
        missing = "signals.agents = none: set it to all, or to a list of ids of signals"
        return self._part(SignalComponent, missing)

    @property
    def roadside(self) -> SignalComponent | LimitComponent:
        """The component of the signals or of the limits that are controlled."""
        if self.config.limits.are_controlled:
            return self._part(LimitComponent, "limits.agents = none: set it to all, or to names")
        return self.signals

    def _part(self, kind: type[Part], missing: str) -> Part:
        """Return the component of a kind. Raises ConfigError with the text if there is none."""
        for part in self._tick.attached:
            if isinstance(part, kind):
                return part
        raise ConfigError(missing)

    def signal_view(self) -> SignalView:
        """Return what signal controllers know, in arrays that the worlds update."""
        part, config = self.signals, self.config
        outputs = part.outputs
        return SignalView(
            config=config.signals,
            dt=config.clock.sim_dt_s,
            table=part.table,
            observations=outputs.observations,
            ticks=self.ticks(),
            counts=outputs.counts,
            states=outputs.states,
            masks=outputs.masks,
            decides=outputs.decides,
            history=outputs.history,
            loops=outputs.loops,
        )

    @property
    def travel(self) -> TripTables:
        """Types and routes of all vehicles."""
        return self._shard.travel

    @property
    def scene(self) -> Scene | None:
        """The scenario of each world; None: there is none."""
        return self._tick.traffic.scene

    @property
    def plans(self) -> NDArray[np.void]:
        """PLAN (G, L): the routes of agents, by `VEHICLE["goal"]`."""
        return self._tick.traffic.plans

    @property
    def division(self) -> ZonedShards:
        """All shards together, and the rows that are exchanged between them."""
        return self._tick.division

    def vehicles(self, world: int = 0) -> NDArray[np.void]:
        """Return the vehicles of one world, VEHICLE records in any order.

        They are a view; in a divided world, a copy.
        """
        return self._tick.division.vehicles(world)

    def running(self) -> NDArray[np.int64]:
        return self._tick.division.running()

    @property
    def migrations(self) -> int:
        """Number of changes of owner since the worlds were made."""
        return sum(coordinator.switched for coordinator in self.coordinators)

    @property
    def coordinators(self) -> tuple[Coordinator, ...]:
        """The coordinators, one per world; none in an undivided world."""
        return self._tick.coordination.coordinators

    @property
    def attached(self) -> tuple[Component, ...]:
        """The components that act in each tick."""
        return self._tick.attached

    @property
    def worlds(self) -> Worlds:
        """The vehicles and signals of all worlds, for measuring tools. Each tick swaps the arrays.

        In divided worlds they are a copy.
        """
        return self._tick.division.whole()

    @property
    def mounted(self) -> RigComponent | None:
        """The sensor rigs of the agents; None: there are none."""
        rigs = (part for part in self._tick.attached if isinstance(part, RigComponent))
        return next(rigs, None)

    def agent_arrays(self) -> list[NDArray[Any]]:
        """Return the agents' state arrays (W, A, …). A node has the state of its own vehicles."""
        rig = () if self.mounted is None else self.mounted.arrays()
        return [self._tick.shards[0].worlds.pending, self.outputs.observations, *rig]

    def signal_phases(self, world: int = 0) -> NDArray[np.int32]:
        """Return the present PHASE rows of the signals and more, see `Worlds.signal_phase`."""
        phases: NDArray[np.int32] = self._shard.worlds.signal_phase[world]
        return phases

    def ticks(self) -> NDArray[np.int64]:
        return self._shard.worlds.ticks

    @property
    def sumo(self) -> SumoTraffic | None:
        """SUMO in these worlds; None if `traffic.source` is native."""
        return self._tick.outside.sumo

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
