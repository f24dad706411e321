"""Draw the pictures of the README and of the cards of environments.

`python -m docs.pictures.pictures docs/images` draws them again.
Each picture shows one moment of a seeded world in which the built-in driver drives all agents.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cavmarl.engine.simulation import Simulation
from cavmarl.engine.world_setup import World, load_world
from cavmarl.render.canvas import load_pygame
from cavmarl.render.topdown import TopDownRenderer
from cavmarl.render.viewport import Bounds
from cavmarl.shards.shard import Commands

if TYPE_CHECKING:
    from pygame import Surface

__all__ = ["PICTURES", "Picture", "draw_picture", "moment", "write_pictures"]

SEED = 0


@dataclass(frozen=True)
class Picture:
    """The settings of a picture.

    Attributes:
        env: name of the environment.
        time_s: simulated time of the picture.
        size: size in pixels; by default, the size fits the map.
        focus: the part of the map to show, m; by default, the whole map.
        agents: number of agents, instead of the environment's.
        background: number of background vehicles, instead of the environment's.
        ghosts_of: the zone whose ghosts are outlined; a divided world is drawn with its zones.
        approach_ticks: ticks between the start of a transfer and the crossing.
    """

    env: str
    time_s: float
    size: tuple[int, int] | None = None
    focus: Bounds | None = None
    agents: int | None = None
    background: int | None = None
    ghosts_of: int | None = None
    approach_ticks: int = 2


PICTURES = {
    "ring": Picture("ring", 8.0),
    "merge": Picture("merge", 9.0, (1280, 400), (150.0, -76.0, 660.0, 40.0)),
    "grid4x4": Picture("grid4x4", 16.0),
    "town": Picture("town", 20.0, background=250),
    "rush": Picture("rush", 60.0),
    "cities": Picture("cities", 20.0, (1000, 800)),
    "cities_validation": Picture("cities_validation", 20.0, (1000, 800)),
    "cities_sensed": Picture("cities_sensed", 20.0, (1000, 800)),
    "cities_test": Picture("cities_test", 20.0, (1000, 800)),
    "cities_test_left": Picture("cities_test_left", 20.0, (1000, 800)),
    "intersection": Picture("intersection", 20.0),
    "roundabout": Picture("roundabout", 20.0),
    "bottleneck": Picture("bottleneck", 15.0, (1280, 400)),
    "tollgate": Picture("tollgate", 15.0, (1280, 560)),
    "exit": Picture("exit", 20.0, (1280, 400), (380.0, -76.0, 890.0, 40.0)),
    "highway": Picture("highway", 20.0, (1280, 300), (600.0, -45.0, 1000.0, 45.0)),
    "two-way": Picture("two-way", 20.0, (1280, 300), (300.0, -45.0, 700.0, 45.0)),
    "u-turn": Picture("u-turn", 12.0, (1280, 400)),
    "ring22": Picture("ring22", 60.0),
    "blind_junction": Picture("blind_junction", 20.0),
    "lane_drop": Picture("lane_drop", 300.0, (1280, 300), (1700.0, -45.0, 2100.0, 45.0)),
    "ghosts": Picture(
        "rush",
        60.0,
        (1280, 720),
        (880.0, 500.0, 1340.0, 760.0),
        ghosts_of=1,
        approach_ticks=75,
    ),
    "hero": Picture(
        "town", 30.0, (1280, 720), (1230.0, 560.0, 1720.0, 835.0), agents=60, background=240
    ),
}


def draw_picture(picture: Picture) -> Surface:
    """Run the world up to the moment of the picture, and draw it."""
    world = load_world(
        picture.env,
        agents=picture.agents,
        background=picture.background,
        overrides={"zones.approach_ticks": picture.approach_ticks},
    )
    config, network = world.config, world.network
    simulation = moment(world, picture.time_s)
    renderer = TopDownRenderer(network, picture.size, picture.focus, simulation.goal_edges)
    return renderer.draw(
        simulation.vehicles(),
        simulation.signal_phases(),
        title=config.name,
        clock_s=float(simulation.ticks()[0]) * config.clock.sim_dt_s,
        zones=simulation.zones.view() if simulation.partition.count > 1 else None,
        ghosts_of=picture.ghosts_of,
    )


def moment(world: World, time_s: float) -> Simulation:
    """Return a seeded world after some time, with the built-in driver in all seats."""
    config = world.config
    simulation = Simulation(config, world.network, demand=world.demand, partition=world.partition)
    simulation.seed(SEED)
    simulation.reset()
    suggested = np.zeros((1, config.population.num_ids, 2))
    for _ in range(round(time_s / config.clock.ctrl_dt_s)):
        simulation.suggest(suggested)
        meta = suggested[..., 0].astype(np.int64)
        simulation.step(Commands(suggested, meta))
        simulation.retire_agents()
    return simulation


def write_pictures(folder: Path) -> list[Path]:
    """Draw all `PICTURES` into a folder, one PNG each."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, picture in PICTURES.items():
        path = folder / f"{name}.png"
        load_pygame().image.save(draw_picture(picture), str(path))
        paths.append(path)
    return paths


if __name__ == "__main__":
    for written in write_pictures(Path(sys.argv[1])):
        print(written)
