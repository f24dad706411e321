"""`cavmarl map export`: a map for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.text import Text

from cavmarl.cli.output import Environment, JsonPath, about_file, grid, write_json
from cavmarl.core.errors import ConfigError
from cavmarl.engine.world_setup import find_map
from cavmarl.maps.exports.geojson import write_geojson
from cavmarl.maps.exports.lanelet import write_lanelet2
from cavmarl.maps.exports.opendrive import MOST_OFF, write_opendrive
from cavmarl.roads.cache import load_network


def export(
    env: Environment,
    opendrive: Annotated[Path | None, about_file("Write OpenDRIVE, and read it back.")] = None,
    lanelet2: Annotated[Path | None, about_file("Write Lanelet2 (.osm), and read it back.")] = None,
    geojson: Annotated[Path | None, about_file("Write the lanes as GeoJSON.")] = None,
    json_path: JsonPath = None,
) -> None:
    """Write a map for other programs; exit code 1 if what is read back differs."""
    if opendrive is None and lanelet2 is None and geojson is None:
        raise ConfigError("nothing to export: give --opendrive, --lanelet2 or --geojson")
    console = Console()
    path = find_map(env)
    network = load_network(path)
    document: dict[str, Any] = {}
    sound = True
    if opendrive is not None:
        with console.status(f"writing {opendrive} …"):
            trip = write_opendrive(path, opendrive)
        told = trip.to_dict()
        rows = [[key, *map(_shown, told[key])] for key in ("edges", "lanes", "links", "road_m")]
        console.print(grid([f"{opendrive}: for cars", "map", "read back"], rows))
        sound = trip.same
        if not sound:
            words = f"differs in its topology, or by more than {MOST_OFF:.0%} in its length"
            console.print(Text(f"{opendrive}: {words}", style="red"))
        document["opendrive"] = told
    if lanelet2 is not None:
        with console.status(f"writing {lanelet2} …"):
            document["lanelet2"] = write_lanelet2(network, lanelet2)
        console.print(Text(f"{lanelet2}: {document['lanelet2']['read back']} lanelets read back"))
    if geojson is not None:
        document["geojson"] = {"lanes": write_geojson(network, geojson, path)}
        console.print(Text(f"{geojson}: {document['geojson']['lanes']} lanes"))
    write_json(json_path, document)
    raise typer.Exit(0 if sound else 1)


def _shown(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:.1f}"
