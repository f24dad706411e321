"""`cavmarl map survey`: makes a point-cloud map by driving through a world with a lidar."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
from rich.console import Console
from rich.text import Text

from cavmarl.cli.output import (
    Environment,
    Imports,
    JsonPath,
    Seed,
    about,
    about_file,
    grid,
    parse_settings,
    write_json,
)
from cavmarl.core.errors import ConfigError
from cavmarl.core.progress import counting
from cavmarl.maps.fidelity.cloud_files import Cloud, write_cloud
from cavmarl.maps.fidelity.exports import write_page, write_points

_TICK_S = 0.05


def survey(
    env: Environment,
    out: Annotated[Path, about_file("Point cloud to write (.ply or .csv).", "--out", "-o")],
    time_s: Annotated[
        float, about("Simulated seconds that each vehicle drives.", metavar="S", min=10.0)
    ] = 60.0,
    vehicles: Annotated[
        int, about("Number of vehicles, each in its own world.", metavar="N", min=1, max=64)
    ] = 4,
    seed: Seed = 0,
    imports: Imports = None,
    buildings: Annotated[
        str | None,
        about("Buildings: osm, or a file beside the map (key map.buildings).", metavar="SOURCE"),
    ] = None,
    range_m: Annotated[
        float, about("Keep echoes up to this range in metres.", "--range", metavar="M", min=2.0)
    ] = 30.0,
    voxel: Annotated[
        float, about("Keep one point per cube of this side in metres.", metavar="M", min=0.02)
    ] = 0.2,
    points: Annotated[
        Path | None, about_file("Write the distance of each point (.csv, .ply).")
    ] = None,
    page: Annotated[Path | None, about_file("Write a page with a 3-D picture.")] = None,
    json_path: JsonPath = None,
) -> None:
    """Map a world with lidar, GNSS and IMU, and compare the cloud with the map's surface."""
    from cavmarl.cosim.lidar_survey import SURVEY_RIG, Surveyor
    from cavmarl.cosim.survey_fit import fit_survey
    from cavmarl.env.vector import make_vec

    if out.suffix.lower() not in (".ply", ".csv"):
        raise ConfigError(f"--out {out}: must end in .ply or .csv")
    overrides: dict[str, Any] = parse_settings(None, imports)
    overrides |= {"rig": SURVEY_RIG, "clock.ctrl_dt_s": _TICK_S}
    if buildings is not None:
        overrides["map.buildings"] = buildings
    console = Console()
    worlds = make_vec(
        env, num_envs=vehicles, agents=1, background=0, workers=0, overrides=overrides
    )
    steps = round(time_s / _TICK_S)
    try:
        worlds.reset(seed=seed)
        with counting(console, "driving") as told:
            found = Surveyor(worlds, range_m, voxel).run(steps, lambda step: told(step, steps))
        if not len(found.cloud.points):
            raise ConfigError(
                f"--time-s {time_s:g}: no lidar frame was recorded; choose a longer time"
            )
        with console.status("comparing with the map …"):
            fit, comparison = fit_survey(found.cloud, worlds.network)
    finally:
        worlds.close()
    write_cloud(out, Cloud(found.cloud.name, found.cloud.points))
    document = {
        "frames": found.frames,
        "drives": found.drives,
        "points": len(found.cloud.points),
        "pose": {
            "mean_off_m": float(found.off_m.mean()),
            "p95_off_m": float(np.quantile(found.off_m, 0.95)),
            "mean_off_height_m": float(np.abs(found.off_height_m).mean()),
            "mean_off_heading_deg": float(np.degrees(np.abs(found.off_heading_rad).mean())),
        },
        "surface": fit.to_dict(),
        "comparison": comparison.to_dict(),
    }
    _print(console, document)
    console.print(Text(f"cloud: {out}"))
    if points is not None:
        write_points(points, comparison)
    if page is not None:
        write_page(page, [comparison])
    write_json(json_path, document)


def _print(console: Console, document: dict[str, Any]) -> None:
    pose, surface, told = document["pose"], document["surface"], document["comparison"]
    rows = [
        ["frames / drives / points", " / ".join(str(document[k]) for k in _COUNTS)],
        ["position error, mean / 95 %, m", f"{pose['mean_off_m']:.3f} / {pose['p95_off_m']:.3f}"],
        ["height error, mean, m", f"{pose['mean_off_height_m']:.3f}"],
        ["heading error, mean, °", f"{pose['mean_off_heading_deg']:.3f}"],
        ["lanes seen", f"{surface['seen_share']:.0%}"],
        ["road heights, RMSE, m", f"{surface['height_rmse_m']:.3f}"],
        ["walls, RMSE across, m", _shown(surface["wall_rmse_m"])],
        ["RMSE to the surface without alignment, eq. (1), m", f"{told['icp_rmse_m']:.3f}"],
        ["mean distance, eq. (2), m", f"{told['mean_distance_m']:.3f}"],
    ]
    console.print(grid(["survey", ""], rows))


_COUNTS = ("frames", "drives", "points")


def _shown(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"
