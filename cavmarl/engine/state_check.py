"""Checks of a saved state before any part of it reaches the worlds.

A state comes from a file, from a worker that has died, or from another node. Kernels use its
numbers as indices without bounds checks.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError
from cavmarl.core.records.arrays import DepartureQueue, RoadArrays, SharedState
from cavmarl.core.records.codes import (
    CHOSEN_BY_AGENT,
    DRIVER_AGENT,
    DRIVER_BACKGROUND,
    DRIVER_EXTERNAL,
    LANE_BEST,
    LANE_GIVEN,
    POS_GIVEN,
    POS_LAST,
    SPEED_AVERAGE,
    SPEED_GIVEN,
)
from cavmarl.driving.vehicles import VEHICLE, blank_vehicle
from cavmarl.engine.component import Component
from cavmarl.engine.external_component import ExternalComponent
from cavmarl.handoff.division import ZonedShards
from cavmarl.roads.network import SIGNAL_STATES, RoadNetwork
from cavmarl.shards.row_check import LEAST_FACTOR, MOST
from cavmarl.shards.state import Use, names_of
from cavmarl.signals.kernels.green_choices import NEVER_MS
from cavmarl.traffic.departure_queue import DEPARTURE
from cavmarl.traffic.native import NativeTraffic

Array = NDArray[Any]

_LARGEST = 1e12
_MOST_TICKS = 1 << 40  # a thousand years in ticks of 30 ms
_CODES = {
    "lane_code": (LANE_BEST, LANE_GIVEN),
    "pos_code": (POS_GIVEN, POS_LAST),
    "speed_code": (SPEED_GIVEN, SPEED_AVERAGE),
}
_NUMBERS = ("pos", "speed", "speed_factor")


class StateForm(NamedTuple):
    """The form that a saved state of these worlds must have."""

    roads: RoadArrays
    division: ZonedShards
    traffic: NativeTraffic
    attached: tuple[Component, ...]
    fixed: Sequence[Array]  # examples of the first arrays, with their dtypes and shapes
    rerouting: Sequence[Array]  # examples of the arrays of rerouting; empty without rerouting

    def check(self, saved: Sequence[Array], is_whole: bool) -> None:
        """Check that worlds can resume from a state that `world_snapshot.save` returned.

        Args:
            saved: the state.
            is_whole: whether it has the vehicles of all zones.

        Raises:
            ConfigError: they cannot; the message says why.
        """
        if wrong := self._wrong(saved, is_whole):
            raise ConfigError(
                f"the state is damaged or belongs to different worlds: {wrong}; use the "
                "environment and the version that saved it"
            )

    def check_share(self, share: Sequence[Array]) -> None:
        """Check the shapes of the arrays of one world's state. Raises ConfigError."""
        num_worlds, queue = self.division.num_worlds, len(self.fixed)
        grown, words = queue + 3, queue + len(self.rerouting) + 1
        rows = np.zeros((num_worlds, 0))
        likes = [*self.fixed, rows, *self.rerouting, rows, np.zeros(num_worlds)]
        for n, (array, like) in enumerate(zip(share, likes, strict=False)):
            shape = (len(like) // num_worlds, *like.shape[1:])
            if n in (queue, words) or (n == grown and self.rerouting):
                shape = (1, *array.shape[1:])
            if array.shape != shape:
                raise ConfigError(
                    f"the state is damaged or belongs to different worlds: array {n} has the shape "
                    f"{array.shape}, not {shape}"
                )

    def _wrong(self, saved: Sequence[Array], is_whole: bool) -> str:
        num_worlds, zones = self.division.num_worlds, self.division.count
        num_fixed, num_more = len(self.fixed), len(self.rerouting)
        number = num_fixed + 1 + num_more + 2 + num_worlds * zones
        if len(saved) != number:
            return f"it has {len(saved)} arrays, not {number}"
        rest = list(saved)
        fixed, rest = rest[:num_fixed], rest[num_fixed:]
        (queue,), rest = rest[:1], rest[1:]
        rerouting, rest = rest[:num_more], rest[num_more:]
        (words, contacts), vehicles = rest[:2], rest[2:]
        names = [*names_of(SharedState, Use.SAVED), *names_of(DepartureQueue, Use.SAVED)]
        for n, (array, like) in enumerate(zip(fixed, self.fixed, strict=True)):
            if array.dtype != like.dtype or array.shape != like.shape:
                name = names[n] if n < len(names) else f"array {n}"
                return f"{name} is {array.dtype} {array.shape}, not {like.dtype} {like.shape}"
        if queue.dtype != DEPARTURE or queue.ndim != 2 or len(queue) != num_worlds:
            return f"the departure queue is {queue.dtype} {queue.shape}"
        if words.dtype != np.int64 or words.ndim != 2 or len(words) != num_worlds:
            return f"the ownership is {words.dtype} {words.shape}"
        if contacts.dtype != np.int64 or contacts.shape != (num_worlds,) or (contacts < 0).any():
            return "the contacts are not one count per world"
        if any(rows.dtype != VEHICLE or rows.ndim != 1 for rows in vehicles):
            return "the vehicles are not VEHICLE records"
        named = dict(zip(names, fixed, strict=False))
        return (
            self._wrong_rerouting(rerouting)
            or self._wrong_common(named)
            or self._wrong_attached(fixed[len(fixed) - self._num_attached :])
            or self._wrong_vehicles(named, queue, rerouting, vehicles)
            or self._wrong_external(fixed[len(fixed) - self._num_attached :], vehicles, is_whole)
        )

    @property
    def _num_attached(self) -> int:
        return sum(1 for part in self.attached for _ in part.arrays())

    def _wrong_attached(self, arrays: Sequence[Array]) -> str:
        at = 0
        for part in self.attached:
            number = sum(1 for _ in part.arrays())
            if wrong := part.wrong(arrays[at : at + number]):
                return wrong
            at += number
        return ""

    def _wrong_external(
        self, arrays: Sequence[Array], vehicles: Sequence[Array], is_whole: bool
    ) -> str:
        """Return what is wrong if external vehicles do not match their slots; empty if nothing.

        A slot is a place for a vehicle that the caller poses or drives, see `ExternalComponent`.
        """
        zones, at = self.division.count, 0
        for part in self.attached:
            number = sum(1 for _ in part.arrays())
            if isinstance(part, ExternalComponent):
                _, ids = arrays[at : at + number]
                for w, own in enumerate(ids):
                    rows = np.concatenate(vehicles[w * zones : (w + 1) * zones])
                    if wrong := part.wrong_rows(own, rows, is_whole):
                        return f"world {w}: {wrong}"
            at += number
        return ""

    def _wrong_rerouting(self, saved: Sequence[Array]) -> str:
        if not self.rerouting:
            return ""
        for array, like in zip(saved, self.rerouting, strict=True):
            if array.dtype != like.dtype or array.shape[:1] != like.shape[:1]:
                return f"an array of rerouting is {array.dtype} {array.shape}"
        past, sums, looks, steps = saved
        if [past.shape, sums.shape, steps.shape] != [
            self.rerouting[n].shape for n in (0, 1, 3)
        ] or looks.ndim != 2:
            return "the arrays of rerouting have wrong shapes"
        edges, lanes, links = map(len, (self.roads.edges, self.roads.lanes, self.roads.links))
        if _outside(looks["goal"], 0, edges) or _outside(looks["seen"], -1, edges):
            return "a vehicle is rerouted to an edge that does not exist"
        if _outside(steps["next"], -1, lanes) or _outside(steps["link"], -1, links):
            return "a route of rerouting leads to a lane or link that does not exist"
        return ""

    def _wrong_common(self, named: dict[str, Array]) -> str:
        roads = self.roads
        controllers = named["controllers"]
        if wrong := wrong_phases(named["signal_phase"], roads):
            return wrong
        if (named["ticks"] > _MOST_TICKS).any():
            return f"ticks is above {_MOST_TICKS}"
        if controllers.size:
            programs = roads.programs[roads.programs["controller"] >= 0]
            own = programs[np.argsort(programs["controller"])]
            first, phase = own["first_phase"], controllers["phase"]
            if ((phase != 0) & ((phase < first) | (phase >= first + own["num_phases"]))).any():
                return "a controller has a phase of another program"
            # A check is due at least every `longest_ms`; checks due before this tick are done.
            now_ms = np.floor(named["ticks"] * self.traffic.dt * 1e3)[:, np.newaxis]
            tick_ms = np.ceil(self.traffic.dt * 1e3)
            longest_ms = 1000 + max(roads.phases["min_ms"].max(), roads.phases["max_ms"].max())
            due_ms, since_ms = controllers["next_ms"], controllers["since_ms"]
            wrong = (due_ms < now_ms - tick_ms) | (due_ms > now_ms + tick_ms + longest_ms)
            chosen = own["detector_gap_s"] == CHOSEN_BY_AGENT
            if np.where(chosen, due_ms != NEVER_MS, wrong).any():
                return "a controller has a check at an impossible time"
            if ((since_ms < 0) | (since_ms > now_ms + tick_ms)).any():
                return "a controller has a phase that begins at an impossible time"
        if np.isnan(named["detected_s"]).any() or not np.isfinite(named["pending"]).all():
            return "detected_s or pending is not a number"
        for name, least in (
            ("ticks", 0), ("cues", -1), ("next_order", 0), ("num_queue", 0), ("next_id", 0),
            ("num_entered", 0), ("counts", 0),
        ):  # fmt: skip
            if (named[name] < least).any():
                return f"{name} is below {least}"
        return "sums are not numbers" if np.isnan(named["sums"]).any() else ""

    def _wrong_vehicles(
        self,
        named: dict[str, Array],
        queue: Array,
        rerouting: Sequence[Array],
        vehicles: Sequence[Array],
    ) -> str:
        zones, tail = self.division.count, rerouting[-1] if rerouting else None
        capacity = self.traffic.capacity
        if (named["num_queue"] > queue.shape[1]).any():
            return "num_queue is larger than the departure queue"
        for w, key in enumerate(named["keys"].tolist()):
            num_orders = self.traffic.num_orders(key)
            if named["next_order"][w] > num_orders or queue.shape[1] > capacity + num_orders:
                return f"world {w} has more departures than its episode"
            rows = np.concatenate(vehicles[w * zones : (w + 1) * zones])
            waiting = queue[w, : named["num_queue"][w]]
            if len(rows) > capacity:
                return f"world {w} has {len(rows)} vehicles, but room for only {capacity}"
            next_id = named["next_id"][w]
            numbered = rows["id"][rows["driver"] != DRIVER_EXTERNAL]
            if (numbered >= next_id).any() or (waiting["id"] >= next_id).any():
                return f"world {w} has vehicles whose ids are not assigned yet"
            times = [rows[name] for name in ("tick", "departed", "last_change")]
            if any((time > named["ticks"][w]).any() for time in times):
                return f"world {w} has a vehicle with a time in the future"
            due = named["next_order"][w] if self.traffic.sumo is None else MOST
            ordered = rows["order"][rows["driver"] != DRIVER_EXTERNAL]
            if (ordered >= due).any() or (waiting["order"] >= due).any():
                return f"world {w} has a vehicle that is not due yet"
            if (np.diff(waiting["id"]) <= 0).any() or np.isin(waiting["id"], rows["id"]).any():
                return f"world {w} has two vehicles with one id"
            agents = np.concatenate([rows["agent"], waiting["agent"]])
            agents = agents[agents >= 0]
            if len(np.unique(agents)) < len(agents):
                return f"world {w} has two vehicles of one agent"
            if (waiting["speed_factor"] < LEAST_FACTOR).any():
                return f"world {w} has a vehicle in the queue whose speed factor is too low"
            check = self.division.row_check
            # SUMO's vehicles get order numbers when they enter, so the largest one is not known.
            numbers = num_orders if self.traffic.sumo is None else MOST
            wrong = check.wrong(rows, tail, numbers) or _wrong_codes(waiting)
            wrong = wrong or check.wrong(_as_vehicles(waiting), tail, numbers)
            if wrong:
                return f"world {w}: {wrong}"
        return ""


def wrong_phases(phases: NDArray[np.int32], roads: RoadArrays | RoadNetwork) -> str:
    """Return what is wrong with `Worlds.signal_phase` (…, columns); empty if nothing."""
    phases, overridden = np.split(phases, [len(roads.signals)], axis=-1)
    if _outside(phases, 0, max(len(roads.phases), 1)):
        return "signal_phase names a phase that does not exist"
    if phases.size:
        ends = roads.phases["first_state"][phases] + roads.signals["num_links"]
        if (ends > len(roads.phase_states)).any():
            return "signal_phase names a phase of another signal"
    if _outside(overridden, 0, len(SIGNAL_STATES) + 1):
        return "signal_phase has an unknown state"
    if overridden.size and overridden[..., roads.links["signal"] < 0].any():
        return "signal_phase has a state of a link without a signal"
    return ""


def _as_vehicles(waiting: NDArray[np.void]) -> NDArray[np.void]:
    """Return VEHICLE (n,) of waiting departures, with the fields that are known already."""
    rows = blank_vehicle().repeat(len(waiting))
    for name in ("id", "way", "agent", "order", "vtype", "goal", "lane", "stop", "stops_end"):
        rows[name] = waiting[name]
    rows["driver"] = np.where(waiting["agent"] >= 0, DRIVER_AGENT, DRIVER_BACKGROUND)
    return rows


def _wrong_codes(waiting: NDArray[np.void]) -> str:
    for name, (low, high) in _CODES.items():
        if _outside(waiting[name], low, high + 1):
            return f"a vehicle in the queue has an invalid {name}"
    for name in _NUMBERS:
        if not (np.abs(waiting[name]) <= _LARGEST).all():
            return f"a vehicle in the queue has an invalid {name}"
    return ""


def _outside(numbers: Array, low: int, end: int) -> bool:
    return bool(((numbers < low) | (numbers >= end)).any())
