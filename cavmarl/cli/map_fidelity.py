"""`cavmarl map fidelity`: compares measured point clouds with a map or another cloud."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.text import Text

from cavmarl.cli.output import JsonPath, about, about_file, grid, write_json
from cavmarl.core.errors import ConfigError
from cavmarl.core.progress import in_stages
from cavmarl.engine.world_setup import find_map
from cavmarl.maps.buildings import with_buildings
from cavmarl.maps.fidelity.cloud_files import Cloud, is_cloud, read_cloud
from cavmarl.maps.fidelity.cloud_filters import crop, drop_outliers, thin_out
from cavmarl.maps.fidelity.cloud_frames import FRAMES, in_map_frame
from cavmarl.maps.fidelity.cloud_registration import moved
from cavmarl.maps.fidelity.comparison import PAPER_TABLE, Comparison, compare, start_transform
from cavmarl.maps.fidelity.exports import write_page, write_points
from cavmarl.maps.fidelity.map_surface import map_surface
from cavmarl.maps.fidelity.road_edges import RoadFit, fit_roads
from cavmarl.maps.netconvert import map_file
from cavmarl.roads.cache import load_network
from cavmarl.roads.network import RoadNetwork

_ALIGNMENTS = ("icp", "edges", "none")
_STAGES = ("points", "surroundings", "distances", "roads")
_MARGIN_M = 5.0  # crop the cloud to the map, and the map to the cloud, with this margin

Reference = Annotated[str, typer.Argument(metavar="MAP", help="Reference: a map or a point cloud.")]
Measured = Annotated[
    Path,
    typer.Argument(metavar="CLOUD", help="Point cloud: csv, ply, pcd, las or laz.", dir_okay=False),
]


def fidelity(
    reference: Reference,
    cloud: Measured,
    cloud2: Annotated[
        Path | None,
        typer.Argument(
            metavar="OTHER", help="Second point cloud, shown in its own column.", dir_okay=False
        ),
    ] = None,
    frame: Annotated[
        str, about(f"Frame of the clouds: {', '.join(FRAMES)}.", metavar="FRAME")
    ] = "map",
    start: Annotated[
        str | None,
        about("Approximate pose of a cloud in metres and degrees.", metavar="X,Y,Z,YAW"),
    ] = None,
    voxel: Annotated[
        float, about("Cube side of the voxel filter in metres; 0 turns it off.", metavar="M")
    ] = 0.05,
    outliers: Annotated[
        float,
        about(
            "Outlier filter: remove points beyond this many sigmas; 0 turns it off.", metavar="X"
        ),
    ] = 4.0,
    keep: Annotated[
        float, about("Share of nearest pairs that trimmed ICP keeps.", metavar="X")
    ] = 0.8,
    align: Annotated[
        str,
        about(
            "How clouds are aligned: icp, edges (road edges and heights) or none.", metavar="METHOD"
        ),
    ] = "icp",
    buildings: Annotated[
        Path | None,
        about("OSM file or SUMO polygons whose walls are added to the map.", metavar="FILE"),
    ] = None,
    points: Annotated[
        Path | None, about_file("Write the distance of each point (.csv, .ply).")
    ] = None,
    page: Annotated[Path | None, about_file("Write a page with a 3-D picture.")] = None,
    json_path: JsonPath = None,
) -> None:
    """Compare point clouds with a map's surface or with another cloud.

    If an alignment does not converge, exit with 1.
    """
    if align not in _ALIGNMENTS:
        raise ConfigError(f"--align {align}: must be one of {', '.join(_ALIGNMENTS)}")
    begin = start_transform(start)
    network = None if is_cloud(Path(reference)) else _network(reference, buildings)
    if network is None and align == "edges":
        raise ConfigError(
            f"--align edges: {reference} is a cloud without roads; name a map instead"
        )
    console = Console()
    rows, fits = [], []
    paths = list(filter(None, (cloud, cloud2)))
    stages = [[f"{name} of cloud {k + 1}" for name in _STAGES] for k in range(len(paths))]
    with in_stages(console, [name for one in stages for name in one]) as told:
        for path, (read, beside, compared, fitted) in zip(paths, stages, strict=True):
            told(read)
            one = _filtered(read_cloud(path), frame, network, begin, voxel, outliers)
            told(beside)
            motion, other = begin, None
            if network is None:
                other = _filtered(read_cloud(Path(reference)), "map", None, None, voxel, outliers)
            else:
                one, motion, other = _beside_map(one, network, begin, align)
            told(compared)
            rows.append(compare(one, other, start=motion, keep=keep, registered=align == "icp"))
            if network is not None:
                told(fitted)
                fits.append(fit_roads(network, rows[-1].aligned, network.extent_m))
    _print(console, rows, fits)
    write_json(json_path, _document(rows, fits))
    if points is not None:
        write_points(points, rows[0])
    if page is not None:
        write_page(page, rows)
    sound = all(row.alignment is None or row.alignment.converged for row in rows)
    raise typer.Exit(0 if sound else 1)


def _network(name: str, buildings: Path | None) -> RoadNetwork:
    network = load_network(map_file(find_map(name)))
    return network if buildings is None else with_buildings(network, buildings)


def _filtered(
    cloud: Cloud,
    frame: str,
    network: RoadNetwork | None,
    begin: Any,
    voxel_m: float,
    sigmas: float,
) -> Cloud:
    cloud = in_map_frame(cloud, frame, network)
    if network is not None:
        inverse = np.linalg.inv(begin)
        placed = crop(
            Cloud(cloud.name, moved(cloud.points, begin), cloud.counts),
            network.extent_m,
            _MARGIN_M,
        )
        cloud = Cloud(cloud.name, moved(placed.points, inverse), placed.counts)
    return drop_outliers(thin_out(cloud, voxel_m), sigmas)


def _beside_map(
    cloud: Cloud, network: RoadNetwork, begin: Any, align: str
) -> tuple[Cloud, Any, Cloud]:
    """Return the cloud, its initial transform, and the map's surface around it."""
    placed = moved(cloud.points, begin)
    box = (*(placed[:, :2].min(axis=0) - _MARGIN_M), *(placed[:, :2].max(axis=0) + _MARGIN_M))
    if align == "edges":
        fit = fit_roads(network, placed, box)
        if fit.transform is None:
            raise ConfigError(
                f"{cloud.name}: {len(fit.edge_offset_m)} road edges of {fit.stations} sections "
                "were found, which are too few or all in one direction; use --align icp or none"
            )
        begin = fit.transform @ begin
    return cloud, begin, map_surface(network, box)[0]


def _document(rows: list[Comparison], fits: list[RoadFit]) -> dict[str, Any]:
    document: dict[str, Any] = {"comparisons": [row.to_dict() for row in rows]}
    for comparison, fit in zip(document["comparisons"], fits, strict=False):
        comparison["roads"] = fit.to_dict()
    return document | {"paper": PAPER_TABLE}


def _print(console: Console, rows: list[Comparison], fits: list[RoadFit]) -> None:
    heads = ["", *(f"{row.source.name} → {row.reference.name}" for row in rows), *PAPER_TABLE]
    told = [row.to_dict() for row in rows]
    columns = [*told, *PAPER_TABLE.values()]
    names = {
        "ICP RMSE, eq. (1), m": "icp_rmse_m",
        "mean distance, eq. (2), m": "mean_distance_m",
        "… in the other direction, m": "mean_distance_reverse_m",
        "… in both directions, m": "mean_distance_symmetric_m",
        "… before alignment, m": "mean_distance_before_m",
        "RMSE of the pairs kept, m": "trimmed_rmse_m",
        "median, m": "median_distance_m",
        "95 % lie within, m": "p95_distance_m",
        "yaw, °": "yaw_deg",
    }
    table = [
        [name, *(_shown(column.get(key)) for column in columns)] for name, key in names.items()
    ]
    for name, key in (
        ("road edges, lateral RMSE, m", "lateral_rmse_m"),
        ("… found / sections of the map", ""),
        ("road heights, RMSE, m", "height_rmse_m"),
        ("… median, m", "height_median_m"),
    ):
        if fits:
            cells = [
                _shown(fit.to_dict()[key]) if key else f"{len(fit.edge_offset_m)} / {fit.stations}"
                for fit in fits
            ]
            table.append([name, *cells, *("-" for _ in PAPER_TABLE)])
    console.print(grid(heads, table, wraps=True))
    for row in rows:
        for cloud in (row.source, row.reference):
            counts = ", ".join(f"{name} {count}" for name, count in cloud.counts.items())
            console.print(Text(f"{cloud.name}: {counts}; compared {len(cloud.points)}"))
        for problem in row.alignment.problems if row.alignment else ():
            console.print(Text(f"{row.source.name}: NOT converged: {problem}", style="red"))


def _shown(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"
