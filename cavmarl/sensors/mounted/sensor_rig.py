"""`Rig`: all mounted sensors of W worlds, and their schedule."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.rig import MountedConfig, SampledConfig, cadence
from cavmarl.core.compiled import specialized
from cavmarl.sensors.kernels.rig_frames import (
    NUM_COUNTS,
    POSE,
    Due,
    SensorSchedule,
    call_due,
    call_roll,
    deliver,
    note_poses,
)
from cavmarl.sensors.mounted.frames import Frames, SensorFrames
from cavmarl.sensors.mounted.mounted_sensor import MountedSensor, Platform, SensedScene, stream_of
from cavmarl.sensors.registry import mount


class Turn(NamedTuple):
    """The work of one sensor in the current tick."""

    place: int  # position in the rig
    sensor: MountedSensor[Any]  # the sensor
    due: Due  # number of samples, and their slots
    frames: SensorFrames  # where the samples are written


Sense: TypeAlias = Callable[[Sequence[SensedScene], Sequence[Turn]], None]
"""Writes the samples of the given sensors, as `MountedSensor.sense` does, before it returns."""


def sense_here(scenes: Sequence[SensedScene], turns: Sequence[Turn]) -> None:
    """Run the sensors one after another in this process."""
    for turn in turns:
        turn.sensor.sense(scenes, turn.due, turn.frames)


class Rig:
    """The sensors of all agents of W worlds.

    `settings`: settings of the sensors, by name. `frames`: destination of the samples. `ids`: (W,
    A) int64, the vehicle of each agent's samples; kept from tick to tick.

    Attributes:
        sense: function that writes the due samples.
    """

    def __init__(
        self,
        settings: Mapping[str, MountedConfig],
        platform: Platform,
        frames: Frames,
        ids: NDArray[np.int64],
    ) -> None:
        self._platform = platform
        self._ids = ids
        self._now = ids.copy()
        self._before = np.zeros(ids.shape, dtype=POSE)
        self._mounted = [
            _Mounted(place, sensor, frames[sensor.name], platform)
            for place, sensor in enumerate(mount(settings, platform))
        ]
        self.sense: Sense = sense_here
        self._is_new = True
        self._everywhere = np.ones(len(ids), dtype=np.bool_)
        self._call_roll = specialized(call_roll)
        self._note_poses = specialized(note_poses)

    @property
    def sensors(self) -> list[MountedSensor[Any]]:
        """All sensors, in the order of the rig."""
        return [mounted.turn.sensor for mounted in self._mounted]

    @property
    def before(self) -> NDArray[np.void]:
        """POSE (W, A) at the previous tick."""
        return self._before

    def begin(self, scenes: Sequence[SensedScene]) -> None:
        """Store the poses of all agents before the tick."""
        self._before["id"] = -1
        for scene in scenes:
            self._note_poses(scene.worlds, self._before)

    def reset(self, scenes: Sequence[SensedScene], chosen: NDArray[np.bool_]) -> None:
        """Clear the chosen worlds (W,) and take the samples due at the reset."""
        if self._is_new:  # load the kernels now, not in the first tick that needs them
            self._is_new = False
            for mounted in self._mounted:
                mounted.rehearse(scenes)
        self._before["id"][chosen] = -1
        for mounted in self._mounted:
            mounted.clear(chosen)
        self._ids[chosen] = -1
        self._take(scenes, chosen)

    def end(self, scenes: Sequence[SensedScene]) -> None:
        """Take the samples due in the current tick."""
        ticks = scenes[0].worlds.ticks
        begins = (ticks - 1) % self._platform.ticks_per_step == 0
        if begins.any():
            for mounted in self._mounted:
                mounted.frames.fresh[begins] = 0
        self._take(scenes, self._everywhere)

    def _take(self, scenes: Sequence[SensedScene], chosen: NDArray[np.bool_]) -> None:
        self._now[:] = -1
        for scene in scenes:
            self._call_roll(scene.worlds, self._now)
        changed = self._now != self._ids
        if changed.any():
            self._ids[:] = self._now
            for mounted in self._mounted:
                mounted.clear(changed)
        ticks = scenes[0].worlds.ticks
        due = [mounted for mounted in self._mounted if mounted.is_due(ticks, chosen)]
        self.sense(scenes, [mounted.turn for mounted in due])
        for mounted in due:
            mounted.deliver(scenes)

    def arrays(self) -> Iterator[NDArray[Any]]:
        """Yield all arrays that outlive a tick."""
        yield self._ids
        for mounted in self._mounted:
            yield from mounted.frames


class _Mounted:
    """A sensor, its schedule and its frames."""

    def __init__(
        self, place: int, sensor: MountedSensor[Any], frames: SensorFrames, platform: Platform
    ) -> None:
        self.frames = frames
        num, first, slot = np.zeros((NUM_COUNTS, platform.num_worlds), dtype=np.int64)
        due = Due(num, first, slot, sensor.carriers)
        self.turn = Turn(place, sensor, due, frames)
        self._schedule = _schedule_of(sensor.config, platform, frames.lost.shape[2])
        self._sim_dt_s = platform.sim_dt_s
        self._stream = stream_of(sensor.name)
        self._bytes = frames.data.reshape((*frames.lost.shape, -1)).view(np.uint8)
        self._call_due = specialized(call_due)
        self._deliver = specialized(deliver)

    def clear(self, chosen: NDArray[np.bool_]) -> None:
        """Set the frames of the chosen worlds (W,) or agents (W, A) to zero."""
        for array in self.frames:
            array[chosen] = 0

    def rehearse(self, scenes: Sequence[SensedScene]) -> None:
        """Take a sample in every world, then restore the frames."""
        kept = self.frames.copy()
        for array, value in zip(self.turn.due[:NUM_COUNTS], (1, 0, 0), strict=True):
            array[:] = value
        sense_here(scenes, [self.turn])
        self.deliver(scenes)
        for array, before in zip(self.frames, kept, strict=True):
            array[...] = before

    def is_due(self, ticks: NDArray[np.int64], chosen: NDArray[np.bool_]) -> bool:
        """Count the samples due in the chosen worlds (W,); return whether any is due."""
        return self._call_due(self._schedule, ticks, chosen, self.turn.due)

    def deliver(self, scenes: Sequence[SensedScene]) -> None:
        """Stamp and count the new samples, and drop some samples."""
        sensor, frames = self.turn.sensor, self.frames
        if sensor.stamps_itself:
            return
        for scene in scenes:
            self._deliver(
                scene.worlds,
                self._schedule,
                self.turn.due,
                self._sim_dt_s,
                self._stream,
                sensor.config.dropout,
                frames.stamp_s,
                frames.lost,
                frames.fresh,
                self._bytes,
            )


def _schedule_of(config: MountedConfig, platform: Platform, slots: int) -> SensorSchedule:
    """Return a sensor's schedule; a sensor without a rate runs in every tick."""
    ticks_per_step = platform.ticks_per_step
    if isinstance(config, SampledConfig):
        rate = cadence(config.rate_hz, platform.sim_dt_s)
        return SensorSchedule(
            rate.numerator, rate.denominator, config.phase_ticks, ticks_per_step, slots
        )
    return SensorSchedule(1, 1, 0, ticks_per_step, slots)
