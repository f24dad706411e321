"""A campaign of faults between nodes: worlds go through all of them bit for bit."""

from __future__ import annotations

import random
import signal
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Unpack

from cavmarl.config.checks import check_count
from cavmarl.config.world_spec import WorldKeys, WorldSpec
from cavmarl.core.errors import ConfigError, WorkerDeathError
from cavmarl.verify.determinism import MAX_STEPS
from cavmarl.verify.faulty_network import FaultyNetwork, NetworkFault
from cavmarl.verify.node_losses import FIRST_STEPS, ComparedWorlds

KILL, STOP, ANY = "kill", "stop", "any of these"
SIGNALS = {KILL: signal.SIGKILL, STOP: signal.SIGSTOP}
FAULTS = (*map(str, NetworkFault), KILL, STOP)
HARMLESS = 10  # faults of a run that end no connection
GRAVE = 2  # faults of a run that a node may be lost of; at most all nodes but one, or the only one
APART = 8  # steps between two of those
TIMEOUT_S = 1.0  # of silence, until a node is asked whether it lives


@dataclass
class FaultLine:
    """Runs with one kind of fault."""

    nodes: int  # how many there were at the beginning
    fault: str  # the kind
    runs: int = 0  # how many there were
    done: int = 0  # faults in all of them
    lost: int = 0  # nodes
    ended: int = 0  # runs that ended with `WorkerDeathError`: what a node had was kept nowhere
    different: list[int] = field(default_factory=list)  # seeds of runs in which anything differed


@dataclass(frozen=True)
class NodeCampaign:
    """What was found."""

    env: str  # of which environment
    zones: int  # of each world
    steps: int  # of each run
    lines: tuple[FaultLine, ...]  # one for each number of nodes and kind of fault

    @property
    def holds(self) -> bool:
        return not any(line.different for line in self.lines)

    def to_dict(self) -> dict[str, Any]:
        return {**asdict(self), "holds": self.holds}


def verify_node_faults(
    env: str | Path | WorldSpec,
    nodes: Sequence[int],
    *,
    faults: Sequence[str] = (*FAULTS, ANY),
    seeds: int = 12,
    zones: int | None = None,
    steps: int = 40,
    policy: str | Path = "idm",
    progress: Callable[[int, int], None] | None = None,
    **keys: Unpack[WorldKeys],
) -> NodeCampaign:
    """Drive worlds over nodes beside undivided ones while connections and nodes fail.

    All connections, to the caller and between nodes, go through a network that delays, damages,
    cuts or silences one of them at random times; processes are killed or stopped.

    Args:
        env: as in `make_vec`, like the other keywords.
        nodes: numbers of them.
        faults: kinds of them; `ANY` draws among all.
        seeds: runs for each number of nodes and kind of fault.
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
    if unknown := [fault for fault in faults if fault not in (*FAULTS, ANY)]:
        raise ConfigError(f"faults = {unknown}: must be among {', '.join((*FAULTS, ANY))}")
    if steps < FIRST_STEPS + APART * GRAVE:
        raise ConfigError(f"steps = {steps}: a run needs {FIRST_STEPS + APART * GRAVE} or more")
    count = 2 * max(nodes) if zones is None else zones
    lines = [FaultLine(number, fault) for number in nodes for fault in faults]
    for n, line in enumerate(lines):
        for k in range(seeds):
            overrides = {"workers.timeout_s": TIMEOUT_S, **given.overrides}
            spec = replace(given, seed=given.seed + k, overrides=overrides)
            _run(spec, line, count, steps, policy)
            if progress is not None:
                progress(n * seeds + k + 1, len(lines) * seeds)
    return NodeCampaign(given.env, count, steps, tuple(lines))


def _run(spec: WorldSpec, line: FaultLine, zones: int, steps: int, policy: str | Path) -> None:
    network, drawn = FaultyNetwork(spec.seed), random.Random(spec.seed)
    line.runs += 1
    try:
        planned = list(_planned(line, steps, drawn))
        pair = ComparedWorlds(spec, line.nodes, zones, 1, policy, network.route)
        strikes: dict[int, Callable[[], None]] = {}
        for step, fault in planned:
            line.done += 1
            if fault in SIGNALS:
                strikes[step] = partial(pair.strike, drawn, SIGNALS[fault])
            else:
                strikes[step] = partial(network.strike, NetworkFault(fault))
        try:
            found = pair.compare(steps, strikes, lambda step: None)
            if found.different is not None:
                line.different.append(spec.seed)
        except WorkerDeathError:
            line.ended += 1
        line.lost += pair.worlds.pool.losses
    finally:
        network.close()


def _planned(line: FaultLine, steps: int, drawn: random.Random) -> Iterator[tuple[int, str]]:
    """The faults of a run, by the step in which each happens."""
    fault = line.fault
    if fault == NetworkFault.DELAY:
        yield from ((step, fault) for step in drawn.sample(range(FIRST_STEPS, steps), HARMLESS))
        return
    first = drawn.randrange(FIRST_STEPS, steps - APART * (GRAVE - 1))
    for n in range(min(GRAVE, max(1, line.nodes - 1))):
        yield first + APART * n, drawn.choice(FAULTS) if fault == ANY else fault
