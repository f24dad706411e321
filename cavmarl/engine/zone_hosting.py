"""`ZoneHosting`: where the zones of running worlds are, and which processes run them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.zones import ZonesConfig
from cavmarl.core.errors import ConfigError
from cavmarl.engine.peers import Peers
from cavmarl.engine.shard_clock import ShardClock
from cavmarl.engine.tick import Tick
from cavmarl.handoff.coordinator.coordinators import OwnershipRuntime, WorldCoordinators
from cavmarl.handoff.coordinator.saved_ownership import SavedOwnership, zone_table
from cavmarl.handoff.division import ZoneLoads
from cavmarl.handoff.repartitioning import Repartition, Repartitioner
from cavmarl.handoff.zone_view import ZoneView, view_zones
from cavmarl.roads.network import RoadNetwork
from cavmarl.shards.executor import Executor, TeamExecutor
from cavmarl.shards.shard import Shard
from cavmarl.shards.shard_group import ShardGroup
from cavmarl.zones.partition.zone_partition import ZonePartition


class ZoneHosting:
    """The zones of the worlds of a `Tick`.

    Attributes:
        partition: where the zones are; it changes if `zones.repartition_steps` is set.
    """

    def __init__(self, tick: Tick, partition: ZonePartition) -> None:
        self.partition = partition
        self._tick = tick
        self._repartitioner: Repartitioner | None = None

    def let_zones_change(self, network: RoadNetwork, settings: ZonesConfig) -> None:
        """Look for better zones every `zones.repartition_steps` steps, if that is set."""
        coordination = self._tick.coordination
        if (
            settings.repartition_steps
            and self.partition.count > 1
            and isinstance(coordination, WorldCoordinators)
        ):
            self._repartitioner = Repartitioner(
                network,
                self._tick.division,
                coordination,
                settings.repartition_steps,
                settings.repartition_tolerance,
            )

    def before_step(self) -> None:
        """Take other zones, if it is time and they share out the vehicles better."""
        if self._repartitioner is not None:
            partition = self._repartitioner.before_step(self.partition)
            if partition is not None:
                self.partition = partition
                self._tick.executor = ShardGroup(self._tick.shards)

    def use_team(
        self,
        # called with the shards, and with the arguments of the phase `gather`
        make: Callable[[Sequence[Shard], tuple[float, float]], TeamExecutor],
    ) -> None:
        """From now on let several processes run the phases of the shards, as `make` says.

        Raises:
            ConfigError: zones may change, and the other processes would not be told.
        """
        self.refuse_changes("the zones of one world over workers")
        self._tick.host(make)

    def host_zones(self, peers: Peers, coordination: OwnershipRuntime, executor: Executor) -> None:
        """From now on run only the zones of this executor; other processes (peers) run the rest."""
        tick = self._tick
        tick.peers, tick.coordination, tick.executor = peers, coordination, executor
        self._repartitioner = None  # no process has the places of all vehicles

    def set_zones(self, partition: ZonePartition) -> None:
        """Say where zones are, before they have their vehicles."""
        if partition.content_hash != self.partition.content_hash:
            self.partition = partition
            self._tick.division.divide(partition)

    def repartition(
        self,
        partition: ZonePartition,
        vehicles: Sequence[NDArray[np.void]],  # VEHICLE (n,) of each world, of all zones
        contacts: NDArray[np.int64],  # (W,) that all zones have counted
    ) -> None:
        """Take other zones where peers run some of them; `host_zones` has to follow."""
        tick = self._tick
        everywhere = np.ones(len(contacts), dtype=np.bool_)
        self.set_zones(partition)
        tick.division.place(vehicles, contacts)
        tick.peers.keep_own(everywhere)
        tick.coordination.reset(everywhere)
        tick.peers.take_up(tick.departures, tick.division.side)

    def measure_costs(self, every: int = 1) -> ShardClock:
        """From now on measure the processor time of each zone, in one tick of `every`."""
        self.refuse_changes("measuring what each zone costs")
        clock = ShardClock(self._tick.shards, every)
        self._tick.executor = clock
        return clock

    def take_saved(self, saved: SavedOwnership) -> bool:
        """Take the zones of a saved state; return whether the worlds have these zones now.

        Other zones than the present ones are taken only if zones may change while worlds run.
        """
        if saved.zones.tobytes() != zone_table(self.partition).tobytes():
            if self._repartitioner is None:
                return False
            self.set_zones(saved.partition())
            self._tick.executor = ShardGroup(self._tick.shards)
        if self._repartitioner is not None:
            self._repartitioner.steps = saved.numbers.repartition_steps_done
        return True

    @property
    def repartition_steps_done(self) -> int:
        """Steps that count towards the next look for better zones; 0: zones never change."""
        return 0 if self._repartitioner is None else self._repartitioner.steps

    def refuse_changes(self, what: str) -> None:
        """Raise ConfigError if zones may change while the worlds run."""
        if self._repartitioner is not None:
            raise ConfigError(
                f"zones.repartition_steps: {what} needs zones that stay; leave one out"
            )

    @property
    def repartitions(self) -> Sequence[Repartition]:
        """When other zones were taken; see `zones.repartition_steps`."""
        return () if self._repartitioner is None else self._repartitioner.repartitions

    def loads(self) -> ZoneLoads:
        """Return how many vehicles and ghosts each zone has."""
        return self._tick.division.loads()

    def view(self, world: int = 0) -> ZoneView:
        """Return the zones of a world with their vehicles, ghosts and transfers."""
        tick = self._tick
        transfers = tick.coordination.in_flight(world)
        halo_m = self.loads().halo_m
        return view_zones(tick.shards, self.partition, halo_m, world, transfers)

    def ghosts(self, zone: int, world: int = 0) -> NDArray[np.void]:
        """Return VEHICLE (n,), what a zone sees of other zones' vehicles in the present tick.

        The view cannot be written.
        """
        return self._tick.division.ghosts(world, zone)
