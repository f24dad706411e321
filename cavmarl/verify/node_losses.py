"""Check that worlds over nodes equal undivided worlds, even if nodes are killed."""

from __future__ import annotations

import os
import random
import signal
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from threading import Timer
from typing import Any, Unpack

from cavmarl.config.checks import check_count
from cavmarl.config.registry import load_config
from cavmarl.config.world_spec import WorldKeys, WorldSpec
from cavmarl.core.errors import ConfigError
from cavmarl.engine.world_setup import make_world
from cavmarl.env.vector import CavVectorEnv, make_vec
from cavmarl.parallel.nodes.node_starters import Route, straight
from cavmarl.parallel.nodes.node_worlds import NodeWorlds
from cavmarl.parallel.placement.backend_name import NODES, BackendName
from cavmarl.verify.determinism import MAX_STEPS
from cavmarl.verify.differences import DrivenRun, same_bytes
from cavmarl.verify.fault_campaign import check_nodes

FIRST_STEPS = 5  # steps without kills, to measure the duration of a step
LATEST = 1.5  # latest time of a kill, in step durations; some kills happen between two steps


@dataclass(frozen=True)
class NodeRun:
    """The result for one number of nodes."""

    nodes: int  # number of nodes at the start
    killed: int  # number of lost nodes
    migrations: int  # number of changes of owner
    different: int | None  # the first step after which anything differed; None: none
    step_ms: float  # median duration of the steps in which no node was lost
    recovery_ms: tuple[float, ...]  # additional durations of the steps in which a node was lost


@dataclass(frozen=True)
class NodeReport:
    """The result of `verify_nodes`."""

    env: str  # name of the environment
    zones: int  # number of zones of each world
    worlds: int  # number of worlds stepped together
    steps: int  # number of compared steps
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
    """Compare worlds over nodes with undivided worlds after each step.

    Args:
        env: see `make_vec`, also for the other keywords; `seed` also seeds the kills.
        nodes: numbers of nodes, one run each.
        kills: number of nodes killed by SIGKILL at random times in each run; one node is spared.
        zones: number of zones of each world; default: twice the largest number of nodes.
        worlds: number of worlds stepped together.
        steps: number of steps of each run.
        policy: as in `load_policy`.
        progress: called with the number of completed steps and of all steps.
        keys: settings of the worlds.

    Raises:
        ConfigError: a number is invalid.
        WorkerDeathError: a node and the node that keeps its state were lost at about the same time.
    """
    spec = WorldSpec.of(env, **keys)
    check_count("steps", steps, MAX_STEPS)
    check_nodes(nodes)
    most = max(steps - FIRST_STEPS, 0)
    if not 0 <= kills <= most:
        raise ConfigError(f"kills = {kills}: must be from 0 to {most} with {steps} steps")
    count = 2 * max(nodes) if zones is None else zones
    found = []
    for n, number in enumerate(nodes):

        def note(step: int, done: int = n * steps) -> None:
            if progress is not None:
                progress(done + step, steps * len(nodes))

        pair = ComparedWorlds(spec, number, count, worlds, policy)
        drawn = random.Random(spec.seed)
        struck = drawn.sample(range(FIRST_STEPS, steps), min(kills, number - 1))
        kill = partial(pair.signal_node, drawn, signal.SIGKILL)
        due = partial(_due, dict[int, Callable[[], object]].fromkeys(struck, kill))
        found.append(pair.compare(steps, due, note))
    return NodeReport(spec.env, count, worlds, steps, tuple(found))


def _due(planned: Mapping[int, Callable[[], object]], step: int) -> Callable[[], object] | None:
    return planned.get(step)


class ComparedWorlds:
    """Worlds over nodes, and undivided worlds with the same driver, for comparison."""

    def __init__(
        self,
        spec: WorldSpec,
        nodes: int,
        zones: int,
        worlds: int,
        policy: str | Path,
        route: Route = straight,  # maps an address to the address that nodes call to reach it
    ) -> None:
        self._nodes = nodes
        self._signalled: set[int] = set()  # processes that have received a signal
        whole = make_vec(spec.env, num_envs=worlds, **spec.keywords)
        config, base_dir = load_config(spec.env, zones=zones, **spec.keywords)
        world = make_world(config, base_dir)
        self.worlds = NodeWorlds(world, base_dir, worlds, BackendName(NODES, nodes), route=route)
        try:
            vecs = (whole, CavVectorEnv(self.worlds))
            self._runs = [DrivenRun(vec, policy, spec.seed) for vec in vecs]
        except BaseException:
            self.worlds.close()
            raise

    def compare(
        self,
        steps: int,
        due: Callable[[int], Callable[[], object] | None],  # step → fault during it, or None
        note: Callable[[int], None],  # called with the number of completed steps
        # returns whether to run more than `steps`
        must_continue: Callable[[int], bool] = lambda step: False,
    ) -> NodeRun:
        """Drive and compare the worlds, then close the nodes."""
        different: int | None = None
        calm_ms: list[float] = []
        recovery_ms: list[float] = []
        timers: list[Timer] = []
        drawn = random.Random(steps)
        try:
            step = -1
            while (step := step + 1) < steps or must_continue(step):
                first = self._runs[0].step()
                if inject := due(step):  # at a random time in the next step or soon after it
                    latest_s = 1e-3 * LATEST * statistics.median(calm_ms)
                    timers.append(Timer(drawn.uniform(0.0, latest_s), inject))
                    timers[-1].start()
                before, began = self.worlds.pool.recoveries, time.perf_counter()
                second = self._runs[1].step()
                took_ms = 1e3 * (time.perf_counter() - began)
                one, other = self._hashes()
                if not same_bytes(first, second) or one != other:
                    different = step
                    break
                lost = self.worlds.pool.recoveries > before
                (recovery_ms if lost else calm_ms).append(took_ms)
                note(step + 1)
            for timer in timers:
                timer.join()
            one, other = self._hashes()  # also detects the loss of the node that was killed last
            different = step if different is None and one != other else different
            migrations = self.worlds.migrations
        finally:
            self.worlds.close()
        median_ms = statistics.median(calm_ms) if calm_ms else 0.0
        above_ms = tuple(took_ms - median_ms for took_ms in recovery_ms)
        return NodeRun(
            self._nodes, self.worlds.pool.losses, migrations, different, median_ms, above_ms
        )

    def signal_node(self, drawn: random.Random, number: signal.Signals) -> bool:
        """Send a signal to a random node that has received none. Return whether it was sent."""
        living = [pid for pid in self.worlds.pool.pids if pid not in self._signalled]
        if living:
            pid = drawn.choice(living)
            self._signalled.add(pid)
            with suppress(ProcessLookupError):
                os.kill(pid, number)
                return True
        return False

    def _hashes(self) -> list[list[str]]:
        vecs = [run.vec for run in self._runs]
        return [[vec.state_hash(w) for w in range(vec.num_envs)] for vec in vecs]
