"""The leader's view of the team of one world, and the job of the other members."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.parallel.processes.worker_loop import Job
from cavmarl.parallel.workers.team import Team, TeamLeader, TeamMember
from cavmarl.parallel.workers.worker_worlds import WorkerWorlds
from cavmarl.parallel.worlds.tasks import Task
from cavmarl.shards.phases import Phase
from cavmarl.shards.shard import Commands, Shard

# The phase after which members have finished a task. The leader does the rest of the task
# alone, while one of the members wakes the caller.
LAST = {Task.STEP: Phase.SENSE, Task.SUGGEST: Phase.SUGGEST}
# Tasks that the leader does alone; the pool does not send them to the members.
ALONE = (Task.STATE_HASH, Task.TRAFFIC_STATS, Task.DRIVEN, Task.SIGNAL_PHASES)


class LedTeam:
    """The workers of one world, commanded by the worker that leads them.

    Attributes:
        hosts: (k,) number within the team of the worker that hosts each zone.
    """

    def __init__(
        self,
        kept: WorkerWorlds,  # the single world, whose shards write shared memory
        zones: Sequence[Sequence[int]],  # initial zones of each worker; the leader comes first
        repeated: Sequence[Commands],  # possible commands of steps that a checkpoint log repeats
        # (k,) total processor time of each zone, updated; None: not measured
        spent_s: NDArray[np.float64] | None = None,
    ) -> None:
        self._kept = kept
        self._zones, self._repeated, self._spent_s = zones, repeated, spent_s
        self.hosts = _hosts(zones)
        kept.worlds.simulation.zones.use_team(self._make_leader)

    def _make_leader(self, shards: Sequence[Shard], gathering: tuple[float, float]) -> TeamLeader:
        worlds = self._kept.worlds
        # The leader compares arguments by identity, so each step has to pass one of these objects.
        commands = [(self._kept.commands,), *((commands,) for commands in self._repeated)]
        chosen = [(worlds.simulation.everywhere,)]
        known: dict[Phase, Sequence[tuple[Any, ...]]] = {
            Phase.BEGIN_STEP: commands,
            Phase.MOVE: commands,
            Phase.GATHER: [gathering],
            Phase.SENSE: chosen,
            Phase.CREDIT: chosen,
            Phase.SUGGEST: [(worlds.arrays.suggested,)],
        }
        self._team = Team(shards, self._zones, known, self._spent_s)
        self._leader = TeamLeader(self._team)
        return self._leader

    def members(self) -> Iterator[TeamMemberJob]:
        """Make the jobs of the other workers."""
        for number in range(1, len(self._zones)):
            member = TeamMember(self._team, number)
            yield TeamMemberJob(member, self._kept.first, number, self.hosts.copy())

    def forget(self) -> None:
        """Restart after the processes of the whole team have died."""
        self._team.forget()

    def command(self, task: Task) -> AbstractContextManager[None]:
        """Enclose a task, in which the members wait for phases unless the leader is alone."""
        return nullcontext() if task in ALONE else self._leader.command()

    def end_with(self, task: Task) -> None:
        """Let the members finish as soon as they are not needed for the rest of the task."""
        self._leader.end_after(LAST.get(task))

    def host(self, payload: Any) -> None:
        """Carry out the task HOST, whose payload has the zones of each worker of each world."""
        self.set_hosts(_hosts(payload[self._kept.first]))

    def set_hosts(self, hosts: NDArray[np.int64]) -> None:
        self.hosts[:] = hosts
        self._leader.host(np.flatnonzero(hosts == 0).tolist())


class TeamMemberJob(Job):
    """Runs some zones of a world that another worker leads."""

    def __init__(
        self, member: TeamMember, world: int, number: int, hosts: NDArray[np.int64]
    ) -> None:
        self._member = member
        self._world = world
        self._number = number
        self._hosts = hosts

    def perform(self, task: int, payload: Any) -> None:
        if task == Task.HOST:
            self._set_hosts(_hosts(payload[self._world]))
        else:
            self._member.run_phases()

    def _set_hosts(self, hosts: NDArray[np.int64]) -> None:
        self._hosts[:] = hosts
        self._member.host(np.flatnonzero(hosts == self._number).tolist())

    def save(self) -> list[NDArray[Any]]:
        """Return which worker hosts which zone; the leader keeps the rest of the state."""
        return [self._hosts]

    def load(self, saved: Sequence[NDArray[Any]]) -> None:
        self._set_hosts(saved[0])


def _hosts(zones: Sequence[Sequence[int]]) -> NDArray[np.int64]:
    """Return (k,) the number within the team of the worker that hosts each zone."""
    hosts = np.zeros(sum(map(len, zones)), dtype=np.int64)
    for number, hosted in enumerate(zones):
        hosts[list(hosted)] = number
    return hosts
