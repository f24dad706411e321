"""`WorldView`: what `env.render()` shows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.roads.network import RoadNetwork
from cavmarl.runtime.simulation import Simulation

__all__ = ["WorldView"]


class WorldView:
    """Draws one world from above, into arrays or into a window.

    Args:
        network: the roads.
        mode: `rgb_array` or `human`.
        fps: frames a second of the window.
    """

    def __init__(self, network: RoadNetwork, mode: str, fps: int) -> None:
        from cavmarl.render.topdown import TopDownRenderer

        self._mode = mode
        self._fps = fps
        self._renderer = TopDownRenderer(network)

    def show(self, simulation: Simulation, time_s: float) -> NDArray[np.uint8] | None:
        """Draw world 0: a frame for `rgb_array`, None for `human`."""
        raise SystemExit

    def close(self) -> None:
        """Close the window, if there is one."""
        self._renderer.close()
