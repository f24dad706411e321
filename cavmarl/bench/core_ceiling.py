"""What the machine itself allows: how much faster programs are side by side that share nothing.

No number of workers can do better than that. It is less than the number of cores where cores share
memory, caches or clocks, and where other programs run.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, ClassVar

from cavmarl.bench.harness import Result, paired_ratio
from cavmarl.bench.worker_speed import WARM_STEPS, drive_ms
from cavmarl.core.errors import ConfigError, WorkerError
from cavmarl.env.vector import make_vec

START_S = 300.0  # that a program may take until its worlds can be stepped


@dataclass(frozen=True)
class CoreCeiling(Result):
    """Programs of their own that step worlds, one at a time and all at once."""

    DERIVED: ClassVar = ("ratio",)

    programs: int  # how many
    # of each turn, ms a step of all worlds, one program after the other
    alone_ms: tuple[float, ...]
    together_ms: tuple[float, ...]  # of each turn, ms a step of the slowest program while all run

    @property
    def ratio(self) -> float:
        """How many times faster all at once are; median of the turns."""
        return paired_ratio(self.alone_ms, self.together_ms)


def measure_ceiling(
    env: str | Path,
    *,
    worlds: int = 16,
    programs: int = 2,
    steps: int = 20,
    repeats: int = 7,
    seed: int = 0,
    wanted: Mapping[str, Any] | None = None,
    alike: bool = False,
) -> CoreCeiling:
    """Let programs step as many worlds as workers would, without any command."""
    if not 1 <= programs <= worlds:
        raise ConfigError(f"{programs} programs, {worlds} worlds: must be at least one world each")
    bounds = [worlds * n // programs for n in range(programs + 1)]
    context = multiprocessing.get_context("spawn")
    wires: list[Connection] = []
    processes = []
    try:
        for first, last in pairwise(bounds):
            ours, theirs = context.Pipe()
            given = (theirs, env, last - first, 0 if alike else first, seed, wanted or {})
            processes.append(context.Process(target=_serve, args=given, daemon=True))
            processes[-1].start()
            theirs.close()
            wires.append(ours)
        for wire in wires:
            _hear(wire)
        alone, together = [], []
        for _ in range(repeats):
            alone.append(sum(_turn([wire], steps)[0] for wire in wires))
            together.append(max(_turn(wires, steps)))
    finally:
        for wire in wires:
            wire.close()
        for process in processes:
            process.join()
    return CoreCeiling(programs, tuple(alone), tuple(together))


def _turn(wires: list[Connection], steps: int) -> list[float]:
    """Milliseconds a step of each program, all at once."""
    for wire in wires:
        wire.send(steps)
    return [_hear(wire) for wire in wires]


def _hear(wire: Connection) -> float:
    """What a program says."""
    try:
        if wire.poll(START_S):
            return float(wire.recv())
    except EOFError as error:
        raise WorkerError(
            "a program that steps worlds by itself has ended; what it printed stands on standard "
            "error"
        ) from error
    raise WorkerError(f"a program that steps worlds by itself said nothing for {START_S:g} s")


def _serve(
    wire: Connection,
    env: str | Path,
    worlds: int,
    first: int,
    seed: int,
    wanted: Mapping[str, Any],
) -> None:
    """One program: as many steps as it is told, until the connection is closed."""
    vec = make_vec(env, num_envs=worlds, copy=False, **wanted)
    vec.reset(seed=seed, options={"first_world": first})
    steps = WARM_STEPS
    while True:
        try:
            wire.send(drive_ms(vec, steps))
            steps = wire.recv()
        except (EOFError, BrokenPipeError, ConnectionResetError):
            return
