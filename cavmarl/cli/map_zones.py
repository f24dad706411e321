"""`cavmarl map zones`: divides a map into zones and prints their statistics."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from cavmarl.cli.output import (
    Environment,
    JsonPath,
    about,
    about_file,
    flag,
    write_json,
)
from cavmarl.config.zones import ZONE_LAYOUTS
from cavmarl.core.errors import ConfigError
from cavmarl.engine.world_setup import find_map
from cavmarl.roads.cache import load_network
from cavmarl.roads.network import RoadNetwork
from cavmarl.zones.partition.zone_file import named_zones, write_zones
from cavmarl.zones.partition.zone_loops import zones_without_loop
from cavmarl.zones.partition.zone_partition import ZonePartition
from cavmarl.zones.partition.zone_statistics import ZoneStatistics, zone_statistics


def zones(
    env: Environment,
    count: Annotated[
        int | None, about("Number of zones [default: 4, or as in a zone file].", metavar="K")
    ] = None,
    layout: Annotated[
        str,
        about(f"Shape of the zones: {', '.join(ZONE_LAYOUTS)}, or a zone file.", metavar="LAYOUT"),
    ] = "bisection",
    avoid_junctions: Annotated[
        bool, flag("Move borders so that they cut no junctions.", "--avoid-junctions")
    ] = False,
    weight: Annotated[
        str,
        about("Quantity that bisection divides: lane_length, or uniform (area).", metavar="NAME"),
    ] = "lane_length",
    halo: Annotated[
        float,
        about(
            "Width of the halo in metres: how far zones see past their borders.",
            metavar="M",
            min=0.0,
        ),
    ] = 100.0,
    out: Annotated[Path | None, about_file("Write the zones to this file.", "--out", "-o")] = None,
    picture: Annotated[
        Path | None, about_file("Draw the map with its zones to this .png file.")
    ] = None,
    json_path: JsonPath = None,
) -> None:
    """Divide a map into zones, and print the statistics of each zone."""
    if picture is not None and picture.suffix != ".png":
        raise typer.BadParameter(f"'{picture}' must end in .png", param_hint="--picture")
    network = load_network(find_map(env))
    partition = named_zones(network, layout, count, avoid_junctions=avoid_junctions, weight=weight)
    statistics = zone_statistics(partition, network, halo_m=halo)
    console = Console()
    _print_table(console, network, partition, statistics)
    loopless = zones_without_loop(network, partition)
    _print_notes(console, partition, statistics, halo)
    if loopless:
        console.print(
            f"note: zones without a closed loop of roads: {_named(loopless)}", soft_wrap=True
        )
    if out is not None:
        write_zones(out, partition)
        console.print(f"zones: {out}", markup=False)
    if picture is not None:
        _draw(network, partition, halo, picture)
        console.print(f"picture: {picture}", markup=False)
    write_json(
        json_path,
        {
            "map": network.name,
            "map_content_sha256": network.content_hash,
            "zones_sha256": partition.content_hash,
            "halo_m": halo,
            "bounds_m": list(partition.bounds),
            "rects_m": partition.rects.tolist(),
            "neighbors": [[other.zone for other in row] for row in partition.neighbors],
            "statistics": statistics.to_dict(),
            "without_loop": list(loopless),
        },
    )


def _print_table(
    console: Console, network: RoadNetwork, partition: ZonePartition, statistics: ZoneStatistics
) -> None:
    table = Table(title=Text(network.name), show_edge=False)
    for heading in ("zone", "x, m", "y, m", "lanes, km", "cut"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("neighbours, *: corner")
    for zone, (min_x, min_y, max_x, max_y) in enumerate(partition.rects.tolist()):
        table.add_row(
            str(zone),
            f"{min_x:.0f} … {max_x:.0f}",
            f"{min_y:.0f} … {max_y:.0f}",
            f"{statistics.lane_km[zone]:.2f}",
            str(statistics.cut_junctions[zone]),
            " ".join(f"{near.zone}{'*' * near.corner}" for near in partition.neighbors[zone]),
        )
    console.print(table)


def _print_notes(
    console: Console, partition: ZonePartition, statistics: ZoneStatistics, halo_m: float
) -> None:
    console.print(
        f"imbalance of lanes (max / mean): {statistics.lane_imbalance:.3f}; "
        f"junctions cut: {statistics.junctions_cut} of {statistics.junctions}"
    )
    console.print(f"hash: {partition.content_hash}", soft_wrap=True)
    if statistics.narrow:
        console.print(
            f"note: narrower than the halo of {halo_m:g} m: zones {_named(statistics.narrow)}; "
            "results stay exact, but such a zone processes more ghosts than vehicles",
            style="yellow",
            soft_wrap=True,
        )


def _named(numbers: Sequence[int]) -> str:
    return ", ".join(map(str, numbers))


def _draw(network: RoadNetwork, partition: ZonePartition, halo_m: float, path: Path) -> None:
    from cavmarl.render.canvas import load_pygame
    from cavmarl.render.zone_overlay import zone_picture

    surface = zone_picture(network, partition, halo_m, network.name)
    try:
        load_pygame().image.save(surface, str(path))
    except (OSError, load_pygame().error) as error:
        raise ConfigError(f"{path}: cannot be written: {error}") from error
