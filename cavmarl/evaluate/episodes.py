"""The episodes of one run, in parts: the worlds of one part are stepped together."""

from __future__ import annotations

import math
import time
import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.registry import load_config
from cavmarl.config.world_spec import WorldSpec
from cavmarl.core.errors import ActionError, PolicyError
from cavmarl.engine.shard_clock import ShardClock
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.world_setup import make_world
from cavmarl.env.drawn_worlds import WorldCopy
from cavmarl.env.vector import CavVectorEnv
from cavmarl.evaluate.border_terms import BorderTerms
from cavmarl.evaluate.encounters import BackgroundUse, EncounterWatch, MessageRecord
from cavmarl.evaluate.failure_clips import Failure
from cavmarl.evaluate.recorder import SLOWEST, Recorder
from cavmarl.evaluate.resources import ResourceWatch
from cavmarl.evaluate.run_extras import RunWatch, recording_path
from cavmarl.evaluate.stuck_trips import StandingWatch
from cavmarl.evaluate.tables import EPISODE, TRACK, TRANSFER, TRIP
from cavmarl.evaluate.transfer_rows import TransferRecorder
from cavmarl.ownership.transfers import TransferLog
from cavmarl.parallel.backends import find_backend, make_worlds
from cavmarl.parallel.nodes.node_groups import NodeGroups
from cavmarl.parallel.nodes.node_worlds import NodeWorlds
from cavmarl.parallel.placement.backend_name import LOCAL
from cavmarl.parallel.worlds.local_worlds import LocalWorlds
from cavmarl.policies.loading import load_policy
from cavmarl.policies.map_check import UntrainedMapWarning
from cavmarl.policies.policy import Policy
from cavmarl.recordings.extra_tables import RecordOptions
from cavmarl.roads.kernels.map_choice import map_of
from cavmarl.zones.partition.zone_statistics import imbalance

MAX_VEHICLES = 100_000  # maximum number in all worlds that are stepped together
MAX_WORLDS = 128
TRACK_S = 0.5  # time between two points of a track
TIMED_TICKS = 16  # in one of 16 ticks, the time of each zone is measured

Progress = Callable[
    [str, int, int], None
]  # called with the policy, the steps done, and the maximum number of steps
Watcher = Callable[[CavVectorEnv], Callable[[], None]]
"""Called with the worlds of a run; returns a function to call after each reset and step."""


@dataclass(frozen=True, kw_only=True)
class EpisodeJob(WorldSpec):
    """One run of some policies over the same episodes; the seed also seeds the policies."""

    policies: Mapping[str, str]  # as in `load_policy`, by name in the results
    episodes: int  # number of episodes; episode e is the first episode of world e
    run: int = 0  # number of this run
    runs: int = 1  # number of runs
    record: RecordOptions | None = None  # options of recordings; None: no recording
    failures: int = 0  # number of failed trips kept for each policy
    backend: str = LOCAL  # where the worlds run, as in `make_vec`


@dataclass(frozen=True)
class Speed:
    """Speed of a run; it is not reproducible."""

    step_ms: float  # milliseconds of simulation for one step of one world
    policy_ms: float  # milliseconds of the policy for one step of one world
    agent_steps_per_s: float  # decisions per second that simulation and policy take together
    worlds: int  # number of worlds stepped together
    # processor time of the slowest zone over the mean of all zones, summed over all worlds;
    # None: not measured
    zone_time_imbalance: float | None = None


@dataclass(frozen=True)
class RunData:
    """The data of a policy from one run."""

    trips: NDArray[np.void]  # TRIP records of all trips
    episodes: NDArray[np.void]  # EPISODE records
    tracks: NDArray[np.void]  # TRACK records of the agents of the first episode
    speed: Speed  # speed of the run
    # TRANSFER records; empty for undivided worlds
    transfers: NDArray[np.void]
    transfer_counts: Mapping[str, int]  # counts of a `TransferLog`, summed over the episodes
    resources: NDArray[np.void]  # RESOURCE records; empty for worlds of this process
    network: Sequence[Mapping[str, Any]] = ()  # nodes and their connections; empty without nodes
    failures: Sequence[Failure] = ()  # failed trips that are kept
    borders: Sequence[BorderTerms] = ()  # terms by zone and place


def worlds_at_once(episodes: int, vehicles: int) -> int:
    """Return how many worlds to step together: bounded memory, parts of equal size."""
    most = max(1, min(MAX_WORLDS, MAX_VEHICLES // max(vehicles, 1)))
    return math.ceil(episodes / math.ceil(episodes / most))


def drive_run(
    job: EpisodeJob, progress: Progress | None = None, watcher: Watcher | None = None
) -> dict[str, RunData]:
    config, base_dir = load_config(job.env, **job.keywords)
    population = config.population
    num_envs = worlds_at_once(job.episodes, population.agents + population.background)
    world = make_world(config, base_dir)
    vec = CavVectorEnv(make_worlds(world, base_dir, num_envs, find_backend(job.backend)))
    copy = WorldCopy()
    try:
        with warnings.catch_warnings():
            # `evaluate` has given this warning when it checked the drivers.
            warnings.simplefilter("ignore", UntrainedMapWarning)
            drivers = {name: load_policy(policy, vec) for name, policy in job.policies.items()}
        look = None if watcher is None else watcher(vec)
        return {
            name: _drive(vec, copy, driver, name, job, progress, look)
            for name, driver in drivers.items()
        }
    finally:
        copy.close()
        vec.close()


def _drive(
    vec: CavVectorEnv,
    copy: WorldCopy,
    driver: Policy,
    name: str,
    job: EpisodeJob,
    progress: Progress | None,
    look: Callable[[], None] | None,
) -> RunData:
    parts: list[_Part] = []
    standing = copy.standing(vec.worlds)
    clock = _zone_clock(vec, standing)
    resources = ResourceWatch(vec)
    count = math.ceil(job.episodes / vec.num_envs)
    path = recording_path(job.record, name, job.run, len(job.policies) == job.runs == 1)
    watch = RunWatch(vec, standing, name, job.run, job.seed, path, job.failures, look)
    for k in range(count):
        first = k * vec.num_envs

        def step_done(steps: int, most: int, before: int = k) -> None:
            resources.step()
            if progress is not None:
                progress(name, before * most + steps, count * most)

        part = _Part(vec, copy, watch, min(vec.num_envs, job.episodes - first), tracked=k == 0)
        try:
            part.drive(driver, job.seed, first, derived_seed(job.seed, k), step_done)
        except ActionError as error:
            raise PolicyError(f"driver {name}: {error}") from error
        parts.append(part)
    watch.close()
    trips, episodes, transfers = (
        np.concatenate([getattr(part, table) for part in parts])
        for table in ("trips", "episodes", "transfers")
    )
    counts: Counter[str] = Counter()
    for part in parts:
        counts.update(part.transfer_counts)
    used, network = resources.rows(), resources.network()
    for table in (trips, episodes, transfers, used):
        table["run"] = job.run
    return RunData(
        trips,
        episodes,
        tracks=parts[0].tracks,
        speed=_speed(parts, vec.num_envs, clock),
        transfers=transfers,
        transfer_counts=dict(counts),
        failures=list(watch.failures),
        borders=[part.borders for part in parts],
        resources=used,
        network=network,
    )


def derived_seed(seed: int, number: int) -> int:
    """Return the seed of a further run or part; the first one has `seed` itself."""
    if number == 0:
        return seed
    return int(np.random.SeedSequence((seed, number)).generate_state(1, np.uint64)[0]) >> 1


class _Part:
    """The episodes of worlds that are stepped together; only the first `count` are evaluated."""

    def __init__(
        self, vec: CavVectorEnv, copy: WorldCopy, seen: RunWatch, count: int, *, tracked: bool
    ) -> None:
        self._vec = vec
        self._copy = copy
        self._seen = seen
        self._count = count
        self._recorder = Recorder(
            vec.num_envs,
            vec.num_agents,
            vec.max_cycles,
            vec.step_s,
            np.array(vec.config.terms.weight_of_each),
            # If trips have a horizon of their own, every arrival is in time.
            math.inf if vec.config.traffic.trip_horizon else SLOWEST,
        )
        self._watch = EncounterWatch(vec, self._recorder)
        self._standing = StandingWatch(vec, self._recorder)
        self._tracked = tracked
        self.borders = BorderTerms(vec.worlds.world.partition, vec.step_s)
        self._tracks: list[NDArray[np.void]] = [np.zeros(0, TRACK)]
        self.policy_s = self.simulation_s = 0.0
        self.decisions = self.timed_steps = 0
        self.trips = np.zeros(0, TRIP)
        self.episodes = np.zeros(0, EPISODE)
        self.transfers = np.zeros(0, TRANSFER)
        self.transfer_counts: Mapping[str, int] = {}

    @property
    def tracks(self) -> NDArray[np.void]:
        return np.concatenate(self._tracks)

    def drive(
        self,
        driver: Policy,
        seed: int,
        first: int,
        policy_seed: int,
        step_done: Callable[[int, int], None],
    ) -> None:
        """Drive until each of the first `count` worlds has finished its episode."""
        vec = self._vec
        observations, infos = vec.reset(seed=seed, options={"first_world": first})
        driver.reset(policy_seed)
        present = self._copy.present(vec.worlds)
        keys, maps = present.worlds.keys, len(vec.network.maps)
        self._recorder.maps[:] = [map_of(key, maps) for key in keys]
        handed_over = TransferRecorder(transfer_logs(vec))
        imbalance, messages, others = _Imbalance(vec), MessageRecord(vec), BackgroundUse(vec)
        running = np.arange(vec.num_envs) < self._count
        every = max(1, round(TRACK_S / vec.step_s))
        self._seen.begin(first, running)
        steps = 0
        while running.any():
            self._watch.locate(present.worlds)
            self._standing.look(steps, infos["mask"])
            imbalance.add(present, running)
            messages.add(present, running)
            others.add(present, steps, running)
            if self._tracked and running[0] and steps % every == 0:
                self._note_track(steps, infos["mask"][0])
            before = time.perf_counter()
            actions = driver.act_batch(observations, infos["mask"])
            between = time.perf_counter()
            observations, rewards, _, _, infos = vec.step(actions)
            after = time.perf_counter()
            present = self._copy.present(vec.worlds)
            if steps:  # the first step loads or compiles the kernels
                self.policy_s += between - before
                self.simulation_s += after - between
                self.decisions += int(infos["acted"].sum())
                self.timed_steps += 1
            acted = infos["acted"] & running[:, None]
            over = infos["episode_over"] & running
            done = infos["vehicle_done"] & acted
            arrivals = infos["arrivals"]
            ended = self._recorder.add(steps, acted, rewards, infos["terms"], done, over, arrivals)
            self._seen.step(running, over, ended, actions)
            self.borders.add(self._recorder.places_m, acted, infos["terms"])
            handed_over.collect(np.flatnonzero(running).tolist(), over)
            running &= ~over
            steps += 1
            self._watch.encounters(present.worlds, steps * vec.step_s, running, infos["mask"])
            step_done(steps, vec.max_cycles)
        self.trips = self._recorder.trips()
        self.episodes = self._recorder.episodes()[: self._count]
        self.trips["episode"] += first
        self.episodes["episode"] += first
        self.episodes["zone_imbalance"] = imbalance.means()[: self._count]
        messages.write(self.episodes)
        others.write(self.episodes)
        self.transfers, self.transfer_counts = handed_over.records(), handed_over.counts
        self.transfers["episode"] += first

    def _note_track(self, steps: int, mask: NDArray[np.bool_]) -> None:
        agents = np.flatnonzero(mask)
        rows = np.zeros(agents.size, TRACK)
        rows["agent"] = agents
        rows["time_s"] = steps * self._vec.step_s
        rows["x_m"], rows["y_m"] = self._recorder.places_m[0, agents].T
        self._tracks.append(rows)


class _Imbalance:
    """Imbalance of vehicles over zones, world by world."""

    def __init__(self, vec: CavVectorEnv) -> None:
        self._is_divided = vec.worlds.world.partition.count > 1
        self._sums = np.zeros(vec.num_envs)
        self._steps = np.zeros(vec.num_envs, dtype=np.int64)

    def add(self, simulation: Simulation, running: NDArray[np.bool_]) -> None:
        """Sample the running worlds (W,) before a step."""
        if self._is_divided:
            self._sums[running] += simulation.zones.loads().imbalance()[running]
            self._steps[running] += 1

    def means(self) -> NDArray[np.float64]:
        """Return (W,) means over the steps; NaN for undivided worlds."""
        return np.where(self._steps > 0, self._sums / np.maximum(self._steps, 1), np.nan)


def transfer_logs(vec: CavVectorEnv) -> Sequence[TransferLog]:
    """Return the log of each world; empty for undivided worlds and for worker processes."""
    worlds = vec.worlds
    return worlds.transfers if isinstance(worlds, (LocalWorlds, NodeWorlds, NodeGroups)) else ()


def _zone_clock(vec: CavVectorEnv, standing: Simulation) -> ShardClock | None:
    """Return a clock for the zones of divided worlds in this process, or None."""
    if standing.partition.count == 1 or not isinstance(vec.worlds, LocalWorlds):
        return None
    return standing.zones.measure_costs(TIMED_TICKS)


def _speed(parts: list[_Part], worlds: int, clock: ShardClock | None) -> Speed:
    timed = max(sum(part.timed_steps for part in parts) * worlds, 1)
    policy_s = sum(part.policy_s for part in parts)
    simulation_s = sum(part.simulation_s for part in parts)
    zones_s = np.zeros(0) if clock is None else clock.take_s()
    return Speed(
        step_ms=1e3 * simulation_s / timed,
        policy_ms=1e3 * policy_s / timed,
        agent_steps_per_s=sum(p.decisions for p in parts) / max(policy_s + simulation_s, 1e-9),
        worlds=worlds,
        zone_time_imbalance=None if not zones_s.any() else imbalance(zones_s.tolist()),
    )
