"""Junctions at borders of zones: drivers decide as in one zone, bit for bit."""

from __future__ import annotations

from pathlib import Path

import pytest

from cavmarl.core.records.codes import HOLD_EXIT_BLOCKED, HOLD_YIELD
from tests.support.divided_scenes import TICK_S, DividedScene
from tests.support.junction_scenes import build_crossing, with_shorter_lane
from tests.support.netgenerate import netconvert

CRAWLS = 1e-3  # speed factor of a vehicle that must stay where it is


@pytest.fixture(scope="module")
def priority(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_crossing(tmp_path_factory.mktemp("crossing"), "priority")


@pytest.mark.parametrize(
    "corner_m", [(0.0, 0.0), (1.6, -1.6), (-3.0, 4.5), (7.5, -7.5), (-9.0, 9.0), (14.0, 3.0)]
)
def test_a_border_at_a_blocked_junction_changes_no_result(
    priority: Path, tmp_path: Path, corner_m: tuple[float, float]
) -> None:
    """The vehicle "stays" blocks the vehicles "held", "north" and "west", but not "east"."""
    here = DividedScene(priority, tmp_path, corner_m, ("car",))
    here.put("stays", "W_in_0 E_out_0", 9.0, wait_s=10.0, speed_factor=CRAWLS)
    here.put("held", "S_in_0 N_out_0", 2.0, wait_s=10.0)
    here.put("north", "N_in_0 E_out_0", -1.0, wait_s=10.0)
    here.put("west", "W_in_0 N_out_0", -1.0, wait_s=10.0)
    here.put("east", "E_in_0 W_out_0", -1.0, wait_s=10.0)
    here.begin()
    holds: dict[str, set[int]] = {name: set() for name in here.names}
    for vehicles in here.run(8.0):
        for name, row in vehicles.items():
            holds[name].add(int(row["hold"]))
    assert all(HOLD_EXIT_BLOCKED in holds[name] for name in ("held", "north", "west"))
    assert HOLD_YIELD in holds["west"]
    lanes = here.whole.network.lane_ids
    assert {name for name, row in vehicles.items() if lanes[row["lane"]] == "W_out_0"} == {"east"}


@pytest.mark.parametrize("corner_m", [(0.0, 0.0), (1.6, -1.6), (-9.0, 9.0), (20.0, 14.0)])
def test_a_border_through_a_deadlock_changes_no_result(
    tmp_path: Path, corner_m: tuple[float, float]
) -> None:
    """Each vehicle yields to the vehicle on its right; a random draw decides which drives first."""
    here = DividedScene(build_crossing(tmp_path, "right_before_left"), tmp_path, corner_m, ("car",))
    for arm, goal in {"W": "E", "S": "N", "E": "W", "N": "S"}.items():
        here.put(arm, f"{arm}_in_0 {goal}_out_0", -0.2, wait_s=1.0, hold=HOLD_YIELD)
    here.begin()
    order: list[str] = []
    lanes = here.whole.network.lane_ids
    for vehicles in here.run(11.0):
        gone = {name for name, row in vehicles.items() if not lanes[row["lane"]].endswith("in_0")}
        order += sorted(gone - set(order))
    assert set(order[:4]) == set("WSEN")


def test_a_driver_does_not_wait_for_a_vehicle_that_cannot_reach_its_path(
    tmp_path: Path,
) -> None:
    # No road leads into the zone of the side road, so that zone needs no ghost of "held".
    path = build_crossing(tmp_path, "priority", only_in="S")
    here = DividedScene(path, tmp_path, (-1.0, -24.0), ("car",))
    here.put("stays", "E_in_0 W_out_0", 23.0, speed_factor=CRAWLS)
    here.put("held", "E_in_0 W_out_0", -1.0, wait_s=10.0, hold=HOLD_EXIT_BLOCKED)
    here.put("side", "S_in_0 N_out_0", -25.0, speed=8.0)
    here.begin()
    for vehicles in here.run(0.5):
        assert vehicles["held"]["hold"] == HOLD_EXIT_BLOCKED
        assert "held" not in here.ghosts("side")
        assert vehicles["side"]["speed"] > 8.0, "the vehicle waits"


@pytest.mark.parametrize("is_second", [False, True])
def test_a_bus_leaves_room_for_a_queued_bus_beyond_a_border(
    priority: Path, tmp_path: Path, is_second: bool
) -> None:
    """The queued bus is stopped, but its path covers the place where the other bus would stop."""
    here = DividedScene(priority, tmp_path, (6.0, -22.0), ("car", "bus"))
    here.put("waits", "S_in_0 N_out_0", -11.0, "bus", speed=8.0)
    here.put("queued", "E_in_0 S_out_0", -22.5, "bus", wait_s=10.0)
    if is_second:
        here.put("first", "E_in_0 W_out_0", -12.0, wait_s=10.0)
    here.put("main", "W_in_0 E_out_0", -30.0, speed=10.0)
    here.begin()
    assert "queued" in here.ghosts("waits")
    first = next(here.run(1.0))
    assert first["waits"]["hold"] == HOLD_YIELD
    assert first["waits"]["speed"] < 7.8, "the bus does not brake for a position before its line"
    for _ in here.run(3.0):
        pass


@pytest.mark.parametrize("corner_m", [(6.0, -22.0), (-9.0, -9.0), (0.0, 0.0)])
@pytest.mark.parametrize("is_far", [False, True])
def test_a_car_enters_the_world_only_after_a_bus_has_turned_across_its_position(
    priority: Path, tmp_path: Path, corner_m: tuple[float, float], is_far: bool
) -> None:
    car = """<vehicle id="late" type="car" depart="0.2" departPos="-0.2" departSpeed="0">
        <route edges="S_in N_out"/></vehicle>"""
    here = DividedScene(priority, tmp_path, corner_m, ("car", "bus"), {"late": car})
    here.put("turns", "E_in_0 S_out_0", -60.0 if is_far else 4.0, "bus", speed=4.0)
    here.begin()
    entered_s = 0.0
    for vehicles in here.run(8.0):
        entered_s += TICK_S * ("late" not in vehicles)
    if is_far:
        assert entered_s < 0.5, "the car waits for a distant bus"
    else:
        assert 2.0 < entered_s < 6.0, "the car does not enter just after the bus"


@pytest.fixture(scope="module")
def shorter(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a map on which the left lane of the southern arm ends 8 m before the right lane."""
    path = build_crossing(tmp_path_factory.mktemp("shorter"), "priority", side_lanes=2)
    return with_shorter_lane(path, "S_in_1", 8.0)


@pytest.mark.parametrize("corner_m", [(6.0, -22.0), (-9.0, -11.5), (0.0, -14.0), (0.0, 0.0)])
@pytest.mark.parametrize("way", ["S_in_1 N_out_1", "S_in_1 W_out_0"])
def test_a_vehicle_that_leaves_a_shorter_lane_is_seen_from_the_longer_lane(
    shorter: Path, tmp_path: Path, corner_m: tuple[float, float], way: str
) -> None:
    here = DividedScene(shorter, tmp_path, corner_m, ("car",))
    right, left = (here.whole.network.lane_ids.index(f"S_in_{k}") for k in range(2))
    lanes = here.whole.network.lanes
    assert lanes["length_m"][right] - lanes["length_m"][left] == pytest.approx(8.0)
    crawls = {"speed": 0.5, "speed_factor": 0.03}
    here.put("changed", way, 3.0, d=-2.8, side_lane=right, **crawls)
    here.put("follows", "S_in_0 E_out_0", -17.0, speed=6.0)
    here.begin()
    covered = 0
    for vehicles in here.run(9.0):
        covered += int(vehicles["changed"]["side_lane"]) == right
    assert covered > 20
    assert vehicles["follows"]["speed"] > 3.0, "the follower does not pass"


@pytest.fixture
def streets(tmp_path: Path) -> Path:
    """Return two junctions with a one-way road of 115 m between them, towards the junction `c`."""
    places = {"W": "-150 0", "m": "-115 0", "n": "-115 90", "c": "0 0"}
    places |= {"E": "150 0", "S": "0 -150", "N": "0 150"}
    ways = [("far", "W", "m"), ("beside", "n", "m"), ("W_in", "m", "c")]
    ways += [(f"{arm}_in", arm, "c") for arm in "ESN"] + [(f"{arm}_out", "c", arm) for arm in "ESN"]
    nodes = "".join(
        f'<node id="{node}" x="{place.split()[0]}" y="{place.split()[1]}" type="priority"/>'
        for node, place in places.items()
    )
    edges = "".join(
        f'<edge id="{name}" from="{begin}" to="{end}" speed="14" numLanes="1" '
        f'priority="{9 if {begin, end} <= set("WmcE") else 1}"/>'
        for name, begin, end in ways
    )
    for kind, rows in (("nod", f"<nodes>{nodes}</nodes>"), ("edg", f"<edges>{edges}</edges>")):
        (tmp_path / f"streets.{kind}.xml").write_text(rows)
    (tmp_path / "streets.con.xml").write_text("<connections/>")
    return netconvert(tmp_path, "streets")


@pytest.mark.parametrize("corner_m", [(-5.0, 4.0), (-2.0, 9.0)])
def test_a_turning_vehicle_yields_to_a_vehicle_that_is_two_junctions_away(
    streets: Path, tmp_path: Path, corner_m: tuple[float, float]
) -> None:
    """At 11 m/s and 130 m from the line, the vehicle is too far away to register at the line."""
    way = """<vehicle id="w" type="car" depart="900"><route edges="far W_in E_out"/></vehicle>"""
    here = DividedScene(streets, tmp_path, corner_m, ("car",), {"w": way})
    here.put("side", "S_in_0 E_out_0", -1.0, wait_s=2.0, hold=HOLD_YIELD)
    here.put("main", "far_0 W_in_0", -15.0, speed=11.0, speed_factor=11.0 / 14.0)
    here.begin()
    here.departs.clear()
    for vehicles in here.run(2.0):
        assert "main" in here.ghosts("side")
        assert vehicles["side"]["hold"] == HOLD_YIELD
