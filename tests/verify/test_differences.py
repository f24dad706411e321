"""Find the first difference between two runs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from cavmarl import make_vec
from cavmarl.driving.vehicles import VEHICLE
from cavmarl.verify.differences import find_difference, same_bytes, snapshot


def state(**fields: object) -> dict[str, np.ndarray]:
    vehicles = np.zeros(2, VEHICLE)
    vehicles["id"] = [4, 9]
    for name, values in fields.items():
        vehicles[name] = values
    return {"vehicles": vehicles, "rewards": np.zeros((1, 2), np.float32)}


def test_the_first_difference_has_the_smallest_id_and_the_first_field() -> None:
    one, other = state(), state(speed=[2.0, 1.0], x=[0.0, 3.0])
    found = find_difference(5, 10, one, other)
    assert (found.vehicle, found.field, found.values) == (4, "speed", (0.0, 2.0))
    assert (found.step, found.tick) == (5, 10)


def test_a_vehicle_that_only_one_run_has_is_a_difference() -> None:
    other = state()
    other["vehicles"] = other["vehicles"][1:]
    found = find_difference(5, 10, state(), other)
    assert (found.vehicle, found.field, found.values) == (4, "id", (4, None))


def test_signs_of_zero_differ_and_equal_nans_do_not() -> None:
    same = find_difference(1, 2, state(accel=np.nan), state(accel=np.nan))
    assert same.what == "hidden state"
    other = state()
    other["rewards"][0, 1] = -0.0
    found = find_difference(1, 2, state(), other)
    assert (found.what, found.vehicle, found.field) == ("rewards", None, "[0, 1]")


def test_arrays_of_another_shape_are_a_difference() -> None:
    one, other = state(), state()
    other["rewards"] = np.zeros((1, 3), np.float32)
    found = find_difference(1, 2, one, other)
    assert (found.what, found.field, found.values) == ("rewards", "shape", ((1, 2), (1, 3)))


def test_results_differ_if_a_byte_differs() -> None:
    assert same_bytes({"a": np.array([np.nan])}, {"a": np.array([np.nan])})
    assert not same_bytes({"a": np.array([0.0])}, {"a": np.array([-0.0])})


@pytest.mark.parametrize("name", ["rewards", "mask", "observations radar", "observations ego"])
@pytest.mark.parametrize("place", [(0, 0), (1, 2)])
def test_a_difference_at_any_place_of_any_array_is_found(name: str, place: tuple[int, int]) -> None:
    def results(value: float) -> dict[str, Any]:
        arrays = {
            other: np.zeros((2, 3))
            for other in ("rewards", "observations ego", "observations radar", "mask")
        }
        arrays[name][place] = value
        sensors = {key.split()[1]: arrays.pop(key) for key in list(arrays) if " " in key}
        return {"observations": sensors, **arrays}

    assert same_bytes(results(1.0), results(1.0))
    assert not same_bytes(results(0.0), results(1.0))


def test_a_snapshot_has_the_vehicles_of_one_world_sorted_by_id() -> None:
    vec = make_vec("merge", num_envs=2, zones=4)
    observations, infos = vec.reset(seed=1)
    results = {"observations": observations, "episode": np.array([3, 8])}
    taken = snapshot(vec, results, 1)
    assert (np.diff(taken["vehicles"]["id"]) > 0).all()
    assert len(taken["vehicles"]) == len(vec.simulation.vehicles(1))
    np.testing.assert_array_equal(taken["observations"], observations[1])
    assert taken["episode"].tolist() == [8]
    assert infos["mask"].shape[0] == 2
