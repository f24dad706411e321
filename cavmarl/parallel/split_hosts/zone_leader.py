"""`ZoneLeader`: runs the phases of worlds that the caller leads, with hosts for the zones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.parallel.hosts.host_commands import Arrays
from cavmarl.parallel.hosts.host_pool import HostPool
from cavmarl.parallel.split_hosts.replica_memory import MemoryReplica, ReplicaMemory
from cavmarl.parallel.split_hosts.zone_phases import PhaseInputs, ZonePhase, ZonePhases, ZoneTurn
from cavmarl.parallel.split_hosts.zones_job import PhaseOrder
from cavmarl.sensors.mounted.mounted_sensor import SensedScene
from cavmarl.sensors.mounted.sensor_rig import Turn, sense_here
from cavmarl.shards.shard import Commands, Shard
from cavmarl.shards.shard_group import ShardGroup

PHASE = 0  # the one task of hosts

Words = NDArray[np.uint64]


class ZoneLeader:
    """Runs each phase on all shards; `Together` with its hosts.

    What goes from zone to zone it does itself: ownership, ghosts, the gate, the signals. So it
    has all rows at the end of each phase, and a host that is lost costs no more than its phase.
    """

    def __init__(
        self,
        shards: Sequence[Shard],  # one a zone
        memory: ReplicaMemory,  # in which their arrays lie
        inputs: PhaseInputs,  # what phases are called with
        zones: Sequence[Sequence[int]],  # of each host
        # (k,) where the processor time of each zone is added up, if hosts measure it
        spent_s: NDArray[np.float64],
    ) -> None:
        self._everybody = ShardGroup(shards)
        self._phases = ZonePhases(shards, memory, inputs)
        self._inputs = inputs
        self._spent_s = spent_s
        self._replicas = [MemoryReplica(memory, self._phases.pieces) for _ in zones]
        self._room: list[Words] = [np.zeros(0, dtype=np.uint64) for _ in zones]
        self._coming = list(self._room)
        self._begins_step = False
        self._is_open = False  # a command has been given, and not all of its results are here
        self._pool: HostPool | None = None
        self.host(zones)

    def host(self, zones: Sequence[Sequence[int]]) -> None:
        self.zones = [np.array(sorted(own), dtype=np.int64) for own in zones]

    def let_work(self, pool: HostPool) -> None:
        """From now on there are hosts; before, all was done here."""
        self._pool = pool

    def each(self, phase: str, *arguments: Any) -> None:
        """Run a phase on every shard. Raises WorkerError: hosts cannot go on."""
        inputs = self._inputs
        if self._pool is None:
            self._everybody.each(phase, *arguments)
        elif phase == "begin_step":
            self._begins_step = True  # with the move that follows at once
        elif phase == "advance":
            self._everybody.turn()
            self._take(*arguments)
            self._run(ZonePhase.MOVE)
            self._begins_step = False
        elif phase == "resolve":
            self._run(ZonePhase.RESOLVE)
        elif phase == "sense":
            inputs.chosen[:] = arguments[0]
            self._run(ZonePhase.SENSE)
        elif phase == "suggest":
            (out,) = arguments
            inputs.suggested[:] = out
            self._run(ZonePhase.SUGGEST)
            out[:] = inputs.suggested
        else:
            self._everybody.each(phase, *arguments)

    def meet(self) -> None:
        """Nothing to wait for: each phase ends when all hosts have answered."""

    def sense(self, scenes: Sequence[SensedScene], turns: Sequence[Turn]) -> None:
        """Let hosts sense for the rigs of their agents; see `rig.Sense`."""
        inputs = self._inputs
        theirs = [turn for turn in turns if not turn.sensor.stamps_itself]
        if self._pool is None or not theirs:
            sense_here(scenes, turns)
            return
        inputs.before[:] = scenes[0].before
        for turn in theirs:
            for array, due in zip(inputs.due[turn.place], turn.due, strict=True):
                array[:] = due
        self._run(ZonePhase.MOUNTED, tuple(turn.place for turn in theirs))
        sense_here(scenes, [turn for turn in turns if turn.sensor.stamps_itself])

    def _take(self, commands: Commands) -> None:
        known = self._inputs.commands
        for name in ("controls", "meta_actions"):
            given, array = getattr(commands, name), getattr(known, name)
            if given is not array:
                array[:] = given

    def _run(self, phase: ZonePhase, sensors: tuple[int, ...] = ()) -> None:
        assert self._pool is not None
        side, next_side = self._everybody.sides
        was_interrupted, self._is_open = self._is_open, True

        def say(k: int, knows: bool) -> tuple[PhaseOrder, Arrays]:
            replica, zones = self._replicas[k], self.zones[k]
            is_new = not knows or was_interrupted
            if is_new:
                replica.forget()
            turn = ZoneTurn(phase, zones, side, next_side, self._begins_step, sensors)
            self._phases.note_inputs(replica, turn)
            stream = replica.stream
            return PhaseOrder(is_new, stream.size, turn.told()), [stream]

        def outputs(k: int, answer: Any) -> Arrays:
            if answer[0] > self._room[k].size:  # memory that is new has to be had page by page
                self._room[k] = np.empty(2 * answer[0], dtype=np.uint64)
            self._coming[k] = self._room[k][: answer[0]]
            return [self._coming[k]]

        answers = self._pool.tell(PHASE, say, outputs)
        for k, (_, *costs_s) in enumerate(answers):
            self._replicas[k].take(self._coming[k])
            if costs_s:
                self._spent_s[self.zones[k]] += costs_s
        self._is_open = False
