"""Checks that worlds over nodes are the undivided ones, also when nodes are killed."""

from __future__ import annotations

import os
import random
import signal
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from threading import Timer
from typing import Any, Unpack

from cavmarl.config.checks import check_count
from cavmarl.config.world_spec import WorldKeys, WorldSpec
from cavmarl.core.errors import ConfigError
from cavmarl.env.vector import make_vec
from cavmarl.parallel.nodes.node_worlds import NodeWorlds
from cavmarl.verify.determinism import MAX_STEPS
from cavmarl.verify.differences import DrivenRun, same_bytes

FIRST_STEPS = 5  # before any is killed, to know how long a step takes
LATEST = 1.5  # of a step's time: some are killed between two steps


@dataclass(frozen=True)
class NodeRun:
    """One number of nodes beside the undivided worlds."""

    nodes: int  # how many there were at the beginning
    killed: int  # of them
    migrations: int  # vehicles that changed their owner
    different: int | None  # the first step after which anything differed; None: none
    step_ms: float  # median of the steps in which no node was lost
    recovery_ms: tuple[float, ...]  # of the others, above that


@dataclass(frozen=True)
class NodeReport:
    """What was found."""

    env: str  # of which environment
    zones: int  # of each world
    worlds: int  # stepped together
    steps: int  # that were compared
    runs: tuple[NodeRun, ...]  # one for each number of nodes

    @property
    def holds(self) -> bool:
        return all(run.different is None for run in self.runs)

    def to_dict(self) -> dict[str, Any]:
        return {**asdict(self), "holds": self.holds}


def verify_nodes(
    env: str | Path | WorldSpec,
    nodes: Sequence[int],
    *,
    kills: int = 0,
    zones: int | None = None,
    worlds: int = 1,
    steps: int = 200,
    policy: str | Path = "idm",
    progress: Callable[[int, int], None] | None = None,
    **keys: Unpack[WorldKeys],
) -> NodeReport:
    """Drive worlds over nodes beside undivided ones and compare everything after each step.

    Args:
        env: as in `make_vec`, like the other keywords; the seed is that of the kills, too.
        nodes: numbers of them, one run each.
        kills: nodes that get a SIGKILL at random times in each run; at most all but one.
        zones: of each world; default: twice the most nodes.
        worlds: stepped together.
        steps: of each run.
        policy: as in `load_policy`.
        progress: called with steps done and steps in all.
        keys: of the worlds.

    Raises:
        ConfigError: numbers that cannot be.
        WorkerDeathError: a node and the one that kept its state were lost at about the same time.
    """
    spec = WorldSpec.of(env, **keys)
    check_count("steps", steps, MAX_STEPS)
    if not nodes or min(nodes) < 1:
        raise ConfigError(f"nodes = {list(nodes)}: name at least one number from 1 on")
    if not 0 <= kills < steps - FIRST_STEPS:
        raise ConfigError(f"kills = {kills}: {steps} steps can have up to {steps - FIRST_STEPS}")
    count = 2 * max(nodes) if zones is None else zones
    found = []
    for n, number in enumerate(nodes):

        def note(step: int, done: int = n * steps) -> None:
            if progress is not None:
                progress(done + step, steps * len(nodes))

        run = _Run(spec, number, min(kills, number - 1), count, worlds, policy)
        found.append(run.compare(steps, note))
    return NodeReport(spec.env, count, worlds, steps, tuple(found))


class _Run:
    def __init__(
        self, spec: WorldSpec, nodes: int, kills: int, zones: int, worlds: int, policy: str | Path
    ) -> None:
        self._random = random.Random(spec.seed)
        self._nodes, self._kills = nodes, kills
        self._struck: set[int] = set()  # processes that were killed
        self._timers: list[Timer] = []
        whole = make_vec(spec.env, num_envs=worlds, **spec.keywords)
        over = make_vec(spec.env, num_envs=worlds, zones=zones, nodes=nodes, **spec.keywords)
        assert isinstance(over.worlds, NodeWorlds)
        self._worlds = over.worlds
        try:
            self._runs = [DrivenRun(vec, policy, spec.seed) for vec in (whole, over)]
        except BaseException:
            over.close()
            raise

    def compare(self, steps: int, note: Callable[[int], None]) -> NodeRun:
        struck = set(self._random.sample(range(FIRST_STEPS, steps), self._kills))
        over = self._runs[1].vec
        different: int | None = None
        calm_ms: list[float] = []
        recovery_ms: list[float] = []
        try:
            for step in range(steps):
                first = self._runs[0].step()
                if step in struck:
                    self._strike(statistics.median(calm_ms))
                before, began = self._worlds.recoveries, time.perf_counter()
                second = self._runs[1].step()
                took_ms = 1e3 * (time.perf_counter() - began)
                one, other = self._hashes()
                if not same_bytes(first, second) or one != other:
                    different = step
                    break
                lost = self._worlds.recoveries > before
                (recovery_ms if lost else calm_ms).append(took_ms)
                note(step + 1)
            for timer in self._timers:
                timer.join()
            one, other = self._hashes()  # a node that was killed last is missed now
            different = steps if different is None and one != other else different
            migrations = self._worlds.migrations
            killed = self._worlds.losses
        finally:
            over.close()
        median_ms = statistics.median(calm_ms) if calm_ms else 0.0
        above_ms = tuple(took_ms - median_ms for took_ms in recovery_ms)
        return NodeRun(self._nodes, killed, migrations, different, median_ms, above_ms)

    def _strike(self, step_ms: float) -> None:
        """Kill a living node some time in the next step."""
        pid = self._random.choice([pid for pid in self._worlds.pids if pid not in self._struck])
        self._struck.add(pid)
        delay_s = 1e-3 * self._random.uniform(0.0, LATEST * step_ms)
        self._timers.append(Timer(delay_s, os.kill, (pid, signal.SIGKILL)))
        self._timers[-1].start()

    def _hashes(self) -> list[list[str]]:
        vecs = [run.vec for run in self._runs]
        return [[vec.state_hash(w) for w in range(vec.num_envs)] for vec in vecs]
