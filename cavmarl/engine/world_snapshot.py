"""The state of W worlds that the next tick depends on: as arrays to resume from, and as a digest.

Ownership is part of the state, but changes no result. Worlds with the same zones restore it, so
that vehicles change their owners in the same ticks and the journal continues without a break.
Worlds with different zones ignore it, and give each vehicle to the zone that contains it, as at a
reset.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.records.arrays import DepartureQueue, Outputs, SharedState, Worlds
from cavmarl.core.records.codes import DRIVER_LEARNED
from cavmarl.driving.vehicles import MEMORY_FIELDS, STATE_FIELDS
from cavmarl.engine.component import Component
from cavmarl.engine.lane_component import LaneComponent
from cavmarl.engine.state_check import StateForm
from cavmarl.handoff.coordinator.coordinators import OwnershipRuntime
from cavmarl.handoff.coordinator.saved_ownership import SavedOwnership, zone_table
from cavmarl.handoff.division import ZonedShards
from cavmarl.shards.state import Use, arrays_of
from cavmarl.traffic.native import NativeTraffic
from cavmarl.traffic.sumo.sumo_traffic import SumoTraffic
from cavmarl.zones.partition.zone_partition import ZonePartition

Array = NDArray[Any]


class Parts(NamedTuple):
    """The parts that keep the state of W worlds."""

    worlds: Worlds  # the worlds of the first shard
    division: ZonedShards  # all shards
    departures: DepartureQueue  # queue through which vehicles enter and leave
    traffic: NativeTraffic  # departures, routes and arrivals
    outputs: Outputs  # agents' outputs, including the frames that the next observation stacks
    coordination: OwnershipRuntime  # decides ownership
    partition: ZonePartition  # the zones
    repartition_steps_done: int  # steps begun so far, which decide when zones are cut again
    has_past: bool  # whether an observation depends on the previous observation
    attached: tuple[Component, ...]  # components that act in each tick
    sumo: SumoTraffic | None  # the other simulator; None: there is none


def save(parts: Parts) -> list[Array]:
    """Return the arrays. Some of them are views: copy them before the next tick."""
    worlds, departures = parts.worlds, parts.departures
    waiting = int(departures.num_queue.max(initial=0))
    return [
        *_fixed(parts),
        departures.queue[:, :waiting],
        *_of_rerouting(parts),
        _stacked([_ownership(parts, w)[np.newaxis] for w in range(len(worlds.ticks))]),
        parts.division.contacts(),
        *(
            parts.division.owned(w, zone)
            for w in range(len(worlds.ticks))
            for zone in range(parts.division.count)
        ),
    ]


def load(
    parts: Parts,
    saved: Sequence[Array],
    ownership: Sequence[SavedOwnership] | None,  # of each world, as `ownership_of` returns it
    home: int | None = None,  # a zone of this process, if other processes exist; see `put_back`
) -> DepartureQueue:  # the departure queue, or a larger one
    """Restore a state. Vehicles go to their former owners, or to the zones that contain them.

    Raises:
        JournalError: the journal does not contain the position that the state names.
    """
    everywhere = np.ones(len(parts.worlds.ticks), dtype=np.bool_)
    rest = iter(saved)
    parts.division.align()
    for array in _fixed(parts):
        array[...] = next(rest)
    for part in parts.attached:
        if isinstance(part, LaneComponent):
            part.renew_plans()
    # The keys determine all departures of a demand file; those already due are in the queue.
    departures = parts.traffic.draw_orders(parts.departures, parts.worlds, everywhere)
    queue = next(rest)
    departures.queue[:, : queue.shape[1]] = queue
    departures.num_passing[:] = 0
    for array in _of_rerouting(parts):
        _put(array, next(rest))
    next(rest)  # the packed ownership, which the caller has read
    contacts = next(rest)
    vehicles = [[next(rest) for _ in range(parts.division.count)] for _ in everywhere]
    if home is not None:
        parts.division.put_back(vehicles, contacts, home)
    elif ownership is None:
        parts.division.place([np.concatenate(zones) for zones in vehicles], contacts)
    else:
        owned = [
            np.split(np.concatenate(zones), np.cumsum(one.counts)[:-1])
            for zones, one in zip(vehicles, ownership, strict=True)
        ]
        goes_on = _can_continue_journals(parts, ownership)
        parts.division.put_back(owned, contacts, 0, keeps_epochs=goes_on)
        ownership = ownership if goes_on else None
    parts.coordination.go_on(ownership)
    return departures


def form_of(parts: Parts) -> StateForm:
    """Return the form that a saved state of these worlds must have."""
    rerouting = [*_of_rerouting(parts)]
    return StateForm(
        parts.traffic.network.arrays,
        parts.division,
        parts.traffic,
        parts.attached,
        [*_fixed(parts)],
        rerouting,
    )


def ownership_of(parts: Parts, saved: Sequence[Array]) -> list[SavedOwnership] | None:
    """Return the owners of vehicles in a saved state; None: unknown, or of different zones.

    Raises:
        ConfigError: the ownership contradicts the vehicles of the state.
    """
    division, num_worlds = parts.division, len(parts.worlds.ticks)
    if not parts.coordination.resumes:
        return None
    first = len(saved) - num_worlds * division.count
    found: list[SavedOwnership] = []
    for w, words in enumerate(saved[first - 2]):
        one = SavedOwnership.unpack(words)
        if one is None or len(one.zones) != 1 + division.count:
            return None
        if found and one.zones.tobytes() != found[0].zones.tobytes():
            return None
        rows = np.concatenate(saved[first + w * division.count : first + (w + 1) * division.count])
        one.check(rows, division.count, parts.worlds.rows.shape[1])
        found.append(one)
    return found


def _can_continue_journals(parts: Parts, ownership: Sequence[SavedOwnership]) -> bool:
    """Return whether all journals, if any, can continue from their position in a saved state.

    A state from a file has no position; the journal then begins a new episode.
    """
    pairs = zip(parts.coordination.coordinators, ownership, strict=True)
    return all(
        coordinator.journal is None or one.numbers.journal.lines >= 0 for coordinator, one in pairs
    )


def _ownership(parts: Parts, w: int) -> Array:
    """Return the packed ownership (n,) of one world; empty if this process does not know it."""
    saved = parts.coordination.save(w)
    if saved is None:
        return np.zeros(0, dtype=np.int64)
    numbers = saved.numbers._replace(repartition_steps_done=parts.repartition_steps_done)
    return saved._replace(zones=zone_table(parts.partition), numbers=numbers).pack()


def share_of(parts: Parts, w: int) -> list[Array]:
    """Return the arrays of `save` for one world alone. Some of them are views: copy them."""
    departures, rerouting = parts.departures, parts.traffic.rerouting
    owns_ways = parts.traffic.owns_ways
    waiting = departures.queue[w : w + 1, : departures.num_queue.item(w)]
    owned = [parts.division.owned(w, zone) for zone in range(parts.division.count)]
    if owns_ways:
        owned = [rows.copy() for rows in owned]
        for rows in owned:
            rows["way"] = parts.traffic.moved_ways(rows["way"], -w)
    if parts.sumo is not None:
        waiting, owned = waiting.copy(), [rows.copy() for rows in owned]
        for rows in (waiting, *owned):
            parts.sumo.single(rows, w)
    return [
        *(array[w : w + 1] for array in _fixed(parts)),
        waiting,
        *(() if rerouting is None else rerouting.arrays_of(w)),
        _ownership(parts, w)[np.newaxis],
        parts.division.contacts()[w : w + 1],
        *owned,
    ]


def join(parts: Parts, shares: Sequence[Sequence[Array]]) -> list[Array]:
    """Join states of single worlds to the arrays that `save` would return for all of them."""
    zones = parts.division.count
    if parts.sumo is not None:
        shares = [_shifted(parts, parts.sumo, share, w) for w, share in enumerate(shares)]
    fields = zip(*(share[:-zones] for share in shares), strict=True)
    joined = [_stacked(field) for field in fields]
    for w, share in enumerate(shares):
        for owned in share[-zones:]:
            rows = owned.copy()
            if parts.traffic.owns_ways:
                rows["way"] = parts.traffic.moved_ways(rows["way"], w)
            joined.append(rows)
    return joined


def _shifted(
    parts: Parts, sumo: SumoTraffic, share: Sequence[Array], worlds: int
) -> Sequence[Array]:
    """Return a copy of one world's share, with vehicles and queue converted to world `worlds`."""
    found = list(share)
    queue = sum(1 for _ in _fixed(parts))
    for n in (queue, *range(len(found) - parts.division.count, len(found))):
        found[n] = found[n].copy()
        sumo.placed(found[n], worlds)
    return found


def _stacked(shares: Sequence[Array]) -> Array:
    """Stack arrays of one world each. Shorter arrays are padded with zeros."""
    if shares[0].ndim < 2:
        return np.concatenate(shares, dtype=shares[0].dtype)  # keeps padding in records
    longest = max(share.shape[1] for share in shares)
    stacked = np.zeros((len(shares), longest, *shares[0].shape[2:]), dtype=shares[0].dtype)
    for row, share in zip(stacked, shares, strict=True):
        row[: share.shape[1]] = share[0]
    return stacked


def _fixed(parts: Parts) -> Iterator[Array]:
    """Yield the arrays whose shapes (W, …) follow from the environment."""
    yield from arrays_of(parts.worlds, SharedState, Use.SAVED)
    yield from arrays_of(parts.departures, DepartureQueue, Use.SAVED)
    for array in arrays_of(parts.outputs, Outputs, Use.SAVED):
        if array is not parts.outputs.observations or parts.has_past:
            yield array
    for part in parts.attached:
        yield from part.arrays()


def _of_rerouting(parts: Parts) -> Iterator[Array]:
    if parts.traffic.rerouting is not None:
        yield from parts.traffic.rerouting.arrays()


def _put(target: Array, saved: Array) -> None:
    """Copy the common part of two arrays, whose room for departures may differ."""
    shared = tuple(slice(min(pair)) for pair in zip(target.shape, saved.shape, strict=True))
    target[shared] = saved[shared]


def digest_world(parts: Parts, world: int) -> str:
    """Return a hex digest of one world, for any order of rows; see `Simulation.state_hash`."""
    worlds, departures, rerouting = parts.worlds, parts.departures, parts.traffic.rerouting
    sumo = parts.sumo
    rows = parts.division.vehicles(world)
    rows = rows[np.argsort(rows["id"])]
    if parts.traffic.owns_ways:
        rows["way"] = parts.traffic.moved_ways(rows["way"], -world)
    if sumo is not None:
        sumo.single(rows, world)
    digest = hashlib.blake2b(digest_size=16)
    remembers = (rows["driver"] == DRIVER_LEARNED).any()
    for name in STATE_FIELDS:
        if name in MEMORY_FIELDS and not remembers:
            continue
        digest.update(np.ascontiguousarray(rows[name]).tobytes())
    agents = rows["agent"][rows["agent"] >= 0]
    digest.update(worlds.pending[world, agents].tobytes())
    queue = departures.queue[world, : departures.num_queue[world]]
    if sumo is not None:
        queue = queue.copy()
        sumo.single(queue, world)
    for name in queue.dtype.names or ():
        digest.update(np.ascontiguousarray(queue[name]).tobytes())
    common = arrays_of(worlds, SharedState, Use.DIGESTED)
    for array in (*common, *arrays_of(departures, DepartureQueue, Use.DIGESTED)):
        digest.update(array[world].tobytes())
    if rerouting is not None:
        for array in rerouting.state(world, parts.division.vehicles(world)):
            digest.update(array.tobytes())
    for part in parts.attached:
        for array in part.arrays():
            digest.update(array[world].tobytes())
    return digest.hexdigest()
