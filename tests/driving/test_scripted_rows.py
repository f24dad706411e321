"""Rows that follow scripts: motion, entries in the indices of lanes and links, and cues."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.core.math.geometry import lane_pose, project
from cavmarl.core.records.arrays import TripTables
from cavmarl.core.records.codes import DRIVER_AGENT, DRIVER_BACKGROUND, DRIVER_SCRIPTED
from cavmarl.driving.kernels.junctions.approach import register_links
from cavmarl.driving.kernels.lanes.lane_index import index_lanes
from cavmarl.driving.kernels.motion.scripted_rows import follow_script, note_cues, stand_at
from cavmarl.driving.vehicles import VEHICLE, blank_vehicle
from cavmarl.roads.routing import PLAN, make_plans
from cavmarl.shards.shard import make_shard_scratch
from cavmarl.traffic.scenarios.motions import Await, Move, Pose, Ride, Wait, arc, path_of
from cavmarl.traffic.scenarios.movement_scripts import (
    BODIES,
    CUE,
    FORESIGHT_S,
    Actor,
    Cue,
    actor_types,
    compile_scripts,
)
from cavmarl.traffic.scenarios.streets import Streets
from tests.support.traffic import network, on_lane, travel

DT = 0.05
ROADS = network("grid4x4")
STREETS = Streets(ROADS)
LANE = STREETS.straights(85.0)[0]
WALK_MPS = 1.25


def crossing() -> Actor:
    """Return a pedestrian who waits for cue 0, then crosses the road 40 m from a lane's start."""
    right, left = STREETS.kerbs_m(LANE, 40.0)
    ends = np.array(
        [STREETS.point(LANE, 40.0, -right - 1.4), STREETS.point(LANE, 40.0, left + 1.4)]
    )
    ends[:, 2] += 0.5 * math.pi
    return Actor("pedestrian", [Move(ends[:1], LANE), Await(0), Move(ends, LANE, WALK_MPS)])


def scripted(
    *actors: Actor, goals: dict[int, int] | None = None
) -> tuple[TripTables, NDArray[np.void]]:
    """Return tables with the actors' scripts, and VEHICLE (n,) at the actors' first positions."""
    scripts, firsts = compile_scripts(ROADS, actors, [Cue(0.0, 0.0, 5.0)], goals or {}, DT)
    base = travel("grid4x4")
    types = np.concatenate([base.types, actor_types()])
    rows = np.zeros(len(actors), VEHICLE)
    for number, (actor, first) in enumerate(zip(actors, firsts, strict=True)):
        rows[number] = blank_vehicle()[0]
        body = BODIES[actor.body]
        rows[number]["id"] = 10 + number
        rows[number]["driver"], rows[number]["goal"] = DRIVER_SCRIPTED, first
        rows[number]["vtype"] = len(base.types) + list(BODIES).index(actor.body)
        rows[number]["length"], rows[number]["width"] = body.length, body.width
        stand_at(scripts.frames[first], rows[number])
    return base._replace(types=types, scripts=scripts), rows


def follow(tables: TripTables, row: np.void, came: bool, ticks: int) -> list[tuple[float, float]]:
    cues = np.array([0 if came else -1])
    places = []
    for _ in range(ticks):
        if row["driver"] != DRIVER_SCRIPTED:
            break
        follow_script(ROADS.arrays, tables, cues, row, DT)
        places.append((float(row["x"]), float(row["y"])))
    return places


def test_an_actor_waits_for_its_cue_and_then_walks() -> None:
    tables, rows = scripted(crossing())
    row = rows[0]
    start = (float(row["x"]), float(row["y"]))
    assert set(follow(tables, row, False, 30)) == {start}
    assert row["wait_s"] == pytest.approx(30 * DT)
    places = follow(tables, row, True, 60)
    way_m = math.dist(start, places[-1])
    # The pedestrian accelerates with 2.5 m/s², then walks at a constant speed.
    ramp_s = WALK_MPS / 2.5
    assert way_m == pytest.approx(WALK_MPS * (60 * DT - 0.5 * ramp_s), abs=0.1)
    assert row["speed"] == WALK_MPS
    assert row["distance_m"] == pytest.approx(way_m, abs=0.1)
    follow(tables, row, True, 400)
    right, left = STREETS.kerbs_m(LANE, 40.0)
    assert math.dist(start, (row["x"], row["y"])) == pytest.approx(right + left + 2.8)
    assert (row["speed"], row["driver"]) == (0.0, DRIVER_SCRIPTED)


def covered(row: np.void, at: tuple[float, float]) -> dict[int, tuple[float, float]]:
    """Return the range of each lane that a body covers, computed from a fine grid of points."""
    found: dict[int, list[float]] = {}
    cos, sin = math.cos(row["heading"]), math.sin(row["heading"])
    lanes, room_m = ROADS.lanes, 3.0 + row["length"]
    near = (lanes["min_x"] - room_m < at[0]) & (at[0] < lanes["max_x"] + room_m)
    near &= (lanes["min_y"] - room_m < at[1]) & (at[1] < lanes["max_y"] + room_m)
    for u in np.linspace(-0.5, 0.5, 41) * row["length"]:
        for v in np.linspace(-0.5, 0.5, 21) * row["width"]:
            x, y = at[0] + u * cos - v * sin, at[1] + u * sin + v * cos
            for number in np.flatnonzero(near).tolist():
                lane = lanes[number]
                s, d, _, _ = project(ROADS.points, lane["first_point"], lane["num_points"], x, y)
                if abs(d) < 0.5 * lane["width_m"] and 0.0 <= s <= lane["length_m"]:
                    found.setdefault(number, []).append(s)
    return {lane: (min(places), max(places)) for lane, places in found.items()}


def entries(
    tables: TripTables, rows: NDArray[np.void]
) -> dict[int, list[tuple[int, float, float]]]:
    """Return (id, start, end) of the entries of each lane in the index."""
    room = make_shard_scratch(ROADS, len(rows), tables.scripts.room)
    index_lanes(ROADS.arrays, tables, rows, len(rows), room)
    return {
        lane: [
            (int(e["id"]), float(e["s"] - e["half"]), float(e["s"] + e["half"]))
            for e in room.entries[room.lane_start[lane] : room.lane_end[lane]]
        ]
        for lane in range(len(ROADS.lanes))
        if room.lane_start[lane] < room.lane_end[lane]
    }


def test_drivers_see_a_body_on_every_lane_that_it_covers_now_or_soon() -> None:
    tables, rows = scripted(crossing())
    row = rows[0]
    assert entries(tables, rows) == {}  # the actor waits beside the road
    soon = round(FORESIGHT_S / DT)
    for ticks in (2, 20, 40, 40, 60):
        follow(tables, row, True, ticks)
        ahead = row.copy()
        places = [(float(row["x"]), float(row["y"])), *follow(tables, ahead, True, soon)]
        expected: dict[int, tuple[float, float]] = {}
        for place in places[::4]:
            for lane, (start, end) in covered(row, place).items():
                old = expected.get(lane, (start, end))
                expected[lane] = (min(start, old[0]), max(end, old[1]))
        found = entries(tables, rows)
        assert found.keys() >= expected.keys()
        for lane, ((vehicle, start, end),) in found.items():
            assert vehicle == 10
            if lane in expected:
                assert (start, end) == pytest.approx(expected[lane], abs=0.15)


def test_entries_of_scripted_bodies_are_sorted_among_vehicles() -> None:
    """An entry of a scripted body is sorted by position, although its id is the largest."""
    tables, rows = scripted(crossing())
    follow(tables, rows[0], True, 60)
    cars = [on_lane(ROADS, LANE, s, tables, id=k) for k, s in enumerate((30.0, 50.0))]
    every_row = np.concatenate([rows, *cars])
    every_row["driver"][1:] = DRIVER_BACKGROUND
    found = entries(tables, every_row)[LANE]
    assert [vehicle for vehicle, *_ in found] == [0, 10, 1]


def riding() -> Actor:
    link = next(
        k for k, row in enumerate(ROADS.links)
        if row["num_conflicts"] and row["direction"] == ord("s") and row["first_internal"] >= 0
    )  # fmt: skip
    path = path_of(ROADS, link)
    line_m = STREETS.length_m(path[0])
    end_m = line_m + float(ROADS.links["length_m"][link]) + 20.0
    ride = Ride(path, line_m - 60.0, end_m, 8.0, 8.0, 8.0)
    return Actor("car", [ride], STREETS.edge(path[-1]))


def test_a_scripted_vehicle_registers_at_junctions_like_a_driver() -> None:
    """Compare with a background car at the same position, with a route over the same link.

    The trip of the background car ends on the lane behind that link; the script goes on.
    """
    actor = riding()
    ride = actor.acts[0]
    assert isinstance(ride, Ride)
    assert actor.released_to is not None
    goals = {actor.released_to: 0}
    tables, rows = scripted(actor, goals=goals)
    tables = tables._replace(steps=make_plans(ROADS, [actor.released_to]).reshape(-1))
    row = rows[0]
    end = int(ROADS.lanes["first_link"][ride.lanes[-1]])
    for _ in range(80):
        follow(tables, row, True, 5)
        if row["driver"] != DRIVER_SCRIPTED:
            break
        twin = on_lane(ROADS, int(row["lane"]), float(row["s"]), tables, id=10, goal=0,
                       speed=row["speed"], link=int(row["link"]))  # fmt: skip
        assert (row["x"], row["y"]) == pytest.approx((twin["x"][0], twin["y"][0]), abs=0.3)
        assert announced(tables, rows) == [at for at in announced(tables, twin) if at[0] != end]
        assert entries(tables, rows).keys() >= entries(tables, twin).keys()
    assert row["driver"] == DRIVER_BACKGROUND
    assert row["to_go"] == pytest.approx(STREETS.length_m(int(row["lane"])) - row["s"], abs=1e-6)


def announced(tables: TripTables, rows: NDArray[np.void]) -> list[tuple[int, float]]:
    room = make_shard_scratch(ROADS, 1, tables.scripts.room)
    step, step_at = np.zeros(1, PLAN), np.zeros(1, np.int64)
    register_links(ROADS.arrays, tables, rows, 1, step, step_at, room)
    return [
        (link, round(float(entry["dist"]), 6))
        for link in range(len(ROADS.links))
        for entry in room.approach[room.link_start[link] : room.link_end[link]]
    ]


def test_a_cue_comes_at_its_tick_or_when_an_agent_is_near() -> None:
    cues = np.array([(0.0, 0.0, 5.0, -1), (0.0, 0.0, 0.0, 7)], CUE)
    rows = np.zeros((2, 1, 3), VEHICLE)  # two zones of one world
    rows["driver"] = DRIVER_BACKGROUND
    num = np.array([[2], [1]])
    came = np.full((1, 2), -1)

    def told(tick: int) -> list[int]:
        note_cues(cues, rows, num, np.array([tick]), came)
        return [int(tick) for tick in came[0]]

    assert told(3) == [-1, -1]  # a background vehicle triggers no cue
    rows["driver"][1, 0, 0] = DRIVER_AGENT
    rows["x"][1, 0, 0] = 5.1
    assert told(6) == [-1, -1]
    rows["x"][1, 0, 0] = 5.0
    assert told(7) == [7, 7]
    rows["x"][1, 0, 0] = 50.0
    assert told(8) == [7, 7]
    rows["driver"][0, 0, 2] = DRIVER_AGENT  # row 2 of this zone is a ghost
    came[:] = -1
    assert told(2) == [-1, -1]


def test_an_arc_has_the_given_radius_turn_and_direction() -> None:
    for turn, backwards in ((1.0, False), (-0.7, False), (1.2, True), (-2.0, True)):
        line = arc((3.0, 4.0, 0.4), 5.0, turn, backwards=backwards)
        assert line[0] == pytest.approx([3.0, 4.0, 0.4])
        assert line[-1, 2] == pytest.approx(0.4 + turn)
        along = np.diff(line[:, :2], axis=0)
        middle = 0.5 * (line[1:, 2] + line[:-1, 2])
        moved = along[:, 0] * np.cos(middle) + along[:, 1] * np.sin(middle)
        assert np.hypot(*along.T).sum() == pytest.approx(5.0 * abs(turn), rel=1e-3)
        assert ((moved < 0.0) == backwards).all()
        assert np.abs(moved).sum() == pytest.approx(5.0 * abs(turn), rel=1e-3)


def test_a_wait_lasts_its_time_and_a_backward_move_has_a_negative_speed() -> None:
    start = np.array([[0.0, 0.0, 0.0]])
    back = np.array([[0.0, 0.0, 0.0], [-2.0, 0.0, 0.0]])
    last: Pose | None = None
    counts, speeds = [], []
    for act in (Move(start, LANE), Wait(1.0), Move(back, LANE, 1.0, backwards=True)):
        poses = list(act.poses(ROADS, 5.0, last, DT))
        last = poses[-1]
        counts.append(len(poses))
        speeds.append(min(pose.speed for pose in poses))
    assert counts[:2] == [1, 20]
    assert speeds == [0.0, 0.0, -1.0]
    assert last is not None
    assert (last.x, last.speed) == (-2.0, 0.0)


def test_lane_coordinates_and_xy_of_a_frame_agree() -> None:
    tables, _ = scripted(riding(), crossing(), goals={riding().released_to or 0: 0})
    for frame in tables.scripts.frames[::7]:
        lane = ROADS.lanes[frame["lane"]]
        x, y, _, cos, sin, _ = lane_pose(
            ROADS.points, lane["first_point"], lane["num_points"], frame["s"]
        )
        place = (x - frame["d"] * sin, y + frame["d"] * cos)
        assert place == pytest.approx((frame["x"], frame["y"]), abs=0.3)
