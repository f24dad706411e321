"""What the workers of one world do: `LeaderJob` runs it, `FollowerJob` helps."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.parallel.processes.worker_loop import Job
from cavmarl.parallel.state.checkpoint_log import CheckpointLog
from cavmarl.parallel.workers.checkpoint_job import CheckpointJob
from cavmarl.parallel.workers.team import Leader, Team, TeamFollower
from cavmarl.parallel.workers.worlds_job import WorldsJob
from cavmarl.parallel.worlds.local_worlds import LocalWorlds
from cavmarl.parallel.worlds.tasks import Task
from cavmarl.shards.phases import Phase
from cavmarl.shards.shard import Shard

# Phases that end a task for the followers; what comes after them the leader does alone, and one of
# the followers wakes the caller in the meantime.
LAST = {Task.STEP: Phase.SENSE, Task.SUGGEST: Phase.SUGGEST}
# Tasks of the leader, of which no follower hears.
ALONE = (Task.STATE_HASH, Task.TRAFFIC_STATS, Task.DRIVEN, Task.SIGNAL_PHASES)


class LeaderJob(CheckpointJob):
    """One world that several workers run, of which this one leads."""

    def __init__(
        self,
        worlds: LocalWorlds,  # the one; what its shards write is shared
        first: int,  # its number among all
        zones: Sequence[Sequence[int]],  # that each worker hosts, to begin with; the leader's first
        checkpoint_log: CheckpointLog,  # the checkpoint log in which it leaves the state behind
        # (k,) where the processor time of each zone is added up; None: not measured
        spent_s: NDArray[np.float64] | None = None,
    ) -> None:
        super().__init__(worlds, first, checkpoint_log)
        self._zones = zones
        self._hosts = _hosts(zones)
        self._spent_s = spent_s
        worlds.simulation.zones.use_team(self._lead)

    def _lead(self, shards: Sequence[Shard], gathering: tuple[float, float]) -> Leader:
        commands = [(self._commands,), *((entry,) for entry in self._log.entries)]
        chosen = [(self._worlds.simulation.everywhere,)]
        known: dict[Phase, Sequence[tuple[Any, ...]]] = {
            Phase.BEGIN_STEP: commands,
            Phase.MOVE: commands,
            Phase.GATHER: [gathering],
            Phase.SENSE: chosen,
            Phase.CREDIT: chosen,
            Phase.SUGGEST: [(self._worlds.arrays.suggested,)],
        }
        self._team = Team(shards, self._zones, known, self._spent_s)
        self._leader = Leader(self._team)
        return self._leader

    def followers(self) -> Iterator[FollowerJob]:
        for number in range(1, len(self._zones)):
            follower = TeamFollower(self._team, number)
            yield FollowerJob(follower, self._first, number, self._hosts.copy())

    def prepare(self) -> None:
        """The former leader is dead, and so are its followers."""
        self._team.forget()

    def perform(self, task: int, payload: Any) -> Any:
        if task in ALONE:
            return super().perform(task, payload)
        if task == Task.HOST:
            self._host(_hosts(payload[self._first]))
            return None
        with self._leader.order():
            self._catch_up(task)
            if task == Task.STEP:
                self._note_step()
            self._leader.end_after(LAST.get(Task(task)))
            WorldsJob.perform(self, task, payload)
        if task in (Task.RESET, Task.LOAD):
            self._begin_anew()
        return None

    def _host(self, hosts: NDArray[np.int64]) -> None:
        self._hosts[:] = hosts
        self._leader.take(np.flatnonzero(hosts == 0).tolist())

    def save(self) -> list[NDArray[Any]]:
        """Where to begin in the checkpoint log, and which worker hosts which zone."""
        return [*super().save(), self._hosts]

    def load(self, saved: Sequence[NDArray[Any]]) -> None:
        """Go on from what `save` gave; the steps since the last image wait for a task."""
        place, hosts = saved
        self._host(hosts)
        super().load([place])


class FollowerJob(Job):
    """Some zones of one world, of which other workers have the rest."""

    def __init__(
        self, follower: TeamFollower, world: int, number: int, hosts: NDArray[np.int64]
    ) -> None:
        self._follower = follower
        self._world = world
        self._number = number
        self._hosts = hosts

    def perform(self, task: int, payload: Any) -> None:
        if task == Task.HOST:
            self._host(_hosts(payload[self._world]))
        else:
            self._follower.follow()

    def _host(self, hosts: NDArray[np.int64]) -> None:
        self._hosts[:] = hosts
        self._follower.take(np.flatnonzero(hosts == self._number).tolist())

    def save(self) -> list[NDArray[Any]]:
        """Which worker hosts which zone; the leader keeps the rest of the state."""
        return [self._hosts]

    def load(self, saved: Sequence[NDArray[Any]]) -> None:
        self._host(saved[0])


def _hosts(zones: Sequence[Sequence[int]]) -> NDArray[np.int64]:
    """(k,) number in the team of each zone's worker."""
    hosts = np.zeros(sum(map(len, zones)), dtype=np.int64)
    for number, hosted in enumerate(zones):
        hosts[list(hosted)] = number
    return hosts
