"""`ScenarioCamera`: a video of a scenario from above, and a picture of its closest moment."""

from __future__ import annotations

import math
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cavmarl.core.errors import ConfigError
from cavmarl.core.records.codes import DRIVER_SCRIPTED
from cavmarl.env.vector import CavVectorEnv
from cavmarl.render.canvas import load_pygame, pixels
from cavmarl.render.topdown import TopDownRenderer
from cavmarl.render.video import VideoWriter

if TYPE_CHECKING:
    from pygame import Surface

SIZE = (1280, 720)
HALF_M = (64.0, 36.0)  # half width and half height of the picture


class ScenarioCamera:
    """A camera on the first world of `make_scenario`, for use in a `with` block.

    `picture` shows the moment in which an agent was closest to a moving actor, `video` the whole
    run. If a path is None, that file is not written.
    """

    def __init__(self, vec: CavVectorEnv, picture: Path | None, video: Path | None) -> None:
        scene = vec.simulation.scene
        if scene is None:
            raise ConfigError(
                "scenario.name = '': this world has no scenario to film; set scenario.name"
            )
        if picture is not None and picture.suffix != ".png":
            raise ConfigError(f"{picture}: the name of a picture must end in .png")
        focus = (scene.x - HALF_M[0], scene.y - HALF_M[1], scene.x + HALF_M[0], scene.y + HALF_M[1])
        self._vec = vec
        self._renderer = TopDownRenderer(vec.network, SIZE, focus)
        self._picture = picture
        self._stack = ExitStack()
        self._writer: VideoWriter | None = None
        if video is not None:
            self._writer = self._stack.enter_context(VideoWriter(video, 1.0 / vec.step_s))
        self._closest_m = math.inf
        self._best: Surface | None = None

    def __enter__(self) -> ScenarioCamera:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()
        if self._picture is not None and self._best is not None:
            self._save(self._picture, self._best)

    def look(self) -> None:
        simulation, config = self._vec.simulation, self._vec.config
        rows = simulation.vehicles()
        agents = rows[rows["agent"] >= 0][:, None]
        actors = rows[(rows["driver"] == DRIVER_SCRIPTED) & (rows["distance_m"] > 0.0)]
        off_m = np.hypot(actors["x"] - agents["x"], actors["y"] - agents["y"])
        apart_m = off_m.min(initial=math.inf)
        is_closest = self._picture is not None and apart_m < self._closest_m
        if self._writer is None and not is_closest:
            return
        surface = self._renderer.draw(
            rows,
            simulation.signal_phases(),
            title=f"{config.scenario.name} on {config.name}",
            clock_s=float(simulation.ticks()[0]) * config.clock.sim_dt_s,
            zones=simulation.zones.view() if simulation.partition.count > 1 else None,
        )
        if is_closest:
            self._closest_m, self._best = float(apart_m), surface
        if self._writer is not None:
            self._writer.write(pixels(surface))

    def _save(self, path: Path, surface: Surface) -> None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            load_pygame().image.save(surface, str(path))
        except OSError as error:
            raise ConfigError(f"{path}: cannot be written ({error.strerror or error})") from error
