"""`MountedSensors`: lets the rig of all agents sense after each tick, as an `Attached` part."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.rig.rig import Rig
from cavmarl.rig.sensor import Platform, Scene
from cavmarl.runtime.attached import Host
from cavmarl.shard.shard import Commands
from cavmarl.traffic.vtypes import generated_types

__all__ = ["MountedSensors"]


class MountedSensors:
    """The rig of an environment; see `Attached`.

    Args:
        host: what it is attached to.
    """

    def __init__(self, host: Host) -> None:
        config = host.config
        platform = Platform(
            host.network,
            generated_types()[0],
            host.num_worlds,
            config.population.num_ids,
            config.clock.sim_dt_s,
            config.clock.ticks_per_step,
        )
        ids = host.zeros((host.num_worlds, config.population.num_ids), dtype=np.int64)
        ids[...] = -1
        self._host = host
        self._rig = Rig(config.rig, platform, host.frames, ids)

    def reset(self, chosen: NDArray[np.bool_]) -> None:
        """Take the samples that are due at the reset of the chosen worlds (W,)."""
        self._rig.reset(self._scenes(), chosen)

    def begin(self, commands: Commands) -> None:
        """Note how everybody moves before the tick."""
        self._rig.begin(self._scenes())

    def end(self) -> None:
        """Take the samples of the tick."""
        self._rig.end(self._scenes())

    def arrays(self) -> Iterator[NDArray[Any]]:
        """The samples."""
        return self._rig.arrays()

    def _scenes(self) -> list[Scene]:
        return [
            Scene(
                shard.roads,
                shard.lane_grid,
                shard.plans,
                shard.travel,
                shard.worlds,
                shard.grid,
                self._rig.before,
            )
            for shard in self._host.shards
        ]
