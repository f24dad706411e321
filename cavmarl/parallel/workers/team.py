"""`Team`: the worker processes of one world, which run the phases of its ticks together.

The first worker leads: it runs the tick as a single process would. Phases that are mostly
independent for each zone are shared. The leader announces such a phase to the other members, runs
it on its own zones, and continues when the members have run it on their zones. Between the phases,
the leader handles departures, signals and ownership alone.

All arrays that shards write are shared memory (`shared_huge_pages`), and each row has one writer at
a time. Between phases, a member keeps scratch memory only. A phase depends only on the arrays and
on the leader's line of words.
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

# Words of the leader's line, after the words of `process_barrier`. The first word announces calls
# with even numbers, the second word announces calls with odd numbers.
CALLS = (2, 3)
# A word of a member's line.
FAILED = 2
CORE = 5  # a word of both lines: the core on which the process was when it began a phase

# Phases that all members run in parallel, by their code.
SHARED = tuple(phase for phase in Phase if phase.value.is_shared)
END = len(SHARED)


class Team:
    """The workers of one world and their zones; made before the processes are forked."""

    def __init__(
        self,
        shards: Sequence[Shard],  # one per zone, in the order of zones; their arrays are shared
        zones: Sequence[Sequence[int]],  # initial zones of each worker; the first worker leads
        # all tuples of arguments that each shared phase may receive; their arrays are shared
        known: Mapping[Phase, Sequence[tuple[Any, ...]]],
        # (k,) total processor time of each zone, updated; None: not measured
        spent_s: NDArray[np.float64] | None = None,
    ) -> None:
        self.known = {phase: tuple(known.get(phase, ((),))) for phase in SHARED}
        self.all_zones = ShardGroup(shards)
        self.hosts = [HostedZones(shards, hosted, spent_s) for hosted in zones]
        lines = shared_zeros((len(zones), WORDS), np.int64)
        self.lines: list[Words] = list(lines)

    def forget(self) -> None:
        """Reset the lines after the processes that wrote them have died."""
        for line in self.lines:
            line[:] = 0


class TeamLeader(PhaseExecutor):
    """Runs each phase on all shards of a world, with the help of the other members."""

    def __init__(self, team: Team) -> None:
        self._known = team.known
        self._all_zones = team.all_zones
        self._own = team.hosts[0]
        self._line, *self._others = team.lines
        self._codes = {phase: code for code, phase in enumerate(SHARED)}
        self._leads = False
        self._last: Phase | None = None
        self._is_ahead = False  # whether a phase is announced and not awaited yet

    @contextmanager
    def command(self) -> Iterator[None]:
        """Enclose a command, in which the members wait for phases.

        Raises:
            TeamFailedError: a member has failed.
        """
        self._wait()
        self._leads, self._last, self._is_ahead = True, None, False
        try:
            yield
        finally:
            self._dismiss()

    def end_after(self, phase: Phase | None) -> None:
        """Let the members end the command as soon as they have run this phase."""
        self._last = phase

    def _dismiss(self) -> None:
        if self._leads:
            self._leads = False
            self._wait()
            self._announce(END)

    def host(self, zones: Sequence[int]) -> None:
        """Host these zones from now on; the other members host the rest."""
        self._own.host(zones)

    def advance(self, commands: Commands) -> None:
        """Sort the rows if that is due, and move the vehicles."""
        self._all_zones.turn()
        self.run(Phase.MOVE, (commands,))

    def run(self, phase: Phase, arguments: tuple[Any, ...]) -> None:
        """Run a phase on every shard.

        Raises:
            TeamFailedError: a member has failed.
        """
        rule = phase.value
        which = self._which(phase, arguments)
        if (which < 0 and not rule.is_early) or rule.is_late:
            self.finish_phase()
        if which < 0:
            phase.run(self._all_zones, arguments)
            return
        self._announce(self._codes[phase], which)
        self._is_ahead = True
        self._own.run(phase, arguments)
        if rule.is_late:
            return
        self.finish_phase()
        if phase is self._last:
            self._dismiss()

    def finish_phase(self) -> None:
        """Wait until the members have run the phase that was announced last, if any."""
        if not self._is_ahead:
            return
        self._wait()
        self._is_ahead = False
        for line in self._others:
            if line.item(FAILED):
                raise TeamFailedError

    def _which(self, phase: Phase, arguments: tuple[Any, ...]) -> int:
        """Return the index of the arguments in the list that members know.

        -1: the members do not know the arguments, or do not wait for a phase.
        """
        if self._leads and phase in self._codes:
            for number, known in enumerate(self._known[phase]):
                if all(map(is_, arguments, known)):
                    return number
        return -1

    def _announce(self, code: int, which: int = 0) -> None:
        line = self._line
        number = line.item(NUMBER) + 1
        side, next_side = self._all_zones.sides
        line[CALLS[number % 2]] = which << 16 | code << 2 | side << 1 | next_side
        line[CORE] = present_core()
        post(line, number)

    def _wait(self) -> None:
        number, core = self._line.item(NUMBER), self._line.item(CORE)
        for line in self._others:
            wait_for(line, number, line.item(CORE) != core)


class TeamMember:
    """A worker that runs the phases announced by the leader on its own shards."""

    def __init__(self, team: Team, number: int) -> None:
        self._known = team.known
        self._own = team.hosts[number]
        self._leader = team.lines[0]
        self._line = team.lines[number]
        self._before = team.lines[:number]
        self._cores = usable_cores()

    def run_phases(self) -> None:
        """Run the phases that the leader announces, until the leader ends the command."""
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

    def host(self, zones: Sequence[int]) -> None:
        self._own.host(zones)

    def _leave_shared_core(self) -> None:
        """Move to another core if a member with a lower number uses the same core.

        Otherwise, one of the two members would wait for the other. Operating systems put processes
        that wake together on one core, and take milliseconds to separate them.
        """
        core = present_core()
        taken = {line.item(CORE) for line in self._before}
        if core in taken and self._cores - taken:
            os.sched_setaffinity(0, self._cores - taken)
            core = present_core()
        self._line[CORE] = core

    def _run(self, phase: Phase, call: int) -> None:
        self._leave_shared_core()
        self._own.set_sides(call >> 1 & 1, call & 1)
        self._own.run(phase, self._known[phase][call >> 16])
