"""Make the moving picture of the README: cars that merge on `merge`.

`python -m docs.pictures.moving docs/images` makes it again.
The built-in driver drives all agents of a seeded world; the camera stands at the end of the ramp.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.registry import load_config
from cavmarl.core.errors import require
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.world_setup import load_roads
from cavmarl.render.topdown import TopDownRenderer
from cavmarl.render.viewport import Bounds
from cavmarl.shards.shard import Commands

__all__ = ["MOVING", "Film", "film_frames", "write_film"]

STEP_S = 0.1  # time between two frames


@dataclass(frozen=True)
class Film:
    """The settings of a film.

    Attributes:
        env: name of the environment.
        focus: the part of the map to show, m.
        start_s: world time of the first frame.
        duration_s: world time that the film shows.
        size: size of a frame in pixels.
        seed: seed of the world.
        agents: number of agents, instead of the environment's.
        background: number of background vehicles, instead of the environment's.
    """

    env: str
    focus: Bounds
    start_s: float
    duration_s: float
    size: tuple[int, int]
    seed: int = 0
    agents: int | None = None
    background: int | None = None


MOVING = Film(
    "merge", focus=(416.0, -10.5, 524.0, 12.5), start_s=10.0, duration_s=14.5, size=(960, 270)
)


def film_frames(film: Film) -> Iterator[NDArray[np.uint8]]:
    """Yield a frame (height, width, 3) for each step of the world in the time of the film."""
    config, folder = load_config(
        film.env,
        agents=film.agents,
        background=film.background,
        overrides={"clock.ctrl_dt_s": STEP_S},
    )
    network = load_roads(config, folder)
    simulation = Simulation(config, network)
    simulation.seed(film.seed)
    simulation.reset()
    renderer = TopDownRenderer(network, film.size, film.focus)
    suggested = np.zeros((1, config.population.num_ids, 2))
    first = round(film.start_s / config.clock.ctrl_dt_s)
    last = first + round(film.duration_s / config.clock.ctrl_dt_s)
    for step in range(last):
        simulation.suggest(suggested)
        simulation.step(Commands(suggested, suggested[..., 0].astype(np.int64)))
        simulation.retire_agents()
        if step >= first:
            yield renderer.frame(
                simulation.vehicles(),
                simulation.signal_phases(),
                title=config.name,
                clock_s=float(simulation.ticks()[0]) * config.clock.sim_dt_s,
            )


def write_film(film: Film, path: Path) -> int:
    """Write a film as a repeating GIF in real time; return its size in bytes."""
    imageio = require("imageio.v3", "render")
    path.parent.mkdir(parents=True, exist_ok=True)
    imageio.imwrite(path, list(film_frames(film)), duration=1000.0 * STEP_S, loop=0)
    return path.stat().st_size


if __name__ == "__main__":
    target = Path(sys.argv[1]) / "merge.gif"
    print(target, write_film(MOVING, target), "bytes")
