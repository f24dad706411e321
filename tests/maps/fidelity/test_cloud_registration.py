from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cavmarl.core.errors import ConfigError, MapError
from cavmarl.maps.fidelity import cloud_registration
from cavmarl.maps.fidelity.cloud_files import Cloud, read_cloud
from cavmarl.maps.fidelity.cloud_filters import drop_outliers, thin_out
from cavmarl.maps.fidelity.cloud_registration import (
    Target,
    align,
    moved,
    nearest_distances,
)
from cavmarl.maps.fidelity.comparison import compare, histogram, start_transform
from tests.maps.fidelity.scenes import motion, street

pytest.importorskip("small_gicp", reason="needs the extra 'maps'")

KNOWN = motion(0.5, -0.5, 0.25, 2.0)  # a shift of 0.75 m and a rotation of 2°


def compared(source: np.ndarray, reference: np.ndarray, **options: float):
    return compare(Cloud("P", source), Cloud("Q", reference), **options)


def left_over(found: np.ndarray, known: np.ndarray) -> tuple[float, float]:
    """Return the error of a found motion as (shift in m, rotation in degrees)."""
    rest = found @ known
    skew = np.array([rest[2, 1] - rest[1, 2], rest[0, 2] - rest[2, 0], rest[1, 0] - rest[0, 1]])
    return float(np.linalg.norm(rest[:3, 3])), float(np.degrees(0.5 * np.linalg.norm(skew)))


@pytest.mark.parametrize("seed", [1, 2])
def test_the_motion_of_a_noisy_cloud_is_found_with_an_error_below_1_mm(seed: int) -> None:
    reference = street(100_000)
    noise = np.random.default_rng(seed).normal(0.0, 0.02, reference.shape)
    source = moved(reference + noise, KNOWN)
    found = compared(source, reference)
    assert found.alignment is not None
    assert found.alignment.converged
    shift_m, turn_deg = left_over(found.transform, KNOWN)
    assert shift_m < 1e-3
    assert turn_deg < 1e-3
    assert found.rmse_m >= found.mean_m


def test_identical_clouds_have_the_distance_0_and_a_moved_copy_is_aligned() -> None:
    cloud = street(20_000)
    assert compared(cloud, cloud).rmse_m < 1e-9
    found = compared(moved(cloud, KNOWN), cloud)
    assert found.rmse_m < 1e-6
    assert found.alignment is not None
    assert found.alignment.yaw_deg == pytest.approx(-2.0, abs=1e-4)


def test_the_rmse_of_noisy_points_equals_its_theoretical_value() -> None:
    reference = 3.0 * np.random.default_rng(3).uniform(-10.0, 10.0, (2000, 3))  # points far apart
    noise = np.random.default_rng(4).normal(0.0, 0.02, reference.shape)
    found = compared(reference + noise, reference, registered=False)
    assert found.rmse_m == pytest.approx(0.02 * np.sqrt(3.0), rel=0.05)


def test_distances_equal_brute_force_in_both_directions() -> None:
    rng = np.random.default_rng(5)
    one, other = rng.uniform(0.0, 9.0, (1000, 3)), rng.uniform(0.0, 12.0, (700, 3))
    apart = np.linalg.norm(one[:, None] - other[None], axis=2)
    assert nearest_distances(one, other) == pytest.approx(apart.min(axis=1), abs=1e-9)
    found = compared(one, other, registered=False).to_dict()
    assert found["mean_distance_m"] == pytest.approx(apart.min(axis=1).mean())
    assert found["mean_distance_reverse_m"] == pytest.approx(apart.min(axis=0).mean())
    assert found["mean_distance_m"] != pytest.approx(found["mean_distance_reverse_m"], rel=0.05)
    assert sum(bin["points"] for bin in histogram(apart.min(axis=1))) == 1000


def test_the_trimmed_rmse_omits_points_that_only_one_cloud_has() -> None:
    reference = street(4000)
    # One of eleven points is 30 m above the street, like leaves in only one of two scans.
    leaves = reference[:400] + np.array([0.0, 0.0, 30.0])
    found = align(np.vstack([reference, leaves]), Target(reference))
    assert found.converged
    assert found.trimmed_rmse_m < 1e-3
    assert np.sqrt(np.mean(found.distance_m**2)) > 30.0 / 11.0


@pytest.mark.parametrize(
    ("spacings_m", "limit_m"),
    [((0.16, 0.1), 0.4), ((0.1, 0.16), 0.4), ((0.02, 0.01), 0.1), ((1.0, 0.1), 0.5)],
)
def test_the_limit_of_distances_is_2_5_spacings_of_the_coarser_cloud_within_bounds(
    spacings_m: tuple[float, float], limit_m: float
) -> None:
    clouds = []
    for spacing_m in spacings_m:
        x, y = np.meshgrid(*(spacing_m * np.arange(20.0),) * 2)
        clouds.append(np.column_stack([x.ravel(), y.ravel(), np.zeros(400)]))
    source, target = clouds
    assert align(source, Target(target)).limit_m == pytest.approx(limit_m)


def test_an_alignment_that_still_moves_has_not_converged(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cloud_registration, "STAGES", 1)
    cloud = street(4000)
    found = align(moved(cloud, KNOWN), Target(cloud))
    assert found.stages == 1
    assert [problem for problem in found.problems if "the last stage (1) still moved" in problem]
    assert align(cloud, Target(cloud)).problems == ()


def test_clouds_of_different_places_do_not_converge() -> None:
    rng = np.random.default_rng(6)
    ball = rng.normal(size=(1000, 3))
    ball *= 20.0 / np.linalg.norm(ball, axis=1)[:, None]
    found = align(ball, Target(street(4000)))
    assert not found.converged
    assert any("more than" in problem for problem in found.problems)


def test_the_alignment_of_a_plane_is_reported_as_underdetermined() -> None:
    rng = np.random.default_rng(7)
    plane = np.column_stack([rng.uniform(0.0, 50.0, (5000, 2)), np.zeros(5000)])
    found = align(moved(plane, motion(0.5, 0.0, 0.0, 0.0)), Target(plane))
    assert not found.converged
    assert any("slide" in problem for problem in found.problems)


def test_clouds_far_from_the_origin_are_aligned_without_loss_of_precision() -> None:
    cloud = street(20_000) + np.array([4.5e5, 5.4e6, 300.0])
    middle = cloud.mean(axis=0)
    source = moved(cloud - middle, KNOWN) + middle
    found = compared(source, cloud)
    assert found.rmse_m < 1e-6
    assert thin_out(Cloud("far", cloud), 0.5).points.mean(axis=0) == pytest.approx(middle, abs=2.0)


def test_filters_remove_and_count_points() -> None:
    cloud = Cloud("c", np.vstack([street(5000), [(0.0, 0.0, 900.0)]]), {"read": 5001})
    thin = thin_out(cloud, 1.0)
    assert 0 < len(thin.points) < 5001
    assert thin.counts["voxel filter"] == 5001 - len(thin.points)
    clean = drop_outliers(thin, 4.0)
    assert clean.points[:, 2].max() < 20.0
    assert clean.counts["outlier filter"] == len(thin.points) - len(clean.points)
    assert thin_out(cloud, 0.0) is cloud
    assert drop_outliers(cloud, 0.0) is cloud


@pytest.mark.parametrize("sigmas", [0.5, 1.0, 2.5])
def test_points_far_from_their_eight_neighbours_are_dropped_as_outliers(sigmas: float) -> None:
    points = np.random.default_rng(0).normal(size=(400, 3))
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)
    distance_m = np.sort(apart, axis=1)[:, 1:9].mean(axis=1)
    kept = distance_m <= distance_m.mean() + sigmas * distance_m.std()
    assert drop_outliers(Cloud("c", points), sigmas).points.tolist() == points[kept].tolist()


def test_invalid_numbers_are_refused() -> None:
    cloud = Cloud("c", street(500))
    with pytest.raises(ConfigError, match="above 0"):
        thin_out(cloud, -1.0)
    with pytest.raises(ConfigError, match="0 for no filter"):
        drop_outliers(cloud, float("nan"))
    with pytest.raises(ConfigError, match="keep 2"):
        align(cloud.points, Target(cloud.points), keep=2.0)
    with pytest.raises(MapError, match="at least 50 are needed"):
        Target(cloud.points[:10])
    with pytest.raises(ConfigError, match="x,y,z,yaw"):
        start_transform("1,2")
    stretched = Cloud("s", np.vstack([cloud.points, [(1e9, 0.0, 0.0)]]))
    with pytest.raises(ConfigError, match="remove stray points"):
        thin_out(stretched, 0.05)


def test_two_scans_of_a_real_street_are_aligned(shared_maps: Path) -> None:
    folder = shared_maps / "pointcloud"
    reference = read_cloud(folder / "car_cloud400.csv")
    source = read_cloud(folder / "car_cloud401.csv")
    found = compare(source, reference)
    assert found.before_m == pytest.approx(0.864, abs=1e-3)
    assert found.mean_m < 0.247
    assert found.alignment is not None
    assert found.alignment.converged
    mirrored = compare(Cloud("mirrored", source.points * [1.0, -1.0, 1.0]), reference)
    assert mirrored.alignment is not None
    assert not mirrored.alignment.converged
