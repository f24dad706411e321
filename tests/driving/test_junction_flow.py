"""Flow at junctions: waiting vehicles start in time, and other vehicles do not brake."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path

import pytest

from tests.support.junction_scenes import Scene, build_crossing

Make = Callable[[str], Scene]


@pytest.fixture(scope="module")
def crossing(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Return a function that builds a crossing with the given SUMO type of junction."""
    return partial(build_crossing, tmp_path_factory.mktemp("crossings"))


@pytest.fixture
def scene(crossing: Callable[[str], Path]) -> Make:
    return lambda kind: Scene(crossing(kind))


@pytest.mark.parametrize(("speed", "left_m", "straight_m"), [(0.0, 1.0, 3.0), (8.0, 10.0, 20.0)])
def test_oncoming_cars_do_not_brake_for_a_left_turning_car_before_its_waiting_position(
    scene: Make, speed: float, left_m: float, straight_m: float
) -> None:
    here = scene("traffic_light")
    here.put("left", "W_in_0", left_m, "N_out", speed=speed)
    for k in range(3):
        to_line_m = straight_m + k * (7.5 + 2.0 * speed)
        here.put(f"straight{k}", "E_in_0", to_line_m, "W_out", speed=speed)
    hardest, waited = 0.0, False
    for _ in here.run(12.0):
        for car in here.simulation.vehicles():
            if here.names[car["id"]] != "left":
                hardest = min(hardest, float(car["accel"]))
            elif here.simulation.network.lanes[car["lane"]]["internal"]:
                waited = waited or car["speed"] < 0.1
    assert waited, "the left turn did not wait inside the junction"
    assert hardest > -0.5


def test_cars_at_an_all_way_stop_do_not_brake_inside_the_junction(scene: Make) -> None:
    here = scene("allway_stop")
    ways = {"W": "N", "S": "W", "E": "S", "N": "E"}  # left turns whose paths cross
    for k, (arm, goal) in enumerate(ways.items()):
        here.put(arm, f"{arm}_in_0", 30.0 + 8.0 * k, f"{goal}_out", speed=10.0)
    hardest: dict[str, float] = defaultdict(float)
    out: dict[str, float] = {}
    lanes = here.simulation.network.lane_ids
    for time in here.run(40.0):
        for car in here.simulation.vehicles():
            arm, lane = here.names[car["id"]], lanes[car["lane"]]
            if lane.startswith(":"):
                hardest[arm] = min(hardest[arm], float(car["accel"]))
            elif not lane.startswith(arm):
                out.setdefault(arm, time)
    assert set(out) == set(ways)
    assert min(hardest.values()) > -1.0
    times = sorted(out.values())
    gaps = [later - time for time, later in pairwise(times)]
    assert max(gaps) < 3.5, "the time between two cars is far above SUMO's 2.8 s"


def test_a_car_that_has_stopped_at_a_stop_sign_goes_in_the_next_tick(scene: Make) -> None:
    here = scene("priority_stop")
    here.put("side", "S_in_0", 30.0, "N_out", speed=10.0)
    stood = max(float(here["side"]["wait_s"]) for _ in here.run(8.0))
    assert stood == pytest.approx(0.1)
