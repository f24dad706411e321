"""`cavmarl bench rays`: what mounted sensors take."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from cavmarl.cli.output import JsonPath, write_json

__all__ = ["rays"]


def rays(
    repeats: Annotated[int, typer.Option(help="Measurements of each, by turns.")] = 5,
    json_path: JsonPath = None,
) -> None:
    """Time of each sensor of the rig `ten_sensors`, and of all, at 400 cars/km² on one core."""
    from cavmarl.bench.sensor_speed import measure_sensor_speed

    console = Console()
    with console.status("") as status:
        found = measure_sensor_speed(repeats, status.update)
    table = Table("sensor", "sample", "µs a sample", "ns a number")
    for row in found.rows:
        table.add_row(
            row.name,
            ", ".join(map(str, row.shape)),
            f"{row.median_us:.1f} ({row.low_us:.1f} to {row.high_us:.1f})",
            f"{1e3 * row.median_us / row.numbers:.1f}",
        )
    console.print(table)
    console.print(
        f"{found.cars_per_km2:.0f} cars/km²: the plane lidar takes "
        f"[bold]{found.lidar_ns:.1f} ns[/] a ray, a depth and a semantic picture "
        f"[bold]{found.cameras_ms:.3f} ms[/],\n"
        f"all ten sensors of one vehicle [bold]{found.tick_ms:.2f} ms[/] a tick"
    )
    write_json(json_path, found.to_dict())
