"""Random worlds: traffic compared with SUMO in each of them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from rich.markup import escape
from rich.table import Table

from benchmarks.map_features import MAP_FEATURES
from benchmarks.program import run
from benchmarks.world_rows import Row, by_feature, comparable, deviation, summary, worst
from benchmarks.world_runs import KEPT, WorldSeries, run_worlds, world_folder
from cavmarl.bench.harness import BenchmarkReport, Say, make_table, silent
from cavmarl.cli.output import about, grid, make_folder

_SHARES = {
    "median": "median",
    "median size": "median_size",
    "90 % below": "size_90",
    "near": "share_near",
    "SUMO near": "sumo_near",
}
_FIGURES = ("mean speed", "arrived", "departed", "mean delay")


def measure(
    worlds: Annotated[int, about("Number of worlds.")] = 100,
    first_seed: Annotated[int, about("Seed of the first world.")] = 0,
    seconds: Annotated[int, about("Simulated seconds of each world.")] = 900,
    dt: Annotated[float, about("Step length of cavmarl and SUMO, in seconds.")] = 0.1,
    out: Annotated[Path, about("Folder of the results; existing rows are kept.")] = Path(
        "traffic_worlds"
    ),
    without: Annotated[
        list[str] | None,
        about("A feature (see world_draw.py) to exclude from all worlds; repeatable."),
    ] = None,
    maps: Annotated[
        Path | None, about("Folder of maps to cut [default: those in SUMO's wheel].")
    ] = None,
    say: Say = silent,
) -> BenchmarkReport:
    """Draw worlds, run those that have no results yet, show a summary and the worst worlds."""
    make_folder(out)
    job = WorldSeries(out, worlds, first_seed, seconds, dt, tuple(without or ()), maps)

    def tell(done: int, count: int) -> None:
        if done < count:
            say(f"world {done + 1} of {count}")

    rows = run_worlds(job, tell)
    found, sound, parts = summary(rows), summary(comparable(rows)), by_feature(rows)
    sound_rows = _shares(sound)
    return BenchmarkReport(
        _title(found),
        {"deviation from SUMO's mean": "figure", **{head: head for head in _SHARES}},
        _shares(found),
        facts={"summary": found, "sound": sound, "features": parts, "worlds": rows},
        caption=_caption(found),
        tables=(
            make_table(
                f"{_title(sound)}, without {', '.join(sorted(MAP_FEATURES))}",
                ("deviation from SUMO's mean", *_SHARES),
                [[row["figure"], *(row[head] for head in _SHARES)] for row in sound_rows],
                _caption(sound),
            ),
            _features(parts),
            worst_table(worst(rows, KEPT), out),
        ),
    )


def _title(found: Row) -> str:
    return f"{found['worlds']} worlds, {found['failed']} failed"


def _shares(found: Row) -> list[dict[str, str]]:
    return [
        {
            "figure": label,
            **{
                head: _percent(found.get(label.replace(" ", "_"), {}).get(key))
                for head, key in _SHARES.items()
            },
        }
        for label in _FIGURES
    ]


def _caption(found: Row) -> str:
    contacts, queue = found.get("contacts", {}), found.get("queue", {})
    return (
        "median size, 90 % below: of absolute deviations; "
        "near: within 15 % (speed), 5 % (arrived, departed), 25 % or 3 s (delay), or SUMO's "
        "spread; SUMO near: each of its seeds, compared with the others; contacts: "
        f"{contacts.get('ours')} in {contacts.get('worlds')} worlds "
        f"(SUMO {contacts.get('sumo')}); locks above 120 s that SUMO does not have: "
        f"{found.get('own_locks')}; queue: {queue.get('ours', 0.0):.1f} "
        f"(SUMO {queue.get('sumo', 0.0):.1f})"
    )


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


def worst_table(rows: list[Row], out: Path) -> Table:
    """Return a table of these rows; `out` is the folder of the results."""
    cells = []
    for row in rows:
        name = world_folder(out, row["seed"]).name
        if "error" in row:
            cells.append((name, row["error"].splitlines()[0], "failed", "-"))
        else:
            off, contacts = deviation(row, "mean_speed_mps"), row["ours"]["contacts"]
            cells.append((name, ", ".join(row["features"]), _percent(off), str(contacts)))
    title = f"the worst worlds; their files, commands and pictures are in {escape(str(out))}"
    return grid(("world", "features", "mean speed", "contacts"), cells, title, lefts=2)


def _percent(value: Any) -> str:
    return "-" if value is None else f"{100.0 * value:.1f} %"


if __name__ == "__main__":
    run(measure)
