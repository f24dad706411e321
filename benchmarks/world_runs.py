"""Runs of many random worlds, with results in a folder from which a run can resume."""

from __future__ import annotations

import json
import shlex
import shutil
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.map_features import map_features
from benchmarks.world_draw import WorldDraw, check_features, draw_world
from benchmarks.world_files import NET_FILE, ROUTES_FILE, cut_maps, make_files
from benchmarks.world_rows import Row, failed_row, row_of, worst
from cavmarl.config.env import ClockConfig
from cavmarl.core.errors import CavmarlError, ConfigError, require
from cavmarl.engine.simulation import Simulation
from cavmarl.evaluate.traffic.traffic_comparison import compare_traffic
from cavmarl.evaluate.traffic.traffic_plot import plot_fundamental_diagram
from cavmarl.render.topdown import WorldView
from cavmarl.roads.cache import load_network

ROWS_FILE, SETTINGS_FILE = "worlds.jsonl", "settings.json"
KEPT = 10  # number of worlds whose files are kept
SUMO_SEEDS = 3


@dataclass(frozen=True)
class WorldSeries:
    """A series of worlds and its settings."""

    out: Path  # folder of the results
    count: int  # number of worlds
    first_seed: int  # first of consecutive seeds
    seconds: int = 400  # simulated duration of both runs, in cavmarl and SUMO
    dt_s: float = 0.1  # step length of both runs
    without: tuple[str, ...] = ()  # features to exclude
    maps: Path | None = None  # folder of maps to cut; None: those in SUMO's wheel
    cut_from: tuple[Path, ...] = field(default=(), init=False)

    def __post_init__(self) -> None:
        if self.count < 1:
            raise ConfigError(f"worlds = {self.count}: must be at least 1")
        if self.first_seed < 0:
            raise ConfigError(f"first_seed = {self.first_seed}: must be 0 or more")
        ClockConfig(self.dt_s, self.dt_s)
        check_features(self.without)
        require("libsumo", "sumo")
        object.__setattr__(self, "cut_from", cut_maps(self.maps))

    def settings(self) -> dict[str, Any]:
        """Return the settings that rows of one folder share."""
        maps = None if self.maps is None else str(self.maps)
        own = {"seconds": self.seconds, "dt_s": self.dt_s, "without": sorted(self.without)}
        return own | {"maps": maps}

    def seeds(self) -> range:
        return range(self.first_seed, self.first_seed + self.count)


def run_worlds(
    job: WorldSeries, progress: Callable[[int, int], None] = lambda done, count: None
) -> list[Row]:
    """Run the worlds that have no row yet; return the rows of all worlds, by seed.

    A row is added to `worlds.jsonl` when its world is done. The files of the worst worlds so far
    are kept.

    Args:
        job: the series.
        progress: called with the numbers of completed and of all worlds.

    Raises:
        ConfigError: the folder has rows with other settings, or an invalid row.
        MissingExtraError: SUMO, matplotlib or pygame is not installed.
    """
    require("matplotlib", "report")
    _check_settings(job)
    rows = {row["seed"]: row for row in read_rows(job.out / ROWS_FILE)}
    for done, seed in enumerate(job.seeds()):
        progress(done, job.count)
        if seed in rows:
            continue
        rows[seed] = run_world(job, seed)
        with (job.out / ROWS_FILE).open("a", encoding="utf-8") as file:
            file.write(json.dumps(rows[seed]) + "\n")
        _drop_files(job.out, list(rows.values()))
    progress(job.count, job.count)
    return [rows[seed] for seed in job.seeds()]


def read_rows(path: Path) -> Iterator[Row]:
    """Yield the rows of a file; a missing file has no rows.

    Raises ConfigError: a line is not a row.
    """
    if not path.exists():
        return
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        try:
            row = json.loads(line)
            int(row["seed"])
        except (ValueError, KeyError, TypeError) as error:
            raise ConfigError(f"{path}, line {number}: not a valid row; remove the line") from error
        yield row


def world_folder(out: Path, seed: int) -> Path:
    """Return the folder of a world's files."""
    return out / f"world_{seed:06d}"


def _check_settings(job: WorldSeries) -> None:
    path = job.out / SETTINGS_FILE
    text = json.dumps(job.settings())
    if not path.exists():
        path.write_text(text + "\n", encoding="utf-8")
    elif path.read_text(encoding="utf-8").strip() != text:
        raise ConfigError(
            f"{path}: has rows with other settings ({path.read_text(encoding='utf-8').strip()}): "
            "choose another --out"
        )


def run_world(job: WorldSeries, seed: int) -> Row:
    """Draw a world, run it here and in SUMO, and return its row."""
    draw = draw_world(seed, job.without)
    folder = world_folder(job.out, seed)
    shutil.rmtree(folder, ignore_errors=True)  # files of an interrupted run
    try:
        net, routes = make_files(draw, folder, job.seconds, job.cut_from)
        _write_commands(job, draw, folder)
        found = compare_traffic(
            net,
            [routes],
            seconds=job.seconds,
            dt_s=job.dt_s,
            seed=seed,
            sumo_seeds=SUMO_SEEDS,
            finished=lambda world: _draw_end(world, folder / "end.png"),
        )
    except CavmarlError as error:
        return failed_row(draw, job.seconds, job.dt_s, error)
    plot_fundamental_diagram(found, folder / "flow.png")
    return row_of(draw, found, map_features(load_network(net)))


def _write_commands(job: WorldSeries, draw: WorldDraw, folder: Path) -> None:
    """Write a README with the world's properties and the commands to run it again."""
    net, routes = folder / NET_FILE, folder / ROUTES_FILE
    words = ["cavmarl", "bench", "traffic", str(net), "--demand", str(routes)]
    words += [f"--seconds={job.seconds}", f"--dt={job.dt_s:g}", f"--seed={draw.seed}"]
    again = ["python", "-m", "benchmarks", "traffic_worlds", "--worlds=1"]
    again += [f"--first-seed={draw.seed}"]
    again += [f"--seconds={job.seconds}", f"--dt={job.dt_s:g}", "--out=AGAIN"]
    again += [f"--without={name}" for name in job.without]
    again += [] if job.maps is None else [f"--maps={job.maps}"]
    tool = "netconvert" if draw.net.kind == "cut" else "netgenerate"
    text = (
        f"World of seed {draw.seed}: {', '.join(draw.features)}\n\n"
        f"{shlex.join(words)}\n{shlex.join(again)}\n\n"
        f"{tool} {shlex.join(draw.net.options)} --seed={draw.seed}\n{draw.demand}\n"
    )
    (folder / "README.txt").write_text(text, encoding="utf-8")


def _draw_end(world: Simulation, path: Path) -> None:
    image = require("matplotlib.image", "report")
    view = WorldView(world, "rgb_array", path.parent.name, fps=1)
    try:
        image.imsave(path, view.show())
    finally:
        view.close()


def _drop_files(out: Path, rows: Sequence[Row]) -> None:
    """Delete all files except the files of the worst worlds."""
    kept: Collection[int] = {row["seed"] for row in worst(rows, KEPT)}
    for row in rows:
        if row["seed"] not in kept:
            shutil.rmtree(world_folder(out, row["seed"]), ignore_errors=True)
