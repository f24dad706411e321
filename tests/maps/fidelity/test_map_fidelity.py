"""Comparison of a map with a generated scan of its roads, moved by a known motion."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from cavmarl.cli import app
from cavmarl.core.errors import CavmarlError, MapError
from cavmarl.engine.world_setup import find_map
from cavmarl.maps.fidelity.cloud_files import Cloud, read_cloud
from cavmarl.maps.fidelity.cloud_registration import moved, nearest_distances
from cavmarl.maps.fidelity.map_surface import along_lane, lanes_in, map_surface
from cavmarl.maps.fidelity.road_edges import fit_roads
from cavmarl.maps.netconvert import map_file
from cavmarl.roads.cache import load_network
from cavmarl.roads.network import RoadNetwork
from tests.maps.fidelity.scenes import motion

pytest.importorskip("small_gicp", reason="needs the extra 'maps'")

MAP = "grid4x4"
KERB_M = 0.15
GAP_M = 0.15  # smallest distance of points beside a road from the road
BIN_M = 0.1  # size of the bins in which borders are searched
NUMBER = 300_000  # points beside the roads


@pytest.fixture(scope="module")
def network() -> RoadNetwork:
    return load_network(map_file(find_map(MAP)))


@pytest.fixture(scope="module")
def scan(network: RoadNetwork) -> np.ndarray:
    """Generate points on roads of a part of the map, and on ground beside them, a kerb higher."""
    box = (140.0, 140.0, 260.0, 260.0)
    roads = map_surface(network, box, 0.2)[0].points
    rng = np.random.default_rng(0)
    ground = np.column_stack(
        [rng.uniform(box[0], box[2], NUMBER), rng.uniform(box[1], box[3], NUMBER), np.zeros(NUMBER)]
    )
    ground = ground[nearest_distances(ground, roads) > GAP_M]
    ground[:, 2] = KERB_M
    return np.concatenate([roads, ground])


def run(*words: object) -> tuple[int, str]:
    done = CliRunner().invoke(app, ["map", "fidelity", *map(str, words)])
    is_refused = isinstance(done.exception, CavmarlError)
    return 2 if is_refused else done.exit_code, done.output + str(done.exception or "")


def test_the_shift_of_a_scan_is_found_from_edges_and_heights_of_roads(
    network: RoadNetwork, scan: np.ndarray
) -> None:
    shifted = scan + np.array([0.2, -0.1, 0.3])
    fit = fit_roads(network, shifted, network.extent_m)
    assert len(fit.edge_offset_m) > 50
    assert fit.transform is not None
    assert fit.transform[:3, 3] == pytest.approx([-0.2, 0.1, -0.3], abs=BIN_M)
    assert np.median(fit.height_offset_m) == pytest.approx(0.3, abs=0.01)


def test_bodies_in_the_inner_half_of_a_lane_are_not_taken_for_its_border(
    network: RoadNetwork, scan: np.ndarray
) -> None:
    lanes = network.lanes
    bodies = []
    for lane in lanes_in(network, (150.0, 150.0, 250.0, 250.0)).tolist():
        if lanes["internal"][lane] or lanes["index"][lane]:
            continue
        places, direction = along_lane(network, lane, 0.05)
        left = np.stack([-direction[:, 1], direction[:, 0]], axis=1)
        places[:, :2] += (2.45 - 0.5 * lanes["width_m"][lane]) * left  # 2.45 m from the border
        places[:, 2] += 0.5
        bodies.append(places)
    plain = fit_roads(network, scan, network.extent_m)
    fit = fit_roads(network, np.concatenate([scan, *bodies]), network.extent_m)
    assert len(fit.edge_offset_m) == len(plain.edge_offset_m)
    assert fit.edge_offset_m == pytest.approx(plain.edge_offset_m, abs=0.05)


def test_the_command_compares_a_scan_with_a_map(tmp_path: Path, scan: np.ndarray) -> None:
    cloud, out = tmp_path / "scan.csv", tmp_path / "out.json"
    points, page = tmp_path / "points.ply", tmp_path / "page.html"
    np.savetxt(cloud, moved(scan, motion(0.2, -0.1, 0.3, 0.0)), fmt="%.4f", delimiter=",")
    code, said = run(
        MAP, cloud, "--align", "edges", "--json", out, "--points", points, "--page", page
    )
    assert code == 0, said
    (found,) = json.loads(out.read_text())["comparisons"]
    assert found["converged"] is None  # only alignments by points can converge
    assert np.array(found["transform"])[:2, 3] == pytest.approx([-0.2, 0.1], abs=0.1)
    # The median is not 0, because cross-sections near junctions meet the kerb of the crossing road.
    assert 0.0 < found["roads"]["lateral_median_m"] < GAP_M + 2 * BIN_M  # voxels are 5 cm
    assert abs(found["roads"]["height_rmse_m"]) < 0.01
    assert found["mean_distance_m"] != found["mean_distance_reverse_m"]
    written = read_cloud(points)
    assert len(written.points) == sum(bin["points"] for bin in found["histogram"])
    text = page.read_text()
    assert "@DATA@" not in text
    assert "http" not in text  # the page loads nothing from other hosts


def test_clouds_and_options_that_do_not_fit_the_map_are_refused(tmp_path: Path) -> None:
    far = tmp_path / "far.csv"
    np.savetxt(far, np.random.default_rng(1).uniform(0, 50, (200, 3)) + 1e6, delimiter=",")
    code, said = run(MAP, far)
    assert code == 2
    assert "--frame" in said
    assert run(MAP, far, "--align", "eyes")[0] == 2
    assert run(MAP, far, "--frame", "mars")[0] == 2
    assert run(MAP, tmp_path / "none.csv")[0] == 2
    code, said = run(far, far, "--align", "edges")
    assert code == 2
    assert "without roads" in said


def test_a_cloud_with_swapped_coordinates_is_refused_with_a_remedy() -> None:
    from cavmarl.maps.fidelity.cloud_filters import crop

    random = np.random.default_rng(0)
    places = np.column_stack([random.uniform(0, 900, 500), random.uniform(0, 90, 500)])
    cloud = Cloud("measured", np.column_stack([places, np.zeros(500)]))
    box = (0.0, 0.0, 900.0, 90.0)
    assert len(crop(cloud, box, 1.0).points) == 500
    turned = Cloud("measured", cloud.points[:, [1, 0, 2]])
    with pytest.raises(MapError, match="--frame swapped"):
        crop(turned, box, 1.0)
