"""Divided worlds whose zones do not hear each other for a time, with a policy that holds."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl import CavVectorEnv, make_vec
from cavmarl.handoff.division import Division
from cavmarl.handoff.fault_injection.fault_plan import Faults
from cavmarl.ownership.messages import Begin, BorderWait, Record
from cavmarl.ownership.transport import Rates
from tests.support.faulted import BUSY, Checked

GRACE = 3
HOLD = {"zones.policy": "hold", "zones.grace_ticks": GRACE, "zones.check_invariants": True}
REROUTE = {**HOLD, "zones.policy": "reroute"}
HEALED = 60  # the tick from which on messages arrive
PARTED = Faults(messages={"Prepare": Rates(drop=1.0)}, until=HEALED)
STEPS, ZONES = 60, 4


@dataclass
class Watched:
    """A divided run: what was held in the first world, and its state after every step."""

    vec: CavVectorEnv
    held: dict[int, dict[int, BorderWait]] = field(default_factory=dict)  # by tick, by vehicle
    rows: dict[int, NDArray[np.void]] = field(default_factory=dict)  # by tick, all vehicles
    hashes: list[str] = field(default_factory=list)

    def logged(self, records: Iterable[Record]) -> None:
        for line in records:
            if isinstance(line, Begin):
                self.held[line.tick] = {wait.vehicle: wait for wait in line.waiting if wait.held}

    def delivered(self, *_: object) -> None: ...

    @property
    def division(self) -> Division:
        return self.vec.simulation._tick.division

    def drive(self, steps: int, push: Callable[[NDArray[Any]], None] | None = None) -> Watched:
        self.vec.reset(seed=0)
        coordinator = self.vec.simulation.coordinators[0]
        for _ in range(steps):
            actions = self.vec.suggest_actions().copy()
            if push is not None:
                push(actions)
            self.vec.step(actions)
            self.rows[coordinator.tick] = self.vec.simulation.vehicles(0).copy()
            self.hashes.append(self.vec.state_hash(0))
        return self


def run(
    faults: Faults = PARTED,
    steps: int = STEPS,
    push: Callable[[NDArray[Any]], None] | None = None,
    num_envs: int = 1,
    **more: Any,
) -> Watched:
    """Drive a divided world that `faults` harm, under the policy of HOLD if `more` has no other.

    The trace of the first world is checked, too. `push` changes what agents do.
    """
    overrides = {**BUSY, **HOLD, "zones.faults": faults.to_json(), **more}
    vec = make_vec("grid4x4", num_envs=num_envs, zones=ZONES, overrides=overrides)
    found = Watched(vec)
    coordinator = vec.simulation.coordinators[0]
    coordinator.watch(found)
    coordinator.watch(Checked(vec.simulation.config.zones.max_deferred_ticks))
    return found.drive(steps, push)
