"""`WorldView`: what `env.render()` shows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError
from cavmarl.engine.simulation import Simulation
from cavmarl.render.canvas import pixels
from cavmarl.render.topdown import TopDownRenderer


class WorldView:
    """Draws one world of a simulation from above, into arrays or into a window.

    Args:
        simulation: the worlds; the first one is shown.
        mode: `rgb_array` or `human`.
        title: for the picture's corner and the window.
        fps: pictures a second of the window.

    Raises:
        MissingExtraError: pygame-ce is not installed.
    """

    def __init__(self, simulation: Simulation, mode: str, title: str, fps: int) -> None:
        self._simulation = simulation
        self._mode = mode
        self._title = title
        self._fps = fps
        self._renderer = TopDownRenderer(simulation.network, goal_edges=simulation.goal_edges)

    def show(self, ghosts_of: int | None = None) -> NDArray[np.uint8] | None:
        """Draw the present moment: (height, width, 3) for `rgb_array`, None for `human`.

        A divided world is drawn with its zones, and vehicles in the colours of their owners.

        Args:
            ghosts_of: the zone whose sight and ghosts are outlined.

        Raises:
            ConfigError: the world has no such zone.
        """
        simulation = self._simulation
        count = simulation.partition.count
        if ghosts_of is not None and not 0 <= ghosts_of < count:
            raise ConfigError(f"ghosts_of = {ghosts_of}: the world has the zones 0 to {count - 1}")
        picture = self._renderer.draw(
            simulation.vehicles(),
            simulation.signal_phases(),
            title=self._title,
            clock_s=float(simulation.ticks()[0]) * simulation.config.clock.sim_dt_s,
            zones=simulation.zone_view() if count > 1 else None,
            ghosts_of=ghosts_of,
        )
        if self._mode == "rgb_array":
            return pixels(picture)
        self._renderer.show(picture, self._title, self._fps)
        return None

    def close(self) -> None:
        """Close the window, if there is one."""
        self._renderer.close()
