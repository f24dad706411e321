"""A campaign of faults with real processes: nodes are killed, and their connections fail."""

from __future__ import annotations

import random
import signal
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Unpack

from cavmarl.config.checks import check_count
from cavmarl.config.world_spec import WorldKeys, WorldSpec
from cavmarl.core.errors import ConfigError, WorkerDeathError
from cavmarl.engine.compilation import compiled_before
from cavmarl.verify.determinism import MAX_STEPS
from cavmarl.verify.fault_campaign import (
    FaultCampaign,
    FaultLine,
    check_kinds,
    check_nodes,
    run_lines,
)
from cavmarl.verify.faulty_network import FaultyNetwork, NetworkFault
from cavmarl.verify.node_losses import FIRST_STEPS, ComparedWorlds

KILL, STOP, ANY = "kill", "stop", "any"
SIGNALS = {KILL: signal.SIGKILL, STOP: signal.SIGSTOP}
FAULTS = (*map(str, NetworkFault), KILL, STOP)
PER_RUN = {NetworkFault.DELAY: 10, KILL: 35, ANY: 5}  # number of faults in a run, by kind
OTHERS = 2  # number of faults in a run, for all other kinds
APART = 4  # steps between two faults that may cost a node, and after the last such fault
WAIT_S = 0.05  # pause between two steps, while a lost node is replaced
REPLACED_S = 60.0  # time for the replacement of a lost node
TIMEOUT_S = 1.0  # time without a frame, after which a node receives a ping


def verify_node_faults(
    env: str | Path | WorldSpec,
    nodes: Sequence[int],
    *,
    faults: Sequence[str] = (*FAULTS, ANY),
    seeds: int = 12,
    first_seed: int = 0,
    zones: int | None = None,
    steps: int = 40,
    per_run: int | None = None,
    policy: str | Path = "idm",
    progress: Callable[[int, int], None] | None = None,
    **keys: Unpack[WorldKeys],
) -> FaultCampaign[FaultLine]:
    """Compare worlds over nodes with undivided worlds, while connections and nodes fail.

    All connections, to the caller and between nodes, go through a network that delays, damages,
    cuts or silences random connections at random times. Processes are killed or stopped.

    Args:
        env: see `make_vec`, also for the other keywords.
        nodes: numbers of nodes.
        faults: kinds of faults; `ANY` draws each fault from all kinds.
        seeds: number of runs for each number of nodes and kind of fault.
        first_seed: seed of the faults of the first run; further runs have the next seeds.
        zones: number of zones of each world; default: twice the largest number of nodes.
        steps: minimum number of steps of each run; a run continues until all its faults have
            happened.
        per_run: number of faults in a run; default: see `PER_RUN`. A run with one node has at most
            one fault that may cost the node.
        policy: as in `load_policy`.
        progress: called with the number of completed runs and of all runs.
        keys: settings of the worlds.

    Raises:
        ConfigError: a number is invalid.
    """
    given = WorldSpec.of(env, **keys)
    check_count("steps", steps, MAX_STEPS)
    check_nodes(nodes)
    check_kinds("faults", faults, (*FAULTS, ANY))
    if steps <= FIRST_STEPS:
        raise ConfigError(f"steps = {steps}: must be at least {FIRST_STEPS + 1}")
    count = 2 * max(nodes) if zones is None else zones
    spec = replace(given, overrides={"workers.timeout_s": TIMEOUT_S, **given.overrides})
    if not compiled_before():
        _let_nodes_compile(given, max(nodes), count, policy)
    lines = [FaultLine(number, fault) for number in nodes for fault in faults]
    run = partial(_run, spec, per_run, count, steps, policy)
    run_lines(lines, range(first_seed, first_seed + seeds), run, progress)
    return FaultCampaign(given.env, count, steps, tuple(lines))


def _let_nodes_compile(spec: WorldSpec, nodes: int, zones: int, policy: str | Path) -> None:
    """Let nodes, and the successor of a killed node, compile their kernels before the campaign.

    Compiling takes longer than `TIMEOUT_S`, so all nodes would count as lost in the campaign.
    """
    pair = ComparedWorlds(spec, nodes, zones, 1, policy)
    drawn = random.Random(0)

    def due(step: int) -> Callable[[], object] | None:
        if nodes == 1 or step != FIRST_STEPS:
            return None
        return partial(pair.signal_node, drawn, signal.SIGKILL)

    pair.compare(2 * FIRST_STEPS, due, lambda step: None)


def _run(
    spec: WorldSpec,
    per_run: int | None,  # number of faults
    zones: int,
    steps: int,
    policy: str | Path,
    line: FaultLine,
    seed: int,
) -> None:
    network = FaultyNetwork(seed)
    num = per_run or PER_RUN.get(line.kind, OTHERS)
    try:
        pair = ComparedWorlds(spec, line.nodes, zones, 1, policy, network.route)
        drawn = random.Random(f"{line.nodes} {line.kind} {seed}")
        planned = _PlannedFaults(line, num, pair, network, drawn)
        try:
            found = pair.compare(steps, planned.due, lambda step: None, planned.are_left)
            if found.different is None:
                line.equal += 1
            else:
                line.wrong.append(f"different after step {found.different}")
                line.wrong_seeds.append(seed)
        except WorkerDeathError:
            line.ended += 1
        line.injected += planned.signalled
        line.deaths += planned.signalled[KILL]
        line.injected += Counter({str(fault): num for fault, num in network.done.items()})
        line.lost += pair.worlds.pool.losses
        line.recoveries += pair.worlds.pool.recoveries
    finally:
        network.close()


class _PlannedFaults:
    """The faults of a run. Each happens while all nodes live, some steps after the last fault."""

    def __init__(
        self,
        line: FaultLine,
        num: int,  # number of faults
        pair: ComparedWorlds,
        network: FaultyNetwork,
        drawn: random.Random,
    ) -> None:
        self._pair, self._network, self._drawn = pair, network, drawn
        self._nodes = line.nodes
        self._is_harmless = line.kind == NetworkFault.DELAY
        num = 1 if line.nodes == 1 and not self._is_harmless else num
        kinds = FAULTS if line.kind == ANY else (line.kind,)
        self._kinds = drawn.choices(kinds, k=num)
        self._next_step = FIRST_STEPS + drawn.randrange(APART)
        self._waits_until_s = 0.0  # latest time for the replacement of a lost node; 0: none is lost
        self.signalled: Counter[str] = Counter()  # number of signals, by kind

    def are_left(self, step: int) -> bool:
        """Return whether the run must continue after `step` steps."""
        return bool(self._kinds) or step < self._next_step

    def due(self, step: int) -> Callable[[], None] | None:
        """Return the fault that happens during a step, or None."""
        if not self._kinds or self._is_replaced_later(step) or step < self._next_step:
            return None
        kind = self._kinds.pop()
        self._next_step = step + (1 if self._is_harmless else APART)
        if kind in SIGNALS:
            return partial(self._signal, kind)
        return partial(self._network.inject, NetworkFault(kind))

    def _is_replaced_later(self, step: int) -> bool:
        """Wait briefly if a lost node is not replaced yet. Return whether to wait longer.

        After the replacement, `APART` steps follow, so that two nodes keep each state again. After
        `REPLACED_S` without a replacement, the faults continue.
        """
        if len(self._pair.worlds.pool.pids) >= self._nodes:
            if self._waits_until_s:
                self._waits_until_s, self._next_step = 0.0, step + APART
            return False
        self._waits_until_s = self._waits_until_s or time.monotonic() + REPLACED_S
        time.sleep(WAIT_S)
        return time.monotonic() < self._waits_until_s

    def _signal(self, kind: str) -> None:
        self.signalled[kind] += self._pair.signal_node(self._drawn, SIGNALS[kind])
