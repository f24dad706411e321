"""`SimulatorComponent`: the simulators that run zones of W worlds.

The vehicles of such a zone are rows of its shard. cavmarl moves them first, which gives the states
that the simulator is to reach. The simulator's report then corrects the rows.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.config.rig import MountedConfig
from cavmarl.core.compiled import specialized
from cavmarl.core.errors import ConfigError, ZoneSimulatorError
from cavmarl.core.records.arrays import Worlds
from cavmarl.core.records.codes import EVENTS_THAT_END
from cavmarl.driving.kernels.motion.reported_motion import find_aims, follow_reports
from cavmarl.engine.component import Component
from cavmarl.engine.outside_traffic import OutsideTraffic
from cavmarl.engine.tick import Tick
from cavmarl.handoff.coordinator.coordinator import Coordinator
from cavmarl.handoff.coordinator.message_coordinator import MessageCoordinator
from cavmarl.handoff.simulators.simulator_kinds import HostedZone
from cavmarl.handoff.simulators.zone_simulator import (
    MOTION,
    FrameSource,
    ZoneSetup,
    ZoneSimulator,
)
from cavmarl.roads.network import SIGNAL_STATES, RoadNetwork
from cavmarl.sensors.mounted.mounted_sensor import SensedScene
from cavmarl.sensors.mounted.sensor_rig import Turn, sense_here
from cavmarl.shards.shard import Commands

log = logging.getLogger(__name__)

T = TypeVar("T")

# Time for which a simulator may refuse a vehicle that has entered the world in its zone. Until the
# simulator accepts the vehicle, cavmarl moves it.
ENTRY_S = 10.0


class _Place(NamedTuple):
    """A zone of a world."""

    w: int
    zone: int


class _Run:
    """A simulator that runs, and its vehicles."""

    def __init__(self, simulator: ZoneSimulator) -> None:
        self.simulator = simulator
        self.owned: set[int] = set()
        self.accepted: set[int] = set()  # vehicles that it has accepted in this tick
        self.refused: dict[int, int] = {}  # vehicle → ticks since it entered the world
        self.before: NDArray[np.void]  # VEHICLE (n,), its vehicles before the tick


class SimulatorComponent(Component):
    """Runs the simulators of zones, and tells coordinators which vehicles they refuse.

    Attributes:
        zones: the zones that simulators run, in this process or in others.
        coordinators: the coordinators of the worlds; set after they are made.
    """

    def __init__(
        self, tick: Tick, config: EnvConfig, network: RoadNetwork, hosted: Sequence[HostedZone]
    ) -> None:
        _refuse_features(config)
        self.coordinators: Sequence[Coordinator] = ()
        self.zones = frozenset(one.zone for one in hosted)
        self._tick, self._config, self._network = tick, config, network
        self._hosted = {one.zone: one for one in hosted}  # of this process
        self._all_hosted = tuple(hosted)
        self._runs: dict[_Place, _Run] = {}  # zones that have failed are absent
        self._has_moved = False  # since the beginning of the tick
        self._broken: dict[int, str] = {}  # world → why it cannot continue before a reset
        self._patience = max(1, round(ENTRY_S / config.clock.sim_dt_s))
        self._roads, self._travel = tick.shards[0].roads, tick.shards[0].travel
        self._find_aims = specialized(find_aims)
        self._follow_reports = specialized(follow_reports)
        self._letters: dict[int, str] = {}  # PHASE row → signal letters

    @property
    def simulators(self) -> list[ZoneSimulator]:
        """The simulators that run now."""
        return [run.simulator for run in self._runs.values()]

    # Part of a tick

    def reset(self, chosen: NDArray[np.bool_]) -> None:
        """Begin an episode: start simulators that do not run, and remove all vehicles."""
        for w in np.flatnonzero(chosen).tolist():
            self._broken.pop(w, None)
            for zone in self._hosted:
                self._begin(_Place(w, zone))

    def host(self, zones: Sequence[int]) -> None:
        """Run the simulators of these zones only: other processes run the other zones.

        The coordinator of those processes records the hosts of zones.
        """
        self.coordinators = ()
        self._hosted = {one.zone: one for one in self._all_hosted if one.zone in zones}
        for place in [place for place in self._runs if place.zone not in zones]:
            self._end(place)

    def refill(self) -> None:
        """Resume from the loaded rows: give them to the simulators, and restart ended simulators.

        The vehicles enter in the next tick, like vehicles that enter the world.
        """
        self._broken.clear()
        for w in range(self._tick.division.num_worlds):
            for zone in self._hosted:
                self._begin(_Place(w, zone))

    def _begin(self, place: _Place) -> None:
        run = self._runs.get(place)
        if run is not None:
            self._ask(place, "begin an episode", partial(self._empty, place, run))
        else:
            simulator = self._ask(place, "start", lambda: self._make(place))
            if simulator is not None:
                self._runs[place] = _Run(simulator)

    def _empty(self, place: _Place, run: _Run) -> None:
        """Remove all vehicles and ghosts of a simulator: the next episode uses their ids again."""
        if run.owned:
            run.simulator.drop(sorted(run.owned))
        run.owned.clear()
        run.accepted.clear()
        run.refused.clear()
        none = self._tick.worlds.rows[place.w, :0]
        run.simulator.show(none, self._signals(place.w))

    def _make(self, place: _Place) -> ZoneSimulator:
        hosted = self._hosted[place.zone]
        setup = ZoneSetup(
            world=place.w,
            zone=place.zone,
            rect=tuple(self._tick.division.zones.rects[place.zone].tolist()),
            network=self._network,
            dt_s=self._config.clock.sim_dt_s,
            wheelbases=self._travel.types["wheelbase"].astype(np.float64),
            place=hosted.place,
            options=hosted.options,
            rig=self._config.rig,
        )
        return hosted.kind.make(setup)

    def begin(self, commands: Commands) -> None:
        """Tell the simulators which vehicles they own, and what surrounds them."""
        for place, run in list(self._runs.items()):
            self._ask(place, "take its vehicles", partial(self._tell, place, run))

    def _tell(self, place: _Place, run: _Run) -> None:
        worlds, w = self._tick.shards[place.zone].worlds, place.w
        num = worlds.num_owned.item(w)
        rows, ghosts = worlds.rows[w, :num].copy(), worlds.rows[w, num : worlds.num_rows[w]].copy()
        ids = rows["id"].tolist()
        if gone := sorted(run.owned.difference(ids)):
            run.simulator.drop(gone)
            run.owned.difference_update(gone)
        new = rows[[vehicle not in run.owned for vehicle in ids]] if num else rows
        if len(new):
            new = self._accepted(place, run, new)
            run.simulator.spawn(new)
            run.owned.update(new["id"].tolist())
        run.accepted.clear()
        run.before = rows[np.isin(rows["id"], list(run.owned))]
        run.simulator.show(ghosts, self._signals(w))

    def _accepted(self, place: _Place, run: _Run, new: NDArray[np.void]) -> NDArray[np.void]:
        """Return the new vehicles that the simulator accepts; the others are offered again."""
        asked = new[~np.isin(new["id"], list(run.accepted))]
        refused = run.simulator.prepare(asked) if len(asked) else {}
        run.refused = {vehicle: run.refused.get(vehicle, 0) + 1 for vehicle in refused}
        for vehicle, ticks in run.refused.items():
            if ticks > self._patience:
                raise ZoneSimulatorError(
                    f"zone {place.zone}: its simulator has refused vehicle {vehicle}, which has "
                    f"entered the world there, for {ENTRY_S:g} s ({refused[vehicle]}); free the "
                    "place in the simulator",
                    place.zone,
                )
        return new[~np.isin(new["id"], list(refused))]

    def _signals(self, w: int) -> list[str]:
        phases = self._tick.worlds.signal_phase[w].tolist()
        for signal, phase in enumerate(phases):
            if phase not in self._letters:
                self._letters[phase] = self._letters_of(signal, phase)
        return [self._letters[phase] for phase in phases]

    def _letters_of(self, signal: int, phase: int) -> str:
        network = self._network
        first = network.phases["first_state"].item(phase)
        num = network.signals["num_links"].item(signal)
        return "".join(SIGNAL_STATES[code] for code in network.phase_states[first : first + num])

    def move(self) -> None:
        """Let all simulators run a tick, and correct the rows that cavmarl has moved."""
        self._has_moved = True
        wanted: dict[_Place, NDArray[np.int64]] = {}  # rows of the simulator's vehicles, by id
        for place, run in list(self._runs.items()):
            rows = self._next_rows(place)
            found = np.flatnonzero(np.isin(rows["id"], list(run.owned)))
            wanted[place] = found = found[np.argsort(rows["id"][found])]
            aims = np.empty((len(found), 2))
            self._find_aims(self._roads, self._travel, found, rows, aims)
            self._ask(place, "run a tick", partial(run.simulator.advance, rows[found], aims))
        for place, run in list(self._runs.items()):
            self._ask(place, "run a tick", partial(self._take, place, run, wanted[place]))

    def sense(self, scenes: Sequence[SensedScene], turns: Sequence[Turn]) -> None:
        """Write all due samples: cavmarl's own, then samples of simulators that give frames."""
        sense_here(scenes, turns)
        if not self._has_moved:  # at a reset, simulators have no vehicles yet
            return
        for place, run in list(self._runs.items()):
            source = run.simulator
            if not isinstance(source, FrameSource):
                continue
            worlds = self._tick.shards[place.zone].worlds
            rows = worlds.rows[place.w, : worlds.num_owned[place.w]]
            rows = rows[(rows["agent"] >= 0) & np.isin(rows["id"], list(run.owned))]
            for turn in turns:
                is_due = turn.due.num.item(place.w) and len(rows)
                if is_due and _type_of(turn.sensor.config) in source.frame_types:
                    self._ask(place, "give frames", partial(_copy, source, rows, turn, place.w))

    def end(self) -> None:
        self._has_moved = False

    def _next_rows(self, place: _Place) -> NDArray[np.void]:
        """Return the owned rows VEHICLE (n,) of a zone, after cavmarl has moved them."""
        worlds = self._tick.shards[place.zone].worlds
        rows: NDArray[np.void] = worlds.next_rows[place.w, : worlds.num_owned[place.w]]
        return rows

    def _take(self, place: _Place, run: _Run, at: NDArray[np.int64]) -> None:
        """Read a simulator's report, and correct its rows."""
        rows, zone = self._next_rows(place), place.zone
        told = np.asarray(run.simulator.read(), dtype=MOTION)
        told = told[np.argsort(told["id"])]
        before = run.before[np.argsort(run.before["id"])]
        wanted = rows[at]
        if not np.array_equal(told["id"], wanted["id"]):
            raise ZoneSimulatorError(
                f"zone {zone}: its simulator reports vehicles {told['id'].tolist()} instead of "
                f"{wanted['id'].tolist()}; each owned vehicle must be reported once",
                zone,
            )
        dx, dy = told["x"] - wanted["x"], told["y"] - wanted["y"]
        far_m = np.sqrt(dx * dx + dy * dy)
        most_m = self._hosted[zone].tolerance_m
        is_right = (far_m <= most_m) & np.isfinite(told["heading"]) & np.isfinite(told["speed"])
        if most_m == 0.0:
            for name in ("heading", "speed"):
                is_right &= told[name] == wanted[name]
        # An agent whose trip is over does not move until it leaves.
        is_right |= (before["agent"] >= 0) & (before["events"] & EVENTS_THAT_END != 0)
        if not is_right.all():
            raise self._deviation(zone, wanted, told, int(np.argmin(is_right)))
        if most_m == 0.0:
            return
        shard, w = self._tick.shards[zone], place.w
        self._follow_reports(
            self._roads,
            shard.plans,
            w,
            shard.lane_grid,
            at,
            before,
            told,
            shard.worlds.next_rows[w],
            shard.worlds.signal_phase[w],
            self._config.clock.sim_dt_s,
        )
        shard.zoned.num_outer[zone, w] = -1

    def _deviation(
        self, zone: int, wanted: NDArray[np.void], told: NDArray[np.void], n: int
    ) -> ZoneSimulatorError:
        place = "({:.3f}, {:.3f}), heading {:.4f}, {:.3f} m/s"
        reported, due = (
            place.format(*(row[name] for name in ("x", "y", "heading", "speed")))
            for row in (told[n], wanted[n])
        )
        return ZoneSimulatorError(
            f"zone {zone}: its simulator has moved vehicle {told['id'][n]} to {reported}, and "
            f"cavmarl to {due}; the simulator declares a tolerance of "
            f"{self._hosted[zone].tolerance_m:g} m, so increase tolerance_m, or fix the simulator",
            zone,
        )

    # Gate of the coordinators

    def check(self, w: int) -> None:
        if w in self._broken:
            raise ZoneSimulatorError(
                f"world {w} cannot continue: {self._broken[w]}. Reset it", min(self.zones)
            )

    def refusals(
        self, w: int, zone: int, vehicles: NDArray[np.void], is_last: bool = False
    ) -> Mapping[int, str]:
        place = _Place(w, zone)
        run = self._runs.get(place)
        if run is None:
            return {}
        refused = self._ask(place, "answer", lambda: dict(run.simulator.prepare(vehicles)))
        if refused is None:
            return {}
        ids = vehicles["id"].tolist()
        run.accepted.update(vehicle for vehicle in ids if vehicle not in refused)
        for vehicle, reason in refused.items():
            log.info("zone %d refuses vehicle %d: %s", zone, vehicle, reason)
        if refused and is_last:
            vehicle, reason = next(iter(refused.items()))
            message = (
                f"zone {zone}: its simulator has refused vehicle {vehicle} for "
                f"{self._config.zones.max_deferred_ticks} ticks ({reason}); free the place there, "
                "or increase zones.max_deferred_ticks"
            )
            self._fail(place, ZoneSimulatorError(message, zone))
            return {}
        return refused

    def _fail(self, place: _Place, error: ZoneSimulatorError) -> None:
        """End the simulator of a zone. Raise the error unless cavmarl takes the zone back."""
        self._end(place)
        if self._config.zones.simulator_failure == "return":
            log.warning("%s. cavmarl runs the zone until the episode ends", error)
            if self.coordinators:
                coordinator = self.coordinators[place.w]
                assert isinstance(coordinator, MessageCoordinator)
                coordinator.rehost(place.zone)
            return
        # The other simulators and the other worlds are in the middle of the same tick.
        self.close()
        self._broken = dict.fromkeys(range(self._tick.division.num_worlds), str(error))
        self._tick.division.align()
        raise error

    def _ask(self, place: _Place, what: str, call: Callable[[], T]) -> T | None:
        """Call a simulator. Return None if it has failed and cavmarl has taken the zone back."""
        try:
            return call()
        except ZoneSimulatorError as error:
            self._fail(place, error)
        except Exception as error:  # a registered simulator may raise any exception
            text = self._hosted[place.zone].text
            failure = ZoneSimulatorError(
                f"zone {place.zone}: its simulator {text!r} cannot {what}: "
                f"{type(error).__name__}: {error}",
                place.zone,
            )
            failure.__cause__ = error
            self._fail(place, failure)
        return None

    def _end(self, place: _Place) -> None:
        run = self._runs.pop(place, None)
        if run is not None:
            with suppress(Exception):  # it has failed already
                run.simulator.close()

    def close(self) -> None:
        """End all simulators."""
        for place in list(self._runs):
            self._end(place)


def _type_of(config: MountedConfig) -> str:
    return str(getattr(config, "type", ""))  # each class of sensors defines it


def _copy(source: FrameSource, rows: NDArray[np.void], turn: Turn, w: int) -> None:
    """Copy the samples that a simulator takes of the agents' vehicles VEHICLE (n,)."""
    frames, slot = turn.frames.data, turn.due.slot.item(w)
    found = source.sense(turn.sensor.name, rows["id"].tolist())
    agents = dict(zip(rows["id"].tolist(), rows["agent"].tolist(), strict=True))
    for vehicle, sample in found.items():
        if sample.shape != frames.shape[3:]:
            raise ValueError(
                f"a sample of '{turn.sensor.name}' has the shape {sample.shape}, not "
                f"{frames.shape[3:]}"
            )
        frames[w, agents[vehicle], slot] = sample


class SimulatorPhases(OutsideTraffic):
    """The phases of a tick in worlds in which other simulators run zones."""

    def __init__(self, hosted: SimulatorComponent) -> None:
        self.gate = self._hosted = hosted

    def host(self, zones: Sequence[int]) -> None:
        """Run the simulators of these zones only."""
        self._hosted.host(zones)

    def catch_up(self, worlds: Worlds) -> None:
        """Fill the simulators from the loaded state."""
        self._hosted.refill()

    def follow(self, tick: Tick) -> None:
        """Move the vehicles of hosted zones."""
        tick.finish_phase()  # other workers may still be moving vehicles
        self._hosted.move()

    def close(self) -> None:
        """End the simulators."""
        self._hosted.close()


def _refuse_features(config: EnvConfig) -> None:
    """Refuse the features that hosted zones do not support, by name."""
    wrong = {
        "traffic.source = sumo…": config.traffic.source != "native",
        "population.external": config.population.external,
        "scenario.name": config.scenario.name,
    }
    for feature, is_used in wrong.items():
        if is_used:
            raise ConfigError(
                f"{feature}: worlds with zones.simulators do not support this; turn it off, or "
                "leave zones.simulators out"
            )
