"""`cavmarl map build`: a road network of a map file, with heights."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from cavmarl.cli.map_check import print_report
from cavmarl.cli.output import JsonPath, about, grid, write_json
from cavmarl.core.errors import ConfigError
from cavmarl.core.progress import in_stages
from cavmarl.maps.check import check_map
from cavmarl.maps.heights.draping import MOST_GRADE, STEEP_GRADE, HeightOptions, HeightReport
from cavmarl.maps.netconvert import STAGES, Box, BuildResult, build_network
from cavmarl.roads.sumo_net.reader import map_name

Source = Annotated[
    Path,
    typer.Argument(
        help="A SUMO network, an OSM or an OpenDRIVE file.", exists=True, dir_okay=False
    ),
]

_NETWORK_ENDINGS = (".net.xml", ".net.xml.gz")
_SHOWN = 12


def build(
    source: Source,
    out: Annotated[
        Path | None, about("Default: NAME.net.xml in this folder.", "--out", "-o")
    ] = None,
    dem: Annotated[
        list[Path] | None,
        typer.Option(
            help="Heights of the ground: GeoTIFF or HGT; may be repeated.",
            exists=True,
            dir_okay=False,
        ),
    ] = None,
    origin: Annotated[
        str | None, about("LAT,LON of the map's x = y = 0; default: UTM, the roads' corner.")
    ] = None,
    limit_grade: Annotated[
        float | None,
        about("Flatten roads to this grade, as 0.15; default: as they are.", min=0.01),
    ] = None,
    max_grade: Annotated[
        float, about("Refuse roads that are steeper than the model may be.", min=0.01)
    ] = MOST_GRADE,
    licence: Annotated[str, about("Of the source; default: ODbL for OpenStreetMap.")] = "",
    dem_licence: Annotated[str, about("Of the heights.")] = "",
    tolerant: Annotated[bool, about("Leave out what netconvert cannot use, and list it.")] = False,
    bbox: Annotated[
        str | None,
        about("Keep roads within min,min,max,max: degrees lon,lat for OSM, else metres."),
    ] = None,
    timeout_s: Annotated[float | None, about("Seconds of netconvert; default 600.", min=1)] = None,
    json_path: JsonPath = None,
) -> None:
    """Make a SUMO network of a map file; its statistics go beside it, to NAME.stats.json."""
    target = out or Path(f"{map_name(source)}.net.xml")
    if not target.name.endswith(_NETWORK_ENDINGS):
        raise typer.BadParameter(
            f"'{target}' must end in {' or '.join(_NETWORK_ENDINGS)}", param_hint="--out"
        )
    if limit_grade is not None and not dem:
        raise ConfigError("--limit-grade: is for heights: give --dem too")
    heights = HeightOptions(tuple(dem), limit_grade, max_grade) if dem else None
    console = Console()
    with in_stages(console, [*STAGES, "checks"]) as told:
        result = build_network(
            source,
            target,
            bbox=_box(bbox),
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
            f"'{text}' is not four numbers: min,min,max,max", param_hint="--bbox"
        ) from error
    return west, south, east, north


def _origin(text: str | None) -> tuple[float, float] | None:
    if text is None:
        return None
    try:
        latitude, longitude = map(float, text.split(","))
    except ValueError as error:
        raise typer.BadParameter(
            f"'{text}' is not two numbers: LAT,LON", param_hint="--origin"
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
    for key in ("licence", "attribution", "projection", "origin"):
        if key in result.provenance:
            console.print(Text(f"{key}: {result.provenance[key]}"))
    if result.warnings:
        table = Table("count", "netconvert's warning")
        for text, count in list(result.warnings.items())[:_SHOWN]:
            table.add_row(str(count), Text(text))
        console.print(table)
        hidden = len(result.warnings) - _SHOWN
        if hidden > 0:
            console.print(f"… and {hidden} more kinds (all in the JSON)", style="dim")
    if result.defaults:
        rows = [
            [row.kind, row.guessed, row.value, f"{row.used_for} of {row.edges}"]
            for row in result.defaults
        ]
        console.print(grid(["kind of road", "not said", "taken", "edges"], rows))
    if result.heights is not None:
        _print_heights(console, result.heights)


def _print_heights(console: Console, heights: HeightReport) -> None:
    low, high = heights.heights_m
    lines = [
        f"heights: {low:.1f} to {high:.1f} m of {', '.join(heights.models)} "
        f"(cells of {heights.cell_m:.1f} m) at {heights.places} places; "
        f"{heights.filled_places} in voids, filled ({heights.void_cells} cells)",
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
        console.print(f"… and {hidden} more (all in the JSON)", style="dim")
