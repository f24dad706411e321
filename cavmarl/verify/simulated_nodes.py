"""Worlds over nodes in one process and in simulated time: thousands of runs, each of a seed.

The code of the caller and of the nodes is the one that real processes run; only sockets, clocks and
processes are those of `SimulatedMachine`. Clocks of all processes differ, and go differently fast.
"""

from __future__ import annotations

import logging
import random
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Unpack

from cavmarl.config.checks import check_count
from cavmarl.config.registry import load_config
from cavmarl.config.workers import WorkersConfig
from cavmarl.config.world_spec import WorldKeys, WorldSpec
from cavmarl.core.errors import ConfigError, NodeRefusedError, WorkerDeathError
from cavmarl.engine.world_setup import World, make_world
from cavmarl.env.vector import CavVectorEnv, make_vec
from cavmarl.parallel.backend_name import NODES, BackendName
from cavmarl.parallel.nodes.link import HEAD_BYTES, MAGIC, FrameKind
from cavmarl.parallel.nodes.node_process import run_node
from cavmarl.parallel.nodes.node_starters import NodeStarter, Route
from cavmarl.parallel.nodes.node_system import NodeSystem
from cavmarl.parallel.nodes.node_worlds import NodeWorlds
from cavmarl.verify.determinism import MAX_STEPS
from cavmarl.verify.differences import Arrays, DrivenRun, first_results, same_bytes, step_results
from cavmarl.verify.simulated_machine import (
    ProcessEndedError,
    SimulatedListener,
    SimulatedMachine,
    SimulatedProcess,
    SimulatedSocket,
)

TIMEOUT_S = 1.0  # of silence, until a node is asked whether it lives
STARTED_S = (0.05, 3.0)  # how long a new node takes
WITHIN_S = 0.03  # of a step's beginning: when a fault happens
PATIENCE_S = 100.0  # for nodes to notice that the caller has ended
FIRST_STEPS = 2
HASHED = 4  # one of so many steps is compared as a whole
SKEW_S = 1e6
RATES = (0.8, 1.25)  # of clocks

NODE_KINDS = (FrameKind.REPORT, FrameKind.MESSAGES, FrameKind.SHARE, FrameKind.KEEP)
RECOVERY_KINDS = (FrameKind.SYNC, FrameKind.REPORT, FrameKind.GIVE, FrameKind.MISSED)
CALLER_KINDS = (FrameKind.COMMAND, FrameKind.LEASE, FrameKind.RECOVER, FrameKind.PING)


class SimulatedNodes:
    """Starts nodes as processes of a simulated machine; a `NodeStarter`."""

    def __init__(
        self, machine: SimulatedMachine, drawn: random.Random, ghosts: bool, nodes: int
    ) -> None:
        self.count = nodes
        self._machine, self._drawn = machine, drawn
        self._ghosts = ghosts  # whether processes that are taken for lost may go on
        self.listener = SimulatedListener(machine, machine.caller)
        self._processes = [self._start(number) for number in range(nodes)]

    def _start(self, number: int) -> SimulatedProcess:
        def run(system: NodeSystem) -> None:
            place, secret = self.listener.place, self.listener.secret
            with suppress(OSError, EOFError, NodeRefusedError):
                run_node(place, secret, number, system=system)

        process = self._machine.start(f"node {number}", run)
        process.clock = _clock(self._drawn)
        process.not_before_s = self._machine.now_s + self._drawn.uniform(*STARTED_S)
        return process

    def trouble(self, begun: Collection[int]) -> str | None:
        return None

    def retry(self, number: int, pid: int, is_silent: bool) -> str | None:
        self.replace(number, is_silent)
        return None

    def replace(self, number: int, is_silent: bool) -> None:
        if not self._ghosts:
            self._machine.end(self._processes[number])
        self._processes[number] = self._start(number)

    def stopped(self) -> set[int]:
        return set()  # a machine elsewhere does not tell

    def close(self) -> None:
        """They end by themselves."""


def _clock(drawn: random.Random) -> tuple[float, float]:
    return drawn.uniform(-SKEW_S, SKEW_S), drawn.uniform(*RATES)


class SimulatedFaults:
    """What can happen to a machine; each method lets one thing happen.

    Attributes:
        done: how often each has happened.
    """

    def __init__(self, machine: SimulatedMachine, drawn: random.Random) -> None:
        self._machine, self._drawn = machine, drawn
        self.done: Counter[str] = Counter()

    def happen(self, name: str) -> None:
        self.done[name] += 1
        getattr(self, name)()

    def _node(self) -> SimulatedProcess | None:
        machine = self._machine
        living = [one for one in machine.processes if one is not machine.caller]
        living = [one for one in living if not one.is_ended]
        return self._drawn.choice(living) if living else None

    def _end(self) -> SimulatedSocket | None:
        """One end of a connection."""
        open_ones = [pair for pair in self._machine.connections if not pair[0].is_closed]
        return self._drawn.choice(self._drawn.choice(open_ones)) if open_ones else None

    def kill(self) -> None:
        if node := self._node():
            self._machine.end(node)

    def kill_at_point(self) -> None:
        """A node dies as it sends a frame of some kind, of which a part may go out."""
        if node := self._node():
            node.on_send = _Trap(self._drawn, NODE_KINDS)

    def kill_in_recovery(self) -> None:
        """One dies, and another one as it takes part in the recovery from that."""
        self.kill()
        if node := self._node():
            node.on_send = _Trap(self._drawn, RECOVERY_KINDS, first=1)

    def stop(self) -> None:
        """A node stops for a while; the rest of the world does not know."""
        if node := self._node():
            node.stopped_until_s = self._machine.now_s + self._drawn.choice((0.1, 1.5, 20.0, 60.0))

    def stop_caller(self) -> None:
        self._machine.caller.stopped_until_s = self._machine.now_s + self._drawn.choice((0.1, 30.0))

    def slow(self) -> None:
        if node := self._node():
            node.slowness_s = self._drawn.choice((0.001, 0.02, 0.1))

    def damage(self) -> None:
        if end := self._end():
            end.due = partial(_damaged, self._drawn)

    def duplicate(self) -> None:
        if end := self._end():
            end.due = lambda data: [data, data]

    def reorder(self) -> None:
        """What is sent next comes after what is sent then."""
        if end := self._end():
            end.due = partial(_kept_back, end)

    def delay(self) -> None:
        if end := self._end():
            end.held_until_s = self._machine.now_s + self._drawn.choice((0.01, 0.5, 3.0))

    def lose(self) -> None:
        """Nothing comes any more in one direction, and the sender does not notice."""
        if end := self._end():
            end.fall_silent()

    def part(self) -> None:
        """A node and the others do not hear each other any more."""
        if node := self._node():
            for pair in self._machine.connections:
                if node in (pair[0].owner, pair[1].owner):
                    for end in pair:
                        end.fall_silent()

    def cut(self) -> None:
        if (end := self._end()) and end.other:
            end.close()
            end.other.close()


FAULTS = (
    "kill", "kill_at_point", "kill_in_recovery", "stop", "stop_caller", "slow", "damage",
    "duplicate", "reorder", "delay", "lose", "part", "cut",
)  # fmt: skip
LOSES = {"stop_caller": 0, "kill_in_recovery": 2}  # nodes at most; of the others 1
END_CALLER, END_CALLER_AT_POINT = "end_caller", "end_caller_at_point"
MIXES = ("none", *FAULTS, "two at once", "any four", END_CALLER, END_CALLER_AT_POINT)


class _Trap:
    """Ends a process as it sends a frame of a kind that is drawn."""

    def __init__(
        self,
        drawn: random.Random,
        kinds: Sequence[FrameKind],
        first: int = 6,  # the last of the first frames of the kind that it may be
    ) -> None:
        self._kind, self._left = drawn.choice(kinds), drawn.randrange(first)
        self._part = drawn.choice((0.0, 0.5, 1.0))

    def __call__(self, data: bytes) -> int | None:
        if data[: len(MAGIC)] != MAGIC or int.from_bytes(data[6:8], "little") != self._kind:
            return None
        self._left -= 1
        return None if self._left >= 0 else int(self._part * len(data))


def _damaged(drawn: random.Random, data: bytes) -> list[bytes]:
    changed = bytearray(data)
    at = drawn.randrange(min(len(data), HEAD_BYTES) if drawn.random() < 0.5 else len(data))
    changed[at] ^= 1 << drawn.randrange(8)
    return [bytes(changed)]


def _kept_back(end: SimulatedSocket, data: bytes) -> list[bytes]:
    end.due = lambda more: [more, data]
    return []


@dataclass
class SimulatedLine:
    """Runs with one kind of fault."""

    nodes: int  # how many there were at the beginning
    faults: str  # which
    runs: int = 0  # how many there were
    lost: int = 0  # nodes
    back: int = 0  # how often the worlds went back
    ended: int = 0  # runs that ended with `WorkerDeathError`: what a node had was kept nowhere
    wrong: list[str] = field(default_factory=list)  # what should not have been, by seeds


@dataclass(frozen=True)
class SimulatedCampaign:
    """What was found."""

    env: str  # of which environment
    zones: int  # of each world
    steps: int  # of each run
    lines: tuple[SimulatedLine, ...]  # one for each number of nodes and kind of fault
    faults: dict[str, int]  # how often each happened

    @property
    def holds(self) -> bool:
        return not any(line.wrong for line in self.lines)

    def to_dict(self) -> dict[str, Any]:
        return {**asdict(self), "holds": self.holds}


class _Reference:
    """What an undivided world gives, and what drives it."""

    def __init__(self, spec: WorldSpec, steps: int, policy: str | Path) -> None:
        told = {name: value for name, value in spec.overrides.items() if name != "zones.faults"}
        keywords = {**spec.keywords, "overrides": told}
        vec = make_vec(spec.env, num_envs=1, **keywords)
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
    zones: int | None = None,
    steps: int = 16,
    policy: str | Path = "idm",
    progress: Callable[[int, int], None] | None = None,
    **keys: Unpack[WorldKeys],
) -> SimulatedCampaign:
    """Drive worlds over simulated nodes, and compare them with an undivided one.

    Args:
        env: as in `make_vec`, like the other keywords.
        nodes: numbers of them.
        mixes: which faults happen, of MIXES.
        seeds: runs for each number of nodes and mix.
        zones: of each world; default: twice the most nodes.
        steps: of each run.
        policy: as in `load_policy`.
        progress: called with runs done and runs in all.
        keys: of the worlds.

    Raises:
        ConfigError: numbers that cannot be.
    """
    given = WorldSpec.of(env, **keys)
    check_count("steps", steps, MAX_STEPS)
    if not nodes or min(nodes) < 1:
        raise ConfigError(f"nodes = {list(nodes)}: name at least one number from 1 on")
    if steps < 2 * FIRST_STEPS:
        raise ConfigError(f"steps = {steps}: a run needs {2 * FIRST_STEPS} or more")
    if unknown := [mix for mix in mixes if mix not in MIXES]:
        raise ConfigError(f"faults = {unknown}: must be among {', '.join(MIXES)}")
    count = 2 * max(nodes) if zones is None else zones
    overrides = {"workers.timeout_s": TIMEOUT_S, **given.overrides}
    keywords = {**given.keywords, "overrides": overrides}
    config, base_dir = load_config(given.env, zones=count, **keywords)
    world = make_world(config, base_dir)
    reference = _Reference(given, steps, policy)
    lines = [SimulatedLine(number, mix) for number in nodes for mix in mixes]
    done: Counter[str] = Counter()
    with _quiet():
        for n, line in enumerate(lines):
            for k in range(seeds):
                run = _Run(world, base_dir, reference, line, given.seed + k)
                done += run.whole(steps)
                if progress is not None:
                    progress(n * seeds + k + 1, len(lines) * seeds)
    return SimulatedCampaign(given.env, count, steps, tuple(lines), dict(done))


class _Run:
    """One of them."""

    def __init__(
        self, world: World, base_dir: Path, reference: _Reference, line: SimulatedLine, seed: int
    ) -> None:
        self._world, self._base_dir = world, base_dir
        self._reference, self._line, self._seed = reference, line, seed
        self._drawn = random.Random(f"{line.nodes} {line.faults} {seed}")
        self._machine = SimulatedMachine(self._drawn.randrange(1 << 32), world)
        self._machine.caller.clock = _clock(self._drawn)
        self._faults = SimulatedFaults(self._machine, self._drawn)

    def whole(self, steps: int) -> Counter[str]:
        """Do it, and note in its line what came of it."""
        line, machine = self._line, self._machine
        line.runs += 1
        try:
            try:
                self._drive(steps, self._planned(steps))
            except WorkerDeathError as error:
                line.ended += 1
                lost = sum(n * LOSES.get(name, 1) for name, n in self._faults.done.items())
                if lost < min(2, line.nodes):
                    self._note(f"one fault, and {error}")
            except ProcessEndedError:
                if not machine.caller.is_ended:
                    raise
            if left := machine.outlived(PATIENCE_S):
                self._note(f"{', '.join(left)} did not end")
        except Exception as error:
            self._note(f"{type(error).__name__}: {error}")
        finally:
            machine.close()
        return self._faults.done

    def _note(self, text: str) -> None:
        self._line.wrong.append(f"seed {self._seed}, {dict(self._faults.done)}: {text}")

    def _planned(self, steps: int) -> dict[int, list[str]]:
        """The faults by the steps in which they happen."""
        drawn, mix = self._drawn, self._line.faults
        if mix == "none":
            return {}
        if mix == "two at once":
            return {drawn.randrange(FIRST_STEPS, steps): drawn.choices(FAULTS, k=2)}
        names = drawn.choices(FAULTS, k=4) if mix == "any four" else [mix]
        found: dict[int, list[str]] = {}
        for name in names:
            found.setdefault(drawn.randrange(FIRST_STEPS, steps), []).append(name)
        return found

    def _drive(self, steps: int, planned: dict[int, list[str]]) -> None:
        machine, line, reference = self._machine, self._line, self._reference
        ghosts = self._drawn.random() < 0.5

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
        try:
            vec = CavVectorEnv(worlds)
            self._compare("reset", first_results(vec, reference.seed), reference.first)
            for step, wanted in enumerate(reference.results):
                for name in planned.get(step, ()):
                    machine.at(self._drawn.uniform(0.0, WITHIN_S), partial(self._strike, name))
                found = step_results(vec.step(wanted["actions"]), wanted["actions"])
                self._compare(f"step {step}", found, wanted)
                if step % HASHED == 0 or step == steps - 1:
                    if worlds.state_hash(0) != reference.hashes[step]:
                        raise AssertionError(f"another state after step {step}")
        finally:
            line.lost += worlds.pool.losses
            line.back += worlds.pool.recoveries
            worlds.close()

    def _strike(self, name: str) -> None:
        caller = self._machine.caller
        if name == END_CALLER:
            self._machine.end(caller)
        elif name == END_CALLER_AT_POINT:
            caller.on_send = _Trap(self._drawn, CALLER_KINDS)
        else:
            self._faults.happen(name)

    def _compare(self, when: str, found: Arrays, wanted: Arrays) -> None:
        if not same_bytes(found, wanted):
            raise AssertionError(f"something else came out of {when}")


@contextmanager
def _quiet() -> Iterator[None]:
    """Nodes are lost on purpose: nothing is logged of it."""
    log = logging.getLogger("cavmarl.nodes")
    before, log.disabled = log.disabled, True
    try:
        yield
    finally:
        log.disabled = before
