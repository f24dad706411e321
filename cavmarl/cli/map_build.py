"""`cavmarl map build`: builds a road network from a map file, with heights."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from cavmarl.cli.map_check import print_report
from cavmarl.cli.output import (
    OUTPUT,
    JsonPath,
    about,
    flag,
    grid,
    write_json,
)
from cavmarl.core.errors import ConfigError
from cavmarl.core.progress import in_stages
from cavmarl.maps.check import check_map
from cavmarl.maps.heights.draping import MOST_GRADE, STEEP_GRADE, HeightOptions, HeightReport
from cavmarl.maps.netconvert import STAGES, Box, BuildResult, build_network
from cavmarl.roads.sumo_net.reader import map_name

Source = Annotated[
    Path,
    typer.Argument(
        metavar="MAP",
        help="Map file: a SUMO network or .sumocfg, OSM, OpenDRIVE, or a logged scene.",
        exists=True,
        dir_okay=False,
    ),
]

_NETWORK_ENDINGS = (".net.xml", ".net.xml.gz")
_SHOWN = 12


def build(
    source: Source,
    out: Annotated[
        Path | None,
        about(
            "Network file to write [default: NAME.net.xml in this folder].",
            "--out",
            "-o",
            metavar="FILE",
            panel=OUTPUT,
        ),
    ] = None,
    dem: Annotated[
        list[Path] | None,
        typer.Option(
            help="Elevation model: GeoTIFF or HGT. Repeat it for more files.",
            metavar="FILE",
            exists=True,
            dir_okay=False,
        ),
    ] = None,
    traffic_side: Annotated[
        Literal["auto", "left", "right"],
        about(
            "Side of the road to drive on; auto: the side of the country (OSM), or the attribute "
            "`rule` of the roads (OpenDRIVE).",
        ),
    ] = "auto",
    origin: Annotated[
        str | None,
        about(
            "Geographic position of x = y = 0 [default: the corner of the roads, in UTM].",
            metavar="LAT,LON",
        ),
    ] = None,
    limit_grade: Annotated[
        float | None,
        about(
            "Flatten steeper roads to this grade, for example 0.15 [default: no limit].",
            metavar="X",
            min=0.01,
        ),
    ] = None,
    max_grade: Annotated[
        float, about("Refuse maps with roads steeper than this grade.", metavar="X", min=0.01)
    ] = MOST_GRADE,
    licence: Annotated[
        str, about("Licence of the map file [default: ODbL for OSM].", metavar="NAME")
    ] = "",
    dem_licence: Annotated[str, about("Licence of the elevation model.", metavar="NAME")] = "",
    tolerant: Annotated[
        bool, flag("Leave out elements that netconvert cannot use, and list them.")
    ] = False,
    bbox: Annotated[
        str | None,
        about(
            "Keep only roads in this box, in degrees for OSM and otherwise in metres.",
            metavar="WEST,SOUTH,EAST,NORTH",
        ),
    ] = None,
    timeout_s: Annotated[
        float | None,
        about("Time limit of netconvert in seconds [default: 600].", metavar="S", min=1),
    ] = None,
    json_path: JsonPath = None,
) -> None:
    """Build a SUMO network from a map file.

    The statistics are written to NAME.stats.json beside it. If the map cannot be driven, exit with
    1.
    """
    target = out or Path(f"{map_name(source)}.net.xml")
    if not target.name.endswith(_NETWORK_ENDINGS):
        raise typer.BadParameter(
            f"'{target}' must end in {' or '.join(_NETWORK_ENDINGS)}", param_hint="--out"
        )
    if limit_grade is not None and not dem:
        raise ConfigError("--limit-grade: needs heights; add --dem FILE")
    heights = HeightOptions(tuple(dem), limit_grade, max_grade) if dem else None
    console = Console()
    with in_stages(console, [*STAGES, "checks"]) as told:
        result = build_network(
            source,
            target,
            bbox=_box(bbox),
            side=None if traffic_side == "auto" else traffic_side,
            origin=_origin(origin),
            heights=heights,
            licences=(licence, dem_licence),
            tolerant=tolerant,
            timeout_s=timeout_s,
            told=told,
        )
        told("checks")
        report = check_map(result.path)
    document = {"build": result.to_dict(), "map": report.to_dict()}
    _print_build(console, result)
    print_report(console, report)
    write_json(target.with_name(f"{map_name(target)}.stats.json"), document)
    write_json(json_path, document)
    raise typer.Exit(0 if report.drivable else 1)


def _box(text: str | None) -> Box | None:
    if text is None:
        return None
    try:
        west, south, east, north = map(float, text.split(","))
    except ValueError as error:
        raise typer.BadParameter(
            f"'{text}' must be four numbers, WEST,SOUTH,EAST,NORTH", param_hint="--bbox"
        ) from error
    return west, south, east, north


def _origin(text: str | None) -> tuple[float, float] | None:
    if text is None:
        return None
    try:
        latitude, longitude = map(float, text.split(","))
    except ValueError as error:
        raise typer.BadParameter(
            f"'{text}' must be two numbers, LAT,LON", param_hint="--origin"
        ) from error
    return latitude, longitude


def _print_build(console: Console, result: BuildResult) -> None:
    console.print(Text(f"{result.source} ({result.kind}) → {result.path}", style="bold"))
    if result.options:
        console.print(Text(f"netconvert {' '.join(result.options)}", style="dim"))
    for line in result.corrections:
        console.print(Text(f"corrected: {line}"))
    for line in result.dropped:
        console.print(Text(f"dropped: {line}", style="yellow"))
    for key in ("licence", "attribution", "projection", "origin", "traffic side"):
        if key in result.provenance:
            console.print(Text(f"{key}: {result.provenance[key]}"))
    if result.warnings:
        table = Table("count", "netconvert's warning")
        for text, count in list(result.warnings.items())[:_SHOWN]:
            table.add_row(str(count), Text(text))
        console.print(table)
        hidden = len(result.warnings) - _SHOWN
        if hidden > 0:
            console.print(f"… and {hidden} more kinds; --json lists all", style="dim")
    if result.defaults:
        rows = [
            [row.kind, row.guessed, row.value, f"{row.used_for} of {row.edges}"]
            for row in result.defaults
        ]
        console.print(grid(["kind of road", "missing", "default", "used for"], rows))
    for line in result.notes:
        console.print(Text(f"note: {line}", style="yellow"))
    if result.heights is not None:
        _print_heights(console, result.heights)


def _print_heights(console: Console, heights: HeightReport) -> None:
    low, high = heights.heights_m
    lines = [
        f"heights: {low:.1f} to {high:.1f} m of {', '.join(heights.models)} "
        f"(cells of {heights.cell_m:.1f} m) at {heights.places} places; "
        f"{heights.void_cells} cells have no height, so {heights.filled_places} places are "
        "interpolated",
        f"bridges and tunnels: {len(heights.raised_edges)} edges, {heights.crossings} crossings of "
        f"lanes, ramps at {heights.ramp_places} places",
        f"flattened: {heights.smoothed_places} places, by {heights.most_smoothed_m:.2f} m at most; "
        f"steepest road {heights.max_grade:.1%}",
    ]
    for line in lines:
        console.print(Text(line))
    for line in heights.steep[:_SHOWN]:
        console.print(Text(f"warning: steeper than {STEEP_GRADE:.0%}: {line}", style="yellow"))
    hidden = len(heights.steep) - _SHOWN
    if hidden > 0:
        console.print(f"… and {hidden} more; --json lists all", style="dim")
