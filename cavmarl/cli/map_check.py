"""`cavmarl map check`: what a map holds, and what looks wrong in it."""

from __future__ import annotations

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from cavmarl.cli.output import Environment, JsonPath, write_json
from cavmarl.engine.world_setup import find_map
from cavmarl.maps.check import MapReport, check_map


def check(env: Environment, json_path: JsonPath = None) -> None:
    """Say what a map holds and whether it can be driven; exit code 1 if it cannot."""
    console = Console()
    with console.status(f"checking {env} …"):
        report = check_map(find_map(env))
    print_report(console, report)
    write_json(json_path, report.to_dict())
    raise typer.Exit(0 if report.drivable else 1)


def print_report(console: Console, report: MapReport) -> None:
    """What a map holds, as a table, and what is wrong with it."""
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
