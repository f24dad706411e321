"""`WorkersConfig`: how worker processes are watched and given work."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from cavmarl.config.checks import Section, Whole, Within

MAX_SENSOR_WORKERS = 256  # of one process


@dataclass(frozen=True)
class WorkersConfig(Section, key="workers"):
    """How worker processes are watched and given work; see docs/guides/divide_a_world.md.

    Attributes:
        timeout_s: for so long a worker may be busy with one step or reset; then it is taken to hang
            and replaced. One that is stopped or sleeps is noticed within a second.
        max_retries: how often a step is begun again because a worker has died.
        pin: keep each worker on a core of its own. The system sometimes leaves two on one; but of
            several environments with workers on one machine all take the same cores.
        balance_steps: so many steps from one round to the next, in which worlds, or zones of a
            split world, may change their worker by what they have cost; 0: they stay where they
            are. Results do not depend on it.
        imbalance_tolerance: while the slowest worker takes at most this share longer than a
            perfect division
            would, nothing moves.
        max_moves: worlds or zones that change their worker in one round.
        monitor_cpu: see how busy others keep the workers' cores, and give nothing more to
            workers above a threshold; without it the cores are taken to be free. Zone nodes watch
            their machines for `balance_steps`.
        sensors: processes that the sensors of `rig` are shared out over, for each process that
            keeps the state of worlds; 0: it senses itself. Results do not depend on it. See
            docs/guides/sensor_workers.md.
        sensor_placement: which of them senses what: by what it `cost` of late, or `in_turn`.
        join_timeout_s: for so long is waited for zone nodes to join; see docs/guides/nodes.md.
        key_file: with the key that nodes started by hand have to know; relative to the environment.
    """

    timeout_s: Annotated[float, Within(1.0, 1e6)] = 300.0
    max_retries: Annotated[int, Whole(0, 1000)] = 3
    pin: bool = False
    balance_steps: Annotated[int, Whole(0, 1_000_000)] = 0
    imbalance_tolerance: Annotated[float, Within(0.0, 100.0)] = 0.1
    max_moves: Annotated[int, Whole(1, 65_536)] = 4
    monitor_cpu: bool = False
    sensors: Annotated[int, Whole(0, MAX_SENSOR_WORKERS)] = 0
    sensor_placement: Literal["cost", "in_turn"] = "cost"
    join_timeout_s: Annotated[float, Within(1.0, 1e6)] = 300.0
    key_file: str = ""
