"""What `render` shows of the worlds that an environment steps: frames, or a window."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import logger
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.core.errors import ConfigError, EpisodeError
from cavmarl.engine.simulation import Simulation
from cavmarl.parallel.backends import shows_state
from cavmarl.parallel.journaled_worlds import unwatched
from cavmarl.parallel.local_worlds import LocalWorlds
from cavmarl.parallel.step_arrays import SteppedWorlds
from cavmarl.render.topdown import WorldView

RENDER_MODES = ("human", "rgb_array")


def check_rendering(
    config: EnvConfig,
    render_mode: str | None,
    num_worlds: int,
    workers: int | str | None,
    hosts: str | None,
    modes: tuple[str, ...] = RENDER_MODES,
) -> None:
    """Refuse what cannot be drawn.

    Raises:
        ConfigError: a mode that is not one of `modes`, or worlds whose state cannot be had here.
    """
    if render_mode is None:
        return
    if render_mode not in modes:
        raise ConfigError(f"render_mode = {render_mode!r}: must be {' or '.join(modes)}, or None")
    with_sumo = config.traffic.source != "native"
    is_here = not workers and hosts in (None, "local")
    if not is_here and (with_sumo or not shows_state(num_worlds, workers, hosts)):
        what = f" and traffic.source = {config.traffic.source!r}" if with_sumo else ""
        raise ConfigError(
            f"render_mode = {render_mode!r} with workers = {workers or hosts!r}{what}: such worlds "
            "are only drawn in the caller's process; use workers=0"
        )


class DrawnWorlds:
    """Base of an environment that draws its worlds; pygame is loaded at the first frame.

    Attributes:
        worlds: that it steps.
        metadata: with `name` and `render_fps`.
        render_mode: `human`, `rgb_array` or None.
    """

    worlds: SteppedWorlds
    metadata: dict[str, Any]
    render_mode: str | None
    _view: WorldView | None
    _copied: LocalWorlds | None = None  # of worlds that other processes have

    def _frame(
        self, begun: bool, world: int = 0, ghosts_of: int | None = None
    ) -> NDArray[np.uint8] | None:
        """A world as it is now; None and a warning without a render_mode, as Gymnasium has it."""
        if self.render_mode is None:
            logger.warn(
                "render() without a render_mode shows nothing: make the environment with "
                "render_mode='rgb_array'"
            )
            return None
        if not begun:
            raise EpisodeError("render() before reset(): call reset(seed=…) first")
        simulation = self._shown()
        if self._view is None:
            name, fps = self.metadata["name"], self.metadata["render_fps"]
            self._view = WorldView(simulation, self.render_mode, name, fps)
        return self._view.show(ghosts_of, world)

    def _shown(self) -> Simulation:
        """The worlds, or a copy of them as they are now where they live in other processes."""
        worlds = self.worlds
        if isinstance(worlds, LocalWorlds):
            return worlds.simulation
        if self._copied is None:
            self._copied = LocalWorlds(unwatched(worlds.world), len(worlds.arrays.mask))
        self._copied.load_worlds(worlds.save_worlds())
        return self._copied.simulation

    def _close_view(self) -> None:
        """Close the window, if there is one."""
        if self._view is not None:
            self._view.close()
            self._view = None
        if self._copied is not None:
            self._copied.close()
            self._copied = None
