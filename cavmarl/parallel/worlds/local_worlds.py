"""`LocalWorlds`: worlds of this process, with autoreset."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.balance.balance_plan import Plan
from cavmarl.config.env import EnvConfig
from cavmarl.core.compiled import specialized
from cavmarl.core.errors import ConfigError, WorkerError
from cavmarl.core.extensions import extension_modules, load_plugins
from cavmarl.core.huge_pages import huge_zeros
from cavmarl.core.memory import Zeros
from cavmarl.engine.kernels.step_results import Results, keep_last, report, report_continuation
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.spaces import global_state, state_space, write_sensed
from cavmarl.engine.world_setup import World, roadside_sizes
from cavmarl.handoff.coordinator.coordinator_setup import OpenRun
from cavmarl.handoff.coordinator.saved_ownership import without_journal
from cavmarl.handoff.zone_view import TransferInFlight
from cavmarl.ownership.transfers import TransferLog
from cavmarl.parallel.sensor_workers.sensor_pool import SensorWorkers
from cavmarl.parallel.state.world_bytes import from_bytes, to_bytes
from cavmarl.parallel.worlds.journaled_worlds import without_journals
from cavmarl.parallel.worlds.step_arrays import Driven, StepArrays, layout_of
from cavmarl.sensors.registry import frame_layout
from cavmarl.shards.shard import Commands
from cavmarl.traffic.sumo.sumo_history import ToldLog
from cavmarl.v2x.v2x_messages import NetworkSimulator


class LocalWorlds:
    """W worlds of one environment. A step has no Python loop over agents or vehicles.

    Attributes:
        simulation: the worlds.
    """

    def __init__(
        self,
        world: World,
        num_worlds: int,  # W
        arrays: StepArrays | None = None,  # arrays to write; None: make new arrays
        warm: bool = False,  # whether to load all kernels now
        in_next_step: bool = False,  # whether new episodes start a step later; see `SteppedWorlds`
        zeros: Zeros = huge_zeros,  # makes the arrays that shards write
        like: LocalWorlds | None = None,  # worlds of the same environment, whose tables are shared
        runs: Sequence[OpenRun] | None = None,  # see `Simulation`
        late_ticks: int = 0,  # see `Simulation`
    ) -> None:
        self.world = world
        self.in_next_step = in_next_step
        self.sensor_workers: SensorWorkers | None = None
        form = world.config.observation
        self._senses = form.mode == "sensors"
        self._is_flat = form.kind == "flat"
        self._shows_signals = world.config.controlled is not None
        # whether an episode goes on when no agent drives
        self._goes_on = world.config.roadside is not None or world.config.drives_alone
        self.simulation: Simulation = Simulation(
            world.config,
            world.network,
            num_worlds,
            world.demand,
            world.partition,
            observations=None if arrays is None or self._senses else arrays.observations,
            frames=None if arrays is None else arrays.frames,
            warm=warm,
            zeros=zeros,
            like=None if like is None else like.simulation,
            runs=runs,
            late_ticks=late_ticks,
        )
        if arrays is None:
            arrays = _own_arrays(self.simulation, num_worlds)
            if not self._senses:
                arrays = arrays._replace(observations=self.simulation.outputs.observations)
        self.arrays = arrays  # inputs and outputs of a step
        self._horizon = world.config.max_steps
        self._late_ticks = late_ticks
        self._steps = np.zeros(num_worlds, dtype=np.int64)
        self._waiting = np.zeros(num_worlds, dtype=np.bool_)  # worlds to reset in the next step
        self._results = Results(*(getattr(arrays, name) for name in Results._fields))
        self._report = specialized(report)
        self._report_continuation = specialized(report_continuation)
        self._keep_last = specialized(keep_last)
        if warm:
            self._write_results()
            self._write_continuation()
            self._keep_observations()
            self._steps[:] = 0
        world.network.let_go()

    @property
    def transfers(self) -> tuple[TransferLog, ...]:
        """Changes of owner of each world; empty for undivided worlds."""
        return self.simulation.transfers

    def in_flight(self, world: int) -> Sequence[TransferInFlight]:
        """Return the incomplete transfers of a world: vehicles that are offered to another zone."""
        return self.simulation.zones.view(world).transfers

    def reset(self, seed: int | None, first_world: int) -> None:
        arrays, chosen = self.arrays, self.arrays.chosen
        if seed is not None:
            self.simulation.seed(seed, first_world)
        self._begin(chosen)
        outputs = self.simulation.outputs
        arrays.mask[chosen] = outputs.present[chosen]
        arrays.vehicle_ids[chosen] = outputs.vehicle_ids[chosen]
        arrays.vehicle_done[chosen] = False
        arrays.terms[chosen] = outputs.terms[chosen]
        arrays.ticks[:] = self.simulation.ticks()
        goes_on = arrays.mask.any(axis=1) | self.simulation.agents_to_come() | self._goes_on
        arrays.episode_over[chosen] = ~goes_on[chosen]
        if not chosen.all():
            arrays.observations[~arrays.mask] = 0.0

    def step(self, commands: Commands) -> None:
        """Let the agents act, and reset worlds whose episode is over, now or a step later."""
        simulation, arrays = self.simulation, self.arrays
        simulation.step(commands)
        self._show(simulation.everywhere)
        if self.in_next_step and self._waiting.any():
            waiting = self._waiting.copy()
            self._begin(waiting)
            self._steps[waiting] = -1  # the first step of these worlds comes next
            arrays.signal_rewards[waiting] = arrays.signal_terms[waiting] = 0.0
        some_ended = self._write_results()
        if some_ended:
            simulation.retire_agents()
        some_over = self._write_continuation()
        if some_over or some_ended:
            self._end(arrays.episode_over, some_over)
        arrays.ticks[:] = simulation.ticks()

    def _write_results(self) -> bool:
        """Write the results of the agents; return whether a trip has ended."""
        outputs = self.simulation.outputs
        return self._report(outputs, self._steps, self._horizon, self._results)

    def _write_continuation(self) -> bool:
        """Write which agents act next; return whether an episode is over."""
        simulation = self.simulation
        return self._report_continuation(
            simulation.outputs,
            simulation.departures,
            self._steps,
            self._horizon,
            self._goes_on,
            self._results,
        )

    def _end(self, over: NDArray[np.bool_], some_over: bool) -> None:
        """Keep the last observations of ended agents and episodes, and start new episodes."""
        arrays = self.arrays
        self._keep_observations()
        if arrays.frames:
            ended = over | arrays.terminations.any(axis=1)
            for name, frames in arrays.frames.items():
                for final, array in zip(arrays.final_frames[name], frames, strict=True):
                    final[ended] = array[ended]
        arrays.final_signal_observations[over] = arrays.signal_observations[over]
        if self.in_next_step:
            self._waiting[over] = True
            arrays.mask[over] = False
        elif some_over:
            self._begin(over)
            arrays.mask[over] = self.simulation.outputs.present[over]

    def _keep_observations(self) -> None:
        arrays = self.arrays
        self._keep_last(
            self._results, arrays.observations, arrays.final_observations, self.in_next_step
        )

    def _begin(self, chosen: NDArray[np.bool_]) -> None:
        self.simulation.reset(chosen)
        self._show(chosen, begins=True)
        self._steps[chosen] = 0
        self._waiting[chosen] = False

    def _show(self, chosen: NDArray[np.bool_], begins: bool = False) -> None:
        """Write the observations of the agents in the chosen worlds (W,).

        At the start of an episode, signals keep the rewards of the last step of the old episode.
        """
        if self._senses and self._is_flat:
            write_sensed(self.arrays.frames, chosen, self.arrays.observations)
        if self._shows_signals:
            found = self.simulation.roadside.outputs
            for name, values in found._asdict().items():
                if begins and name in ("rewards", "terms"):
                    continue
                getattr(self.arrays, f"signal_{name}")[chosen] = values[chosen]

    def suggest(self) -> None:
        """Write the actions of the built-in driver for all agents."""
        self.arrays.suggested[:] = 0.0
        self.simulation.suggest(self.arrays.suggested)

    def write_states(self) -> None:
        """Write the `CavEnv.state` of each world."""
        simulation, space = self.simulation, state_space(self.simulation.capacity)
        for world, state in enumerate(self.arrays.states):
            state[:] = global_state(self.world.network, simulation.vehicles(world), space)

    def ticks(self) -> NDArray[np.int64]:
        return self.simulation.ticks().copy()

    def state_hash(self, world: int) -> str:
        return self.simulation.state_hash(world)

    def traffic_stats(self, world: int) -> dict[str, float]:
        stats = asdict(self.simulation.traffic_stats(world))
        if self.world.config.v2x.enabled:
            stats |= self.simulation.messages.statistics(world).to_dict()
        return stats

    def driven(self, world: int, agents: Sequence[int]) -> list[Driven]:
        """Return the vehicles of some agents of a world, in any order; some may have none."""
        simulation = self.simulation
        rows = simulation.vehicles(world)
        rows = rows[np.isin(rows["agent"], agents)]
        columns = (
            rows["agent"],
            rows["id"],
            simulation.types["vclass"][rows["vtype"]],
            rows["length"].astype(np.float64),
            rows["width"].astype(np.float64),
            simulation.goal_edges[simulation.network.lanes["map"][rows["lane"]], rows["goal"]],
            rows["speed"].astype(np.float64),
            simulation.types["wheelbase"][rows["vtype"]],
        )
        found = [Driven(*row) for row in zip(*(each.tolist() for each in columns), strict=True)]
        return [row._replace(heard=self._heard(world, row.agent)) for row in found]

    def _heard(self, world: int, agent: int) -> list[list[int]] | None:
        """See `Driven.heard`."""
        if not self.world.config.v2x.enabled:
            return None
        reports = self.simulation.messages.mail.signals[world, agent]
        # The code of an overridden signal is negative: it shows no phase of its program.
        reports = reports[(reports["sender"] >= 0) & (reports["code"] >= 0)]
        age = self.ticks()[world] - reports["tick"]
        heard = np.stack([reports["subject"], reports["code"], age], axis=1)
        return [list(map(int, row)) for row in heard.tolist()]

    def signal_phases(self, world: int) -> NDArray[np.int32]:
        """Return a world's row of `Worlds.signal_phase`, as a view."""
        return self.simulation.signal_phases(world)

    def save(self) -> list[NDArray[Any]]:
        """Return all state on which the next step depends, as views."""
        return [self._steps, self._waiting, *self.simulation.save()]

    def load(self, saved: Sequence[NDArray[Any]], with_sumo: bool = True) -> None:
        """Resume from the result of `save`, as `Simulation.load` does, with the same errors."""
        self._check_own(saved)
        self.simulation.load(saved[2:], with_sumo)
        self._steps[:], self._waiting[:] = saved[:2]

    def load_own(self, saved: Sequence[NDArray[Any]], home: int) -> None:
        """Resume while other processes hold zones; see `Simulation.load_own`."""
        self._check_own(saved)
        self.simulation.load_own(saved[2:], home)
        self._steps[:], self._waiting[:] = saved[:2]

    def check(self, saved: Sequence[NDArray[Any]], is_whole: bool = True) -> None:
        """Raise ConfigError if the worlds cannot resume from what `save` returned.

        `is_whole`: see `Simulation.check`.
        """
        self._check_own(saved)
        self.simulation.check(saved[2:], is_whole)

    def _check_own(self, saved: Sequence[NDArray[Any]]) -> None:
        if any(array.shape != self._steps.shape for array in saved[:2]):
            raise ConfigError("the state is damaged: it has another number of worlds")

    def __reduce__(self) -> tuple[Any, ...]:
        """Return how to make a copy: from the world, its state and its step arrays.

        A copy has no journal, since the file belongs to the original.

        Raises:
            ConfigError: the worlds have processes of their own, or use an extension of a module
                that another process, which reads the pickle, could not import.
        """
        config = self.world.config
        if key := kept_elsewhere(config):
            raise ConfigError(
                f"{key}: worlds with processes of their own cannot be copied; make another "
                "environment with the same seed"
            )
        saved = [array.copy() for array in self.save()]
        shown = [array.copy() for array in every_array(self.arrays)]
        modules = extension_modules(config.registered, config.plugins)
        return _made_again, (modules, without_journals(self.world), self.in_next_step, saved, shown)

    def __deepcopy__(self, memo: dict[int, Any]) -> LocalWorlds:
        """Copy the state; the map and the settings are shared, since they never change."""
        make, parts = self.__reduce__()
        copied: LocalWorlds = make(*parts)
        return copied

    def of_number(self, num_worlds: int) -> LocalWorlds:
        """Return new worlds of the same environment, before their first reset."""
        return LocalWorlds(
            self.world,
            num_worlds,
            in_next_step=self.in_next_step,
            like=self,
            late_ticks=self._late_ticks,
        )

    def connect_network(self, network: NetworkSimulator) -> None:
        """Let a network simulator decide receptions. Raises the errors of `Bus.connect`."""
        self.simulation.messages.connect(network)

    def keep_logs(self) -> tuple[ToldLog, ...]:
        """Start and return logs of what SUMO receives, one per world, which `load` needs.

        See `SumoTraffic.keep_logs`.
        """
        sumo = self.simulation.sumo
        return () if sumo is None else sumo.keep_logs()

    def share_of(self, world: int) -> list[NDArray[Any]]:
        """Return, as views, the result of `save` if there were only this world."""
        only = slice(world, world + 1)
        return [self._steps[only], self._waiting[only], *self.simulation.share_of(world)]

    def join(self, shares: Sequence[Sequence[NDArray[Any]]]) -> list[NDArray[Any]]:
        """Join the shares of single worlds to what `load` expects."""
        ended = [np.concatenate([share[n] for share in shares]) for n in range(2)]
        return [*ended, *self.simulation.join([share[2:] for share in shares])]

    def save_worlds(self) -> list[bytes]:
        """Return the state of each world, for `load_worlds` with any zones and workers.

        After `load_worlds`, vehicles keep their owners if the zones are the same, and a journal
        begins a new episode, because the saved state has no place in a journal.
        """
        zones = self.world.partition.count
        saved = []
        for world in range(len(self._steps)):
            *common, words, contacts = (share := self.share_of(world))[:-zones]
            filed = [*common, without_journal(words), contacts, np.concatenate(share[-zones:])]
            saved.append(to_bytes(filed))
        return saved

    def load_worlds(self, saved: Sequence[bytes]) -> None:
        """Resume from what `save_worlds` returned; `arrays` do not change.

        Raises:
            ConfigError: the state belongs to other worlds.
        """
        self.load(self.read_worlds(saved))

    def read_worlds(self, saved: Sequence[bytes]) -> list[NDArray[Any]]:
        """Convert what `save_worlds` returned to what `load` expects. Errors: see `load_worlds`."""
        zones = self.world.partition.count
        like = self.share_of(0)
        shares = [from_bytes(one, [*like[:-zones], like[-1]]) for one in saved]
        for share in shares:
            if any(array.shape != (1,) for array in share[:2]):
                raise ConfigError("the state is damaged: it is not the state of one world")
            self.simulation.check_share(share[2:])
        return self.join([[*share, *[share[-1][:0]] * (zones - 1)] for share in shares])

    def refusal(self, saved: Sequence[bytes]) -> str:
        """Return why the worlds cannot resume from these states; empty: they can."""
        try:
            self.check(self.read_worlds(saved))
        except ConfigError as error:
            return str(error)
        return ""

    @property
    def num_parts(self) -> int:
        """Number of the last arrays of `save`, of which each zone of each world has one."""
        return len(self._steps) * self.world.partition.count

    @property
    def plans(self) -> tuple[Plan, ...]:
        """Empty: there are no workers."""
        return ()

    @property
    def worker_pids(self) -> dict[int, int]:
        """Empty: there are no workers."""
        return {}

    def attach_sensor_workers(self, sensor_workers: SensorWorkers) -> None:
        """Let sensor workers write the frames of mounted sensors in `arrays`."""
        mounted = self.simulation.mounted
        assert mounted is not None
        mounted.rig.sense = sensor_workers
        self.sensor_workers = sensor_workers

    def close(self) -> None:
        if self.sensor_workers is not None:
            self.sensor_workers.close()
        self.simulation.close()


def _made_again(
    modules: list[str],
    world: World,
    in_next_step: bool,
    saved: list[NDArray[Any]],
    shown: list[NDArray[Any]],
) -> LocalWorlds:
    load_plugins(modules, WorkerError)
    worlds = LocalWorlds(world, len(saved[0]), in_next_step=in_next_step)
    worlds.load(saved)
    for array, before in zip(every_array(worlds.arrays), shown, strict=True):
        array[...] = before
    return worlds


def kept_elsewhere(config: EnvConfig) -> str:
    """Return a configuration key whose value prevents copies of worlds; empty: no such key."""
    return "zones.simulators" if config.zones.simulators else missing_in_states(config)


def missing_in_states(config: EnvConfig) -> str:
    """Return a key whose value puts state outside of the saved arrays; empty: no such key.

    `zones.simulators` is not such a key: simulators of zones receive the loaded state.
    """
    kept = {
        "traffic.source = sumo-traffic": config.traffic.source == "sumo-traffic",
        "map.changed_lanes with traffic.source = sumo-demand": config.tells_sumo,
        "workers.sensors": config.workers.sensors,
    }
    return next((key for key, is_so in kept.items() if is_so), "")


def every_array(arrays: StepArrays) -> Iterator[NDArray[Any]]:
    *plain, frames, final_frames = arrays
    yield from plain
    for rig in (frames, final_frames):
        for sensor in rig.values():
            yield from sensor


def _own_arrays(simulation: Simulation, num_worlds: int) -> StepArrays:
    sizes = roadside_sizes(simulation.config, simulation.network)
    layout = layout_of(simulation.config, simulation.capacity, num_worlds, sizes)
    sensed = frame_layout(simulation.config, num_worlds)
    made = {
        name: np.zeros(shape, dtype)
        for name, (dtype, shape) in layout.items()
        if name not in sensed
    }
    return StepArrays.of(made)._replace(frames=simulation.frames)
