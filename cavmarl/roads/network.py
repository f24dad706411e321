"""`RoadNetwork`: a road map as a set of immutable record arrays.

Frames and units: metres, radians, metres per second; x east, y north, z up, right-handed; headings
are counter-clockwise from east. A lane is a polyline along its centre in driving direction; `s` is
the arc length along the polyline and `d` the lateral offset, positive to the left.

Every lane has one row, including junction-internal lanes. A *link* is one permitted movement over a
junction: from the end of a lane, along a chain of internal lanes, to the start of an outgoing lane.
Arrays contain records, so that a kernel has one parameter instead of ten.

An index of -1 means "none".
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

# Permission bits of LANE["permissions"]: SUMO's abstract vehicle classes that drive on roads.
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
CARS = 1 << VEHICLE_CLASSES.index("passenger")

# SUMO's signal letters in the order of their codes in `phase_states`.
SIGNAL_STATES = "rugGysoOY"

POINT = record(
    ("x", np.float64),  # m
    ("y", np.float64),  # m
    ("z", np.float64),  # m
    ("s", np.float64),  # m from the start of the lane, in the plane
    # direction of the segment that starts here (the last point repeats the previous one)
    ("cos", np.float64),
    ("sin", np.float64),
    ("slope", np.float64),  # dz/ds of that segment
    ("heading", np.float64),  # heading of that segment, rad
    ("left_s", np.float64),  # position beside this point on the left neighbour lane, m
    ("right_s", np.float64),
)

# The fields that drivers read most come first, so that they share a cache line.
LANE = record(
    # arc length of the polyline in the plane: the `s` of its last point
    ("length_m", np.float64),
    ("speed_mps", np.float64),  # speed limit
    ("width_m", np.float64),
    ("internal", np.bool_),  # inside a junction
    # whether this lane's vehicles have the right of way over vehicles that turn, without a signal,
    # into the road beyond its end; these watch the last `records.rows.MERGES_M` before that line
    ("merges", np.bool_),
    ("left", np.int32),  # LANE row of the left neighbour in the same direction
    ("right", np.int32),
    ("successor", np.int32),  # internal lanes: the LANE that follows (internal or normal)
    ("link", np.int32),  # internal lanes: the LINK that this lane is part of
    # LINK rows of the movements from this lane's end; none for internal lanes (see `successor`)
    ("first_link", np.int32),
    ("num_links", np.int32),
    ("first_point", np.int32),  # POINT rows [first_point, first_point + num_points)
    ("num_points", np.int32),  # at least 2
    ("edge", np.int32),  # EDGE row; also for internal lanes
    # internal lanes: path length of the link before this lane
    ("link_offset_m", np.float64),
    # from the stop line to the lane's end; 0 unless other paths come near or the map says so
    ("stop_back_m", np.float64),
    # into[first_into : first_into + num_into]: LANE rows that lead here (internal lanes if the map
    # has them)
    ("first_into", np.int32),
    ("num_into", np.int32),
    # bit k set: VEHICLE_CLASSES[k] may drive here; bit NO_CHANGE_LEFT + k or NO_CHANGE_RIGHT + k
    # set: it must not change lanes to that side (a solid line). 0: a contraflow lane, see
    # `maps.contraflow`
    ("permissions", np.uint32),
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
    ("from_junction", np.int32),  # JUNCTION rows; both are the same for internal edges
    ("to_junction", np.int32),
    ("length_m", np.float64),
    ("speed_mps", np.float64),
)

LINK = record(
    ("from_lane", np.int32),  # LANE before the junction; its end is the stop line
    ("to_lane", np.int32),  # LANE after the junction
    ("first_internal", np.int32),  # first LANE of the chain inside the junction
    # lane after the end of from_lane: first_internal, or to_lane
    ("next_lane", np.int32),
    ("length_m", np.float64),  # length of the chain of internal lanes
    ("fork_m", np.float64),  # length of the part of the path that is near paths from the same lane
    ("wait_m", np.float64),  # from the stop line to the waiting position inside; inf: none
    ("junction", np.int32),
    ("index", np.int32),  # the link's bit in its junction's request, response and foes
    ("signal", np.int32),  # SIGNAL row
    ("signal_index", np.int32),  # index of the letter in the signal's state
    ("direction", np.uint8),  # ord of SUMO's dir: s t l r L R
    ("state", np.uint8),  # ord of SUMO's link state when no signal controls it: M m = s w Z o …
    ("may_block", np.bool_),  # vehicles enter without room beyond the junction (keepClear="0")
    ("first_conflict", np.int32),  # CONFLICT rows, sorted by the foe's LINK row
    ("num_conflicts", np.int32),
    ("first_sweep", np.int32),  # SWEEP rows, sorted by `own`, then by the foe's LINK row
    ("num_sweeps", np.int32),
    ("swept_by", np.int32),  # the smallest size class of vehicles that sweep over cars on this link
    ("swept_m", np.float64),  # up to here, rears may sweep over other lanes; m from the stop line
)

CONFLICT = record(
    ("foe", np.int32),  # LINK whose path crosses or merges with this link's path (a `foes` bit)
    ("merging", np.bool_),  # whether both links lead into one lane
    ("must_yield", np.bool_),  # whether this link must yield to the foe (a `response` bit)
    ("near", np.bool_),  # False: the links are foes in the map, but their paths stay apart
    ("enter_m", np.float64),  # start and end of the shared area on this link's path,
    ("leave_m", np.float64),  # from the stop line; leave = the whole length if both merge
    ("foe_enter_m", np.float64),  # the same area on the foe's path
    ("foe_leave_m", np.float64),
)

SWEEP = record(
    ("foe", np.int32),  # LINK of the same junction; a U-turn is also a foe of its own lane's links
    ("own", np.int32),  # size class (`SIZE_LENGTHS_M`) of the vehicle on this link
    ("other", np.int32),  # size class of the vehicle on the foe's path
    # distances from the stop line at which a front begins, and a rear ceases, to obstruct the foe;
    # may be outside the junction; if the body is longer than the shared area, leave < enter
    ("enter_m", np.float64),
    ("leave_m", np.float64),
    ("foe_enter_m", np.float64),  # the same distances on the foe's path
    ("foe_leave_m", np.float64),
)

JUNCTION = record(
    ("x", np.float64),
    ("y", np.float64),
    ("z", np.float64),
    ("kind", np.int32),  # index into RoadNetwork.junction_kinds
    ("signal", np.int32),  # SIGNAL row of the traffic light here
    ("unruled", np.bool_),  # the map has no rule for some movements that end in the same lane
)

SIGNAL = record(
    ("program", np.int32),  # PROGRAM at the beginning of the episode
    ("num_links", np.int32),  # number of letters in a state
    ("first_switch", np.int32),  # SWITCH rows, in order of time
    ("num_switches", np.int32),
)

PROGRAM = record(
    ("signal", np.int32),
    ("first_phase", np.int32),  # PHASE rows [first_phase, first_phase + num_phases)
    ("num_phases", np.int32),
    ("offset_s", np.float64),  # delay of all phases
    ("cycle_s", np.float64),  # sum of the phases' durations
    # if actuated, or chosen by an agent: index in a world's controllers
    ("controller", np.int32),
    # if actuated: time from a detector to the stop line at the speed limit; or CHOSEN_BY_AGENT
    ("detector_gap_s", np.float64),
    ("simplified", np.bool_),  # whether rules of the program in SUMO are not implemented
)

PHASE = record(
    ("duration_s", np.float64),
    ("min_ms", np.int64),  # if actuated: bounds of the duration, in SUMO's unit of time
    ("max_ms", np.int64),
    ("following", np.int32),  # if actuated: the next PHASE
    ("green", np.bool_),  # some letter is green and none is yellow, so the phase may be prolonged
    ("first_state", np.int32),  # phase_states[first_state : first_state + num_links]
    ("first_detector", np.int32),  # phase_detectors that prolong the phase
    ("num_detectors", np.int32),
)

SWITCH = record(
    ("signal", np.int32),
    ("at_s", np.float64),  # time since the beginning of the episode
    ("program", np.int32),  # PROGRAM that then starts
)

DETECTOR = record(
    ("lane", np.int32),  # LANE of the detector; its signal may be at the end of the next lane
    ("s_m", np.float64),  # position on that lane
    ("max_gap_s", np.float64),  # the green ends after the detector was free this long
)

# A detector that vehicles on a lane can cover; a linked list per lane, see `RoadNetwork._places`.
PLACE = record(
    ("next", np.int32),  # the next PLACE of the same lane
    ("detector", np.int32),
    # s of the detector along this lane; outside of the lane if the detector is on another lane
    ("s_m", np.float64),
)

# Rows of one map are contiguous; in a network of several maps, a world uses one map.
MAP = record(
    ("first_lane", np.int32),  # LANE rows [first_lane, first_lane + num_lanes)
    ("num_lanes", np.int32),
    ("first_signal", np.int32),  # SIGNAL rows
    ("num_signals", np.int32),
    ("first_program", np.int32),  # PROGRAM rows
    ("num_programs", np.int32),
)

# Maps with files below this size are copied to memory with huge pages. With a larger, mapped file,
# ticks take a tenth longer, because they read many small pages, but processes share the memory.
COPIED = 1 << 27

# Fields of a network for kernels, in the order of `RoadArrays`.
_TABLES = (
    "points", "lanes", "edges", "links", "conflicts", "sweeps", "into", "signals", "programs",
    "phases", "phase_states", "switches", "detectors", "phase_detectors",
)  # fmt: skip


@dataclass(frozen=True)
class GeoReference:
    """The position of a map on the earth: x and y are projected coordinates plus the offset."""

    projection: str  # PROJ parameters
    offset_x_m: float  # added to the projected easting
    offset_y_m: float  # added to the projected northing


@dataclass(frozen=True, eq=False)
class RoadNetwork:
    """An immutable road map; the module describes frames, and the record types describe fields.

    Arrays are read-only; ids are the names in the source, by row.
    """

    name: str  # name of the source file without its suffixes
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
    junction_kinds: tuple[str, ...]  # SUMO's junction types, by `JUNCTION["kind"]`
    geo: GeoReference | None = None  # position on the earth; None: not given by the map
    left_hand: bool = False  # whether the map has left-hand traffic
    # differences from the lanes of the source, and elements that are not simulated, with counts
    notes: tuple[str, ...] = ()
    # MAP rows if the network has several maps, else empty
    joined: NDArray[np.void] = field(default_factory=lambda: np.zeros(0, MAP))
    map_names: tuple[str, ...] = ()  # empty for a single map
    # WALL (num_walls,) of the buildings, if requested; see `maps.buildings`
    walls: NDArray[np.void] = field(default_factory=lambda: np.zeros(0, WALL))
    # (num_roofs, 4, 2) corners in m of the convex parts of the buildings' footprints
    roofs: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 4, 2)))
    # (num_roofs,) m above the ground
    roof_height: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, np.ndarray):
                value.setflags(write=False)

    @cached_property
    def arrays(self) -> RoadArrays:
        """The tables for kernels, in huge pages; tables of a large map stay in the mapped file.

        The first access replaces the fields of the network by the same arrays.
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
        """Release the memory of a cached map; a later access reads the file again."""
        file = file_of(self.lanes)
        if file is not None:
            let_go(file)

    @cached_property
    def maps(self) -> NDArray[np.void]:
        """MAP (M,): the maps of the network: one, or several from `joined_maps.join`."""
        if len(self.joined):
            return self.joined
        rows = np.zeros(1, MAP)
        rows["num_lanes"] = len(self.lanes)
        rows["num_signals"] = len(self.signals)
        rows["num_programs"] = len(self.programs)
        return rows

    def name_of(self, number: int) -> str:
        """Return the name of the map in a MAP row."""
        return self.map_names[number] if self.map_names else self.name

    def extent_of(self, number: int) -> tuple[float, float, float, float]:
        """Return the `extent_m` of one of the maps."""
        row = self.maps[number]
        return _extent(self.lanes[row["first_lane"] : row["first_lane"] + row["num_lanes"]])

    @cached_property
    def room_m(self) -> tuple[float, float, float, float]:
        """(min_x, min_y, max_x, max_y) of an area into which each of the maps can be moved."""
        if len(self.maps) == 1:
            return self.extent_m
        extents = np.array([self.extent_of(number) for number in range(len(self.maps))])
        width, height = (extents[:, 2:] - extents[:, :2]).max(axis=0).tolist()
        return 0.0, 0.0, width, height

    @property
    def num_controllers(self) -> int:
        """Number of programs with a state in every world: actuated, or controlled by an agent."""
        return int((self.programs["controller"] >= 0).sum())

    @cached_property
    def _places(self) -> tuple[NDArray[np.int32], NDArray[np.void]]:
        """The first PLACE of every lane, (num_lanes,), and the PLACE rows.

        A vehicle belongs to the lane of its centre, but its body may extend onto the previous or
        next lane. So a detector is also listed for the internal lanes before and after its lane.
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
        """(min_x, min_y, max_x, max_y) of all lanes; nodes without lanes do not count."""
        return _extent(self.lanes)

    def lane_polyline(self, lane: int) -> NDArray[np.float64]:
        """Return the centre line of a lane as (num_points, 3) x, y, z in metres."""
        points = self.lane_points(lane)
        return np.stack([points["x"], points["y"], points["z"]], axis=1)

    def lane_points(self, lane: int) -> NDArray[np.void]:
        """Return POINT (num_points,) of a lane."""
        row = self.lanes[lane]
        return self.points[row["first_point"] : row["first_point"] + row["num_points"]]

    def pose_on(self, lane: int, s: float) -> tuple[float, float, float, float, float, float]:
        """Return x, y, z of a position on a lane, and the lane's cosine, sine and slope there."""
        row = self.lanes[lane]
        return lane_pose(self.points, row["first_point"], row["num_points"], s)

    def beside(self, lane: int, x: float, y: float) -> tuple[float, float, float, float]:
        """Return s and d of a point beside a lane, and the lane's cosine and sine there."""
        row = self.lanes[lane]
        return project(self.points, row["first_point"], row["num_points"], x, y)

    @cached_property
    def content_hash(self) -> str:
        """SHA-256 of all arrays and ids, hex: equal networks have equal hashes."""
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
    """Return the bytes of an array; records are read by field, because padding is undefined."""
    names = array.dtype.names
    if names is None:
        return array.tobytes()
    return b"".join(array[name].tobytes() for name in names)
