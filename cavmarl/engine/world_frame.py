"""`WorldFrame`: one world between two steps, for viewers and recordings."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.records.codes import (
    EVENT_ARRIVED,
    EVENT_COLLIDED,
    EVENT_OFF_ROAD,
    EVENT_OUT_OF_TIME,
    EVENT_RED_LIGHT,
    EVENT_WRONG_WAY,
)
from cavmarl.engine.kernels.seen_rows import write_seen
from cavmarl.engine.world_views import WorldViews
from cavmarl.handoff.zone_view import TransferInFlight
from cavmarl.roads.network import SIGNAL_STATES
from cavmarl.shards.shard import override_columns

# One vehicle of a frame. Units and coordinate frames are as in `driving.vehicles.VEHICLE`.
SEEN = np.dtype(
    [
        ("id", "<i8"),
        ("x", "<f8"),
        ("y", "<f8"),
        ("z", "<f8"),
        ("heading", "<f8"),
        ("pitch", "<f8"),
        ("speed", "<f8"),
        ("accel", "<f8"),
        ("steering", "<f8"),
        ("distance_m", "<f8"),
        ("to_go", "<f8"),
        ("length", "<f4"),
        ("width", "<f4"),
        ("height", "<f4"),
        ("lane", "<i4"),
        ("agent", "<i4"),
        ("events", "<i4"),
        ("vclass", "<i2"),
        ("zone", "<i2"),  # the owner
        ("target_zone", "<i2"),  # target of the transfer in flight; -1: none
        ("driver", "i1"),
        ("blinker", "i1"),
        ("transfer", "i1"),  # 1: a transfer is in flight
    ]
)
# An agent whose trip ended in the step before the frame, and the EVENT_* bits that ended it.
ENDED = np.dtype([("agent", "<i4"), ("events", "<i4")])
NONE_ENDED = np.zeros(0, dtype=ENDED)

_KINDS = {
    EVENT_COLLIDED: "collision",
    EVENT_OFF_ROAD: "off_road",
    EVENT_WRONG_WAY: "wrong_way",
    EVENT_RED_LIGHT: "red_light",
    EVENT_ARRIVED: "arrived",
    EVENT_OUT_OF_TIME: "out_of_time",
}


class WorldFrame(NamedTuple):
    """One world between two steps. It owns its arrays."""

    world: int
    tick: int  # ticks since the reset
    time_s: float
    vehicles: NDArray[np.void]  # SEEN (n,), by id
    signals: NDArray[np.int32]  # active PHASE rows and more, see `Worlds.signal_phase`
    transfers: tuple[TransferInFlight, ...] = ()
    ghosts: tuple[NDArray[np.int64], ...] = ()  # ids of each zone's ghosts
    ended: NDArray[np.void] = NONE_ENDED  # ENDED (m,): agents that are not among `vehicles`
    # kind and detail of each change that the caller made in the step before
    asked: tuple[tuple[str, str], ...] = ()
    num_overrides: int = 0  # columns at the end of `signals` with states of the caller, by link


class FrameEvent(NamedTuple):
    """An event between two frames."""

    tick: int  # tick of the later frame
    # departed, left, arrived, collision, off_road, wrong_way, red_light, out_of_time,
    # transferred, signal; inserted, closed, opened, damaged, reversed: changes by the caller
    kind: str
    vehicle: int  # id; -1: no vehicle
    agent: int  # index; -1: no agent
    detail: str


def frame_of(
    simulation: WorldViews,
    world: int = 0,
    ghosts: bool = False,
    ended: NDArray[np.void] = NONE_ENDED,
    asked: tuple[tuple[str, str], ...] = (),
    room: Callable[[int], NDArray[np.void]] | None = None,
) -> WorldFrame:
    """Return a frame of the present state of one world.

    Args:
        simulation: the worlds.
        world: the index of the world.
        ghosts: whether to include the ids of each zone's ghosts.
        ended: ENDED, of the last step.
        asked: kind and detail of each change that the caller made in the last step.
        room: returns memory for n records SEEN; None: new memory.
    """
    rows = simulation.vehicles(world)
    seen = np.empty(len(rows), dtype=SEEN) if room is None else room(len(rows))
    order = np.argsort(rows["id"], kind="stable")  # fast for ids that are almost sorted
    write_seen(rows, order, simulation.types, seen)
    view = simulation.zones.view(world) if simulation.partition.count > 1 else None
    if view is not None and view.transfers:
        _mark_transfers(seen, view.transfers)
    tick = int(simulation.ticks()[world])
    return WorldFrame(
        world,
        tick,
        tick * simulation.config.clock.sim_dt_s,
        seen,
        simulation.signal_phases(world).copy(),
        () if view is None else view.transfers,
        view.ghosts if view is not None and ghosts else (),
        ended,
        asked,
        override_columns(simulation.config, simulation.network),
    )


def _mark_transfers(seen: NDArray[np.void], transfers: Sequence[TransferInFlight]) -> None:
    """Write the target zones of vehicles in transfer into SEEN (n,), which is ordered by id."""
    targets = {transfer.vehicle: transfer.target for transfer in transfers}
    moving = np.flatnonzero(np.isin(seen["id"], list(targets)))
    seen["target_zone"][moving] = [targets[int(number)] for number in seen["id"][moving]]
    seen["transfer"][moving] = 1


def events_between(before: WorldFrame, after: WorldFrame) -> Iterator[FrameEvent]:
    """Yield the events between two frames of an episode: the caller's, vehicles', signals'."""
    for kind, detail in after.asked:
        yield FrameEvent(after.tick, kind, -1, -1, detail)
    ids, were = after.vehicles["id"], before.vehicles["id"]
    both = ids
    old: Any = slice(None)
    new: Any = slice(None)
    if not np.array_equal(ids, were):
        for row in after.vehicles[~np.isin(ids, were)]:
            yield FrameEvent(after.tick, "departed", int(row["id"]), int(row["agent"]), "")
        bits_of = {int(end["agent"]): int(end["events"]) for end in after.ended}
        for row in before.vehicles[~np.isin(were, ids)]:
            bits = bits_of.get(int(row["agent"]), 0)
            kinds = [kind for bit, kind in _KINDS.items() if bits & bit] or ["left"]
            for kind in kinds:
                yield FrameEvent(after.tick, kind, int(row["id"]), int(row["agent"]), "")
        both, old, new = np.intersect1d(were, ids, assume_unique=True, return_indices=True)
    rows, zones = after.vehicles[new], before.vehicles["zone"][old]
    events = rows["events"]
    moved = zones != rows["zone"]
    for k in np.flatnonzero(moved | (events != 0)):
        row, agent = rows[k], int(rows["agent"][k])
        for bit, kind in _KINDS.items():
            if events[k] & bit:
                yield FrameEvent(after.tick, kind, int(both[k]), agent, "")
        if moved[k]:
            detail = f"{zones[k]} to {row['zone']}"
            yield FrameEvent(after.tick, "transferred", int(both[k]), agent, detail)
    num_signals = len(after.signals) - after.num_overrides
    for column in np.flatnonzero(before.signals != after.signals):
        shown = after.signals[column]
        if column < num_signals:
            detail = f"{column}: phase {shown}"
        else:
            letter = SIGNAL_STATES[shown - 1] if shown else "its program"
            detail = f"link {column - num_signals}: shows {letter}"
        yield FrameEvent(after.tick, "signal", -1, -1, detail)
