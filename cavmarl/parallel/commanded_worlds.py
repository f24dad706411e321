"""`OrderedWorlds`: worlds that live elsewhere, and do what they are told."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

import cavmarl.core.errors
from cavmarl.balance.balance_plan import Plan
from cavmarl.balance.load_snapshot import LoadSnapshot
from cavmarl.balance.plan_text import describe_plan
from cavmarl.config.v2x import V2xConfig
from cavmarl.core.errors import CavmarlError, ConfigError, WorkerDeathError, WorkerFailureError
from cavmarl.parallel.hosts.host_pool import HostPool
from cavmarl.parallel.mover import Mover
from cavmarl.parallel.processes.worker_pool import Death, Pool
from cavmarl.parallel.step_arrays import Driven, StepArrays
from cavmarl.parallel.step_placement import StepPlacement
from cavmarl.parallel.work_shares import Part
from cavmarl.parallel.worlds_job import Task
from cavmarl.shards.shard import Commands
from cavmarl.v2x.v2x_messages import NetworkSimulator

ASKED_AT_ONCE = 500  # agents: an answer is one message

log = logging.getLogger("cavmarl.workers")


class OrderedWorlds(ABC):
    """What is the same wherever the worlds live; see `step_arrays.SteppedWorlds`."""

    arrays: StepArrays  # what goes in and comes out
    placement: StepPlacement  # which worker hosts what
    pool: Pool | HostPool  # that runs them
    mover: Mover | None = None  # has that changed; None: it does not change
    _steps = 0  # since the last reset of all

    @property
    def plans(self) -> tuple[Plan, ...]:
        return self.placement.plans

    @property
    def worker_pids(self) -> dict[int, int]:
        """Process of each worker on this machine."""
        return {worker: pid for worker, pid in self._pids().items() if pid}

    @property
    def deaths(self) -> list[Death]:
        return self.pool.deaths

    def close(self) -> None:
        """End the processes, and a cluster that was started for them."""
        self.pool.close()

    @abstractmethod
    def _pids(self) -> Mapping[int, int]:
        """Of the workers' processes, as far as this machine can look at them."""

    def _seen(self) -> LoadSnapshot:
        return self.placement.snapshot(self._pids())

    @abstractmethod
    def _settle(self, parts: list[Part]) -> None:
        """Note which worker runs what from now on."""

    @abstractmethod
    def _send(self, task: Task, payload: Any, commits: bool) -> None:
        """Let all workers do a task."""

    @abstractmethod
    def _ask(
        self,
        task: Task,
        world: int,  # its number; numbers from the end count as they do for arrays
        more: Any = None,  # than the world that the worker has to know
    ) -> Any:
        """Let the worker of a world answer."""

    def __reduce__(self) -> tuple[Any, ...]:
        raise uncopied()

    def reset(self, seed: int | None, first_world: int) -> None:
        self._order(Task.RESET, {"seed": seed, "first_world": first_world})
        if self.arrays.chosen.all():
            self._steps = 0
            log.info("%s", "\n\n".join(map(describe_plan, self.plans)))

    def step(self, commands: Commands) -> None:
        """Let the agents act, and reset the worlds whose episode is over, now or a step later.

        Before that worlds or zones change their worker, if it is time.
        """
        parts = None if self.mover is None else self.mover.before_step(self._order, self._seen)
        if parts is not None:
            self._settle(parts)
        arrays = self.arrays
        if commands.controls is not arrays.controls:  # where `CavVectorEnv` decodes them
            arrays.controls[:] = commands.controls
            arrays.meta_actions[:] = commands.meta_actions
        arrays.declared[:] = commands.declared if commands.declared.size else 0
        arrays.inserted[:] = commands.inserted if commands.inserted.size else 0
        self._order(Task.STEP)
        self._steps += 1

    def suggest(self) -> None:
        """Write what the built-in driver would do in the agents' place."""
        self._order(Task.SUGGEST, commits=False)

    def write_states(self) -> None:
        self._order(Task.WRITE_STATES, commits=False)

    def save_worlds(self) -> list[bytes]:
        raise unsaved()

    def load_worlds(self, saved: Sequence[bytes]) -> None:
        raise unsaved()

    def connect_network(self, network: NetworkSimulator) -> None:
        raise unconnected()

    def ticks(self) -> NDArray[np.int64]:
        return self.arrays.ticks.copy()

    def state_hash(self, world: int) -> str:
        return str(self._ask(Task.STATE_HASH, world))

    def traffic_stats(self, world: int) -> dict[str, float]:
        found: dict[str, float] = self._ask(Task.TRAFFIC_STATS, world)
        return found

    def driven(self, world: int, agents: Sequence[int]) -> list[Driven]:
        found = []
        for first in range(0, len(agents), ASKED_AT_ONCE):
            some = list(agents[first : first + ASKED_AT_ONCE])
            found += [Driven(*row) for row in self._ask(Task.DRIVEN, world, some)]
        return found

    def signal_phases(self, world: int) -> NDArray[np.int32]:
        return np.array(self._ask(Task.SIGNAL_PHASES, world), dtype=np.int32)

    def _order(self, task: Task, payload: Any = None, commits: bool = True) -> None:
        """`_send`, with the errors that the worlds would raise in this process."""
        try:
            self._send(task, payload, commits)
        except WorkerFailureError as failure:
            raise own_error(failure) from failure
        except WorkerDeathError as death:
            death.add_note(f"in step {self._steps + 1} since the reset")
            raise


def uncopied() -> ConfigError:
    """What a copy or a pickle of worlds in other processes ends in."""
    return ConfigError(
        "workers: worlds that worker processes run cannot be copied; use backend='local', "
        "or make the environment once more, with the same seed"
    )


def unsaved() -> ConfigError:
    """What saving worlds on other machines ends in."""
    return ConfigError(
        "hosts: worlds on the machines of a cluster are not saved; use workers of this machine"
    )


def refuse_external(v2x: V2xConfig) -> None:
    """Refuse what asks a part of the caller's process in each tick."""
    if v2x.enabled and v2x.channel.external:
        raise unconnected()


def unconnected() -> ConfigError:
    """What connecting a network simulator to worlds in workers ends in."""
    return ConfigError(
        "v2x.channel.external: a network simulator is in the caller's process, and worlds over "
        "workers do not ask it; use backend='local', or nodes"
    )


def own_error(failure: WorkerFailureError) -> CavmarlError:
    """An error that the worlds raise on purpose, as they would raise it in this process."""
    kind = getattr(cavmarl.core.errors, failure.kind, None)
    if not isinstance(kind, type) or not issubclass(kind, CavmarlError):
        return failure
    takes_text = "__init__" not in vars(kind)
    return kind(failure.text) if takes_text else failure
