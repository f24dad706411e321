"""`cavmarl map check`: prints statistics and defects of a map."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from cavmarl.cli.output import Environment, JsonPath, about, about_file, flag, grid, write_json
from cavmarl.core.errors import ConfigError
from cavmarl.core.progress import in_stages
from cavmarl.engine.world_setup import find_map
from cavmarl.maps.check import MapReport, check_map
from cavmarl.maps.check_page import write_check_page
from cavmarl.maps.defects import SEARCHES, Defect, find_defects
from cavmarl.maps.repair import mend
from cavmarl.roads.cache import load_network

if TYPE_CHECKING:
    from cavmarl.cosim.carla.client_map_check import ClientMapReport

_SHOWN = 12
_READ, _COUNT, _CLIENT, _PAGE, _REPAIR = "reading", "figures", "CARLA's client", "page", "repair"


def check(
    env: Environment,
    buildings: Annotated[
        Path | None,
        about(
            "OSM file or SUMO polygons; buildings on roads are reported.",
            metavar="FILE",
            exists=True,
        ),
    ] = None,
    fix: Annotated[
        Path | None, about_file("Write a repaired network to this .net.xml file.")
    ] = None,
    carla: Annotated[
        bool,
        flag(
            "Also read the map with CARLA's client, and compare. The environment variable "
            "CAVMARL_CARLA_PYTHON names a Python that has the client."
        ),
    ] = False,
    page: Annotated[
        Path | None, about_file("Write a page with a picture in which defects are marked.")
    ] = None,
    json_path: JsonPath = None,
) -> None:
    """Print the statistics and defects of a map.

    If the map cannot be driven, or CARLA's client reads it differently, exit with 1.
    """
    if fix is not None and not fix.name.endswith(".net.xml"):
        raise ConfigError(f"--fix {fix}: must end in .net.xml")
    if carla:
        from cavmarl.cosim.carla.client_map_check import check_with_client
        from cavmarl.cosim.carla.client_process import client_python

        client_python()  # raises an error early if CARLA's client is missing
    console = Console()
    done: list[str] = []
    left: list[Defect] = []
    reading: ClientMapReport | None = None
    with in_stages(console, [_READ, _COUNT, *SEARCHES, _CLIENT, _PAGE, _REPAIR]) as told:
        told(_READ)
        path = find_map(env)
        network = load_network(path)
        told(_COUNT)
        report = check_map(network)
        defects = find_defects(network, path, buildings, told)
        if carla:
            told(_CLIENT)
            reading = check_with_client(network, path, Path(env) if Path(env).is_file() else path)
        if page is not None:
            told(_PAGE)
            write_check_page(page, network, defects)
        if fix is not None:
            told(_REPAIR)
            done, left = mend(path, fix, defects)
    print_report(console, report)
    _print_defects(console, defects)
    document = report.to_dict() | {"defects": [defect.to_dict() for defect in defects]}
    if reading is not None:
        _print_reading(console, env, reading)
        document["carla"] = reading.to_dict()
    if fix is not None:
        for line in done:
            console.print(Text(f"repaired: {line}"))
        console.print(
            Text(f"{fix}: {len(done)} defects repaired, {len(left)} left for you to repair")
        )
        document |= {"repaired": done, "left": [defect.to_dict() for defect in left]}
    write_json(json_path, document)
    is_read = reading is None or not reading.problems
    raise typer.Exit(0 if report.drivable and is_read else 1)


def _print_reading(console: Console, env: str, reading: ClientMapReport) -> None:
    from cavmarl.cosim.carla.client_map_check import OFF_LIMIT_M, SHARE_LIMIT, TURN_LIMIT_DEG

    rows = [
        [
            "95 % of the points on lanes are off by",
            f"{reading.off_m.usual:.2f} m",
            f"{OFF_LIMIT_M:g} m",
        ],
        [
            "95 % of the points on lanes are turned by",
            f"{reading.turned_deg.usual:.1f}°",
            f"{TURN_LIMIT_DEG:g}°",
        ],
    ]
    rows += [
        [name, f"{share.found} of {share.total}", f"{SHARE_LIMIT:.0%}"]
        for name, share in reading.shares.items()
    ]
    rows.append(["traffic lights", str(reading.landmarks), ""])
    console.print(grid([f"{env}: read by CARLA's client", "found", "limit"], rows))
    for problem in reading.problems:
        console.print(Text(f"CARLA: {problem}", style="red"))


def _print_defects(console: Console, defects: Sequence[Defect]) -> None:
    counts = Counter(defect.kind for defect in defects)
    for kind, count in counts.items():
        console.print(Text(f"{count} x {kind}", style="yellow"))
    rows = [
        [defect.kind, defect.name, f"{defect.x_m:.1f}, {defect.y_m:.1f}", defect.about]
        for defect in defects[:_SHOWN]
    ]
    if rows:
        console.print(grid(["kind", "name", "x, y (m)", ""], rows, wraps=True))
    if len(defects) > _SHOWN:
        console.print(
            f"… and {len(defects) - _SHOWN} more; --page and --json list all", style="dim"
        )


def print_report(console: Console, report: MapReport) -> None:
    """Print a map's statistics as a table, and its problems."""
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
