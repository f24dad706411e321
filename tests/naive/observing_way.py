"""Compute the `way` and `conflicts` sensors from the whole path and by sorting all vehicles."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cavmarl.roads.network import RoadNetwork

RED, YELLOW, GREEN = "ru", "yY", "gG"


def looks_s(horizon_s: float) -> list[float]:
    """Return the moments of a prediction."""
    return [0.5 * k for k in range(round(2.0 * horizon_s) + 1)]


@dataclass
class Stretch:
    """A lane of the path."""

    lane: int
    start_m: float  # distance from the vehicle to the start of the lane
    end_m: float
    link: int  # link at the end of the lane, or -1


def way_of(
    roads: RoadNetwork, plans: NDArray[np.void], vehicle: np.void, most: int = 48
) -> list[Stretch]:
    """Return the lanes of the path, starting at the vehicle."""
    lane, start = int(vehicle["lane"]), -float(vehicle["s"])
    found: list[Stretch] = []
    while lane >= 0 and len(found) < most:
        end = start + float(roads.lanes[lane]["length_m"])
        following, link = _beyond(roads, plans[vehicle["goal"]], lane)
        found.append(Stretch(lane, start, end, link))
        lane, start = following, end
    return found


def _beyond(roads: RoadNetwork, plan: NDArray[np.void], lane: int) -> tuple[int, int]:
    if roads.lanes[lane]["internal"]:
        return int(roads.lanes[lane]["successor"]), -1
    for _ in range(8):
        if lane < 0:
            break
        if plan[lane]["next"] >= 0:
            return int(plan[lane]["next"]), int(plan[lane]["link"])
        if plan[lane]["change"] == 0:
            break
        lane = int(roads.lanes[lane]["left" if plan[lane]["change"] > 0 else "right"])
    return -1, -1


def pose(roads: RoadNetwork, lane: int, s: float) -> tuple[float, float, float]:
    """Return x, y and direction at a position of a lane, which is straight beyond its ends."""
    points = roads.lane_points(lane)
    k = min(max(int(np.searchsorted(points["s"], s, side="right")) - 1, 0), len(points) - 2)
    one, other = points[k], points[k + 1]
    direction = math.atan2(other["y"] - one["y"], other["x"] - one["x"])
    along = s - one["s"]
    return one["x"] + along * math.cos(direction), one["y"] + along * math.sin(direction), direction


def on_way(way: list[Stretch], distance: float) -> tuple[Stretch, float]:
    """Return the lane of the path at a distance ahead, and the position on it."""
    for stretch in way:
        if distance <= stretch.end_m:
            return stretch, distance - stretch.start_m
    return way[-1], distance - way[-1].start_m


def clip(value: float) -> float:
    return min(max(value, -1.0), 1.0)


def places(
    roads: RoadNetwork, plans: NDArray[np.void], vehicle: np.void, distances_m: list[float]
) -> list[float]:
    """Return lateral position, curvature, width and speed limit at each distance."""
    way = way_of(roads, plans, vehicle)
    reach = way[-1].end_m
    numbers: list[float] = []
    heading = float(vehicle["heading"])
    before, direction = 0.0, pose(roads, int(vehicle["lane"]), float(vehicle["s"]))[2]
    for wanted in distances_m:
        distance = min(wanted, reach)
        stretch, s = on_way(way, distance)
        x, y, turned = pose(roads, stretch.lane, s)
        aside = (y - vehicle["y"]) * math.cos(heading) - (x - vehicle["x"]) * math.sin(heading)
        curvature = 0.0
        if distance > before:
            turn = (turned - direction + math.pi) % (2.0 * math.pi) - math.pi
            curvature = turn / (distance - before)
        lane = roads.lanes[stretch.lane]
        numbers += [clip(aside / wanted), clip(curvature / 0.2)]
        numbers += [clip(lane["width_m"] / 8.0), clip(lane["speed_mps"] / 40.0)]
        before, direction = distance, turned
    return numbers


def lines(
    roads: RoadNetwork,
    plans: NDArray[np.void],
    vehicle: np.void,
    shown: dict[int, str],
    count: int,
    range_m: float,
    stop_signs: str = "give_way",
) -> list[float]:
    """Return closeness, red, yellow, green and duty to yield for each stop line.

    `shown` has the signal letter of each link. With `stop_signs="own"`, the duty to stop is added.
    """
    found = []
    for stretch in way_of(roads, plans, vehicle):
        if stretch.end_m > range_m:
            break
        if stretch.link < 0:
            continue
        letter = shown.get(stretch.link, "")
        link = roads.links[stretch.link]
        own = slice(link["first_conflict"], link["first_conflict"] + link["num_conflicts"])
        yields = letter not in ("G", "O") and bool(roads.conflicts["must_yield"][own].any())
        has_sign = not letter and chr(link["state"]) in "sw"
        if not letter and not yields and not has_sign:
            continue
        near = 20.0 / (20.0 + max(stretch.end_m, 0.0))
        if letter:
            flags = [letter in (*RED, "s"), letter in YELLOW, letter in GREEN, yields]
        elif stop_signs == "red":
            flags = [has_sign, False, False, yields]
        else:
            flags = [False, False, False, True]
        if stop_signs == "own":
            flags.append(has_sign or letter == "s")
        found.append([near, *map(float, flags)])
    size = 6 if stop_signs == "own" else 5
    found = [*found, *([[0.0] * size] * count)][:count]
    return [number for line in found for number in line]


def straight_looks(vehicle: np.void, horizon_s: float) -> list[tuple[float, float, float]]:
    """Return the predicted poses (x, y, direction) of a vehicle that goes straight on."""
    x, y, heading, speed = (float(vehicle[name]) for name in ("x", "y", "heading", "speed"))
    return [
        (x + time * speed * math.cos(heading), y + time * speed * math.sin(heading), heading)
        for time in looks_s(horizon_s)
    ]


def indicated_way(
    roads: RoadNetwork, plans: NDArray[np.void], vehicle: np.void, from_m: float = 0.0
) -> tuple[list[Stretch], int]:
    """Return the path up to the end of the lane after the next junction, and the link or -1.

    If `from_m` is not 0 and the junction is farther away, the path ends before the junction.
    """
    way = way_of(roads, plans, vehicle)
    here = roads.lanes[way[0].lane]
    ends = [k for k, stretch in enumerate(way) if stretch.link >= 0]
    if from_m and not here["internal"] and ends and way[ends[0]].end_m > from_m:
        return way[: ends[0] + 1], -1
    links = [int(here["link"])] if here["internal"] else []
    for k, stretch in enumerate(way):
        if stretch.link >= 0:
            links.append(stretch.link)
        if len(links) > 1:
            return way[: k + 1], links[0]
    return way, next(iter(links), -1)


def departing_m(speed: float, limit: float, time: float) -> float:
    """Return the distance of a vehicle that accelerates with 2 m/s² to `limit`, in small steps."""
    steps = 2000
    times = (np.arange(steps) + 0.5) * (time / steps)
    return float(np.minimum(speed + 2.0 * times, max(limit, speed)).mean() * time)


def looks_along(
    roads: RoadNetwork, way: list[Stretch], vehicle: np.void, driven_m: list[float]
) -> list[tuple[float, float, float]]:
    """Return the poses (x, y, direction) of a vehicle now and after distances along its path."""
    found = [(float(vehicle["x"]), float(vehicle["y"]), float(vehicle["heading"]))]
    for distance in driven_m[1:]:
        stretch, s = on_way(way, distance)
        found.append(pose(roads, stretch.lane, s))
    return found


def approach(
    looks: list[tuple[float, float, float]],
    others: list[tuple[float, float, float]],
    ego: np.void,
    other: np.void,
) -> tuple[float, float]:
    """Return the gap between two vehicles, and its time, at their most critical approach."""
    gaps = []
    for k, ((x, y, direction), (x_there, y_there, direction_there)) in enumerate(
        zip(looks, others, strict=True)
    ):
        time = 0.5 * k
        dx, dy = x_there - x, y_there - y
        turned = direction_there - direction
        ends = [
            (0.5 * a * other["length"], 0.5 * b * other["width"]) for a in (1, -1) for b in (1, -1)
        ]
        half_along = max(a * math.cos(turned) - b * math.sin(turned) for a, b in ends)
        half_across = max(a * math.sin(turned) + b * math.cos(turned) for a, b in ends)
        along = abs(dx * math.cos(direction) + dy * math.sin(direction))
        across = abs(dy * math.cos(direction) - dx * math.sin(direction))
        gap = max(along - half_along - 0.5 * ego["length"], 0.0)
        gap += max(across - half_across - 0.5 * ego["width"], 0.0)
        gaps.append((gap + 2.0 * time, gap, time))
    return min(gaps)[1:]


def goes_first(
    roads: RoadNetwork, way: list[Stretch], reach_m: float, other: np.void, shown: dict[int, str]
) -> float:
    """Return 1 if the other vehicle has priority at the next junction, -1 if it yields, else 0."""
    here = roads.lanes[way[0].lane]
    ahead = [int(here["link"])] if here["internal"] else []
    for stretch in way:
        if stretch.start_m < reach_m and stretch.link >= 0:
            ahead.append(stretch.link)
    if not ahead:
        return 0.0
    link = roads.links[ahead[0]]
    own = slice(link["first_conflict"], link["first_conflict"] + link["num_conflicts"])
    there = roads.lanes[other["lane"]]
    answers = []
    for conflict in roads.conflicts[own]:
        foe = int(conflict["foe"])
        if there["internal"]:
            if foe == there["link"]:
                return 0.0 if here["internal"] else 1.0
            continue
        if roads.links[foe]["from_lane"] != other["lane"]:
            continue
        mine, its = shown.get(ahead[0], ""), shown.get(foe, "")
        if here["internal"]:
            answers.append(-1.0)
        elif its and its in RED:
            answers.append(0.0 if mine and mine in RED else -1.0)
        elif mine and mine in RED:
            answers.append(1.0)
        else:
            answers.append(1.0 if conflict["must_yield"] and mine != "G" else -1.0)
    return next((value for value in (1.0, -1.0) if value in answers), 0.0)


def turn_over(roads: RoadNetwork, link: int) -> float:
    """Return 1 for a left turn, -1 for a right turn, else 0."""
    if link < 0:
        return 0.0
    before, after = int(roads.links[link]["from_lane"]), int(roads.links[link]["to_lane"])
    direction = pose(roads, before, float(roads.lanes[before]["length_m"]))[2]
    turned = math.remainder(pose(roads, after, 0.0)[2] - direction, 2.0 * math.pi)
    return math.copysign(1.0, turned) if abs(turned) >= 0.4 else 0.0


def bent(value: float, half: float) -> float:
    return value / (half + abs(value))


def conflicts(
    roads: RoadNetwork,
    plans: NDArray[np.void],
    rows: NDArray[np.void],
    i: int,
    shown: dict[int, str],
    count: int,
    range_m: float,
    hidden: Collection[int] = (),
    told: Mapping[int, tuple[np.void, float]] | None = None,
    indicators: bool = False,
    from_m: float = 0.0,
    horizon_s: float = 4.5,
    departs: bool = False,
) -> list[float]:
    """Return features of each of the `count` most critical vehicles.

    A vehicle has nine features, ten with `indicators`, and eleven with reports. `hidden` are the
    ids of vehicles that are not seen. `told` has reports from messages: a VEHICLE row and an age in
    s per vehicle id.
    """
    ego = rows[i]
    way = way_of(roads, plans, ego)
    times_s = looks_s(horizon_s)
    speed, limit = float(ego["speed"]), float(roads.lanes[ego["lane"]]["speed_mps"])
    driven_m = [max(speed, 3.0) * time for time in times_s]
    if departs:
        driven_m = [departing_m(speed, limit, time) for time in times_s]
    looks = looks_along(roads, way, ego, driven_m)
    known = {int(row["id"]): (row, -1.0) for row in rows if int(row["id"]) not in hidden}
    known = {**(told or {}), **known}
    del known[int(ego["id"])]
    ranked = []
    for subject, (other, _) in known.items():
        away = math.hypot(other["x"] - ego["x"], other["y"] - ego["y"])
        if away > range_m or abs(other["z"] - ego["z"]) > 4.0:
            continue
        others = straight_looks(other, horizon_s)
        if indicators:
            its_way = indicated_way(roads, plans, other, from_m)[0]
            its_driven_m = [float(other["speed"]) * time for time in times_s]
            others = looks_along(roads, its_way, other, its_driven_m)
        near, when = approach(looks, others, ego, other)
        # Rounding must not decide the order of equally critical vehicles, so round and sort by id.
        ranked.append((round(near + 2.0 * when, 6), subject, near, when))
    numbers: list[float] = []
    for _, subject, near, when in sorted(ranked)[:count]:
        other, age_s = known[subject]
        cos, sin = math.cos(ego["heading"]), math.sin(ego["heading"])
        dx, dy = other["x"] - ego["x"], other["y"] - ego["y"]
        vx = other["speed"] * math.cos(other["heading"]) - ego["speed"] * cos
        vy = other["speed"] * math.sin(other["heading"]) - ego["speed"] * sin
        turned = other["heading"] - ego["heading"]
        numbers += [2.0 / (2.0 + near), 2.0 / (2.0 + when)]
        numbers += [bent(dx * cos + dy * sin, 10.0), bent(dy * cos - dx * sin, 10.0)]
        numbers += [bent(vx * cos + vy * sin, 10.0), bent(vy * cos - vx * sin, 10.0)]
        numbers += [math.cos(turned), math.sin(turned)]
        is_seen = age_s < 0.0
        numbers.append(goes_first(roads, way, driven_m[-1], other, shown) if is_seen else 0.0)
        if told is not None:
            numbers += [1.0, 0.0] if is_seen else [0.0, min(age_s, 1.0)]
        if indicators:
            numbers.append(turn_over(roads, indicated_way(roads, plans, other, from_m)[1]))
    size = (9 if told is None else 11) + int(indicators)
    return [*numbers, *([0.0] * (size * count))][: size * count]
