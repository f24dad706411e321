"""`Simulation`: W worlds of one environment, stepped together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.core.errors import CapacityError, ConfigError, SumoError
from cavmarl.core.huge_pages import huge_zeros
from cavmarl.core.math.rng import world_key
from cavmarl.core.memory import Zeros
from cavmarl.core.records.codes import ACTION_IDLE
from cavmarl.driving.vehicles import blank_vehicle
from cavmarl.engine import world_snapshot as snapshot
from cavmarl.engine.compilation import compiling_all, prepare_kernels
from cavmarl.engine.compiled_step import CompiledStep, compiled_step
from cavmarl.engine.peers import Peers
from cavmarl.engine.shard_clock import ShardClock
from cavmarl.engine.shared_outputs import SharedOutputs
from cavmarl.engine.sumo_phases import SumoPhases
from cavmarl.engine.tick_setup import cut_zones, make_frames, make_tick
from cavmarl.engine.world_views import WorldViews
from cavmarl.handoff.coordinator.coordinator_setup import OpenRun, make_coordinators
from cavmarl.handoff.coordinator.coordinators import Coordination, Coordinators
from cavmarl.handoff.coordinator.handoff_log import HandoffLog
from cavmarl.handoff.coordinator.saved_ownership import SavedOwnership, zone_table
from cavmarl.handoff.repartitioning import Recutter
from cavmarl.ownership.messages import Switch
from cavmarl.ownership.transfers import TransferLog
from cavmarl.roads.network import RoadNetwork
from cavmarl.sensors.mounted.frames import Frames
from cavmarl.sensors.observed import carried_from
from cavmarl.shards.executor import Executor, TeamExecutor
from cavmarl.shards.shard import Commands, Shard
from cavmarl.shards.shard_group import ShardGroup
from cavmarl.traffic.demand import DemandFile
from cavmarl.traffic.sumo.sumo_demand import SumoDemand
from cavmarl.traffic.sumo.sumo_traffic import SumoTraffic
from cavmarl.zones.partition.zone_partition import ZonePartition
from cavmarl.zones.reach import longest_move_m


class Simulation(WorldViews):
    """W worlds of one environment on one map.

    Attributes:
        frames: what the rigs of the agents have sensed; arrays that the next step overwrites.
    """

    def __init__(
        self,
        config: EnvConfig,
        network: RoadNetwork,
        num_worlds: int = 1,  # W
        # whose vehicles drive beside the generator's; of a file, or SUMO's
        demand: DemandFile | SumoDemand | None = None,
        partition: ZonePartition | None = None,  # the zones; None: cut as `config.zones` says
        *,
        # (W, A, D) float32, where the agents' are written; None: made for them
        observations: NDArray[np.float32] | None = None,
        # where the samples of their rigs are written; None: made for them
        frames: Frames | None = None,
        warm: bool = False,  # call every kernel now, so that none is loaded in a step
        zeros: Zeros = huge_zeros,  # makes the arrays that shards write
        like: Simulation | None = None,  # of the same environment, whose tables are used
        runs: Sequence[OpenRun] | None = None,  # what coordinators go by; None: `config.zones`
        late_ticks: int = 0,  # for so many more a vehicle that has crossed may stay with its zone
    ) -> None:
        self.config = config
        self._carried_from = carried_from(config.sensors)
        self.network = network
        self.demand = demand
        self.num_worlds = num_worlds
        self.partition = cut_zones(config, network) if partition is None else partition
        self._seed = 0
        self._first_world = 0
        self._episodes = np.zeros(num_worlds, dtype=np.int64)
        self.everywhere = np.ones(num_worlds, dtype=np.bool_)  # (W,) all of the worlds
        self.frames: Frames = make_frames(config, num_worlds, zeros) if frames is None else frames
        self.transfers: tuple[TransferLog, ...] = ()
        self._recutter: Recutter | None = None
        self._compiled_step: CompiledStep | None = None
        prepare_kernels()
        shared = SharedOutputs(config, network, num_worlds, observations, zeros)
        self._tick = make_tick(
            config,
            network,
            self.partition,
            self.demand,
            shared,
            self.frames,
            zeros,
            None if like is None else like._tick.traffic.for_worlds(num_worlds),
            late_ticks,
        )
        self._shards = self._tick.shards
        if warm:
            with compiling_all(), self.unheard():
                self._call_every_kernel()
        self._add_sumo()
        self._add_coordinators(runs)

    def _add_sumo(self) -> None:
        if isinstance(self.demand, SumoDemand):
            tick = self._tick
            travel, zoned = tick.traffic.travel, tick.division.zoned
            tick.sumo = SumoPhases(
                SumoTraffic(
                    self.demand, self.network, travel, travel.num_fixed, zoned, blank_vehicle()
                )
            )

    def _add_coordinators(self, runs: Sequence[OpenRun] | None) -> None:
        """Coordinators, and what makes other zones, where the settings ask for them."""
        zones = self.config.zones
        watched = zones.journal or zones.check_invariants
        if self.partition.count > 1 or watched:
            self._let_coordinate(runs)
        coordination = self._tick.coordination
        if (
            zones.repartition_steps
            and self.partition.count > 1
            and isinstance(coordination, Coordinators)
        ):
            self._recutter = Recutter(
                self.network,
                self._tick.division,
                coordination,
                zones.repartition_steps,
                zones.repartition_tolerance,
            )

    def _let_coordinate(self, runs: Sequence[OpenRun] | None) -> None:
        """Let coordinators decide ownership; with one zone there are none."""
        tick = self._tick
        setup = make_coordinators(
            self.config.zones,
            tick.division,
            longest_move_m(self.network, tick.traffic.travel, self.config.clock.sim_dt_s),
            runs=runs,
        )
        tick.coordination = setup.coordination
        self.transfers = setup.transfers

    def _call_every_kernel(self) -> None:
        tick = self._tick
        shape = self.outputs.present.shape
        controls = np.zeros((*shape, 2))
        self._populate(self.everywhere)
        self.suggest(controls)
        self.step(Commands(controls, np.full(shape, ACTION_IDLE, dtype=np.int64)))
        # Once more what is only called when vehicles leave or wait.
        tick.let_in()
        tick.traffic.accept(tick.gate, self._shard.worlds, tick.peers.running())
        tick.admit()
        tick.executor.leave(tick.gate)
        tick.executor.retire(tick.gate)
        tick.executor.forget(tick.gate)
        tick.executor.gather(*tick.division.gathering)
        tick.division.rehearse_gathering()
        tick.traffic.settle(tick.gate, self._shard.worlds)
        tick.division.near(0, everybody=True)
        with suppress(ConfigError):
            tick.division.hand_over(0, Switch(-1, 0, 0, 0, False))
        book = HandoffLog(tick.division, 0)
        book.release(book.hand_over(True, sum(tick.division.counts(0)), ()))
        book.reset(0)
        self._episodes[:] = 0

    def seed(self, seed: int, first_world: int = 0) -> None:
        """Set the root of all random numbers; the next reset of each world is its first episode."""
        self._seed = seed
        self._first_world = first_world
        self._episodes[:] = 0

    def reset(self, chosen: NDArray[np.bool_] | None = None) -> None:
        """Begin a new episode in the chosen worlds (W,), all by default, and sense.

        World w's episode is a function of (seed, first_world + w, its resets since `seed`).
        """
        chosen = self.everywhere if chosen is None else np.ascontiguousarray(chosen, dtype=np.bool_)
        self._populate(chosen)
        agents = self.config.population.agents
        seated = self.outputs.present[chosen].sum(axis=1)
        if self.config.population.mode == "closed" and (seated < agents).any():
            raise CapacityError(
                f"population.agents = {agents}: the map '{self.network.name}' has free places for "
                f"{int(seated.min())}; use fewer agents, or population.mode = open or respawn, "
                "where the others wait until there is room"
            )

    def _populate(self, chosen: NDArray[np.bool_]) -> None:
        tick = self._tick
        worlds = self._shard.worlds
        for w in np.flatnonzero(chosen):
            number = self._first_world + int(w)
            worlds.keys[w] = world_key(self._seed, number, int(self._episodes[w]))
            worlds.ticks[w] = 0
        self._episodes[chosen] += 1
        tick.gate = tick.traffic.draw_orders(tick.gate, worlds, chosen)
        tick.traffic.populate(tick.gate, worlds, chosen)
        tick.sumo.reset(chosen, worlds)
        tick.division.distribute(chosen)
        tick.peers.keep_own(chosen)
        tick.coordination.reset(chosen)
        tick.sumo.switch_signals(tick)
        for part in tick.attached:
            part.reset(chosen)
        tick.sense(chosen)

    def step(self, commands: Commands) -> None:
        """One agent step: its ticks, then what the agents sense.

        Raises:
            SumoError: SUMO cannot go on; the worlds are as they were before the step, but for
                those that share zones with other processes: they end.
        """
        if self.sumo is None or not self._tick.peers.are_none:
            self._run_ticks(commands)
            return
        before = [array.copy() for array in self.save()]
        try:
            self._run_ticks(commands)
        except SumoError:
            self._put_back(before)
            raise

    def _run_ticks(self, commands: Commands) -> None:
        self._compiled_step = compiled_step(self._tick, self._compiled_step)
        if self._compiled_step is not None:
            self._compiled_step.run(commands)
            return
        ticks = self.config.clock.ticks_per_step
        if self._recutter is not None:
            partition = self._recutter.before_step(self.partition)
            if partition is not None:
                self.partition = partition
                self._tick.executor = ShardGroup(self._shards)
        for number in range(ticks):
            self.run_tick(commands, number == 0, number == ticks - 1)

    def run_tick(self, commands: Commands, is_first: bool, is_last: bool) -> None:
        """Run one tick of a step; see `Tick.run`."""
        self._tick.run(commands, is_first, is_last)

    def instrument(self, wrap: Callable[[Any], Any]) -> None:
        """Put `wrap(part)` in the place of each part that phases are calls of, to time them."""
        self._refuse_recutting("measuring the phases of a tick")
        self._tick.instrument(wrap)

    def trace(self, wrap: Callable[[Executor], Executor], note: Callable[[str], None]) -> None:
        """Let `wrap(executor)` note the phases of a tick, and attached parts name theirs to `note`.

        A part that has phases of its own (another simulator's step, say) has a method `trace`.
        """
        self._tick.trace(wrap, note)

    def host(
        self,
        # called with the shards, and with what the phase `gather` is called with
        make: Callable[[Sequence[Shard], tuple[float, float]], TeamExecutor],
    ) -> None:
        """From now on let others run the phases of the shards, as `make` returns them.

        Raises:
            ConfigError: zones become others, and the caller would not be told.
        """
        self._refuse_recutting("the zones of one world over workers")
        self._tick.host(make)

    def share(self, peers: Peers, coordination: Coordination, executor: Executor) -> None:
        """From now on host the zones that `executor` runs, and leave the others to `peers`."""
        tick = self._tick
        tick.peers, tick.coordination, tick.executor = peers, coordination, executor
        self._recutter = None  # no process has the places of all vehicles

    def divide(self, partition: ZonePartition) -> None:
        """Say where zones are from now on, before zones have their vehicles; see `share`."""
        if partition.content_hash != self.partition.content_hash:
            self.partition = partition
            self._tick.division.divide(partition)

    def cut(
        self,
        partition: ZonePartition,
        vehicles: Sequence[NDArray[np.void]],  # VEHICLE (n,) of each world, of all zones
        contacts: NDArray[np.int64],  # (W,) that all zones have counted
    ) -> None:
        """Divide the plane otherwise, where others hold zones; then `share` has to follow."""
        tick = self._tick
        self.divide(partition)
        tick.division.place(vehicles, contacts)
        tick.peers.keep_own(self.everywhere)
        tick.coordination.reset(self.everywhere)
        tick.peers.take_up(tick.gate, tick.division.side)

    def time_shards(self, every: int = 1) -> ShardClock:
        """From now on run phases zone by zone, with a clock on each."""
        self._refuse_recutting("measuring what each zone costs")
        clock = ShardClock(self._shards, every)
        self._tick.executor = clock
        return clock

    def _refuse_recutting(self, what: str) -> None:
        if self._recutter is not None:
            raise ConfigError(
                f"zones.repartition_steps: {what} needs zones that stay; leave one out"
            )

    def close(self) -> None:
        self._tick.sumo.close()
        for coordinator in self.coordinators:
            coordinator.close()

    def retire_agents(self) -> None:
        """Take out the agents whose trip ended in the last step; to be called after it is read."""
        if not self.outputs.terminated.any():
            return
        self._tick.retire_agents()

    def save(self) -> list[NDArray[Any]]:
        """All that the next step depends on, between two steps; views, to be copied."""
        roots = np.array([self._seed, self._first_world], dtype=np.int64)
        return [roots, self._episodes, *snapshot.save(self._parts())]

    def load(self, saved: Sequence[NDArray[Any]]) -> None:
        """Go on from what `save` gave, in worlds of the same environment.

        Raises:
            ConfigError: it is damaged, or one of other worlds; these are as they were.
            JournalError: the state is not one of the run whose journal this is.
            SumoError: SUMO moves vehicles there, and what it was told is not on record; see
                `SumoTraffic.keep_logs`.
        """
        self._put_back(saved)
        tick = self._tick
        tick.sumo.catch_up(self._shard.worlds)
        tick.peers.keep_own(self.everywhere)
        tick.peers.take_up(tick.gate, tick.division.side)

    def load_own(self, saved: Sequence[NDArray[Any]], home: int) -> None:
        """`load` where other processes hold zones: each goes on with its own, one is `home`."""
        self._put_back(saved, home)
        tick = self._tick
        tick.sumo.catch_up(self._shard.worlds)
        tick.gate.num_passing[:] = 0
        tick.peers.take_up(tick.gate, tick.division.side)
        tick.peers.share_rows(tick.gate, tick.division.side)

    def _put_back(self, saved: Sequence[NDArray[Any]], home: int | None = None) -> None:
        self.check(saved)
        roots, episodes, *rest = saved
        ownership = self._saved_ownership(rest)
        self.seed(*roots.tolist())
        self._episodes[:] = episodes
        self._tick.gate = snapshot.load(self._parts(), rest, ownership, home)

    def check(self, saved: Sequence[NDArray[Any]]) -> None:
        """See that worlds can go on from what `save` gave. Raises ConfigError: they cannot."""
        if len(saved) < 2 or saved[0].shape != (2,) or saved[1].shape != self._episodes.shape:
            raise ConfigError("the state is damaged: it says of no episode which one it is")
        snapshot.form_of(self._parts()).check(saved[2:])

    def check_share(self, share: Sequence[NDArray[Any]]) -> None:
        """See that `join` can take what `share_of` gave. Raises ConfigError: it cannot."""
        if [array.shape for array in share[:2]] != [(2,), (1,)]:
            raise ConfigError("the state is damaged: it says of no episode which one it is")
        snapshot.form_of(self._parts()).check_share(share[2:])

    def _saved_ownership(self, saved: Sequence[NDArray[Any]]) -> list[SavedOwnership] | None:
        """The owners of vehicles in a saved state, if they are known and the zones are the same."""
        found = snapshot.ownership_of(self._parts(), saved)
        if found is None:
            return None
        if found[0].zones.tobytes() != zone_table(self.partition).tobytes():
            if self._recutter is None:
                return None
            self.divide(found[0].partition())
            self._tick.executor = ShardGroup(self._shards)
        if self._recutter is not None:
            self._recutter.steps = found[0].numbers.recut_steps
        return found

    def share_of(self, world: int) -> list[NDArray[Any]]:
        """What `save` would give if there were no world but one; views, to be copied."""
        roots = np.array([self._seed, self._first_world + world], dtype=np.int64)
        episodes = self._episodes[world : world + 1]
        return [roots, episodes, *snapshot.share_of(self._parts(), world)]

    def join(self, shares: Sequence[Sequence[NDArray[Any]]]) -> list[NDArray[Any]]:
        """What `load` takes, of worlds of which each share has been one by itself."""
        episodes = np.concatenate([share[1] for share in shares])
        return [
            shares[0][0], episodes, *snapshot.join(self._parts(), [share[2:] for share in shares])
        ]  # fmt: skip

    def _parts(self) -> snapshot.Parts:
        tick = self._tick
        return snapshot.Parts(
            worlds=self._shard.worlds,
            division=tick.division,
            gate=tick.gate,
            traffic=tick.traffic,
            outputs=self.outputs,
            coordination=tick.coordination,
            partition=self.partition,
            recut_steps=0 if self._recutter is None else self._recutter.steps,
            has_past=self._carried_from < self.outputs.observations.shape[2],
            attached=tick.attached,
            sumo=tick.sumo.traffic,
        )

    def suggest(self, out: NDArray[np.float64]) -> None:
        """Write what the built-in driver would do in the agents' place into `out` (W, A, 2)."""
        self._tick.executor.suggest(out)

    def state_hash(self, world: int = 0) -> str:
        """Hex digest of a world's state.

        Over all vehicles in the order of their ids, the queue, the signals, the tick and the key of
        all random numbers; not over where a record lives, nor over what a view keeps (steps to the
        horizon, held actions).
        """
        return snapshot.digest_world(self._parts(), world)
