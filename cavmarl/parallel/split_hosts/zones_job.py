"""`ZonesJob`: the job of a host that runs some zones of worlds that a remote caller leads."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.engine.world_setup import World
from cavmarl.parallel.hosts.host_process import RemoteJob, TaskOutcome, serve
from cavmarl.parallel.journaled_worlds import unwatched
from cavmarl.parallel.local_worlds import LocalWorlds
from cavmarl.parallel.recipe import ELSEWHERE, world_of
from cavmarl.parallel.split_hosts.replica_memory import MemoryReplica, ReplicaMemory
from cavmarl.parallel.split_hosts.zone_phases import PhaseInputs, ZonePhase, ZonePhases, ZoneTurn
from cavmarl.parallel.step_arrays import StepArrays, layout_of
from cavmarl.parallel.team.hosted_zones import HostedZones
from cavmarl.parallel.worlds_job import commands_of
from cavmarl.sensors.kernels.rig_frames import Due
from cavmarl.sensors.mounted.sensor_rig import Turn, sense_here

Array = NDArray[Any]


class PhaseOrder(NamedTuple):
    """The payload of a command: a phase on some zones, and how much has changed before it."""

    is_new: bool  # the host is to forget what it has
    words: int  # of changes
    turn: list[Any]  # a `ZoneTurn`, as JSON knows it


def host_zones(recipe: str, place: tuple[str, int], secret: bytes, number: int) -> None:
    """The whole life of a process that hosts zones; see `hosts.host.serve`."""
    serve(partial(ZonesJob, json.loads(recipe)), place, secret, number)


def replicated_arrays(
    world: World, num_worlds: int
) -> tuple[ReplicaMemory, StepArrays, PhaseInputs]:
    """Arrays that lie at the same places wherever they are made; the memory makes the others."""
    memory = ReplicaMemory()
    layout = layout_of(world.config, world.capacity, num_worlds).items()
    arrays = StepArrays.of({name: memory.zeros(shape, kind) for name, (kind, shape) in layout})
    inputs = PhaseInputs.make(memory, commands_of(arrays), arrays.suggested, arrays.frames)
    return memory, arrays, inputs


class ZonesJob(RemoteJob):
    """Some zones of all worlds; which ones, each command says.

    Raises:
        WorkerError: this machine's files are not the caller's.
        CavmarlError: they cannot be read.
    """

    def __init__(self, recipe: dict[str, Any]) -> None:
        world, num_worlds = unwatched(world_of(recipe, ELSEWHERE)), recipe["num_worlds"]
        memory, arrays, self._inputs = replicated_arrays(world, num_worlds)
        self._worlds = LocalWorlds(
            world, num_worlds, arrays, warm=True, in_next_step=recipe["in_next_step"],
            zeros=memory.zeros,
        )  # fmt: skip
        simulation = self._worlds.simulation
        shards = simulation.shards
        self._mounted = simulation.mounted
        self._phases = ZonePhases(shards, memory, self._inputs)
        self._caller = MemoryReplica(memory, self._phases.pieces)
        self._spent_s = np.zeros(len(shards)) if recipe["measures"] else None
        self._hosted = HostedZones(shards, (), self._spent_s)
        self._zones: list[int] = []
        self._coming: Array = np.zeros(0, dtype=np.uint64)
        self._rehearse(np.arange(len(shards)))

    def inputs(self, task: int, letter: Any) -> list[Array]:
        self._coming = np.empty(PhaseOrder(*letter).words, dtype=np.uint64)
        return [self._coming]

    def perform(self, task: int, letter: Any) -> TaskOutcome:
        """Run a phase.

        The answer is how many words of changes come out; where that is asked for, also the
        processor time of each zone, in s.
        """
        order = PhaseOrder(*letter)
        if order.is_new:
            self._phases.clear()
            self._caller.forget()
        turn = ZoneTurn.heard(order.turn)
        if order.is_new or order.turn[1] != self._zones:
            self._zones = turn.zones.tolist()
            self._hosted.take(self._zones)
        self._caller.take(self._coming)
        self._run(turn)
        self._phases.note_results(self._caller, turn)
        stream = self._caller.stream
        return TaskOutcome([stream.size, *self._costs(turn.zones)], [stream])

    def _costs(self, zones: NDArray[np.int64]) -> list[float]:
        """Processor time of each zone since it was asked for last."""
        if self._spent_s is None:
            return []
        costs: list[float] = self._spent_s[zones].tolist()
        self._spent_s[:] = 0.0
        return costs

    def _run(self, turn: ZoneTurn) -> None:
        hosted, inputs = self._hosted, self._inputs
        hosted.face(turn.side, turn.next_side)
        match turn.phase:
            case ZonePhase.MOVE:
                if turn.begins_step:
                    hosted.each("begin_step", inputs.commands)
                hosted.each("move", inputs.commands)
            case ZonePhase.RESOLVE:
                hosted.each("resolve")
            case ZonePhase.SENSE:
                hosted.each("sense", inputs.chosen)
            case ZonePhase.SUGGEST:
                hosted.each("suggest", inputs.suggested)
            case ZonePhase.MOUNTED:
                self._sense(turn.sensors)

    def _sense(self, places: Sequence[int]) -> None:
        """Let the sensors of the rig write the frames of the agents that are here."""
        mounted, inputs = self._mounted, self._inputs
        assert mounted is not None
        scenes = mounted.scenes()
        scenes = [scenes[zone]._replace(before=inputs.before) for zone in self._zones]
        sensors = mounted.rig.sensors
        turns = [
            Turn(k, sensors[k], Due(*inputs.due[k]), inputs.frames[sensors[k].name]) for k in places
        ]
        if self._spent_s is None:
            sense_here(scenes, turns)
            return
        for zone, scene in zip(self._zones, scenes, strict=True):
            began_ns = time.thread_time_ns()
            sense_here([scene], turns)
            self._spent_s[zone] += 1e-9 * (time.thread_time_ns() - began_ns)

    def close(self) -> None:
        self._worlds.close()

    def _rehearse(self, zones: NDArray[np.int64]) -> None:
        """Do all once: the first time takes longer, and is none of a death's business.

        Nothing of it stays, since a caller begins with a new host.
        """
        worlds = self._worlds
        worlds.arrays.chosen[:] = True
        worlds.reset(0, 0)
        worlds.step(self._inputs.commands)
        worlds.suggest()
        worlds.close()  # SUMO, if there is one, is the caller's
        turn = ZoneTurn(ZonePhase.MOVE, zones, 0, 0)
        self._phases.note_inputs(self._caller, turn)
        self._caller.take(self._caller.stream.copy())
        self._phases.note_results(self._caller, turn)
