"""`ZoneHosting`: the zones of running worlds, and the processes that run them."""

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
from cavmarl.handoff.coordinator.message_coordinator import ZoneGate
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
        partition: the zones; it changes if `zones.repartition_steps` is set.
    """

    def __init__(self, tick: Tick, partition: ZonePartition) -> None:
        self.partition = partition
        self._tick = tick
        self._repartitioner: Repartitioner | None = None

    def let_zones_change(self, network: RoadNetwork, settings: ZonesConfig) -> None:
        """Search for better zones every `zones.repartition_steps` steps, if that is set."""
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
        """Change the zones, if a search is due and finds zones with a better balance."""
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
        """Let the executor that `make` returns run the phases of the shards in several processes.

        Raises:
            ConfigError: zones may change, which the other processes would not notice.
        """
        self.refuse_changes("the zones of one world over workers")
        self._tick.host(make)

    def host_zones(
        self,
        zones: Sequence[int],  # of the executor
        peers: Peers,
        coordination: OwnershipRuntime,
        executor: Executor,
    ) -> None:
        """Run only these zones here; other processes (peers) run the rest."""
        tick = self._tick
        tick.peers, tick.coordination, tick.executor = peers, coordination, executor
        tick.outside.host(zones)
        self._repartitioner = None  # no process has the positions of all vehicles

    def set_zones(self, partition: ZonePartition) -> None:
        """Set the zones, before their vehicles are placed."""
        if partition.content_hash != self.partition.content_hash:
            self.partition = partition
            self._tick.division.divide(partition)

    def repartition(
        self,
        partition: ZonePartition,
        vehicles: Sequence[NDArray[np.void]],  # VEHICLE (n,) of each world, of all zones
        contacts: NDArray[np.int64],  # (W,) number of contacts in all zones
    ) -> None:
        """Change the zones of worlds that peers run in part. Call `host_zones` afterwards."""
        tick = self._tick
        everywhere = np.ones(len(contacts), dtype=np.bool_)
        self.set_zones(partition)
        tick.division.place(vehicles, contacts)
        tick.peers.drop_foreign_rows(everywhere)
        tick.coordination.reset(everywhere)
        tick.peers.resume_from(tick.departures, tick.division.side)

    def measure_costs(self, every: int = 1) -> ShardClock:
        """Measure the processor time of each zone from now on, in one tick of `every`."""
        self.refuse_changes("measuring the cost of each zone")
        clock = ShardClock(self._tick.shards, every)
        self._tick.executor = clock
        return clock

    def take_saved(self, saved: SavedOwnership) -> bool:
        """Restore the zones of a saved state. Return whether the worlds have these zones now.

        Zones that differ from the present ones are restored only if zones may change in a run.
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
    def gate(self) -> ZoneGate | None:
        """The simulators that run zones, which may refuse vehicles; None: there are none."""
        return self._tick.outside.gate

    @property
    def repartition_steps_done(self) -> int:
        """Steps begun so far, which decide when a search is due; 0 if zones never change."""
        return 0 if self._repartitioner is None else self._repartitioner.steps

    def refuse_changes(self, what: str) -> None:
        """Raise ConfigError if zones may change while the worlds run."""
        if self._repartitioner is not None:
            raise ConfigError(
                f"zones.repartition_steps is set, but {what} needs zones that do not change; set "
                "it to 0"
            )

    @property
    def repartitions(self) -> Sequence[Repartition]:
        """The changes of zones so far; see `zones.repartition_steps`."""
        return () if self._repartitioner is None else self._repartitioner.repartitions

    def loads(self) -> ZoneLoads:
        """Return the numbers of vehicles and ghosts of each zone."""
        return self._tick.division.loads()

    def view(self, world: int = 0) -> ZoneView:
        """Return the zones of a world with their vehicles, ghosts and transfers."""
        tick = self._tick
        transfers = tick.coordination.in_flight(world)
        halo_m = self.loads().halo_m
        return view_zones(tick.shards, self.partition, halo_m, world, transfers)

    def ghosts(self, zone: int, world: int = 0) -> NDArray[np.void]:
        """Return a read-only view of the ghosts VEHICLE (n,) of a zone in the present tick."""
        return self._tick.division.ghosts(world, zone)
