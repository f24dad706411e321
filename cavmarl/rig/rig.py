"""`Rig`: all mounted sensors of W worlds, and what is due of them in each tick."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.config_rig import MountedConfig, SampledConfig, cadence
from cavmarl.kernels.repeated import repeated
from cavmarl.kernels.rig_frames import POSE, call_roll, deliver, note_poses
from cavmarl.kernels.rig_schedule import Due, Schedule, call_due
from cavmarl.rig.catalogue import mount
from cavmarl.rig.frames import Frames, SensorFrames
from cavmarl.rig.sensor import MountedSensor, Platform, Scene, stream_of

__all__ = ["Rig"]


class Rig:
    """The sensors of all agents of W worlds.

    Args:
        settings: of the sensors, by name.
        platform: what they are mounted on.
        frames: where their samples go.
        ids: (W, A) int64, the vehicle whose samples each agent's are; kept from tick to tick.
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
            _Mounted(sensor, frames[sensor.name], platform) for sensor in mount(settings, platform)
        ]
        self._everywhere = np.ones(len(ids), dtype=np.bool_)
        self._call_roll = repeated(call_roll)
        self._note_poses = repeated(note_poses)

    @property
    def before(self) -> NDArray[np.void]:
        """POSE (W, A) of the tick before."""
        return self._before

    def begin(self, scenes: Sequence[Scene]) -> None:
        """Note where everybody is before the tick."""
        self._before["id"] = -1
        for scene in scenes:
            self._note_poses(scene.worlds, self._before)

    def reset(self, scenes: Sequence[Scene], chosen: NDArray[np.bool_]) -> None:
        """Forget what there was in the chosen worlds (W,), and take what is due at the reset."""
        self._before["id"][chosen] = -1
        for mounted in self._mounted:
            mounted.clear(chosen)
        self._ids[chosen] = -1
        self._take(scenes, chosen)

    def end(self, scenes: Sequence[Scene]) -> None:
        """Take what is due in the present tick."""
        ticks = scenes[0].worlds.ticks
        begins = (ticks - 1) % self._platform.ticks_per_step == 0
        if begins.any():
            for mounted in self._mounted:
                mounted.frames.fresh[begins] = 0
        self._take(scenes, self._everywhere)

    def _take(self, scenes: Sequence[Scene], chosen: NDArray[np.bool_]) -> None:
        self._now[:] = -1
        for scene in scenes:
            self._call_roll(scene.worlds, self._now)
        changed = self._now != self._ids
        if changed.any():
            self._ids[:] = self._now
            for mounted in self._mounted:
                mounted.clear(changed)
        for mounted in self._mounted:
            mounted.take(scenes, chosen)

    def arrays(self) -> Iterator[NDArray[Any]]:
        """All that outlives a tick."""
        yield self._ids
        for mounted in self._mounted:
            yield from mounted.frames


class _Mounted:
    """A sensor, its schedule and its frames."""

    def __init__(
        self, sensor: MountedSensor[Any], frames: SensorFrames, platform: Platform
    ) -> None:
        self.frames = frames
        self._sensor = sensor
        self._schedule = _schedule_of(sensor.config, platform, frames.lost.shape[2])
        self._sim_dt_s = platform.sim_dt_s
        self._stream = stream_of(sensor.name)
        self._due = Due(*(np.zeros(platform.num_worlds, dtype=np.int64) for _ in Due._fields))
        self._bytes = frames.data.reshape((*frames.lost.shape, -1)).view(np.uint8)
        self._call_due = repeated(call_due)
        self._deliver = repeated(deliver)

    def clear(self, chosen: NDArray[np.bool_]) -> None:
        """Write zeros for some worlds (W,), or agents (W, A)."""
        for array in self.frames:
            array[chosen] = 0

    def take(self, scenes: Sequence[Scene], chosen: NDArray[np.bool_]) -> None:
        """Take what is due in the chosen worlds (W,)."""
        schedule, due, frames = self._schedule, self._due, self.frames
        if not self._call_due(schedule, scenes[0].worlds.ticks, chosen, due):
            return
        self._sensor.sense(scenes, due, frames)
        if not self._sensor.stamps_itself:
            for scene in scenes:
                self._deliver(
                    scene.worlds,
                    schedule,
                    due,
                    self._sim_dt_s,
                    self._stream,
                    self._sensor.config.dropout,
                    frames.stamp_s,
                    frames.lost,
                    frames.fresh,
                    self._bytes,
                )


def _schedule_of(config: MountedConfig, platform: Platform, slots: int) -> Schedule:
    """Of a sensor with a rate; without one it is asked in every tick."""
    ticks_per_step = platform.ticks_per_step
    if isinstance(config, SampledConfig):
        rate = cadence(config.rate_hz, platform.sim_dt_s)
        return Schedule(rate.numerator, rate.denominator, config.phase_ticks, ticks_per_step, slots)
    return Schedule(1, 1, 0, ticks_per_step, slots)
