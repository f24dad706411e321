"""Compares a road network with what CARLA's own library reads from its OpenDRIVE file.

CARLA's client programs spawn vehicles on lanes, follow lanes over junctions, and look ahead for
traffic lights. The comparison makes the library do the same.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import MapError
from cavmarl.cosim.carla import client_map_reader
from cavmarl.cosim.carla.carla_geometry import carla_pose
from cavmarl.cosim.carla.carla_map import SPAWN_HEIGHT_M, spawn_points
from cavmarl.cosim.carla.client_process import run_client_program
from cavmarl.maps.exports.opendrive import carla_document
from cavmarl.maps.exports.opendrive_carla import LIGHT_TYPE
from cavmarl.maps.map_kinds import map_kind
from cavmarl.maps.net_document import NetDocument
from cavmarl.roads.network import CARS, RoadNetwork

Poses = NDArray[np.float64]  # (n, 4): x, y, z in m and yaw in degrees, in CARLA's frame

OFF_LIMIT_M = 0.3  # largest distance for 95 % of the points on lanes
TURN_LIMIT_DEG = 5.0
SHARE_LIMIT = 0.95  # share of each kind of element that must be found
SPAWN_LIMIT_M = 1.0  # largest distance of a spawn point from a lane of the same direction
SPAWN_LIMIT_DEG = 15.0

_EVERY_M = 2.0  # distance between points on a lane
_MOST_POINTS = 100_000
_MARGIN_M = 2.0  # distance from the ends of lanes to the ends of paths over junctions
# The library's paths over a junction can be shorter than cavmarl's, or longer (wider U-turns).
_PATH_LONGER_M = (-8.0, 0.0, 8.0, 16.0)
_PATH_ALONG_M = 5.0
_PATH_ASIDE_M = 1.5
_PATH_DEG = 45.0
_BEFORE_LIGHT_M = 5.0
_LIGHT_AHEAD_M = 30.0


class Deviation(NamedTuple):
    """Differences of poses: 95 % are at most `usual`, and all are at most `largest`."""

    usual: float
    largest: float

    @classmethod
    def of(cls, values: NDArray[np.float64]) -> Deviation:
        if not len(values):
            return cls(0.0, 0.0)
        return cls(float(np.quantile(values, 0.95)), float(values.max()))


class Share(NamedTuple):
    """The number of elements of a map, and how many of them CARLA's library finds."""

    total: int
    found: int

    @classmethod
    def of(cls, found: NDArray[np.bool_]) -> Share:
        return cls(len(found), int(found.sum()))


@dataclass(frozen=True)
class ClientMapReport:
    """The map of cavmarl compared with the map that CARLA's library reads.

    Attributes:
        points: number of points on lanes for cars.
        off_m: distances of these points from the nearest lane of the library.
        turned_deg: differences of the directions there.
        spawn_points: places where clients spawn vehicles; found: those on a lane of the library.
        movements: from lane to lane over a junction; found: those that the library drives.
        junctions: those in which paths cross; found: those with a path in a junction of the
            library.
        lanes_with_lights: lanes that end at a traffic light; found: those on which the library
            sees one ahead.
        landmarks: number of traffic lights of the library.
    """

    points: int
    off_m: Deviation
    turned_deg: Deviation
    spawn_points: Share
    movements: Share
    junctions: Share
    lanes_with_lights: Share
    landmarks: int

    @property
    def shares(self) -> dict[str, Share]:
        names = ("spawn_points", "movements", "junctions", "lanes_with_lights")
        return {name.replace("_", " "): getattr(self, name) for name in names}

    @property
    def problems(self) -> list[str]:
        """Differences that programs for CARLA would notice."""
        found = []
        if self.off_m.usual > OFF_LIMIT_M:
            found.append(
                f"5 % of the points on lanes are off by {self.off_m.usual:.2f} m or more; at most "
                f"{OFF_LIMIT_M:g} m are allowed"
            )
        if self.turned_deg.usual > TURN_LIMIT_DEG:
            found.append(
                f"5 % of the points on lanes are turned by {self.turned_deg.usual:.1f} degrees or "
                f"more; at most {TURN_LIMIT_DEG:g} degrees are allowed"
            )
        found += [
            f"{share.total - share.found} of {share.total} {name} are not found; at least "
            f"{SHARE_LIMIT:.0%} must be"
            for name, share in self.shares.items()
            if share.found < SHARE_LIMIT * share.total
        ]
        return found

    def to_dict(self) -> dict[str, Any]:
        return asdict(self) | {"problems": self.problems}


class _Questions:
    """Places in CARLA's frame that the library is asked about.

    Attributes:
        lanes: poses on lanes for cars.
        spawns: poses of spawn points, on the road.
        starts: poses before junctions, one for each movement of cars.
        distances_m: lengths of the paths from there to `ends`.
        ends: poses after junctions.
        insides: poses in the middle of the paths of junctions in which paths cross.
        junctions: the junction of each of `insides`.
        before_lights: poses before traffic lights, one for each lane.
    """

    def __init__(self, network: RoadNetwork) -> None:
        lanes, links = network.lanes, network.links
        for_cars = (lanes["permissions"] & CARS) != 0
        rows = np.flatnonzero(for_cars & ~lanes["internal"]).tolist()
        every_m = max(_EVERY_M, float(lanes["length_m"][rows].sum()) / _MOST_POINTS)
        self.lanes = _poses(
            network,
            [
                (lane, (number + 0.5) / count)
                for lane in rows
                for count in [max(1, int(lanes["length_m"][lane] / every_m))]
                for number in range(count)
            ],
        )
        spawns = spawn_points(network)
        self.spawns = np.array(
            [(one.x, one.y, one.z - SPAWN_HEIGHT_M, one.yaw) for one in spawns]
        ).reshape(-1, 4)

        moves = links[for_cars[links["from_lane"]] & for_cars[links["to_lane"]]]
        before_m = np.minimum(_MARGIN_M, 0.5 * lanes["length_m"][moves["from_lane"]])
        after_m = np.minimum(_MARGIN_M, 0.5 * lanes["length_m"][moves["to_lane"]])
        self.distances_m = before_m + moves["length_m"] + after_m
        at_start = 1.0 - before_m / lanes["length_m"][moves["from_lane"]]
        at_end = after_m / lanes["length_m"][moves["to_lane"]]
        self.starts = _poses(network, zip(moves["from_lane"], at_start, strict=True))
        self.ends = _poses(network, zip(moves["to_lane"], at_end, strict=True))

        crossing = np.unique(moves["junction"][moves["num_conflicts"] > 0])
        paths = moves[np.isin(moves["junction"], crossing) & (moves["first_internal"] >= 0)]
        self.insides = _poses(network, [(lane, 0.5) for lane in paths["first_internal"].tolist()])
        self.junctions = paths["junction"]

        with_light = np.unique(moves["from_lane"][moves["signal"] >= 0])
        length_m = lanes["length_m"][with_light]
        at_light = np.maximum(0.5, 1.0 - _BEFORE_LIGHT_M / length_m)
        self.before_lights = _poses(network, zip(with_light, at_light, strict=True))

    def packed(self, shift: Poses) -> dict[str, Any]:
        """Return the questions of `client_map_reader`; `shift`: from the file to cavmarl's map."""
        places = np.concatenate([self.lanes, self.spawns, self.insides]) - shift
        starts = (self.starts - shift)[:, :3].tolist()
        far_m = np.maximum(_MARGIN_M, np.add.outer(self.distances_m, _PATH_LONGER_M)).tolist()
        return {
            "places": places[:, :3].tolist(),
            "paths": list(zip(starts, far_m, strict=True)),
            "before_lights": (self.before_lights - shift)[:, :3].tolist(),
            "light_type": LIGHT_TYPE,
            "ahead_m": _LIGHT_AHEAD_M,
        }


def check_with_client(network: RoadNetwork, source: Path, original: Path) -> ClientMapReport:
    """Compare a network with what CARLA's client reads from its OpenDRIVE file.

    Args:
        network: the network.
        source: its SUMO file.
        original: the map file; OpenDRIVE is read as it is, and other maps are exported for CARLA.

    Raises:
        ClientProgramError: CARLA's library fails or aborts.
        MapError: the file cannot be read, or netconvert refuses the network.
        MissingExtraError: CARLA's client or netconvert is not installed.
    """
    shift = np.zeros(4)
    if map_kind(original) == "opendrive":
        document = _text_of(original)
        x, y = NetDocument(source).offset_m
        shift[:2] = x, -y
    else:
        document = carla_document(source, network)
    asked = _Questions(network)
    return _compare(asked, _answers(document, asked.packed(shift)), shift)


def _text_of(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeError) as error:
        raise MapError(f"{path}: cannot be read ({error}): export it again, in UTF-8") from error


def _answers(document: str, questions: dict[str, Any]) -> dict[str, Any]:
    with TemporaryDirectory() as folder:
        files = [Path(folder) / name for name in ("map.xodr", "questions.json", "answers.json")]
        files[0].write_text(document, encoding="utf-8")
        files[1].write_text(json.dumps(questions), encoding="utf-8")
        run_client_program(Path(client_map_reader.__file__), files)
        answers: dict[str, Any] = json.loads(files[2].read_text(encoding="utf-8"))
    return answers


def _compare(asked: _Questions, answers: dict[str, Any], shift: Poses) -> ClientMapReport:
    nowhere = [math.inf] * 4
    nearest = np.array([pose or nowhere for pose in answers["nearest"]]).reshape(-1, 4) + shift
    lanes, spawns, _ = np.split(nearest, np.cumsum([len(asked.lanes), len(asked.spawns)]))
    in_junction = np.array(answers["in_junction"][len(lanes) + len(spawns) :], bool)
    crossed = [in_junction[asked.junctions == one].any() for one in np.unique(asked.junctions)]
    on_lane = (_apart_m(asked.spawns, spawns) < SPAWN_LIMIT_M) & (
        _turned_deg(asked.spawns, spawns) < SPAWN_LIMIT_DEG
    )
    reached = [np.array(one).reshape(-1, 4) + shift for one in answers["reached"]]
    arrived = [_is_reached(end, poses) for end, poses in zip(asked.ends, reached, strict=True)]
    return ClientMapReport(
        len(lanes),
        Deviation.of(_apart_m(asked.lanes, lanes)),
        Deviation.of(_turned_deg(asked.lanes, lanes)),
        Share.of(on_lane),
        Share.of(np.array(arrived, bool)),
        Share.of(np.array(crossed, bool)),
        Share.of(np.array(answers["lights"], int) > 0),
        answers["landmarks"],
    )


def _poses(network: RoadNetwork, places: Iterable[tuple[int, float]]) -> Poses:
    """Return the poses at places on lanes: LANE row, and share of its length."""
    found = []
    for lane, share in places:
        s = share * float(network.lanes["length_m"][lane])
        x, y, z, cos, sin, _ = network.pose_on(lane, s)
        pose = carla_pose(x, y, z, math.atan2(sin, cos))
        found.append((pose.x, pose.y, pose.z, pose.yaw))
    return np.array(found).reshape(-1, 4)


def _apart_m(ours: Poses, theirs: Poses) -> NDArray[np.float64]:
    apart: NDArray[np.float64] = np.linalg.norm(ours[:, :3] - theirs[:, :3], axis=1)
    return apart


def _turned_deg(ours: Poses, theirs: Poses) -> NDArray[np.float64]:
    """Return the differences of yaw, 180 degrees where there is no pose."""
    turned = np.where(np.isfinite(theirs[:, 3]), theirs[:, 3] - ours[:, 3], 180.0)
    return np.abs((turned + 180.0) % 360.0 - 180.0)


def _is_reached(end: Poses, poses: Poses) -> bool:
    """Return whether one of the poses is at the end of a path, or on the same lane near it."""
    yaw = math.radians(end[3])
    ahead = np.array([math.cos(yaw), math.sin(yaw)])
    away = poses[:, :2] - end[:2]
    along_m, aside_m = away @ ahead, away @ np.array([-ahead[1], ahead[0]])
    turned_deg = _turned_deg(np.broadcast_to(end, poses.shape), poses)
    return bool(
        np.any(
            (np.abs(along_m) < _PATH_ALONG_M)
            & (np.abs(aside_m) < _PATH_ASIDE_M)
            & (turned_deg < _PATH_DEG)
        )
    )
