"""Recorded sensor data of an agent's vehicle, for pages."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.config.io import validate
from cavmarl.core.errors import ConfigError, RecordingError
from cavmarl.env.recorded_extras import SAMPLES
from cavmarl.recordings.recording import Recording
from cavmarl.sensors.sensed_shapes import Shape, observed_shapes, sampled_shapes
from cavmarl.viewer.vehicle_details import named_numbers, named_terms

OLDEST_S = 2.0  # largest age of a sample to show


class RecordedSensors:
    """Observations, terms and sensor shapes of one episode, as far as they were recorded.

    Args:
        recording: the recording.
        world: index of the world.
        episode: index of the episode.
    """

    def __init__(self, recording: Recording, world: int, episode: int) -> None:
        self._recording = recording
        self._world, self._episode = world, episode
        self._ticks = recording.ticks(world, episode)
        self._observes = "observations" in recording.extras
        self._config, self._note = _settings_of(recording)

    def of(self, tick: int, vehicle: int, sensors: bool) -> dict[str, Any]:
        """Return the data of an agent's vehicle: `terms`, `observation`, `shapes`, `note`.

        Args:
            tick: tick of a recorded frame.
            vehicle: id of the vehicle.
            sensors: whether to include the sensors' shapes; if there are none, `note` says why.

        Raises:
            RecordingError: the data do not fit the sensors' settings.
        """
        head, found = self._recording.head, {}
        rows = self._rows("observations", tick, vehicle) if self._observes else ()
        shapes: list[Shape] = []
        for row in rows:
            found["terms"] = named_terms(head.terms, row["terms"])
            found["observation"] = named_numbers(head.features, row["values"])
            if self._config is not None:
                shapes += self._drawn(partial(observed_shapes, self._config, row["values"]))
        if not sensors:
            return found
        if self._config is not None:
            for name, settings in self._config.rig.items():
                sample = self._newest(SAMPLES + name, tick, vehicle)
                if sample is not None:
                    shapes += self._drawn(partial(sampled_shapes, name, settings, sample))
        return {**found, "shapes": shapes, "note": self._note}

    def _drawn(self, draw: Callable[[], list[Shape]]) -> list[Shape]:
        try:
            with np.errstate(invalid="ignore"):  # recorded numbers may be NaN
                return draw()
        except (ArithmeticError, IndexError, KeyError, TypeError, ValueError) as error:
            raise RecordingError(
                f"{self._recording.path}: its sensor data do not fit the settings of its sensors "
                f"({error}); get the recording again, or record the run again"
            ) from error

    def _rows(self, table: str, tick: int, vehicle: int) -> NDArray[np.void]:
        rows = self._recording.extra_at(table, tick, self._world, self._episode)
        mine: NDArray[np.void] = rows[rows["vehicle"] == vehicle]
        return mine

    def _newest(self, table: str, tick: int, vehicle: int) -> NDArray[Any] | None:
        """Return the last sample up to a tick; None if it is too old, lost, or not recorded."""
        if table not in self._recording.extras:
            return None
        oldest = tick - OLDEST_S / self._recording.head.sim_dt_s
        place = int(np.searchsorted(self._ticks, tick, side="right")) - 1
        for earlier in reversed(self._ticks[: place + 1]):
            if earlier < oldest:
                break
            rows = self._rows(table, earlier, vehicle)
            if len(rows):
                return None if rows["lost"][-1] else np.asarray(rows["data"][-1])
        return None


def _settings_of(recording: Recording) -> tuple[EnvConfig | None, str]:
    """Return the recorded environment's settings if readable, and a note for the page."""
    try:
        settings = recording.manifest["world"]["config"]
        config = validate(EnvConfig, settings, f"{recording.path}")
    except (ConfigError, KeyError, TypeError):
        return None, "The recording has no sensor settings that this version can read."
    missing: Sequence[str] = [
        name
        for name, is_missing in (
            (
                "observations",
                config.observation.mode != "sensors" and "observations" not in recording.extras,
            ),
            ("samples", any(SAMPLES + name not in recording.extras for name in config.rig)),
        )
        if is_missing
    ]
    if not missing:
        return config, ""
    return config, (
        f"This recording has no {' and no '.join(missing)} of sensors; "
        f"--record-also {','.join(missing)} records them."
    )
