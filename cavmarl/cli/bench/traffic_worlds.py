"""`cavmarl bench traffic --worlds`: many worlds drawn by chance, ours beside SUMO in each."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cavmarl.bench.harness import make_table
from cavmarl.cli.output import grid, write_json
from cavmarl.core.progress import counting

if TYPE_CHECKING:
    from cavmarl.evaluate.traffic.world_rows import Row


def compare_worlds(
    worlds: int,
    first_seed: int,
    out: Path,
    seconds: int,
    dt: float,
    json_path: Path | None,
    without: tuple[str, ...],
    maps: Path | None,
) -> None:
    """Run the worlds that have no row yet; print what all rows come to, and the worst."""
    from cavmarl.evaluate.traffic.world_rows import (
        by_feature,
        comparable,
        summary,
        worst,
    )
    from cavmarl.evaluate.traffic.world_runs import KEPT, WorldSeries, run_worlds
    from cavmarl.maps.map_features import MAP_FEATURES

    job = WorldSeries(out, worlds, first_seed, seconds, dt, without, maps)
    console = Console()
    with counting(console, "worlds") as bar:
        rows = run_worlds(job, bar)
    found, parts = summary(rows), by_feature(rows)
    sound = comparable(rows)
    console.print(_shares(found))
    console.print(_shares(summary(sound), f", without {', '.join(sorted(MAP_FEATURES))}"))
    console.print(_features(parts))
    console.print(_worst(worst(rows, KEPT), out))
    found_sound = summary(sound)
    write_json(json_path, {"summary": found, "sound": found_sound, "features": parts, "rows": rows})


def _shares(found: Row, which: str = "") -> Table:
    title = f"{found['worlds']} worlds{which}, {found['failed']} failed"
    rows = [
        (label, *(_percent(found.get(name, {}).get(key)) for key in keys))
        for label, name in (
            ("mean speed", "mean_speed"),
            ("arrived", "arrived"),
            ("departed", "departed"),
            ("mean delay", "mean_delay"),
        )
        for keys in [("median", "median_size", "size_90", "share_near", "sumo_near")]
    ]
    contacts, queue = found.get("contacts", {}), found.get("queue", {})
    caption = (
        "near: within 15 % (speed), 5 % (arrived, departed), 25 % or 3 s (delay), or SUMO's own "
        "spread; SUMO near: each of its seeds, beside the others; contacts: "
        f"{contacts.get('ours')} in {contacts.get('worlds')} worlds "
        f"(SUMO {contacts.get('sumo')}); locks above 120 s that SUMO has not: "
        f"{found.get('own_locks')}; queue: {queue.get('ours', 0.0):.1f} "
        f"(SUMO {queue.get('sumo', 0.0):.1f})"
    )
    heads = ("over SUMO's mean, less 1", "median", "median size", "90 % below", "near", "SUMO near")
    return make_table(title, heads, rows, caption)


def _features(parts: dict[str, Row]) -> Table:
    rows = [
        (
            name,
            str(part["worlds"]),
            _percent(part.get("mean_speed", {}).get("median")),
            _percent(part.get("mean_speed", {}).get("size_90")),
            _percent(part.get("mean_speed", {}).get("share_near")),
            str(part.get("contacts", {}).get("ours", "-")),
        )
        for name, part in parts.items()
    ]
    heads = ("feature", "worlds", "speed, median", "90 % below", "near", "contacts")
    return make_table("by feature", heads, rows)


def _worst(rows: list[Row], out: Path) -> Table:
    from cavmarl.evaluate.traffic.world_rows import deviation
    from cavmarl.evaluate.traffic.world_runs import world_folder

    cells = []
    for row in rows:
        name = world_folder(out, row["seed"]).name
        if "error" in row:
            cells.append((name, row["error"].splitlines()[0], "failed", "-"))
        else:
            off, contacts = deviation(row, "mean_speed_mps"), row["ours"]["contacts"]
            cells.append((name, ", ".join(row["features"]), _percent(off), str(contacts)))
    title = f"the worst; files, commands and pictures are in {escape(str(out))}"
    return grid(("world", "features", "mean speed", "contacts"), cells, title, lefts=2)


def _percent(value: Any) -> str:
    return "-" if value is None else f"{100.0 * value:.1f} %"
