"""`WorkersConfig`: the monitoring of worker processes and the distribution of work."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from cavmarl.config.checks import Section, Whole, Within

MAX_SENSOR_WORKERS = 256  # per process


@dataclass(frozen=True)
class WorkersConfig(Section, key="workers"):
    """Monitoring of worker processes and distribution of work; docs/guides/divide_a_world.md.

    Attributes:
        timeout_s: time after which a worker that is still busy with one step or reset is replaced.
            A worker that is stopped or sleeps is noticed within a second.
        max_retries: number of retries of a step after a worker dies.
        pin: bind each worker to a core of its own. If false, two workers may run on one core. If
            true, several environments on one machine share the same cores.
        balance_steps: steps between two rounds in which worlds, or zones of a divided world, may
            move to another worker, based on their measured cost; 0: they never move. Results do
            not depend on it.
        imbalance_tolerance: worlds or zones move only if the time of the slowest worker exceeds the
            time with evenly divided work by more than this share.
        max_moves: maximum number of worlds or zones that move in one round.
        monitor_cpu: measure the load of other programs on the workers' cores, and give no more work
            to workers above a threshold of `LoadScore` (docs/explanation/balance.md); if false,
            cores are assumed to be free. Over zone nodes, true also needs `balance_steps`.
        sensors: processes that compute the sensors of `rig`, for each process that runs worlds;
            0: each process computes its own. Results do not depend on it. See
            docs/guides/sensor_workers.md.
        sensor_placement: how sensors are assigned to processes: by recent `cost`, or `in_turn`.
        join_timeout_s: how long to wait for zone nodes to join; see docs/guides/nodes.md.
        key_file: file with the shared key of nodes that are started by hand; relative to the
            environment.
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
