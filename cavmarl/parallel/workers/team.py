"""`Team`: the worker processes of one world, which run the phases of its ticks together.

The first of them leads: it runs the tick as one process would. Each phase that is mostly done zone
by zone it announces to the others, the followers, runs it on its own zones, and goes on when they
have run it on theirs. What is in between, departures, signals and owners, it does alone.

All arrays that shards write are shared (`shared_huge_pages`), and each row has one writer at a
time. A follower keeps nothing from one phase to the next but scratch memory: what a phase needs to
know beside the arrays stands in the leader's line.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from operator import is_
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.parallel.memory.shared_memory import shared_zeros
from cavmarl.parallel.processes.process_barrier import (
    NUMBER,
    WORDS,
    Words,
    post,
    present_core,
    usable_cores,
    wait_for,
)
from cavmarl.parallel.processes.worker_loop import TeamFailedError
from cavmarl.parallel.workers.hosted_zones import HostedZones
from cavmarl.shards.executor import PhaseExecutor
from cavmarl.shards.phases import Phase
from cavmarl.shards.shard import Commands, Shard
from cavmarl.shards.shard_group import ShardGroup

# Words of the leader's line, behind those of `barrier`: what is called with even numbers, and what
# with odd ones.
CALLS = (2, 3)
# A word of a follower's line.
FAILED = 2
CORE = 5  # a word of both: where the process was when it began with a phase

# Phases that all workers run side by side, by their code.
SHARED = tuple(phase for phase in Phase if phase.value.is_shared)
END = len(SHARED)


class Team:
    """The workers of one world and their zones; made before the processes start."""

    def __init__(
        self,
        shards: Sequence[Shard],  # one a zone, in the order of zones; their arrays are shared
        zones: Sequence[Sequence[int]],  # of each worker, to begin with; the first leads
        # the arguments of shared phases: for each phase all that there are to choose from; the
        # arrays among them are shared
        known: Mapping[Phase, Sequence[tuple[Any, ...]]],
        # (k,) where the processor time of each zone is added up; None: not measured
        spent_s: NDArray[np.float64] | None = None,
    ) -> None:
        self.known = {phase: tuple(known.get(phase, ((),))) for phase in SHARED}
        self.everybody = ShardGroup(shards)
        self.hosts = [HostedZones(shards, hosted, spent_s) for hosted in zones]
        lines = shared_zeros((len(zones), WORDS), np.int64)
        self.lines: list[Words] = list(lines)

    def forget(self) -> None:
        """Begin to count anew: the processes that counted are dead."""
        for line in self.lines:
            line[:] = 0


class Leader(PhaseExecutor):
    """Runs each phase on all shards of a world, with the help of the followers; an `Executor`."""

    def __init__(self, team: Team) -> None:
        self._known = team.known
        self._everybody = team.everybody
        self._own = team.hosts[0]
        self._line, *self._others = team.lines
        self._codes = {phase: code for code, phase in enumerate(SHARED)}
        self._leads = False
        self._last: Phase | None = None
        self._is_ahead = False  # a phase is announced and not waited for

    @contextmanager
    def order(self) -> Iterator[None]:
        """The time of a command, in which the followers wait for phases.

        Raises:
            TeamFailedError: one of them has failed.
        """
        self._wait()
        self._leads, self._last, self._is_ahead = True, None, False
        try:
            yield
        finally:
            self._dismiss()

    def end_after(self, phase: Phase | None) -> None:
        """Let the followers end the command when they have run this phase."""
        self._last = phase

    def _dismiss(self) -> None:
        if self._leads:
            self._leads = False
            self._wait()
            self._announce(END)

    def take(self, zones: Sequence[int]) -> None:
        """From now on these zones are its own; the others are the followers'."""
        self._own.take(zones)

    def advance(self, commands: Commands) -> None:
        """Turn the rows, if they are to be put in order, and move them."""
        self._everybody.turn()
        self.run(Phase.MOVE, (commands,))

    def run(self, phase: Phase, arguments: tuple[Any, ...]) -> None:
        """Run a phase on every shard.

        Raises:
            TeamFailedError: a follower has failed.
        """
        rule = phase.value
        which = self._which(phase, arguments)
        if (which < 0 and not rule.is_early) or rule.is_late:
            self.meet()
        if which < 0:
            phase.run(self._everybody, arguments)
            return
        self._announce(self._codes[phase], which)
        self._is_ahead = True
        self._own.run(phase, arguments)
        if rule.is_late:
            return
        self.meet()
        if phase is self._last:
            self._dismiss()

    def meet(self) -> None:
        """Wait until the followers are through with the last phase, whatever it was."""
        if not self._is_ahead:
            return
        self._wait()
        self._is_ahead = False
        for line in self._others:
            if line.item(FAILED):
                raise TeamFailedError

    def _which(self, phase: Phase, arguments: tuple[Any, ...]) -> int:
        """Which of what the followers know a phase is called with; -1: none, or no followers."""
        if self._leads and phase in self._codes:
            for number, known in enumerate(self._known[phase]):
                if all(map(is_, arguments, known)):
                    return number
        return -1

    def _announce(self, code: int, which: int = 0) -> None:
        line = self._line
        number = line.item(NUMBER) + 1
        side, next_side = self._everybody.sides
        line[CALLS[number % 2]] = which << 16 | code << 2 | side << 1 | next_side
        line[CORE] = present_core()
        post(line, number)

    def _wait(self) -> None:
        number, core = self._line.item(NUMBER), self._line.item(CORE)
        for line in self._others:
            wait_for(line, number, line.item(CORE) != core)


class TeamFollower:
    """Runs the phases that the leader announces on its own shards."""

    def __init__(self, team: Team, number: int) -> None:
        self._known = team.known
        self._own = team.hosts[number]
        self._leader = team.lines[0]
        self._line = team.lines[number]
        self._before = team.lines[:number]
        self._cores = usable_cores()

    def follow(self) -> None:
        line, leader = self._line, self._leader
        line[FAILED] = 0
        failure: Exception | None = None
        while True:
            number = line.item(NUMBER) + 1
            wait_for(leader, number, leader.item(CORE) != line.item(CORE))
            call = leader.item(CALLS[number % 2])
            code = call >> 2 & 0xFF
            if code != END:
                try:
                    self._run(SHARED[code], call)
                except Exception as error:
                    failure = error
                    line[FAILED] = 1
            post(line, number)
            if code == END:
                break
        if failure is not None:
            raise failure

    def take(self, zones: Sequence[int]) -> None:
        self._own.take(zones)

    def _get_out_of_the_way(self) -> None:
        """Leave the core of those before in the team: they wait for this one, and it for them.

        Systems put processes that are woken together on one core, and take milliseconds to notice.
        """
        core = present_core()
        taken = {line.item(CORE) for line in self._before}
        if core in taken and self._cores - taken:
            os.sched_setaffinity(0, self._cores - taken)
            core = present_core()
        self._line[CORE] = core

    def _run(self, phase: Phase, call: int) -> None:
        self._get_out_of_the_way()
        self._own.face(call >> 1 & 1, call & 1)
        self._own.run(phase, self._known[phase][call >> 16])
