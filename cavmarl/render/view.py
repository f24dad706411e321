"""`WorldView`: what `env.render()` shows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.render.topdown import TopDownRenderer
from cavmarl.runtime.simulation import Simulation

__all__ = ["WorldView"]


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

    def show(self) -> NDArray[np.uint8] | None:
        """Draw the present moment: (height, width, 3) for `rgb_array`, None for `human`."""
        simulation = self._simulation
        vehicles, phases = simulation.vehicles(), simulation.signal_phases()
        clock_s = float(simulation.ticks()[0]) * simulation.config.clock.sim_dt_s
        if self._mode == "rgb_array":
            return self._renderer.frame(vehicles, phases, title=self._title, clock_s=clock_s)
        surface = self._renderer.draw(vehicles, phases, title=self._title, clock_s=clock_s)
        self._renderer.show(surface, self._title, self._fps)
        return None

    def close(self) -> None:
        """Close the window, if there is one."""
        self._renderer.close()
