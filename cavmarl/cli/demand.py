"""`cavmarl demand`: make files of demand."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cavmarl.cli.output import JsonPath, MapName, Seed, about, write_json

app = typer.Typer(help="Make files of demand.", no_args_is_help=True)


@app.callback()
def _group() -> None:
    """Keep `random` a command of its own while there is no other."""


@app.command()
def random(
    map_name: MapName,
    out: Annotated[Path, about("The .rou.xml to write.", "--out", "-o")],
    vehicles: Annotated[int, about("Number of cars.")] = 1000,
    within: Annotated[float, about("Seconds in which they depart, evenly.")] = 60.0,
    route: Annotated[float, about("Shortest route, in metres.")] = 10_000.0,
    seed: Seed = 0,
    json_path: JsonPath = None,
) -> None:
    """Cars with explicit random routes, from edges drawn by the length of their lanes."""
    from cavmarl.engine.world_setup import find_map
    from cavmarl.roads.cache import load_network
    from cavmarl.traffic.random_trips import write_random_demand

    network = load_network(find_map(map_name))
    write_random_demand(network, out, vehicles=vehicles, within_s=within, route_m=route, seed=seed)
    typer.echo(f"{out}: {vehicles} vehicles on {network.name}")
    asked = {"vehicles": vehicles, "within_s": within, "route_m": route, "seed": seed}
    write_json(json_path, {"file": str(out), "map": network.name, **asked})
