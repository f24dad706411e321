"""`Simulation`: W worlds of one environment, stepped together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.core.errors import CapacityError, ConfigError, SumoError
from cavmarl.core.huge_pages import huge_zeros
from cavmarl.core.math.rng import world_key
from cavmarl.core.memory import Zeros
from cavmarl.core.records.codes import ACTION_IDLE
from cavmarl.engine import world_snapshot as snapshot
from cavmarl.engine.compilation import compiling_all, prepare_kernels
from cavmarl.engine.compiled_step import CompiledStep, compiled_step
from cavmarl.engine.shared_outputs import SharedOutputs
from cavmarl.engine.simulation_setup import (
    add_coordinators,
    add_external,
    add_simulators,
    add_sumo,
    call_rare_kernels,
)
from cavmarl.engine.tick_setup import cut_zones, make_frames, make_tick
from cavmarl.engine.v2x_component import without_network
from cavmarl.engine.world_views import WorldViews
from cavmarl.engine.zone_hosting import ZoneHosting
from cavmarl.handoff.coordinator.coordinator_setup import OpenRun
from cavmarl.handoff.coordinator.saved_ownership import SavedOwnership
from cavmarl.roads.network import RoadNetwork
from cavmarl.sensors.mounted.frames import Frames
from cavmarl.sensors.observed import carried_from
from cavmarl.shards.executor import Executor
from cavmarl.shards.shard import Commands
from cavmarl.traffic.demand import DemandFile
from cavmarl.traffic.sumo.sumo_demand import SumoDemand
from cavmarl.zones.partition.zone_partition import ZonePartition


class Simulation(WorldViews):
    """W worlds of one environment on one map.

    Attributes:
        frames: the samples of the agents' sensor rigs; the next step overwrites these arrays.
    """

    def __init__(
        self,
        config: EnvConfig,
        network: RoadNetwork,
        num_worlds: int = 1,  # W
        # vehicles in addition to the generator's, from a demand file or from SUMO
        demand: DemandFile | SumoDemand | None = None,
        partition: ZonePartition | None = None,  # the zones; None: cut as `config.zones` says
        *,
        # (W, A, D) float32, the array for the agents' observations; None: allocated here
        observations: NDArray[np.float32] | None = None,
        # arrays for the samples of the agents' rigs; None: allocated here
        frames: Frames | None = None,
        warm: bool = False,  # call every kernel now, so that none is loaded in a step
        zeros: Zeros = huge_zeros,  # allocates the arrays that shards write
        like: Simulation | None = None,  # worlds of the same environment, to share tables
        runs: Sequence[OpenRun] | None = None,  # one per world; None: made as `config.zones` says
        late_ticks: int = 0,  # extra ticks that a vehicle across a border may stay with its owner
    ) -> None:
        self._carried_from = carried_from(config.sensors)
        self.demand = demand
        self._seed = 0
        self._first_world = 0
        self._episodes = np.zeros(num_worlds, dtype=np.int64)
        self.everywhere = np.ones(num_worlds, dtype=np.bool_)  # (W,) all worlds chosen
        self.frames: Frames = make_frames(config, num_worlds, zeros) if frames is None else frames
        self._compiled_step: CompiledStep | None = None
        prepare_kernels()
        partition = cut_zones(config, network) if partition is None else partition
        if config.zones.simulators:  # they may refuse a vehicle for some ticks
            late_ticks = max(late_ticks, config.zones.max_deferred_ticks)
        tick = make_tick(
            config,
            network,
            partition,
            demand,
            SharedOutputs(config, network, num_worlds, observations, zeros),
            self.frames,
            zeros,
            None if like is None else like._tick.traffic.for_worlds(num_worlds),
            late_ticks,
        )
        super().__init__(config, network, tick, ZoneHosting(tick, partition))
        if warm:
            with compiling_all(), without_network(tick.attached):
                self._call_every_kernel()
        add_sumo(tick, demand, network)
        add_external(tick)
        hosted = add_simulators(tick, config, network)
        self.transfers = add_coordinators(tick, config, network, runs, hosted)
        self.zones.let_zones_change(network, config.zones)

    def _call_every_kernel(self) -> None:
        shape = self.outputs.present.shape
        controls = np.zeros((*shape, 2))
        self._populate(self.everywhere)
        self.suggest(controls)
        self.step(Commands(controls, np.full(shape, ACTION_IDLE, dtype=np.int64)))
        call_rare_kernels(self._tick)
        self._episodes[:] = 0

    def seed(self, seed: int, first_world: int = 0) -> None:
        """Set the seed of all random numbers; the next reset of each world is its first episode."""
        self._seed = seed
        self._first_world = first_world
        self._episodes[:] = 0

    def reset(self, chosen: NDArray[np.bool_] | None = None) -> None:
        """Begin a new episode in the chosen worlds (W,), by default in all, and let agents sense.

        World w's episode is a function of (seed, first_world + w, its resets since `seed`).
        """
        chosen = self.everywhere if chosen is None else np.ascontiguousarray(chosen, dtype=np.bool_)
        self._populate(chosen)
        agents = self.config.population.agents
        seated = self.outputs.present[chosen].sum(axis=1)
        if self.config.population.mode == "closed" and (seated < agents).any():
            fewer = self._tick.traffic.placed_agents
            raise CapacityError(
                f"population.agents = {agents}: the map '{self.network.name}' has free places for "
                f"{int(seated.min())}; set it (agents=N, --agents N) to {fewer} or less, or "
                "population.mode = open or respawn, where further agents wait for room"
            )

    def _populate(self, chosen: NDArray[np.bool_]) -> None:
        tick = self._tick
        worlds = self._shard.worlds
        for w in np.flatnonzero(chosen):
            number = self._first_world + int(w)
            worlds.keys[w] = world_key(self._seed, number, int(self._episodes[w]))
            worlds.ticks[w] = 0
        self._episodes[chosen] += 1
        tick.departures = tick.traffic.draw_orders(tick.departures, worlds, chosen)
        tick.traffic.populate(tick.departures, worlds, chosen)
        tick.outside.reset(chosen, worlds)
        tick.division.distribute(chosen)
        tick.peers.drop_foreign_rows(chosen)
        tick.coordination.reset(chosen)
        tick.outside.switch_signals(tick)
        for part in tick.attached:
            with tick.all_rows("reset" in part.reads_all, tick.division.side):
                part.reset(chosen)
        tick.sense(chosen)

    def step(self, commands: Commands) -> None:
        """Run one agent step: its ticks, and the sensing of the agents in the last tick.

        Raises:
            SumoError: SUMO cannot continue. The worlds are restored to their state before the
                step, unless other processes hold some of their zones; such worlds end.
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
        self.zones.before_step()
        ticks = self.config.clock.ticks_per_step
        for number in range(ticks):
            self.run_tick(commands, number == 0, number == ticks - 1)

    def run_tick(self, commands: Commands, is_first: bool, is_last: bool) -> None:
        """Run one tick of a step; see `Tick.run`."""
        self._tick.run(commands, is_first, is_last)

    def instrument(self, wrap: Callable[[Any], Any]) -> None:
        """Replace each part that runs phases by `wrap(part)`, to time the phases."""
        self.zones.refuse_changes("measuring the phases of a tick")
        self._tick.instrument(wrap)

    def trace(self, wrap: Callable[[Executor], Executor], note: Callable[[str], None]) -> None:
        """Report each phase of a tick when it begins.

        The executor `wrap(executor)` runs the shards' phases from now on, and `note` is called with
        the name of each phase of the components. A component with phases of its own (such as
        another simulator's step) has a method `trace`.
        """
        self._tick.trace(wrap, note)

    def close(self) -> None:
        self._tick.outside.close()
        for coordinator in self.coordinators:
            coordinator.close()

    def retire_agents(self) -> None:
        """Remove the agents whose trip ended in the last step. Call after reading its results."""
        if not self.outputs.terminated.any():
            return
        self._tick.retire_agents()

    def save(self) -> list[NDArray[Any]]:
        """Return the state that the next step depends on. The arrays are views: copy them."""
        roots = np.array([self._seed, self._first_world], dtype=np.int64)
        return [roots, self._episodes, *snapshot.save(self._parts())]

    def load(self, saved: Sequence[NDArray[Any]], with_sumo: bool = True) -> None:
        """Resume from a state that `save` returned in worlds of the same environment.

        `with_sumo`: whether the worlds will be stepped. If not, SUMO does not repeat the episode,
        and routes that SUMO has chosen are missing.

        Raises:
            ConfigError: the state is damaged or belongs to different worlds. These worlds are
                unchanged.
            JournalError: the state does not belong to the run of the open journal.
            SumoError: SUMO moves vehicles in the state, but its commands are not on record; see
                `SumoTraffic.keep_logs`.
        """
        self._put_back(saved)
        tick = self._tick
        if with_sumo or self.sumo is None:
            tick.outside.catch_up(self._shard.worlds)
        tick.peers.drop_foreign_rows(self.everywhere)
        tick.peers.resume_from(tick.departures, tick.division.side)

    def load_own(self, saved: Sequence[NDArray[Any]], home: int) -> None:
        """Resume like `load` if several processes have zones; `home`: a zone of this process."""
        self._put_back(saved, home)
        tick = self._tick
        tick.outside.catch_up(self._shard.worlds)
        tick.departures.num_passing[:] = 0
        tick.peers.resume_from(tick.departures, tick.division.side)
        tick.peers.share_rows(tick.departures, tick.division.side)

    def _put_back(self, saved: Sequence[NDArray[Any]], home: int | None = None) -> None:
        self.check(saved, is_whole=home is None)
        roots, episodes, *rest = saved
        ownership = self._saved_ownership(rest)
        self.seed(*roots.tolist())
        self._episodes[:] = episodes
        self._tick.departures = snapshot.load(self._parts(), rest, ownership, home)

    def check(self, saved: Sequence[NDArray[Any]], is_whole: bool = True) -> None:
        """Check that `load` can take a state. Raises ConfigError if it cannot.

        `is_whole`: whether the state has the vehicles of all zones, not of one process alone.
        """
        if len(saved) < 2 or saved[0].shape != (2,) or saved[1].shape != self._episodes.shape:
            raise ConfigError("the state is damaged: it lacks the seed or the episodes' numbers")
        snapshot.form_of(self._parts()).check(saved[2:], is_whole)

    def check_share(self, share: Sequence[NDArray[Any]]) -> None:
        """Check that `join` can take a state of one world. Raises ConfigError if it cannot."""
        if [array.shape for array in share[:2]] != [(2,), (1,)]:
            raise ConfigError("the state is damaged: it lacks the seed or the episodes' numbers")
        snapshot.form_of(self._parts()).check_share(share[2:])

    def _saved_ownership(self, saved: Sequence[NDArray[Any]]) -> list[SavedOwnership] | None:
        """Return the owners of vehicles in a saved state; None: unknown, or of other zones."""
        found = snapshot.ownership_of(self._parts(), saved)
        return found if found is not None and self.zones.take_saved(found[0]) else None

    def share_of(self, world: int) -> list[NDArray[Any]]:
        """Return the arrays of `save` for one world alone. They are views: copy them."""
        roots = np.array([self._seed, self._first_world + world], dtype=np.int64)
        episodes = self._episodes[world : world + 1]
        return [roots, episodes, *snapshot.share_of(self._parts(), world)]

    def join(self, shares: Sequence[Sequence[NDArray[Any]]]) -> list[NDArray[Any]]:
        """Join states of single worlds, as `share_of` returns them, to a state for `load`."""
        episodes = np.concatenate([share[1] for share in shares])
        return [
            shares[0][0], episodes, *snapshot.join(self._parts(), [share[2:] for share in shares])
        ]  # fmt: skip

    def _parts(self) -> snapshot.Parts:
        tick = self._tick
        return snapshot.Parts(
            worlds=self._shard.worlds,
            division=tick.division,
            departures=tick.departures,
            traffic=tick.traffic,
            outputs=self.outputs,
            coordination=tick.coordination,
            partition=self.partition,
            repartition_steps_done=self.zones.repartition_steps_done,
            has_past=self._carried_from < self.outputs.observations.shape[2],
            attached=tick.attached,
            sumo=tick.outside.sumo,
        )

    def suggest(self, out: NDArray[np.float64]) -> None:
        """Write the actions that the built-in driver would take for agents to `out` (W, A, 2)."""
        self._tick.executor.suggest(out)

    def state_hash(self, world: int = 0) -> str:
        """Return a hex digest of a world's state.

        It covers all vehicles in the order of their ids, the departure queue, the signals, the tick
        and the key of all random numbers. It covers neither the places of records in memory nor
        the state of an environment's view (steps to the horizon, held actions).
        """
        return snapshot.digest_world(self._parts(), world)
