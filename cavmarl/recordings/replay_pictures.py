"""Pictures of a recording, drawn with the renderer of worlds."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError
from cavmarl.driving.vehicles import blank_vehicle
from cavmarl.engine.world_frame import SEEN, WorldFrame
from cavmarl.handoff.zone_view import ZoneView
from cavmarl.recordings.recording import Recording
from cavmarl.render.canvas import pixels
from cavmarl.render.topdown import TopDownRenderer

_SHARED = [name for name in SEEN.names or () if name not in ("zone", "vclass")]


class ReplayPictures:
    """Draws frames of a recording, into arrays or into a window.

    Args:
        recording: the recording.
        ghosts_of: zone whose sensing range and ghosts are outlined.

    Raises:
        ConfigError: there is no zone with that index.
        MissingExtraError: pygame-ce is not installed.
        RecordingError: the map is missing or damaged, or a frame does not fit the map.
    """

    def __init__(self, recording: Recording, ghosts_of: int | None = None) -> None:
        self._recording, head = recording, recording.head
        self._partition, self._halo_m = head.partition, head.halo_m
        self._title = head.environment
        self._ghosts_of = ghosts_of
        count = self._partition.count
        if ghosts_of is not None and not (count > 1 and 0 <= ghosts_of < count):
            raise ConfigError(
                f"ghosts_of = {ghosts_of}: must be from 0 to {count - 1}, in a world with several "
                "zones"
            )
        self._renderer = TopDownRenderer(recording.network)
        self.fps = max(1, round(1.0 / head.step_s))

    def picture(self, frame: WorldFrame) -> NDArray[np.uint8]:
        """Draw a frame as (height, width, 3)."""
        return pixels(self._draw(frame))

    def show(self, frame: WorldFrame) -> bool:
        """Show a frame in a window, at the run's pace; return False if the user has closed it."""
        self._renderer.show(self._draw(frame), self._title, self.fps)
        return not self._renderer.closed_by_person

    def close(self) -> None:
        self._renderer.close()

    def _draw(self, frame: WorldFrame) -> Any:
        self._recording.check_on_map(frame)
        view = None
        if self._partition.count > 1:
            owners = frame.vehicles["zone"].astype(np.int64)
            view = ZoneView(self._partition, self._halo_m, owners, frame.ghosts, frame.transfers)
        return self._renderer.draw(
            drawable(frame.vehicles),
            frame.signals,
            title=self._title,
            clock_s=frame.time_s,
            zones=view,
            ghosts_of=self._ghosts_of,
        )


def drawable(vehicles: NDArray[np.void]) -> NDArray[np.void]:
    """Convert SEEN rows to the VEHICLE fields that pictures need."""
    rows = np.repeat(blank_vehicle(), len(vehicles))
    for name in _SHARED:
        rows[name] = vehicles[name]
    rows["owner"] = vehicles["zone"]
    return rows
