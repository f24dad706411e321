"""The fault matrix, run: every line beside the undivided world, compared after every step."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from hashlib import blake2b
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.checks import check_count
from cavmarl.config.world_spec import WorldKeys, WorldSpec
from cavmarl.core.errors import ConfigError, EvaluationError, LostTickError, ProtocolError
from cavmarl.engine.world_setup import load_world
from cavmarl.env.vector import CavVectorEnv, make_vec
from cavmarl.handoff.fault_injection.fault_plan import PHASES, Crash, Faults
from cavmarl.handoff.fault_injection.injected_faults import FaultyCoordinator
from cavmarl.handoff.fault_injection.reproducer_file import read_reproducer
from cavmarl.ownership.messages import Begin, Message, Record
from cavmarl.ownership.transport import check_whole
from cavmarl.verify.determinism import MAX_STEPS
from cavmarl.verify.differences import Arrays, DrivenRun, first_results, single_arrays, step_results
from cavmarl.verify.fault_figures import FaultFigures, HandOverClock, spread
from cavmarl.verify.fault_matrix import MatrixLine, Rehearsal, matrix
from cavmarl.verify.replay import replay_tick, world_of

ENV = "grid4x4"
ZONES = (4, 9)
# A world in which many go over borders, and as much as can be goes with them.
BUSY: Mapping[str, Any] = {
    "population.mode": "respawn",
    "population.agents": 8,
    "population.background": 120,
    "clock.sim_dt_s": 0.1,
    "clock.control_latency_ticks": 3,
    "zones.approach_ticks": 12,
    "sensors.stack": 2,
}
EPISODES = 3  # of a run, so that hand-overs are under way when one ends
NEVER = 1 << 40  # a tick that no run comes to


@dataclass
class LineResult:
    """What came of a line of the matrix, with one number of zones."""

    name: str  # of the line
    points: str  # where it strikes
    zones: int  # how many
    runs: int = 0  # how many
    survived: int = 0  # faults of the runs that were equal to the end
    unmet: tuple[str, ...] = ()  # points not reached
    missed: int = 0  # deaths that were planned and did not happen
    # of each run that was not as it has to be, what was wrong, and its plan
    failures: list[dict[str, Any]] = field(default_factory=list)
    figures: FaultFigures = field(default_factory=FaultFigures)  # of all runs

    def to_dict(self) -> dict[str, Any]:
        return {**vars(self), "injected": self.figures.injected, "figures": self.figures.to_dict()}


@dataclass
class Campaign:
    """All lines."""

    env: str  # of which environment
    zones: tuple[int, ...]  # numbers of zones
    steps: int  # of each run
    ticks: int = 0  # of each run
    lines: list[LineResult] = field(default_factory=list)  # results
    calm_ms: list[float] = field(default_factory=list)  # of each step without a death
    stricken_ms: list[float] = field(default_factory=list)  # of each step with a death

    @property
    def holds(self) -> bool:
        """Whether every run was as it has to be."""
        return not any(line.failures for line in self.lines)

    def total(self) -> FaultFigures:
        figures = FaultFigures()
        for line in self.lines:
            figures.add(line.figures)
        return figures

    def to_dict(self) -> dict[str, Any]:
        total = self.total()
        return {
            "env": self.env,
            "zones": list(self.zones),
            "steps": self.steps,
            "ticks": self.ticks,
            "runs": sum(line.runs for line in self.lines),
            "injected": total.injected,
            "survived": sum(line.survived for line in self.lines),
            "step_ms": spread(self.calm_ms),
            "step_with_death_ms": spread(self.stricken_ms),
            "figures": total.to_dict(),
            "lines": [line.to_dict() for line in self.lines],
            "holds": self.holds,
        }


def run_campaign(
    env: str | Path | WorldSpec | None = None,
    zones: Sequence[int] | None = None,
    *,
    steps: int = 40,
    seeds: int = 12,
    policy: str | Path = "idm",
    progress: Callable[[int, int], None] | None = None,
    **keys: Unpack[WorldKeys],
) -> Campaign:
    """Run the whole matrix; each run is compared with the undivided world after every step.

    Args:
        env: as in `make_vec`, like the other keywords; None: a small busy world.
        zones: numbers of them, 2 or more; default: `ZONES`.
        steps: of each run, in `EPISODES` episodes.
        seeds: runs in which any process dies at any time.
        policy: as in `load_policy`.
        progress: called after each run with its number and how many there are.
        keys: of the world.
    """
    check_count("steps", steps, MAX_STEPS)
    check_whole("seeds", seeds, 0)
    counts = ZONES if zones is None else tuple(dict.fromkeys(zones))
    if not counts or min(counts) < 2:
        raise ConfigError(f"zones = {list(counts)}: a campaign needs numbers of 2 or more")
    spec = WorldSpec.of("" if env is None else env, **keys)
    if not spec.env:
        given = {"population.agents": spec.agents, "population.background": spec.background}
        named = {key: value for key, value in given.items() if value is not None}
        overrides = {**BUSY, **spec.overrides, **named}
        spec = replace(spec, env=ENV, agents=None, background=None, overrides=overrides)
    campaign = Campaign(spec.env, counts, steps)
    with TemporaryDirectory() as folder:
        _run_matrix(_Stage(spec, steps, policy, folder), campaign, seeds, progress)
    return campaign


def _run_matrix(
    stage: _Stage, campaign: Campaign, seeds: int, progress: Callable[[int, int], None] | None
) -> None:
    lines = []
    for count in campaign.zones:
        seen = stage.rehearse(count)
        campaign.ticks = seen.ticks
        lines += [(count, line) for line in matrix(seen, stage.seed, seeds)]
    runs, done = sum(len(line.plans) for _, line in lines), 0
    for count, line in lines:
        result = LineResult(line.name, line.points, count, unmet=line.unmet)
        campaign.lines.append(result)
        for plan in line.plans:
            stage.run(plan, line, result, campaign)
            done += 1
            if progress is not None:
                progress(done, runs)


class _Stage:
    """The undivided run, recorded, and divided ones that are held against it.

    Reproducers of ticks that cannot be finished go into `folder`.
    """

    def __init__(self, spec: WorldSpec, steps: int, policy: str | Path, folder: str) -> None:
        self.env, self.seed = spec.env, spec.seed
        self._folder = folder
        clock = load_world(spec.env, **spec.keywords)[0].clock
        episode_s = clock.ctrl_dt_s * max(1, steps // EPISODES)
        self._settings = {"horizon_s": episode_s, **spec.overrides}
        plain = {k: v for k, v in self._settings.items() if not k.startswith("zones.")}
        self._keywords = spec.keywords
        whole = make_vec(spec.env, num_envs=1, **self._keywords | {"overrides": plain})
        run = DrivenRun(whole, policy, spec.seed)
        self._actions: list[NDArray[Any]] = []
        self._prints = [_fingerprint(whole, run.results)]
        for _ in range(steps):
            results = run.step()
            self._actions.append(results["actions"].copy())
            self._prints.append(_fingerprint(whole, results))

    def rehearse(self, count: int) -> Rehearsal:
        """A divided run without faults; an error if it is not the undivided one."""
        vec = self._divided(count, Faults(crashes=(Crash(NEVER, PHASES[0], 0),)))
        coordinator = vec.simulation.coordinators[0]
        assert isinstance(coordinator, FaultyCoordinator)
        visits = coordinator.crashes.visits = set()
        for step, is_equal in self._drive(vec):
            if not is_equal:
                raise EvaluationError(
                    f"{self.env}, {count} zones: differs from the undivided world in step {step} "
                    "without any fault; `cavmarl verify` says where"
                )
        rows = vec.simulation.transfers[0].rows
        switches = tuple((row.tick, row.source, row.target) for row in rows)
        return Rehearsal(count, coordinator.tick, frozenset(visits), switches)

    def run(self, plan: Faults, line: MatrixLine, result: LineResult, campaign: Campaign) -> None:
        """A divided run with faults; what came of it is added to the result and the campaign."""
        vec = self._divided(result.zones, plan)
        simulation = vec.simulation
        clock = HandOverClock()
        healing = _Healing(plan.until, simulation.config.zones.max_deferred_ticks)
        for watcher in (clock, healing):
            simulation.coordinators[0].watch(watcher)
        wrong = self._wrong(vec, line, campaign) or healing.wrong
        figures = FaultFigures.of(simulation, [clock])
        planned = sum(crash.times for crash in plan.crashes)
        result.runs += 1
        result.figures.add(figures)
        if wrong:
            told = {"wrong": wrong, "zones": result.zones, "plan": plan.to_json()}
            result.failures.append(told)
            return
        result.survived += figures.injected
        if planned and not line.poison:
            result.missed += planned - figures.deaths

    def _wrong(self, vec: CavVectorEnv, line: MatrixLine, campaign: Campaign) -> str:
        """What is not as it has to be in a run; nothing if all is."""
        revivals = vec.simulation.revivals
        began, deaths = time.perf_counter(), 0
        try:
            for step, is_equal in self._drive(vec):
                ms = 1000.0 * (time.perf_counter() - began)
                (campaign.calm_ms if len(revivals) == deaths else campaign.stricken_ms).append(ms)
                if not is_equal:
                    return f"differs from the undivided world in step {step}"
                began, deaths = time.perf_counter(), len(revivals)
        except LostTickError as error:
            return self._unlike(error) if line.poison else str(error)
        except ProtocolError as error:
            return str(error)
        return "a tick that kills every host was survived" if line.poison else ""

    def _unlike(self, error: LostTickError) -> str:
        """How the tick is not as it was when it is run again from its file."""
        if not isinstance(error.reproducer, Path):
            return str(error)
        kept = read_reproducer(error.reproducer)
        world = world_of(kept, self.env)
        try:
            replay_tick(kept, world)
        except LostTickError as again:
            replay_tick(kept, world, faults=False)
            same = (again.zone, again.tick) == (error.zone, error.tick)
            return "" if same else f"run again, {again}"
        return f"tick {error.tick} is reached when it is run again"

    def _divided(self, count: int, plan: Faults) -> CavVectorEnv:
        settings = self._settings | {"zones.faults": plan.to_json()}
        if plan.may_crash:
            settings["zones.reproducers"] = self._folder
        wanted = self._keywords | {"overrides": settings}
        return make_vec(self.env, num_envs=1, zones=count, **wanted)

    def _drive(self, vec: CavVectorEnv) -> Iterator[tuple[int, bool]]:
        """Each step's number, and whether all is as in the undivided world."""
        yield 0, _fingerprint(vec, first_results(vec, self.seed)) == self._prints[0]
        for step, actions in enumerate(self._actions, start=1):
            results = step_results(vec.step(actions), actions)
            yield step, _fingerprint(vec, results) == self._prints[step]


class _Healing:
    """A watcher that sees that hand-overs which were open when faults ended are done in time.

    Faults end in tick `until`; for `deferral` ticks more a hand-over may be put off.
    """

    def __init__(self, until: int | None, deferral: int) -> None:
        self.wrong = ""  # what is not so
        self._until = until
        self._last = None if until is None else until + deferral + 2

    def logged(self, records: Iterable[Record]) -> None:
        for record in records:
            if isinstance(record, Begin) and record.tick == self._last:
                assert self._until is not None
                since = {v: record.tick - ticks for v, ticks in record.deferred}
                late = [vehicle for vehicle, tick in since.items() if tick < self._until]
                if late:
                    self.wrong = f"hand-overs of {late} are open in tick {record.tick}"

    def delivered(self, destination: int, message: Message) -> None:
        """A message that has arrived."""


def _fingerprint(vec: CavVectorEnv, results: Arrays) -> bytes:
    """Digest of the world's state and of all that its agents got."""
    digest = blake2b(vec.state_hash(0).encode(), digest_size=16)
    for name, array in single_arrays(results):
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.digest()
