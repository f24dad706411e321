"""`RoadNetwork`: a road map as a handful of immutable record arrays.

Frames and units: metres, radians, metres a second; x east, y north, z up, right-handed; headings
are counter-clockwise from east. A lane is a polyline along its centre in driving direction; `s` is
the arc length on it and `d` the lateral offset, positive to the left.

Every lane has one row, junction-internal lanes included. A *link* is one permitted movement over a
junction: from the end of a lane, along a chain of internal lanes, to the start of an outgoing lane.
Records instead of many plain arrays: a kernel takes one argument where it would take ten.

Indices that point at nothing are -1.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.huge_pages import huge_copy
from cavmarl.core.mapped_file import file_of, let_go
from cavmarl.core.math.geometry import lane_pose, project
from cavmarl.core.records import record
from cavmarl.core.records.arrays import RoadArrays
from cavmarl.roads.kernels.backdrop_pieces import WALL
from cavmarl.roads.kernels.signal_phases import DETECTOR_REACH_M

# The permission bits of LANE["permissions"], SUMO's abstract vehicle classes that drive on roads.
VEHICLE_CLASSES = (
    "passenger",
    "truck",
    "bus",
    "motorcycle",
    "emergency",
    "delivery",
    "taxi",
    "tram",
    "bicycle",
)

# SUMO's signal letters in the order of their codes in `phase_states`.
SIGNAL_STATES = "rugGysoOY"

POINT = record(
    ("x", np.float64),  # m
    ("y", np.float64),  # m
    ("z", np.float64),  # m
    ("s", np.float64),  # m from the start of its lane, in the plane
    # direction of the segment that starts here (the last point repeats the one before)
    ("cos", np.float64),
    ("sin", np.float64),
    ("slope", np.float64),  # dz/ds of that segment
    ("heading", np.float64),  # of that segment, rad
    ("left_s", np.float64),  # where on the left neighbour of its lane the point lies, m
    ("right_s", np.float64),
)

# What drivers ask all the time comes first and shares a cache line.
LANE = record(
    # arc length of the polyline in the plane: the `s` of its last point
    ("length_m", np.float64),
    ("speed_mps", np.float64),  # speed limit
    ("width_m", np.float64),
    ("internal", np.bool_),  # lies inside a junction
    # at its end others give way that turn into its road: they look `MERGES_M` before it
    ("merges", np.bool_),
    ("left", np.int32),  # LANE row of the neighbour to the left in the same direction
    ("right", np.int32),
    ("successor", np.int32),  # internal lanes: the one LANE that follows (internal or normal)
    ("link", np.int32),  # internal lanes: the LINK that this lane is part of
    # LINK rows of the movements that leave this lane's end, sorted by from-lane; 0 of them for
    # internal lanes (see `successor`)
    ("first_link", np.int32),
    ("num_links", np.int32),
    ("first_point", np.int32),  # POINT rows [first_point, first_point + num_points)
    ("num_points", np.int32),  # at least 2
    ("edge", np.int32),  # EDGE row; internal lanes too
    # internal lanes: path length of the link before this lane starts
    ("link_offset_m", np.float64),
    ("stop_back_m", np.float64),  # from the stop line to the end, where paths of others sweep
    # into[first_into : first_into + num_into]: LANE rows whose ends lead here (internal lanes where
    # the map has them)
    ("first_into", np.int32),
    ("num_into", np.int32),
    ("permissions", np.uint32),  # bit k set: VEHICLE_CLASSES[k] may drive here
    ("index", np.int32),  # position on its edge, 0 = at the kerb
    ("min_x", np.float64),  # bounding box of the polyline, m
    ("min_y", np.float64),
    ("max_x", np.float64),
    ("max_y", np.float64),
    ("map", np.int32),  # MAP row
)

EDGE = record(
    # LANE rows [first_lane, first_lane + num_lanes), from the kerb to the middle of the road
    ("first_lane", np.int32),
    ("num_lanes", np.int32),
    ("internal", np.bool_),
    ("from_junction", np.int32),  # JUNCTION rows; both the same for internal edges
    ("to_junction", np.int32),
    ("length_m", np.float64),
    ("speed_mps", np.float64),
)

LINK = record(
    ("from_lane", np.int32),  # LANE it leaves; its end is the stop line
    ("to_lane", np.int32),  # LANE it reaches
    ("first_internal", np.int32),  # first LANE of the chain inside the junction
    # where a vehicle is after the end of from_lane: first_internal, or to_lane
    ("next_lane", np.int32),
    ("length_m", np.float64),  # of the chain of internal lanes
    ("fork_m", np.float64),  # of its path that others from the same lane come near
    ("wait_m", np.float64),  # from the stop line to the waiting position inside; inf: none
    ("junction", np.int32),
    ("index", np.int32),  # the link's bit in its junction's request, response and foes
    ("signal", np.int32),  # SIGNAL row
    ("signal_index", np.int32),  # which letter of the signal's state
    ("direction", np.uint8),  # ord of SUMO's dir: s t l r L R
    ("state", np.uint8),  # ord of SUMO's link state without a signal: M m = s w Z o …
    ("first_conflict", np.int32),  # CONFLICT rows, sorted by the foe's LINK row
    ("num_conflicts", np.int32),
    ("first_sweep", np.int32),  # SWEEP rows, sorted by the foe's LINK row and sizes
    ("num_sweeps", np.int32),
    ("swept_by", np.int32),  # the least size class of those that sweep over its cars
    ("swept_m", np.float64),  # up to where a rear, m from the stop line, is minded by others
)

CONFLICT = record(
    ("foe", np.int32),  # LINK whose path crosses or merges with this link's path (a `foes` bit)
    ("merging", np.bool_),  # both lead into one lane
    ("must_yield", np.bool_),  # this link has to give way to the foe (a `response` bit)
    ("near", np.bool_),  # False: a foe by the map's rules only, the paths keep apart
    ("enter_m", np.float64),  # where on this link's path the shared area begins and ends,
    ("leave_m", np.float64),  # from the stop line; leave = the whole length where both merge
    ("foe_enter_m", np.float64),  # the same area on the foe's path
    ("foe_leave_m", np.float64),
)

SWEEP = record(
    ("foe", np.int32),  # LINK of the same junction, other than from one lane
    ("own", np.int32),  # size class (`SIZE_LENGTHS_M`) of the vehicle on this link,
    ("other", np.int32),  # and of the one on the foe's
    ("enter_m", np.float64),  # from the stop line to where a front begins to be in the way,
    ("leave_m", np.float64),  # and where a rear ceases to be; both may lie outside the junction,
    ("foe_enter_m", np.float64),  # and a body longer than the shared area leaves before it enters
    ("foe_leave_m", np.float64),
)

JUNCTION = record(
    ("x", np.float64),
    ("y", np.float64),
    ("z", np.float64),
    ("kind", np.int32),  # index into RoadNetwork.junction_kinds
    ("signal", np.int32),  # SIGNAL row of a traffic light here
    ("unruled", np.bool_),  # the map has no rule for ways that end in one lane here
)

SIGNAL = record(
    ("program", np.int32),  # PROGRAM that is on at the beginning
    ("num_links", np.int32),  # letters in a state
    ("first_switch", np.int32),  # SWITCH rows, by rising time
    ("num_switches", np.int32),
)

PROGRAM = record(
    ("signal", np.int32),
    ("first_phase", np.int32),  # PHASE rows [first_phase, first_phase + num_phases)
    ("num_phases", np.int32),
    ("offset_s", np.float64),  # by which all phases are late
    ("cycle_s", np.float64),  # sum of the phases' durations
    ("controller", np.int32),  # actuated: its place in a world's controllers
    ("detector_gap_s", np.float64),  # actuated: from a detector to the stop line, at the limit
    ("simplified", np.bool_),  # SUMO has rules for it that are not run here
)

PHASE = record(
    ("duration_s", np.float64),
    ("min_ms", np.int64),  # actuated: bounds of the duration, in SUMO's unit of time
    ("max_ms", np.int64),
    ("following", np.int32),  # actuated: PHASE that comes next
    ("green", np.bool_),  # some letter is green and none is yellow: it may be prolonged
    ("first_state", np.int32),  # phase_states[first_state : first_state + num_links]
    ("first_detector", np.int32),  # phase_detectors that prolong it
    ("num_detectors", np.int32),
)

SWITCH = record(
    ("signal", np.int32),
    ("at_s", np.float64),  # since the beginning
    ("program", np.int32),  # PROGRAM that is on from then
)

DETECTOR = record(
    ("lane", np.int32),  # LANE on which it lies; its signal may be one lane farther on
    ("s_m", np.float64),  # where on that lane
    ("max_gap_s", np.float64),  # between two vehicles of which the second prolongs the green
)

PLACE = record(
    ("next", np.int32),  # the next PLACE of the same lane
    ("detector", np.int32),
    ("s_m", np.float64),  # of the detector in the lane's s; beyond its ends on lanes beside it
)

# Rows of one map lie together; of several maps in one network a world drives on one.
MAP = record(
    ("first_lane", np.int32),  # LANE rows [first_lane, first_lane + num_lanes)
    ("num_lanes", np.int32),
    ("first_signal", np.int32),  # SIGNAL rows
    ("num_signals", np.int32),
    ("first_program", np.int32),  # PROGRAM rows
    ("num_programs", np.int32),
)

# At most so many bytes of a map's file are copied. A tick reads many places of a map: in the small
# pages of a file it takes a tenth longer, but processes of one machine share that memory.
COPIED = 1 << 27

# Fields of a network that kernels take, in the order of `RoadArrays`.
_TABLES = (
    "points", "lanes", "edges", "links", "conflicts", "sweeps", "into", "signals", "programs",
    "phases", "phase_states", "switches", "detectors", "phase_detectors",
)  # fmt: skip


@dataclass(frozen=True)
class GeoReference:
    """Where a map lies on the earth: a place projected, plus the offset, is its x and y."""

    projection: str  # parameters of PROJ
    offset_x_m: float  # added to the east of the projection
    offset_y_m: float  # added to its north


@dataclass(frozen=True, eq=False)
class RoadNetwork:
    """An immutable road map; see the module's docstring for frames and the dtypes for fields.

    Arrays are read-only; ids are the names of the source, by row.
    """

    name: str  # the source file's name without its endings
    source_hash: str  # SHA-256 of the source, hex; part of every manifest and cache key
    points: NDArray[np.void]
    lanes: NDArray[np.void]
    edges: NDArray[np.void]
    links: NDArray[np.void]
    conflicts: NDArray[np.void]
    sweeps: NDArray[np.void]
    junctions: NDArray[np.void]
    into: NDArray[np.int32]  # LANE rows, see LANE["first_into"]
    signals: NDArray[np.void]
    programs: NDArray[np.void]
    phases: NDArray[np.void]
    phase_states: NDArray[np.uint8]  # signal letters as codes, see PHASE
    switches: NDArray[np.void]
    detectors: NDArray[np.void]
    phase_detectors: NDArray[np.int32]  # DETECTOR rows, see PHASE["first_detector"]
    lane_ids: tuple[str, ...]
    edge_ids: tuple[str, ...]
    junction_ids: tuple[str, ...]
    signal_ids: tuple[str, ...]
    program_ids: tuple[str, ...]
    junction_kinds: tuple[str, ...]  # SUMO's types that occur, by `JUNCTION["kind"]`
    geo: GeoReference | None = None  # where it lies on the earth; None: the map does not say
    left_hand: bool = False  # whether one drives on the left
    joined: NDArray[np.void] = field(default_factory=lambda: np.zeros(0, MAP))  # MAP of several
    map_names: tuple[str, ...] = ()  # of several
    # WALL (num_walls,) of the buildings, if they were asked for; see `maps.buildings`
    walls: NDArray[np.void] = field(default_factory=lambda: np.zeros(0, WALL))
    # (num_roofs, 4, 2) corners in m of the convex parts of their footprints
    roofs: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 4, 2)))
    # (num_roofs,) m over the ground
    roof_height: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, np.ndarray):
                value.setflags(write=False)

    @cached_property
    def arrays(self) -> RoadArrays:
        """The tables as kernels take them; from then on the fields are these.

        They are in huge pages; those of a large map stay where the cache's file is mapped.
        """
        file = file_of(self.lanes)
        is_copied = file is not None and len(file) <= COPIED
        for name in _TABLES:
            object.__setattr__(self, name, huge_copy(getattr(self, name), also_mapped=is_copied))
        if file is not None and is_copied:
            let_go(file)
        own = (getattr(self, name) for name in _TABLES)
        found = (*own, *map(huge_copy, self._places), self.maps)
        return RoadArrays(*found)

    def let_go(self) -> None:
        """Have only those parts of a cached map in memory that are used from now on."""
        file = file_of(self.lanes)
        if file is not None:
            let_go(file)

    @cached_property
    def maps(self) -> NDArray[np.void]:
        """MAP (M,): the maps that lie in it, one or, as `joined_maps.join` makes it, several."""
        if len(self.joined):
            return self.joined
        rows = np.zeros(1, MAP)
        rows["num_lanes"] = len(self.lanes)
        rows["num_signals"] = len(self.signals)
        rows["num_programs"] = len(self.programs)
        return rows

    def name_of(self, number: int) -> str:
        """What a map of it, by its MAP row, is called."""
        return self.map_names[number] if self.map_names else self.name

    def extent_of(self, number: int) -> tuple[float, float, float, float]:
        """`extent_m` of one of its maps."""
        row = self.maps[number]
        return _extent(self.lanes[row["first_lane"] : row["first_lane"] + row["num_lanes"]])

    @cached_property
    def room_m(self) -> tuple[float, float, float, float]:
        """(min_x, min_y, max_x, max_y) that any one of its maps fits in, moved if need be."""
        if len(self.maps) == 1:
            return self.extent_m
        extents = np.array([self.extent_of(number) for number in range(len(self.maps))])
        width, height = (extents[:, 2:] - extents[:, :2]).max(axis=0).tolist()
        return 0.0, 0.0, width, height

    @property
    def num_controllers(self) -> int:
        """Actuated programs: each keeps a state in every world."""
        return int((self.programs["controller"] >= 0).sum())

    @cached_property
    def _places(self) -> tuple[NDArray[np.int32], NDArray[np.void]]:
        """The first PLACE of every lane, (num_lanes,), and the PLACE rows.

        A vehicle belongs to the lane of its centre while its ends reach onto others: so a detector
        is listed with the internal lanes before and behind its own, too.
        """
        found: list[tuple[int, int, float]] = []
        for number, detector in enumerate(self.detectors):
            lane = self.lanes[detector["lane"]]
            s = float(detector["s_m"])
            found.append((int(detector["lane"]), number, s))
            if s < DETECTOR_REACH_M:
                into = self.into[lane["first_into"] : lane["first_into"] + lane["num_into"]]
                found += [
                    (int(before), number, s + float(self.lanes["length_m"][before]))
                    for before in into[self.lanes["internal"][into]]
                ]
            beyond = s - float(lane["length_m"])
            if beyond > -DETECTOR_REACH_M:
                links = self.links[lane["first_link"] : lane["first_link"] + lane["num_links"]]
                behind = links["first_internal"]
                found += [(int(row), number, beyond) for row in behind[behind >= 0]]
        first = np.full(len(self.lanes), -1, dtype=np.int32)
        places = np.zeros(len(found), PLACE)
        for row, (at, number, s) in enumerate(found):
            places[row] = (first[at], number, s)
            first[at] = row
        return first, places

    @cached_property
    def extent_m(self) -> tuple[float, float, float, float]:
        """(min_x, min_y, max_x, max_y) over all lanes: roads, not stray nodes."""
        return _extent(self.lanes)

    def lane_polyline(self, lane: int) -> NDArray[np.float64]:
        """The centre line of a lane as (num_points, 3) x, y, z in metres."""
        points = self.lane_points(lane)
        return np.stack([points["x"], points["y"], points["z"]], axis=1)

    def lane_points(self, lane: int) -> NDArray[np.void]:
        """POINT (num_points,) of a lane."""
        row = self.lanes[lane]
        return self.points[row["first_point"] : row["first_point"] + row["num_points"]]

    def pose_on(self, lane: int, s: float) -> tuple[float, float, float, float, float, float]:
        """X, y and z of a place on a lane, and cosine, sine and slope of its direction there."""
        row = self.lanes[lane]
        return lane_pose(self.points, row["first_point"], row["num_points"], s)

    def beside(self, lane: int, x: float, y: float) -> tuple[float, float, float, float]:
        """S and d of a place beside a lane, and cosine and sine of the lane's direction there."""
        row = self.lanes[lane]
        return project(self.points, row["first_point"], row["num_points"], x, y)

    @cached_property
    def content_hash(self) -> str:
        """SHA-256 over all arrays and ids, hex: two equal networks have equal hashes."""
        digest = hashlib.sha256()
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, np.ndarray):
                digest.update(content_of(value))
            elif isinstance(value, tuple):
                digest.update("\0".join(value).encode())
            elif isinstance(value, GeoReference):
                digest.update(repr(value).encode())
            elif value is True:
                digest.update(item.name.encode())
        return digest.hexdigest()


def _extent(lanes: NDArray[np.void]) -> tuple[float, float, float, float]:
    return (
        float(lanes["min_x"].min()),
        float(lanes["min_y"].min()),
        float(lanes["max_x"].max()),
        float(lanes["max_y"].max()),
    )


def content_of(array: NDArray[Any]) -> bytes:
    """The bytes of an array, of records field by field: what lies between these is anything."""
    names = array.dtype.names
    if names is None:
        return array.tobytes()
    return b"".join(array[name].tobytes() for name in names)
