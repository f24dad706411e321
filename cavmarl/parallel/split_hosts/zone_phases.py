"""`ZonePhases`: what the hosts' phases read and write, each on its zones in its own memory.

A host has the rows of its own zones and their ghosts, and what all zones have in common. Before a
phase it is sent what has changed of that; after it, it sends what has changed of what its zones
write. What a phase writes it has been sent before, so that both ends tell changes from the same.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.numba.specialized import specialized
from cavmarl.core.records.arrays import Common, Outputs, Zoned
from cavmarl.parallel.kernels.replica_copies import mark_agents
from cavmarl.parallel.split_hosts.replica_memory import MemoryReplica, Place, ReplicaMemory
from cavmarl.sensors.kernels.rig_frames import POSE, Due
from cavmarl.sensors.mounted.frames import Frames
from cavmarl.shards.shard import Commands, Shard
from cavmarl.shards.state import Use, arrays_of
from cavmarl.v2x.kernels.v2x_records import Mail

Array = NDArray[Any]


class ZonePhase(IntEnum):
    """What hosts run together."""

    MOVE = 0
    RESOLVE = 1
    SENSE = 2
    SUGGEST = 3
    MOUNTED = 4  # the sensors of the rig


CLEARED = 1 << 16  # words that are made 0 at once


class PhaseInputs(NamedTuple):
    """What phases are called with, at the same place in all processes."""

    commands: Commands  # of the agents
    chosen: NDArray[np.bool_]  # (W,) worlds in which agents sense
    suggested: NDArray[np.float64]  # (W, A, 2) what the built-in driver would do
    before: NDArray[np.void]  # POSE (W, A) of all agents in the tick before
    due: NDArray[np.int64]  # (S, 3, W) of each sensor of the rig, see `Due`
    frames: Frames  # what the rigs sense

    @classmethod
    def make(
        cls,
        memory: ReplicaMemory,
        commands: Commands,
        suggested: NDArray[np.float64],
        frames: Frames,
    ) -> PhaseInputs:
        """With arrays of the memory for the rest."""
        agents = commands.meta_actions.shape
        return cls(
            commands,
            memory.zeros(agents[0], np.bool_),
            suggested,
            memory.zeros(agents, POSE),
            memory.zeros((len(frames), len(Due._fields), agents[0]), np.int64),
            frames,
        )


class ZoneTurn(NamedTuple):
    """One phase on some zones."""

    phase: ZonePhase
    zones: NDArray[np.int64]  # on which, rising
    side: int  # where their rows are
    next_side: int  # where the next ones are
    begins_step: bool = False  # before it moves, the accounts of a step are opened
    sensors: tuple[int, ...] = ()  # of the rig, by number, that are due

    def told(self) -> list[Any]:
        """The same, as JSON knows it."""
        return list(self._replace(zones=self.zones.tolist()))

    @classmethod
    def heard(cls, told: Sequence[Any]) -> ZoneTurn:
        turn = cls(*told)
        return turn._replace(
            phase=ZonePhase(turn.phase),
            zones=np.array(turn.zones, dtype=np.int64),
            sensors=tuple(turn.sensors),
        )


class _Rows(NamedTuple):
    """An array (k, W, C), of which each zone of each world has the first few."""

    place: Place
    strides: NDArray[np.int64]


class _OfAgents(NamedTuple):
    """An array (W, A, …)."""

    place: Place
    size: int  # bytes of each agent


class ZonePhases:
    """What is sent before and after the phases of some worlds.

    Attributes:
        pieces: of a stream there are at most so many that do not lie next to each other.
    """

    def __init__(self, shards: Sequence[Shard], memory: ReplicaMemory, inputs: PhaseInputs) -> None:
        first = shards[0]
        self.inputs = inputs
        self._memory = memory
        self._zoned = zoned = first.zoned
        self._marks = np.zeros(inputs.commands.meta_actions.shape, dtype=np.bool_)
        self._mark_agents = specialized(mark_agents)
        common = [
            *arrays_of(first.worlds, Common, Use.SENT),
            *(array for array in _ways_on_the_way(first) if memory.find(array) is not None),
        ]
        numbers = list(arrays_of(zoned, Zoned, Use.SENT))
        inboxes = [] if first.mail is None else list(arrays_of(first.mail, Mail, Use.SENT))
        acts = inputs.commands.meta_actions if first.discrete else inputs.commands.controls
        reads = {
            ZonePhase.MOVE: [*common, *numbers, acts],
            ZonePhase.RESOLVE: numbers,
            ZonePhase.SENSE: [*common, *numbers, inputs.chosen, *inboxes],
            ZonePhase.SUGGEST: [*common, *numbers],
            ZonePhase.MOUNTED: [*common, *numbers, inputs.before, inputs.due],
        }
        of_agents = {
            ZonePhase.MOVE: [first.worlds.pending],
            ZonePhase.SENSE: [
                array  # with `observation.mode: sensors` some are not seen
                for array in arrays_of(first.outputs, Outputs, Use.SENT)
                if memory.find(array) is not None
            ],
            ZonePhase.SUGGEST: [inputs.suggested],
            ZonePhase.MOUNTED: [frames.data for frames in inputs.frames.values()],
        }
        rows = [*zoned.rows, zoned.outer]
        self._numbers = memory.spans_of(numbers)
        self._reads = {phase: memory.spans_of(arrays) for phase, arrays in reads.items()}
        self._rows = [self._rows_of(array) for array in zoned.rows]
        self._outer = self._rows_of(zoned.outer)
        self._of_agents = {
            phase: [_OfAgents(memory.place_of(array), array.strides[1]) for array in arrays]
            for phase, arrays in of_agents.items()
        }
        everything = [*rows]
        for arrays in (*reads.values(), *of_agents.values()):
            everything += arrays
        self._everything = memory.spans_of(everything)
        agents = self._marks.size * sum(map(len, of_agents.values()))
        self.pieces = len(everything) + 4 * zoned.num_owned.size + agents

    def _rows_of(self, array: Array) -> _Rows:
        strides = np.array(array.strides[:3], dtype=np.int64)
        return _Rows(self._memory.place_of(array), strides)

    def clear(self) -> None:
        """Make all that is ever sent 0: the other end takes this process for a new one."""
        for arena, bounds in self._everything:
            words = self._memory.arenas[arena]
            for begin, end in bounds.tolist():
                last = -(-end // words.itemsize)
                for first in range(begin // words.itemsize, last, CLEARED):
                    some = words[first : min(first + CLEARED, last)]
                    if some.any():  # memory that is never written is never taken
                        some[:] = 0

    def note_inputs(self, replica: MemoryReplica, turn: ZoneTurn) -> None:
        """Note what has changed of what a host reads and writes."""
        zoned, zones, phase = self._zoned, turn.zones, turn.phase
        replica.begin()
        replica.note(self._reads[phase])
        side = turn.next_side if phase == ZonePhase.RESOLVE else turn.side
        replica.note_rows(*self._rows[side], zones, zoned.num_rows)
        if phase == ZonePhase.MOVE:
            replica.note_rows(*self._outer, zones, zoned.num_owned)
            if turn.next_side != side:
                replica.note_rows(*self._rows[turn.next_side], zones, zoned.num_owned)
        self._note_agents(replica, turn)

    def note_results(self, replica: MemoryReplica, turn: ZoneTurn) -> None:
        """Note what has changed of what a host writes; called there."""
        zoned, zones, phase = self._zoned, turn.zones, turn.phase
        replica.begin()
        if phase in (ZonePhase.MOVE, ZonePhase.RESOLVE):
            replica.note(self._numbers)
            replica.note_rows(*self._rows[turn.next_side], zones, zoned.num_owned)
        if phase == ZonePhase.MOVE:
            replica.note_rows(*self._outer, zones, zoned.num_outer)
            if turn.begins_step and turn.next_side != turn.side:
                replica.note_rows(*self._rows[turn.side], zones, zoned.num_owned)
        self._note_agents(replica, turn)

    def _note_agents(self, replica: MemoryReplica, turn: ZoneTurn) -> None:
        """Note what has changed of the agents that the zones own."""
        arrays = self._of_agents.get(turn.phase, [])
        if turn.phase == ZonePhase.MOUNTED:
            arrays = [arrays[place] for place in turn.sensors]
        if not arrays:
            return
        zoned = self._zoned
        self._mark_agents(zoned.rows[turn.side], zoned.num_owned, turn.zones, self._marks)
        for place, size in arrays:
            replica.note_agents(place, size, self._marks)


def _ways_on_the_way(shard: Shard) -> Iterator[Array]:
    """Ways and stops that are written while worlds run."""
    travel = shard.travel
    yield travel.steps[travel.num_fixed :]
    yield travel.stops
