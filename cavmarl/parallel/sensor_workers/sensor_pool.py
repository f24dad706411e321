"""`SensorWorkers`: a pool of processes that sense for the worlds of this process."""

from __future__ import annotations

import weakref
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.workers import WorkersConfig
from cavmarl.core.compiled import specialized
from cavmarl.core.errors import WorkerError
from cavmarl.parallel.memory.shared_memory import Segment, size_of
from cavmarl.parallel.processes.worker_pool import Death, Pool, Program
from cavmarl.parallel.sensor_workers.line_costs import LineCosts
from cavmarl.parallel.sensor_workers.sensor_job import SensorTask
from cavmarl.parallel.sensor_workers.sensor_scene import NEVER, SceneArrays, SceneShape
from cavmarl.parallel.sensor_workers.sensor_shares import (
    Shares,
    cut,
    divide,
    share_by_cost,
    share_in_turn,
)
from cavmarl.sensors.kernels.rig_frames import NUM_COUNTS
from cavmarl.sensors.kernels.sensor_share import gather_rows
from cavmarl.sensors.mounted.mounted_sensor import SensedScene
from cavmarl.sensors.mounted.sensor_rig import Turn, sense_here

SHARED_ANEW = 32  # ticks between two distributions of the work; initially 1, 2, 4, …
NEW_COST = 0.5  # weight of newly measured costs; the first measurements suffer from cold caches


class SensorWorkerPlan(NamedTuple):
    """The settings for starting sensor workers."""

    module: str  # program of the workers
    message: Mapping[str, Any]  # message for the program, without descriptors of shared memory
    frames: Segment  # memory of the samples, closed together with the workers
    shape: SceneShape
    num_lines: tuple[int, ...]  # (S,) lines into which a frame of each sensor can be divided
    workers: WorkersConfig


@dataclass
class SensorWorkerTimes:
    """Totals over all ticks in which sensors were due."""

    own_s: float = 0.0  # sensing in this process
    wait_s: float = 0.0  # from the command until all frames were written
    busy_s: float = 0.0  # part of `wait_s` in which the busiest worker sensed
    ticks: int = 0
    sent_bytes: int = 0  # size of the scene written for the workers
    got_bytes: int = 0  # size of the frames written by the workers
    messages: int = 0  # commands and answers

    def since(self, before: SensorWorkerTimes) -> SensorWorkerTimes:
        """Return the differences to an earlier copy."""
        return SensorWorkerTimes(
            *(getattr(self, field.name) - getattr(before, field.name) for field in fields(self))
        )


class _Sharing:
    """The shares of a set of sensors, and the measurements since they were made.

    Attributes:
        spent_s: (n, S) processor time of each worker for each sensor since the shares were made.
    """

    def __init__(self, shares: Shares, sensors: int) -> None:
        self.shares = shares
        self.uses = 0  # total number of ticks with these sensors
        self.spent_s = np.zeros((shares.workers, sensors))
        self.agents = 0  # agents, summed over the ticks since the shares were made

    def note(self, spent_s: NDArray[np.float64], agents: int) -> None:
        self.uses += 1
        self.spent_s += spent_s
        self.agents += agents

    @property
    def is_settled(self) -> bool:
        """True if there are enough measurements to keep the shares for long."""
        return self.uses >= SHARED_ANEW

    @property
    def is_over(self) -> bool:
        """True if it is time to evaluate the measurements."""
        often = self.uses % SHARED_ANEW == 0 if self.is_settled else self.uses.bit_count() == 1
        return often and self.agents > 0

    def forget(self) -> None:
        self.spent_s[:] = 0.0
        self.agents = 0


class SensorWorkers:
    """n sensor workers, called as `sensor_rig.Sense`.

    The first call starts the workers, so the object may be made before a fork. A call returns when
    each sensor that is due has delivered the frame of this tick. A dead worker is replaced, and its
    successor senses the same frames.

    Attributes:
        shared: memory shared with the workers, once they have started.
    """

    shared: SceneArrays

    def __init__(self, plan: SensorWorkerPlan) -> None:
        self.times = SensorWorkerTimes()
        self._plan = plan
        self._pool: Pool | None = None
        self._unused = weakref.finalize(self, plan.frames.close)
        self._costs_s = np.zeros(plan.shape.sensors)
        self._line_costs = LineCosts(plan.num_lines)
        self._sharings: dict[tuple[int, ...], _Sharing] = {}
        self._written: Shares | None = None
        self._gather = specialized(gather_rows)

    @property
    def pool(self) -> Pool | None:
        """The worker processes, if they have started."""
        return self._pool

    @property
    def deaths(self) -> list[Death]:
        return [] if self._pool is None else self._pool.deaths

    @property
    def costs_s(self) -> NDArray[np.float64]:
        """(S,) recent processor time of each sensor for one frame of one agent."""
        return self._costs_s.copy()

    def __call__(self, scenes: Sequence[SensedScene], turns: Sequence[Turn]) -> None:
        """Write the samples of all turns; a turn is the work of one sensor in this tick."""
        theirs = [turn for turn in turns if not turn.sensor.stamps_itself]
        if not theirs:
            sense_here(scenes, turns)
            return
        pool = self._started()
        sharing = self._share(tuple(turn.place for turn in theirs))
        self._publish(scenes, theirs)
        published = perf_counter()
        sense_here(scenes, [turn for turn in turns if turn.sensor.stamps_itself])
        sensed = perf_counter()
        pool.run(SensorTask.SENSE, commits=False)
        self.check(theirs)
        ended = perf_counter()
        sharing.note(self.shared.spent_s, int(self.shared.num_agents.sum()))
        self._note(published, sensed, ended, theirs)

    def close(self) -> None:
        self._unused()
        if self._pool is not None:
            self._pool.close()

    def _started(self) -> Pool:
        if self._pool is None:
            self._pool = self._start()
            self._unused.detach()  # the pool closes the memory
        return self._pool

    def _start(self) -> Pool:
        plan = self._plan
        scene = Segment.make(size_of(plan.shape.layout))
        self.shared = SceneArrays.of(scene, plan.shape)
        shared = {"shape": plan.shape, "scene": scene.fd, "frames": plan.frames.fd}
        message = {**plan.message, **shared}
        names = tuple(f"sensor worker {k}" for k in range(plan.shape.workers))
        tasks = tuple(task.name.lower() for task in SensorTask)
        program = Program(
            plan.module, message, names, (scene, plan.frames), tasks, plan.workers.pin
        )
        return Pool(program, plan.workers.timeout_s, plan.workers.max_retries)

    def _publish(self, scenes: Sequence[SensedScene], turns: Sequence[Turn]) -> None:
        """Write the scene: the rows of all zones, without duplicates."""
        shared, worlds = self.shared, scenes[0].worlds
        shared.num_rows[:] = 0
        for scene in scenes:
            self._gather(scene.worlds, True, shared.rows, shared.num_rows)
        shared.num_agents[:] = shared.num_rows
        for scene in scenes:
            self._gather(scene.worlds, False, shared.rows, shared.num_rows)
        shared.ticks[:] = worlds.ticks
        shared.keys[:] = worlds.keys
        shared.signal_phase[:] = worlds.signal_phase
        shared.before[:] = scenes[0].before
        shared.due[:, 0] = 0
        for turn in turns:
            shared.due[turn.place] = turn.due[:NUM_COUNTS]
        shared.delivered[:] = NEVER
        shared.spent_s[:] = 0.0

    def check(self, turns: Sequence[Turn]) -> None:
        """Check that each worker has delivered all frames of this tick.

        Raises:
            WorkerError: a frame is of another tick.
        """
        shared = self.shared
        wrong = (shared.delivered != shared.ticks) & (shared.due[:, 0] > 0)  # (n, S, W)
        if not wrong.any():
            return
        for turn in turns:
            for worker, world in np.argwhere(wrong[:, turn.place]).tolist():
                found = shared.delivered[worker, turn.place, world]
                raise WorkerError(
                    f"rig.{turn.sensor.name}: the frame of tick {shared.ticks[world]} is missing; "
                    f"the worker's newest frame is of tick {found}; use sensor_workers=0"
                )

    def _share(self, sensors: tuple[int, ...]) -> _Sharing:
        """Return the shares of a set of sensors, written for the workers."""
        sharing = self._sharings.get(sensors)
        if sharing is None:
            sharing = _Sharing(self._share_anew(sensors), self._plan.shape.sensors)
            self._sharings[sensors] = sharing
        elif sharing.is_over:
            self._learn(sharing)
            if self._by_cost:
                sharing.shares = self._share_anew(sensors)
        if sharing.shares is not self._written:
            self._written = sharing.shares
            lines = self.shared.lines
            self._written.write(lines.reshape(*lines.shape[:2], -1, 2))
        return sharing

    @property
    def _by_cost(self) -> bool:
        return self._plan.workers.sensor_placement == "cost"

    def _share_anew(self, sensors: tuple[int, ...]) -> Shares:
        plan, shape = self._plan, self._plan.shape
        lines = {sensor: plan.num_lines[sensor] for sensor in sensors}
        units = cut(lines, shape.worlds * shape.agents, shape.workers)
        unknown = not self._costs_s[list(sensors)].all()
        costs = [
            float(unknown or self._costs_s[unit.sensor]) * (unit.last - unit.first)
            for unit in units
        ]
        if not self._by_cost:
            return share_in_turn(units, costs, shape.workers)
        shares = share_by_cost(units, costs, shape.workers)
        return shares if unknown else divide(shares, self._line_costs)

    def _learn(self, sharing: _Sharing) -> None:
        """Update the costs of frames and of their lines by the measurements."""
        costs_s = sharing.spent_s.sum(axis=0) / sharing.agents
        weight = NEW_COST if sharing.is_settled else 1.0
        known = np.where(self._costs_s > 0.0, self._costs_s, costs_s)
        self._costs_s = np.where(costs_s > 0.0, known + weight * (costs_s - known), self._costs_s)
        for sensor, parts in sharing.shares.divided.items():
            spent_s = [float(sharing.spent_s[home, sensor]) for home, _ in parts]
            self._line_costs.learn(sensor, [lines for _, lines in parts], spent_s)
        sharing.forget()

    def _note(self, published: float, sensed: float, ended: float, turns: Sequence[Turn]) -> None:
        """Add the times of a tick; the arguments are values of `time.perf_counter`."""
        times, shared = self.times, self.shared
        times.own_s += sensed - published
        times.wait_s += ended - sensed
        # workers start while this process still senses, so their time may exceed the waiting time
        times.busy_s += min(float(shared.busy_s.max()), ended - sensed)
        times.ticks += 1
        times.sent_bytes += int(shared.num_rows.sum()) * shared.rows.itemsize + sum(
            array.nbytes for array in (shared.before, shared.due, shared.signal_phase)
        )
        for turn in turns:
            frames = turn.frames.data
            one = frames.nbytes // (frames.shape[0] * frames.shape[2])  # a world's frames
            times.got_bytes += int(turn.due.num.sum()) * one
        times.messages += 2 * self._plan.shape.workers
