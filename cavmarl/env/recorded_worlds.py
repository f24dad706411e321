"""Recordings of the worlds that an environment steps."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.core.errors import ConfigError
from cavmarl.core.machine import describe_machine
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.world_description import describe_world
from cavmarl.engine.world_frame import WorldFrame
from cavmarl.env.drawn_worlds import why_not_copied
from cavmarl.env.recorded_extras import RecordedExtras, check_extras
from cavmarl.env.recorded_inputs import StepInputs
from cavmarl.parallel.placement.backend_name import BackendName
from cavmarl.parallel.worlds.local_worlds import LocalWorlds
from cavmarl.parallel.worlds.step_arrays import SteppedWorlds
from cavmarl.recordings.extra_tables import RecordOptions
from cavmarl.recordings.recording_writer import RecordingWriter

Record: TypeAlias = RecordOptions | str | Path
"""Types of the argument `record`."""


def check_recording(
    config: EnvConfig,
    record: Record | None,
    backend: BackendName,
) -> None:
    """Raise an error for worlds whose state is not available in this process.

    Raises:
        ConfigError: the worlds or the requested tables cannot be recorded.
    """
    if record is None:
        return
    options = RecordOptions.of(record)
    check_extras(config, options.include, backend.is_local)
    if obstacle := why_not_copied(config, backend):
        raise ConfigError(
            f"record = {str(options.path)!r} with {obstacle}: such worlds can only be recorded in "
            "the caller's process; use backend='local'"
        )


class WorldRecorder:
    """Records worlds after their steps, with a manifest.

    Args:
        record: the new folder, or options with the optional tables.
        worlds: the worlds that are stepped.
        simulation: the worlds or a local copy, which know the width of the halo.
        state_hash: returns the hash of a world, for the table `commands`; None: it is not
            available.
        more: additional entries of the manifest.

    Raises:
        ConfigError: a requested table is not available.
        RecordingError: the path exists already, or it cannot be written.
        MissingExtraError: pyarrow is not installed.
    """

    def __init__(
        self,
        record: Record,
        worlds: SteppedWorlds,
        simulation: Simulation,
        state_hash: Callable[[int], str] | None,
        **more: Any,
    ) -> None:
        options, world = RecordOptions.of(record), worlds.world
        config = world.config
        check_extras(config, options.include, is_here=isinstance(worlds, LocalWorlds))
        self._extras = RecordedExtras(
            config, options.include, worlds.arrays, simulation, state_hash
        )
        self._writer = RecordingWriter(
            options.path,
            environment=f"{config.name}-v{config.version}",
            network=world.network,
            partition=world.partition,
            halo_m=float(simulation.zones.loads().halo_m),
            sim_dt_s=config.clock.sim_dt_s,
            step_s=config.clock.ctrl_dt_s,
            manifest={
                "started": datetime.now(UTC).isoformat(timespec="seconds"),
                "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
                "world": describe_world(config, world.network, world.demand, world.partition),
                **more,
                **describe_machine(),
            },
            extras=self._extras.dtypes,
            features=self._extras.features,
            terms=config.terms.names if options.include else (),
        )

    @property
    def path(self) -> Path:
        """The folder of the recording."""
        return self._writer.path

    def note(self, inputs: StepInputs) -> None:
        """Note the inputs of a reset or a step, before its frames are added."""
        self._extras.inputs = inputs

    def room(self, count: int) -> NDArray[np.void]:
        """Return memory, SEEN (count,), for a frame that is only passed to `add`."""
        return self._writer.memory.take(count)

    def add(
        self, frames: Iterable[WorldFrame], actions: NDArray[Any] | None, first: int = 0
    ) -> None:
        """Add frames of worlds as they are now.

        Args:
            frames: frames with the worlds' numbers in the environment.
            actions: (W, A, …) of the step that led to the frames; None: the worlds were reset.
            first: number of world 0 in the recording.

        Raises:
            RecordingError: an earlier part could not be written.
        """
        these = list(frames)
        extras = [self._extras.of(frame, actions) for frame in these]
        self._writer.add((frame._replace(world=first + frame.world) for frame in these), extras)

    def end(self, worlds: Iterable[int], actions: NDArray[Any], first: int = 0) -> None:
        """Add the last rows of episodes that have just ended, whose last frames are not available.

        Raises:
            RecordingError: an earlier part could not be written.
        """
        for world in worlds:
            self._writer.add_rows(first + world, self._extras.at_the_end(world, actions))

    def close(self) -> None:
        """Write the remaining rows; raises as `add`."""
        self._writer.close()
