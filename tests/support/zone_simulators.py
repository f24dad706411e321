"""Zone simulators for tests, which have their own state and check the calls that they get."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

import cavmarl
from cavmarl.core.extensions import REGISTERED_ZONE_SIMULATORS
from cavmarl.core.math.geometry import wrap_angle
from cavmarl.core.records.codes import EVENTS_THAT_END
from cavmarl.driving.kernels.motion.bicycle import bicycle_step
from cavmarl.driving.kernels.motion.motion import MAX_SPEED_MPS
from cavmarl.handoff.simulators.zone_simulator import MOTION, ZoneSetup


class OwnKinematics:
    """A zone simulator: agents move by the kinematic model, other vehicles as cavmarl requests.

    Attributes:
        made: all simulators in the order of their creation.
    """

    made: list[OwnKinematics] = []  # noqa: RUF012 - emptied by `registered`

    def __init__(self, setup: ZoneSetup) -> None:
        self.setup = setup
        self.vehicles: dict[int, np.void] = {}
        self.ghosts: set[int] = set()
        self.signals: list[str] = []
        self.counts: Counter[str] = Counter()
        self.is_closed = False
        self.made.append(self)

    def prepare(self, vehicles: NDArray[np.void]) -> Mapping[int, str]:
        assert not self.vehicles.keys() & set(vehicles["id"].tolist())
        return {}

    def spawn(self, vehicles: NDArray[np.void]) -> None:
        for row in vehicles:
            assert row["id"] not in self.vehicles
            self.vehicles[int(row["id"])] = row.copy()
            self.counts["spawned"] += 1

    def drop(self, vehicles: Sequence[int]) -> None:
        for vehicle in vehicles:
            del self.vehicles[vehicle]
            self.counts["dropped"] += 1

    def show(self, ghosts: NDArray[np.void], signals: Sequence[str]) -> None:
        self.ghosts, self.signals = set(ghosts["id"].tolist()), list(signals)
        assert not self.ghosts & self.vehicles.keys()

    def advance(self, wanted: NDArray[np.void], aims: NDArray[np.float64]) -> None:
        assert sorted(wanted["id"].tolist()) == sorted(self.vehicles)
        assert np.array_equal(np.isnan(aims).all(axis=1), wanted["agent"] >= 0)
        for row in wanted:
            self.vehicles[int(row["id"])] = self.moved(self.vehicles[int(row["id"])], row.copy())
            self.counts["moved"] += 1

    def moved(self, row: np.void, wanted: np.void) -> np.void:
        """Return the state of a vehicle after a tick, from the state `row` before the tick."""
        if wanted["agent"] < 0 or row["events"] & EVENTS_THAT_END:
            return wanted
        x, y, heading, speed, _ = bicycle_step(
            float(row["x"]),
            float(row["y"]),
            float(row["heading"]),
            float(row["speed"]),
            float(wanted["throttle"]),
            float(wanted["steering"]),
            float(self.setup.wheelbases[wanted["vtype"]]),
            self.setup.dt_s,
        )
        self.counts["driven"] += 1
        wanted["x"], wanted["y"], wanted["heading"] = x, y, wrap_angle(heading)
        wanted["speed"] = min(max(speed, 0.0), MAX_SPEED_MPS)
        return wanted

    def read(self) -> NDArray[np.void]:
        found = np.zeros(len(self.vehicles), dtype=MOTION)
        for place, row in enumerate(reversed(self.vehicles.values())):
            for name in MOTION.names or ():
                found[place][name] = row[name]
        return found

    def close(self) -> None:
        self.vehicles.clear()
        self.is_closed = True


@contextmanager
def registered(kind: type[OwnKinematics], tolerance_m: float = 0.0) -> Iterator[str]:
    """Register a zone simulator within the block, and yield its name."""
    name = "simulator_of_a_test"
    OwnKinematics.made.clear()
    cavmarl.register_zone_simulator(name, kind, tolerance_m=tolerance_m)
    try:
        yield name
    finally:
        REGISTERED_ZONE_SIMULATORS.remove(name)


def steps_alike(whole: cavmarl.CavVectorEnv, divided: cavmarl.CavVectorEnv, steps: int) -> None:
    """Step both environments; check that all results and states are equal, bit for bit."""
    for _ in range(steps):
        actions = whole.suggest_actions()
        of_whole: tuple[Any, ...] = whole.step(actions)
        of_divided = divided.step(actions)
        for one, other in zip(of_whole[:4], of_divided[:4], strict=True):
            assert np.array_equal(one, other)
        for world in range(whole.num_envs):
            assert whole.state_hash(world) == divided.state_hash(world)


def step_on(vec: cavmarl.CavVectorEnv, steps: int) -> None:
    """Step an environment with the actions of the built-in driver."""
    for _ in range(steps):
        vec.step(vec.suggest_actions())
