"""`cavmarl map`: builds road networks, checks and divides them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from cavmarl.cli import map_fidelity, map_zones
from cavmarl.cli.output import Environment, JsonPath, about, write_json
from cavmarl.engine.world_setup import find_map
from cavmarl.maps.check import MapReport, check_map
from cavmarl.maps.netconvert import Box, BuildResult, build_network
from cavmarl.roads.sumo_net.reader import map_name

app = typer.Typer(
    help="Build road networks, check that they can be driven, and divide them.",
    no_args_is_help=True,
)

Source = Annotated[
    Path,
    typer.Argument(
        help="A SUMO network, an OSM or an OpenDRIVE file.", exists=True, dir_okay=False
    ),
]

app.command("zones")(map_zones.zones)
app.command("fidelity")(map_fidelity.fidelity)

_NETWORK_ENDINGS = (".net.xml", ".net.xml.gz")
_SHOWN_WARNINGS = 12


@app.command()
def build(
    source: Source,
    out: Annotated[
        Path | None, about("Default: NAME.net.xml in this folder.", "--out", "-o")
    ] = None,
    tolerant: Annotated[bool, about("Leave out what netconvert cannot use, and list it.")] = False,
    bbox: Annotated[
        str | None,
        about("Keep roads within min,min,max,max: degrees lon,lat for OSM, else metres."),
    ] = None,
    timeout_s: Annotated[float, about("Seconds that netconvert may take.", min=1.0)] = 600.0,
    json_path: JsonPath = None,
) -> None:
    """Make a SUMO network of a map file; its statistics go beside it, to NAME.stats.json."""
    target = out or Path(f"{map_name(source)}.net.xml")
    if not target.name.endswith(_NETWORK_ENDINGS):
        raise typer.BadParameter(
            f"'{target}' must end in {' or '.join(_NETWORK_ENDINGS)}", param_hint="--out"
        )
    console = Console()
    with console.status(f"building {target} …"):
        box = _box(bbox)
        result = build_network(source, target, bbox=box, tolerant=tolerant, timeout_s=timeout_s)
        report = check_map(result.path)
    document = {"build": result.to_dict(), "map": report.to_dict()}
    _print_build(console, result)
    _print_report(console, report)
    write_json(target.with_name(f"{map_name(target)}.stats.json"), document)
    write_json(json_path, document)
    raise typer.Exit(0 if report.drivable else 1)


@app.command()
def check(env: Environment, json_path: JsonPath = None) -> None:
    """Say what a map holds and whether it can be driven; exit code 1 if it cannot."""
    console = Console()
    with console.status(f"checking {env} …"):
        report = check_map(find_map(env))
    _print_report(console, report)
    write_json(json_path, report.to_dict())
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


def _print_build(console: Console, result: BuildResult) -> None:
    console.print(Text(f"{result.source} ({result.kind}) → {result.path}", style="bold"))
    if result.options:
        console.print(Text(f"netconvert {' '.join(result.options)}", style="dim"))
    for line in result.corrections:
        console.print(Text(f"corrected: {line}"))
    for line in result.dropped:
        console.print(Text(f"dropped: {line}", style="yellow"))
    if result.warnings:
        table = Table("count", "netconvert's warning")
        for text, count in list(result.warnings.items())[:_SHOWN_WARNINGS]:
            table.add_row(str(count), Text(text))
        console.print(table)
        hidden = len(result.warnings) - _SHOWN_WARNINGS
        if hidden > 0:
            console.print(f"… and {hidden} more kinds (all in the JSON)", style="dim")


def _print_report(console: Console, report: MapReport) -> None:
    table = Table(title=Text(report.name), show_header=False)
    min_x, min_y, max_x, max_y = report.extent_m
    share = f"{report.connected_share:.0%}"
    kinds = ", ".join(f"{count} {kind}" for kind, count in report.junctions_by_type.items())
    rows = {
        "road / lane length": f"{report.road_km:.2f} km / {report.lane_km:.2f} km",
        "edges / lanes": f"{report.edges} / {report.lanes}",
        "junctions": f"{report.junctions} (nodes: {kinds})",
        "traffic lights": f"{report.signals} ({report.actuated_signals} actuated), "
        f"{report.programs} programs",
        "extent": f"{max_x - min_x:.0f} m x {max_y - min_y:.0f} m",
        "elevation": f"{report.elevation_m[0]:.1f} to {report.elevation_m[1]:.1f} m",
        "steepest grade": f"{report.max_grade:.1%}",
        "connected": f"{report.connected_edges}/{report.edges} edges ({share})",
        "horizon without env.yaml": f"{report.horizon_s:g} s",
        "drivable": "yes" if report.drivable else "NO",
    }
    for key, value in rows.items():
        table.add_row(key, value)
    console.print(table)
    for line in report.problems:
        console.print(Text(f"problem: {line}", style="red"))
    for line in report.notes:
        console.print(Text(f"note: {line}"))
