"""A campaign of faults on a simulated machine: many runs, each reproducible from its seed.

The caller and the nodes run the code of real processes; only the sockets, the clocks and the
processes are simulated by `SimulatedMachine`. The clocks of the processes have different offsets
and rates.
"""

from __future__ import annotations

import logging
import random
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Unpack

from cavmarl.config.checks import check_count
from cavmarl.config.registry import load_config
from cavmarl.config.workers import WorkersConfig
from cavmarl.config.world_spec import WorldKeys, WorldSpec
from cavmarl.core.errors import ConfigError, NodeRefusedError, WorkerDeathError
from cavmarl.engine.world_setup import World, make_world
from cavmarl.env.vector import CavVectorEnv, make_vec
from cavmarl.parallel.nodes.node_process import run_node
from cavmarl.parallel.nodes.node_starters import NodeStarter, Route
from cavmarl.parallel.nodes.node_system import NodeSystem
from cavmarl.parallel.nodes.node_worlds import NodeWorlds
from cavmarl.parallel.placement.backend_name import NODES, BackendName
from cavmarl.verify.determinism import MAX_STEPS
from cavmarl.verify.differences import Arrays, DrivenRun, first_results, same_bytes, step_results
from cavmarl.verify.fault_campaign import (
    FaultCampaign,
    FaultLine,
    check_kinds,
    check_nodes,
    run_lines,
)
from cavmarl.verify.simulated_faults import (
    CALLER_DEATHS,
    FAULTS,
    SEVERE_RATES,
    TOLERATED,
    TOLERATED_RATES,
    Fault,
    SimulatedFaults,
    counts_by_name,
    random_clock,
)
from cavmarl.verify.simulated_machine import (
    ProcessEndedError,
    SimulatedListener,
    SimulatedMachine,
    SimulatedProcess,
)

TIMEOUT_S = 1.0  # time without a frame, after which a node receives a ping
STARTED = (-2.0, 0.5)  # range of log10 of the time that a node's start takes, s
THOUGHT_S = 0.15  # longest pause of the caller between two steps
WITHIN_S = 0.03  # longest time from the start of a step to its planned fault
MAX_SEEDS = 1_000_000
PATIENCE_S = 100.0  # time for nodes to notice the end of the caller
FIRST_STEPS = 2  # number of steps without planned faults
HASHED = 4  # steps between two comparisons of the state's hash

NONE, TWO, FOUR = "none", "two_at_once", "any_four"
MANY_TOLERATED, MANY = "many_tolerated", "many"  # faults by rate, drawn for each frame
MIXES = (NONE, *map(str, FAULTS), TWO, FOUR, MANY_TOLERATED, MANY, *map(str, CALLER_DEATHS))
RATES = {MANY_TOLERATED: TOLERATED_RATES, MANY: {**TOLERATED_RATES, **SEVERE_RATES}}


# A world in which many vehicles change their zone, for campaigns without an environment.
BUSY = WorldSpec(
    env="grid4x4",
    overrides={
        "population.mode": "respawn",
        "population.agents": 8,
        "population.background": 120,
        "clock.sim_dt_s": 0.1,
        "clock.ctrl_dt_s": 0.4,
        "clock.control_latency_ticks": 3,
        "sensors.stack": 2,
    },
)


class SimulatedNodes(NodeStarter):
    """Starts nodes as processes of a simulated machine, which end by themselves."""

    def __init__(
        self, machine: SimulatedMachine, drawn: random.Random, ghosts: bool, nodes: int
    ) -> None:
        super().__init__(nodes)
        self._machine, self._drawn = machine, drawn
        self._ghosts = ghosts  # whether replaced processes may continue to run
        self.listener = SimulatedListener(machine, machine.caller)
        self._processes = [self._start(number) for number in range(nodes)]

    def _start(self, number: int) -> SimulatedProcess:
        def run(system: NodeSystem) -> None:
            place, secret = self.listener.place, self.listener.secret
            with suppress(OSError, EOFError, NodeRefusedError):
                run_node(place, secret, number, system=system)

        process = self._machine.start(f"node {number}", run)
        process.clock = random_clock(self._drawn)
        process.not_before_s = self._machine.now_s + 10.0 ** self._drawn.uniform(*STARTED)
        return process

    def replace(self, number: int, is_silent: bool) -> None:
        if not self._ghosts:
            self._machine.end(self._processes[number])
        self._processes[number] = self._start(number)


@dataclass
class SimulatedLine(FaultLine):
    """The runs on the simulated machine with one number of nodes and one mix of faults."""

    replacements: int = 0  # number of nodes that replaced lost nodes during a run
    migrations: int = 0  # number of changes of owner
    caller_ended: int = 0  # runs in which the caller died, and all nodes ended by themselves


class _Reference:
    """The results and the actions of the undivided world."""

    def __init__(self, spec: WorldSpec, steps: int, policy: str | Path) -> None:
        vec = make_vec(spec.env, num_envs=1, **spec.keywords)
        run = DrivenRun(vec, policy, spec.seed)
        self.seed, self.first = spec.seed, run.results
        self.results: list[Arrays] = []
        self.hashes: list[str] = []
        for _ in range(steps):
            found = run.step()
            self.results.append({name: array.copy() for name, array in found.items()})
            self.hashes.append(vec.state_hash(0))
        vec.close()


def verify_simulated_nodes(
    env: str | Path | WorldSpec,
    nodes: Sequence[int],
    *,
    mixes: Sequence[str] = MIXES,
    seeds: int = 100,
    first_seed: int = 0,
    zones: int | None = None,
    steps: int = 16,
    policy: str | Path = "idm",
    progress: Callable[[int, int], None] | None = None,
    **keys: Unpack[WorldKeys],
) -> FaultCampaign[SimulatedLine]:
    """Drive worlds over simulated nodes, and compare each run with an undivided world.

    The world, the number of nodes, the mix and the seed of the faults determine a run completely.

    Args:
        env: see `make_vec`, also for the other keywords.
        nodes: numbers of nodes.
        mixes: mixes of faults; keys of MIXES.
        seeds: number of runs for each number of nodes and mix.
        first_seed: seed of the faults of the first run; further runs have the next seeds.
        zones: number of zones of each world; default: twice the largest number of nodes.
        steps: number of steps of each run.
        policy: as in `load_policy`.
        progress: called with the number of completed runs and of all runs.
        keys: settings of the worlds.

    Raises:
        ConfigError: a number is invalid.
    """
    given = WorldSpec.of(env, **keys)
    check_count("steps", steps, MAX_STEPS)
    check_count("seeds", seeds, MAX_SEEDS)
    if first_seed < 0:
        raise ConfigError(f"first_seed = {first_seed}: must be a whole number of at least 0")
    check_nodes(nodes)
    if steps < 2 * FIRST_STEPS:
        raise ConfigError(f"steps = {steps}: must be at least {2 * FIRST_STEPS}")
    check_kinds("mixes", mixes, MIXES)
    count = 2 * max(nodes) if zones is None else zones
    overrides = {"workers.timeout_s": TIMEOUT_S, **given.overrides}
    keywords = {**given.keywords, "overrides": overrides}
    config, base_dir = load_config(given.env, zones=count, **keywords)
    world = make_world(config, base_dir)
    reference = _Reference(given, steps, policy)
    lines = [SimulatedLine(number, mix) for number in nodes for mix in mixes]
    with _quiet():

        def run(line: SimulatedLine, seed: int) -> None:
            _Run(world, base_dir, reference, line, seed).execute()

        run_lines(lines, range(first_seed, first_seed + seeds), run, progress)
    return FaultCampaign(given.env, count, steps, tuple(lines))


class _Run:
    """One run: a world over simulated nodes, and the faults that a seed determines."""

    def __init__(
        self, world: World, base_dir: Path, reference: _Reference, line: SimulatedLine, seed: int
    ) -> None:
        self._world, self._base_dir = world, base_dir
        self._reference, self._line, self._seed = reference, line, seed
        self._drawn = random.Random(f"{line.nodes} {line.kind} {seed}")
        self._machine = SimulatedMachine(self._drawn.randrange(1 << 32), world)
        self._machine.caller.clock = random_clock(self._drawn)
        self._faults = SimulatedFaults(self._machine, self._drawn, RATES.get(line.kind, {}))
        self._losses = 0  # number of lost nodes
        # numbers of lost and of living nodes at the time of the last state that all nodes have kept
        self._losses_before, self._living = 0, line.nodes

    def execute(self) -> None:
        """Perform the run, and add its result to the `FaultLine`."""
        line, machine = self._line, self._machine
        wrong = ""
        try:
            result = self._result()
            if left := machine.outlived(PATIENCE_S):
                wrong = f"{', '.join(left)} did not end"
        except Exception as error:
            wrong = f"{type(error).__name__}: {error}"
        finally:
            machine.close()
            line.injected += self._faults.injected
            line.deaths += self._faults.deaths
        if not wrong and self._losses and self._must_lose_no_node:
            wrong = f"{self._losses} nodes were lost to faults that must be tolerated"
        if wrong:
            line.wrong.append(f"{counts_by_name(self._faults.injected.items())}: {wrong}")
            line.wrong_seeds.append(self._seed)
        else:
            setattr(line, result, getattr(line, result) + 1)

    def _result(self) -> str:
        """Drive the worlds. Return how the run ended: "equal", "ended" or "caller_ended".

        Raises:
            AssertionError: the worlds differ from the reference, or ended too soon.
        """
        try:
            self._drive()
        except WorkerDeathError as error:
            lost = self._losses - self._losses_before
            if lost < min(2, self._living):  # one loss is survivable: the next node has a replica
                raise AssertionError(f"ended after {lost} losses in a row: {error}") from error
            return "ended"
        except ProcessEndedError:
            if not self._machine.caller.is_ended:
                raise
            return "caller_ended"
        return "equal"

    @property
    def _must_lose_no_node(self) -> bool:
        """Return whether no fault of this run may cost a node."""
        return self._line.kind in (NONE, MANY_TOLERATED, *TOLERATED)

    def _planned(self) -> dict[int, list[Fault]]:
        """Return the planned faults by step."""
        drawn, mix, steps = self._drawn, self._line.kind, len(self._reference.results)
        if mix == NONE or mix in RATES:
            return {}
        if mix == TWO:
            return {drawn.randrange(FIRST_STEPS, steps): drawn.choices(FAULTS, k=2)}
        faults = drawn.choices(FAULTS, k=4) if mix == FOUR else [Fault(mix)]
        found: dict[int, list[Fault]] = {}
        for fault in faults:
            found.setdefault(drawn.randrange(FIRST_STEPS, steps), []).append(fault)
        return found

    def _drive(self) -> None:
        machine, line, reference = self._machine, self._line, self._reference
        planned, ghosts = self._planned(), self._drawn.random() < 0.5

        def start(
            backend: BackendName,
            num_worlds: int,
            settings: WorkersConfig,
            base_dir: Path,
            route: Route,
        ) -> tuple[NodeStarter, SimulatedListener]:
            starter = SimulatedNodes(machine, self._drawn, ghosts, line.nodes)
            return starter, starter.listener

        worlds = NodeWorlds(
            self._world, self._base_dir, 1, BackendName(NODES, line.nodes),
            system=machine.system(machine.caller), start=start,
        )  # fmt: skip
        self._faults.begin_severe()
        try:
            vec = CavVectorEnv(worlds)
            self._compare("reset", first_results(vec, reference.seed), reference.first)
            for step, wanted in enumerate(reference.results):
                for fault in planned.get(step, ()):
                    delay_s = self._drawn.uniform(0.0, WITHIN_S)
                    machine.at(delay_s, partial(self._faults.inject, fault))
                before = worlds.pool.losses, worlds.pool.replacements
                living = len(worlds.pool.pids)
                until_s = machine.now_s + self._drawn.uniform(0.0, THOUGHT_S)
                machine.wait(machine.caller, lambda: False, until_s)
                found = step_results(vec.step(wanted["actions"]), wanted["actions"])
                if before == (worlds.pool.losses, worlds.pool.replacements):
                    self._losses_before, self._living = worlds.pool.losses, living
                self._compare(f"step {step}", found, wanted)
                if step % HASHED == 0 or step == len(reference.results) - 1:
                    if worlds.state_hash(0) != reference.hashes[step]:
                        raise AssertionError(f"the state after step {step} is different")
        finally:
            pool = worlds.pool
            self._losses = pool.losses
            line.lost += pool.losses
            line.recoveries += pool.recoveries
            line.replacements += pool.replacements
            line.migrations += worlds.migrations
            worlds.close()

    def _compare(self, when: str, found: Arrays, wanted: Arrays) -> None:
        if not same_bytes(found, wanted):
            raise AssertionError(f"the results of {when} are different")


@contextmanager
def _quiet() -> Iterator[None]:
    """Disable the log of nodes, which are lost on purpose."""
    log = logging.getLogger("cavmarl.nodes")
    before, log.disabled = log.disabled, True
    try:
        yield
    finally:
        log.disabled = before
