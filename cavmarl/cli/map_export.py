"""`cavmarl map export`: writes a map for other programs."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.text import Text

from cavmarl.cli.output import (
    OUTPUT,
    Environment,
    JsonPath,
    about,
    about_file,
    flag,
    grid,
    write_json,
)
from cavmarl.core.errors import ConfigError
from cavmarl.core.progress import in_stages
from cavmarl.engine.world_setup import find_map
from cavmarl.maps.exports.geojson import write_geojson
from cavmarl.maps.exports.lanelet import write_lanelet2, write_map_folder
from cavmarl.maps.exports.opendrive import STAGES, write_opendrive
from cavmarl.maps.exports.opendrive_trip import MOST_OFF, CarRoads, RoundTrip
from cavmarl.roads.cache import load_network

_LOAD, _LANELETS, _LINES = "map", "Lanelet2", "GeoJSON"


def export(
    env: Environment,
    opendrive: Annotated[
        Path | None, about_file("Write OpenDRIVE, and check it by reading it back.")
    ] = None,
    carla: Annotated[
        bool, flag("Write OpenDRIVE as CARLA's programs read it: one signal per approach.")
    ] = False,
    lanelet2: Annotated[
        Path | None, about_file("Write Lanelet2 (.osm), and check it by reading it back.")
    ] = None,
    autoware: Annotated[
        Path | None,
        about(
            "Write a map folder of Autoware: lanelet2_map.osm and map_projector_info.yaml.",
            metavar="FOLDER",
            panel=OUTPUT,
        ),
    ] = None,
    geojson: Annotated[Path | None, about_file("Write the lanes as GeoJSON.")] = None,
    json_path: JsonPath = None,
) -> None:
    """Write a map for other programs.

    If the OpenDRIVE file differs from the map when it is read back, exit with 1.
    """
    if autoware is not None:
        if lanelet2 is not None:
            raise ConfigError("--autoware and --lanelet2: use only one of them")
    if (opendrive, lanelet2, autoware, geojson) == (None,) * 4:
        raise ConfigError(
            "the format is missing: give --opendrive, --lanelet2, --autoware or --geojson"
        )
    if carla and opendrive is None:
        raise ConfigError("--carla goes with --opendrive; add --opendrive FILE")
    console = Console()
    document: dict[str, Any] = {}
    sound = True
    stages = [_LOAD, *(STAGES if opendrive else ())]
    stages += [
        name for name, file in ((_LANELETS, lanelet2 or autoware), (_LINES, geojson)) if file
    ]
    with in_stages(console, stages) as told:
        told(_LOAD)
        path = find_map(env)
        network = load_network(path)
        if opendrive is not None:
            trip = write_opendrive(path, opendrive, told=told, for_carla=carla)
            _show(console, opendrive, trip)
            sound = trip.same
            document["opendrive"] = trip.to_dict()
        if target := lanelet2 or autoware:
            told(_LANELETS)
            write = write_lanelet2 if lanelet2 else write_map_folder
            document["lanelet2"] = found = write(network, target)
            told_back = f"{found['read back']} lanelets and {found['rules read back']} rules"
            console.print(Text(f"{target}: {told_back} read back"))
        if geojson is not None:
            told(_LINES)
            document["geojson"] = {"lanes": write_geojson(network, geojson, path)}
            console.print(Text(f"{geojson}: {document['geojson']['lanes']} lanes"))
    write_json(json_path, document)
    raise typer.Exit(0 if sound else 1)


def _show(console: Console, target: Path, trip: RoundTrip) -> None:
    def row(name: str) -> list[str]:
        values = [getattr(one, name) for one in (trip.map, trip.file, trip.read)]
        return [name, *(f"{one:.1f}" if isinstance(one, float) else str(one) for one in values)]

    rows = [row(one.name) for one in fields(CarRoads) if one.name != "merges"]
    console.print(grid([f"{target}: for cars", "map", "file", "read by netconvert"], rows))
    for problem in trip.problems:
        console.print(Text(f"{target}: {problem}", style="red"))
    if trip.read.links < trip.map.links or trip.read_off > MOST_OFF:
        words = (
            "where several lanes lead into one lane, netconvert reads only one of the links; it "
            "also shortens roads at junctions. The file itself is complete"
        )
        console.print(Text(f"note: {words}", style="yellow"))
