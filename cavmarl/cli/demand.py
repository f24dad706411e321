"""`cavmarl demand`: generates demand files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cavmarl.cli.output import (
    CliGroup,
    JsonPath,
    MapName,
    Seed,
    about,
    add_command,
    write_json,
)

app = typer.Typer(cls=CliGroup, help="Generate demand files.", no_args_is_help=True)


@app.callback()
def _group() -> None:
    """Keep `random` a subcommand although it is the only one."""


def random(
    map_name: MapName,
    out: Annotated[Path, about("The .rou.xml file to write.", "--out", "-o", metavar="FILE")],
    vehicles: Annotated[int, about("Number of cars.", metavar="N")] = 1000,
    within: Annotated[
        float, about("Seconds during which the cars depart, evenly spaced.", metavar="S")
    ] = 60.0,
    route: Annotated[float, about("Minimum length of a route in metres.", metavar="M")] = 10_000.0,
    seed: Seed = 0,
    json_path: JsonPath = None,
) -> None:
    """Write cars with random routes; start edges are drawn in proportion to their lane length."""
    from cavmarl.engine.world_setup import find_map
    from cavmarl.roads.cache import load_network
    from cavmarl.traffic.random_trips import write_random_demand

    network = load_network(find_map(map_name))
    write_random_demand(network, out, vehicles=vehicles, within_s=within, route_m=route, seed=seed)
    typer.echo(f"{out}: {vehicles} vehicles on {network.name}")
    asked = {"vehicles": vehicles, "within_s": within, "route_m": route, "seed": seed}
    write_json(json_path, {"file": str(out), "map": network.name, **asked})


add_command(
    app,
    "random",
    random,
    "cavmarl demand random town --vehicles 500 --out town.rou.xml",
)
