"""Checks of recorded frames before pictures and pages use their indices and sizes."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.population import MAX_IDS
from cavmarl.core.records.codes import CLASS_PEDESTRIAN, DRIVER_BACKGROUND, DRIVER_LEARNED
from cavmarl.engine.state_check import wrong_phases
from cavmarl.engine.world_frame import SEEN, WorldFrame
from cavmarl.roads.network import RoadNetwork
from cavmarl.shards.row_check import MOST, MOST_IDS, ColumnCheck

if TYPE_CHECKING:
    from cavmarl.recordings.recording_format import RecordedFrame

MOST_TICKS = 1 << 32
MOST_SECONDS = 1e9
MOST_SIZE_M = 1000.0  # length, width or height of a vehicle
_FLOATS = [name for name in SEEN.names or () if SEEN[name].kind == "f"]


def wrong_frames(frames: Sequence[RecordedFrame], rows: NDArray[np.void], num_zones: int) -> str:
    """Return what is wrong with frames of a world; empty if nothing.

    Args:
        frames: the frames of one part.
        rows: SEEN (n,) of all frames, in order.
        num_zones: number of zones of the recording.
    """
    return (
        next(filter(None, (_wrong_frame(one, num_zones) for one in frames)), "")
        or _wrong_order(frames)
        or _wrong_vehicles(frames, rows, num_zones)
    )


def wrong_on_map(frame: WorldFrame, network: RoadNetwork) -> str:
    """Return why a frame cannot be drawn on a map; empty if it can."""
    if len(frame.signals) not in (len(network.signals), len(network.signals) + len(network.links)):
        return f"a frame has {len(frame.signals)} signals, and the map has {len(network.signals)}"
    return wrong_phases(frame.signals, network)


def _wrong_frame(one: RecordedFrame, num_zones: int) -> str:
    frame = one.frame
    if one.episode < 0 or not 0 <= frame.tick < MOST_TICKS:
        return f"a frame has episode {one.episode} and tick {frame.tick}"
    if not 0.0 <= frame.time_s <= MOST_SECONDS:
        return f"time_s is {frame.time_s:g} at tick {frame.tick}"
    if len(frame.ghosts) not in (0, num_zones):
        return f"a frame has the ghosts of {len(frame.ghosts)} zones, and there are {num_zones}"
    for transfer in frame.transfers:
        if not (0 <= transfer.source < num_zones and 0 <= transfer.target < num_zones):
            return f"vehicle {transfer.vehicle} changes to zone {transfer.target} of {num_zones}"
    if len(frame.signals) and int(frame.signals.min()) < 0:
        return f"a signal has phase {int(frame.signals.min())}"
    return ""


def _wrong_order(frames: Sequence[RecordedFrame]) -> str:
    moments = [(one.episode, one.frame.tick) for one in frames]
    if all(one < after for one, after in pairwise(moments)):
        return ""
    return "its frames are not in order"


def _wrong_vehicles(frames: Sequence[RecordedFrame], rows: NDArray[np.void], num_zones: int) -> str:
    ints = {
        "id": range(MOST_IDS),
        "lane": range(-1, MOST),
        "agent": range(-1, MAX_IDS),
        "events": range(MOST),
        "vclass": range(CLASS_PEDESTRIAN + 1),
        "zone": range(num_zones),
        "target_zone": range(-1, num_zones),
        "driver": range(DRIVER_BACKGROUND, DRIVER_LEARNED + 1),
        "blinker": range(-1, 2),
    }
    if wrong := ColumnCheck(ints, _FLOATS, ("to_go",), {}).wrong(rows):
        return wrong
    for name in ("length", "width", "height"):
        wrong_size = ~((rows[name] > 0.0) & (rows[name] <= MOST_SIZE_M))
        if wrong_size.any():
            row = rows[np.argmax(wrong_size)]
            return f"vehicle {row['id']} has {name} = {row[name]:g}, not in (0, {MOST_SIZE_M:g}] m"
    is_after = np.diff(rows["id"]) > 0
    starts = np.cumsum([len(one.frame.vehicles) for one in frames])
    starts = starts[(starts > 0) & (starts < len(rows))]
    is_after[starts - 1] = True
    return "" if is_after.all() else "the vehicles of a frame are not in the order of their ids"
