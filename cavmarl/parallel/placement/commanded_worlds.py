"""`CommandedWorlds`: worlds in other processes, which carry out commands."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from cavmarl.balance.balance_plan import Plan
from cavmarl.balance.load_snapshot import LoadSnapshot
from cavmarl.balance.plan_text import describe_plan
from cavmarl.core.errors import ConfigError, WorkerDeathError, WorkerFailureError
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.world_setup import World
from cavmarl.parallel.placement.mover import Mover
from cavmarl.parallel.placement.step_placement import StepPlacement
from cavmarl.parallel.placement.work_shares import Part
from cavmarl.parallel.worlds.step_arrays import Driven, StepArrays
from cavmarl.parallel.worlds.tasks import Task
from cavmarl.parallel.worlds.world_errors import copy_error, network_error, original_error
from cavmarl.shards.shard import Commands
from cavmarl.signals.kernels.green_choices import KEEP
from cavmarl.v2x.v2x_messages import NetworkSimulator

MAX_AGENTS = 500  # limit in one request, since an answer is one message

log = logging.getLogger("cavmarl.workers")


class CommandedPool(Protocol):
    """The processes of the worlds."""

    def close(self) -> None:
        """End the processes, and a cluster that was started for them."""
        ...


class CommandedWorlds(ABC):
    """Base class of `SteppedWorlds` in other processes.

    Attributes:
        world: see `SteppedWorlds`.
        in_next_step: see `SteppedWorlds`.
        arrays: see `SteppedWorlds`.
        placement: which worker or node hosts which shards.
        mover: changes the placement between steps; None: it does not change.
        pool: the processes.
    """

    world: World
    in_next_step: bool
    arrays: StepArrays
    placement: StepPlacement
    mover: Mover | None = None
    pool: CommandedPool
    _steps = 0  # number of steps since the last reset of all worlds

    @property
    def simulation(self) -> Simulation:
        """Not available: the worlds are in other processes."""
        raise ConfigError(
            "the worlds are in worker processes or nodes: use backend='local' for access to the "
            "simulation"
        )

    @property
    def plans(self) -> tuple[Plan, ...]:
        return self.placement.plans

    @property
    def worker_pids(self) -> dict[int, int]:
        """Worker → process id, for workers on this machine."""
        return {worker: pid for worker, pid in self._pids().items() if pid}

    def close(self) -> None:
        self.pool.close()

    @abstractmethod
    def _pids(self) -> Mapping[int, int]:
        """Return worker → process id, for processes that this machine can observe."""

    def _seen(self) -> LoadSnapshot:
        return self.placement.snapshot(self._pids())

    @abstractmethod
    def _settle(self, parts: list[Part]) -> None:
        """Note the new part of each worker."""

    @abstractmethod
    def _send(self, task: Task, payload: Any, commits: bool) -> None:
        """Run a task on all workers or nodes, and write its outputs to `arrays`."""

    @abstractmethod
    def _ask(self, task: Task, world: int, payload: Any) -> Any:
        """Run a task on the worker or node of a world, and return its answer."""

    def __reduce__(self) -> tuple[Any, ...]:
        raise copy_error()

    def reset(self, seed: int | None, first_world: int) -> None:
        self._command(Task.RESET, {"seed": seed, "first_world": first_world})
        if self.arrays.chosen.all():
            self._steps = 0
            log.info("%s", "\n\n".join(map(describe_plan, self.plans)))

    def step(self, commands: Commands) -> None:
        """Let the agents act, and reset worlds whose episode is over, now or a step later.

        If a round of balancing is due, worlds or zones move to other workers first.
        """
        parts = None if self.mover is None else self.mover.before_step(self._command, self._seen)
        if parts is not None:
            self._settle(parts)
        arrays = self.arrays
        if commands.controls is not arrays.controls:  # `CavVectorEnv` decodes into `arrays`
            arrays.controls[:] = commands.controls
            arrays.meta_actions[:] = commands.meta_actions
        arrays.declared[:] = commands.declared if commands.declared.size else 0
        arrays.inserted[:] = commands.inserted if commands.inserted.size else 0
        arrays.external[:] = commands.external if commands.external.size else 0
        arrays.overridden[:] = commands.overridden if commands.overridden.size else 0
        arrays.lane_changes[:] = commands.lane_changes if commands.lane_changes.size else 0
        arrays.signal_choices[:] = commands.signal_choices if commands.signal_choices.size else KEEP
        self._command(Task.STEP)
        self._steps += 1

    def suggest(self) -> None:
        """Write the actions of the built-in driver for all agents."""
        self._command(Task.SUGGEST, commits=False)

    def write_states(self) -> None:
        self._command(Task.WRITE_STATES, commits=False)

    @abstractmethod
    def save_worlds(self) -> list[bytes]:
        """Return the state of each world, for `load_worlds` with any zones and workers."""

    @abstractmethod
    def load_worlds(self, saved: Sequence[bytes]) -> None:
        """Resume from what `save_worlds` returned; `arrays` do not change."""

    def connect_network(self, network: NetworkSimulator) -> None:
        raise network_error()

    def ticks(self) -> NDArray[np.int64]:
        return self.arrays.ticks.copy()

    def state_hash(self, world: int) -> str:
        return str(self._ask_about(Task.STATE_HASH, world))

    def traffic_stats(self, world: int) -> dict[str, float]:
        found: dict[str, float] = self._ask_about(Task.TRAFFIC_STATS, world)
        return found

    def driven(self, world: int, agents: Sequence[int]) -> list[Driven]:
        found = []
        for first in range(0, len(agents), MAX_AGENTS):
            some = list(map(int, agents[first : first + MAX_AGENTS]))
            found += [Driven(*row) for row in self._ask_about(Task.DRIVEN, world, some)]
        return found

    def signal_phases(self, world: int) -> NDArray[np.int32]:
        return np.array(self._ask_about(Task.SIGNAL_PHASES, world), dtype=np.int32)

    def _ask_about(self, task: Task, world: int, more: Any = None) -> Any:
        """Ask about a world; negative numbers count from the end, as for arrays."""
        number = range(len(self.arrays.mask))[world]
        return self._ask(task, number, number if more is None else [number, more])

    def _command(self, task: Task, payload: Any = None, commits: bool = True) -> None:
        """Call `_send`, but raise the errors that worlds of this process would raise."""
        try:
            self._send(task, payload, commits)
        except WorkerFailureError as failure:
            raise original_error(failure) from failure
        except WorkerDeathError as death:
            death.add_note(f"in step {self._steps + 1} since the reset")
            raise
