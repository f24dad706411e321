"""Comparison of two runs of the same scenario, and search for the first difference.

Results are compared as bytes and not as numbers: -0.0 differs from 0.0, and NaN equals NaN.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.driving.vehicles import STATE_FIELDS
from cavmarl.env.vector import CavVectorEnv, StepResult
from cavmarl.policies.loading import load_policy

Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Difference:
    """The first difference of two runs."""

    step: int  # number of the step; 0 is the reset
    tick: int  # the world's tick after the step
    # `vehicle`, the name of another array, or `hidden state`: hashed state that is in no array
    # (queue and random keys)
    what: str
    vehicle: int | None  # lowest id of the vehicles that differ; None: no vehicle differs
    field: str  # first field of the vehicle that differs, or the place in the array
    values: tuple[Any, Any]  # its values in the two runs; None where a vehicle is missing


def step_results(result: StepResult, actions: NDArray[Any]) -> Arrays:
    """Return the arrays (W, …) that a step returned, and its actions, by name."""
    observations, rewards, terminations, truncations, infos = result
    return {
        "observations": observations,
        "rewards": rewards,
        "terminations": terminations,
        "truncations": truncations,
        **{f"infos {name}": array for name, array in infos.items()},
        "actions": actions,
    }


def first_results(vec: CavVectorEnv, seed: int) -> Arrays:
    observations, infos = vec.reset(seed=seed)
    return {"observations": observations, "infos mask": infos["mask"]}


class DrivenRun:
    """W worlds and their driver, with the same seed, since the reset."""

    def __init__(self, vec: CavVectorEnv, policy: str | Path, seed: int) -> None:
        self.vec = vec
        self._driver = load_policy(policy, vec)
        self.results = first_results(vec, seed)
        self._driver.reset(seed)

    def step(self) -> Arrays:
        seen, mask = self.results["observations"], self.results["infos mask"]
        actions = self._driver.act_batch(seen, mask)
        self.results = step_results(self.vec.step(actions), actions)
        return self.results


def single_arrays(results: Mapping[str, Any]) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield the arrays of results with their names; observations are split by sensor."""
    for name, found in results.items():
        if isinstance(found, Mapping):
            yield from ((f"{name} {sensor}", array) for sensor, array in found.items())
        else:
            yield name, found


def snapshot(vec: CavVectorEnv, results: Mapping[str, NDArray[Any]], world: int = 0) -> Arrays:
    """Return one world's vehicles by rising id, its signals, and its part of a step's results."""
    vehicles = vec.simulation.vehicles(world)
    return {
        "vehicles": vehicles[np.argsort(vehicles["id"])],
        "signals": vec.simulation.signal_phases(world),
        **{
            f"frames {name} {field}": array[world]
            for name, frames in vec.frames().items()
            for field, array in frames._asdict().items()
        },
        **{name: np.atleast_1d(array[world]) for name, array in single_arrays(results)},
    }


def same_bytes(one: Mapping[str, NDArray[Any]], other: Mapping[str, NDArray[Any]]) -> bool:
    """Return whether all arrays of two results have the same bytes."""
    others = dict(single_arrays(other))
    return all(array.tobytes() == others[name].tobytes() for name, array in single_arrays(one))


def find_difference(step: int, tick: int, one: Arrays, other: Arrays) -> Difference:
    """Return the first difference of two snapshots.

    If vehicles differ, this is the first differing field of the vehicle with the lowest id; if not,
    the first differing place in another array.
    """

    def found(what: str, vehicle: int | None, field: str, values: tuple[Any, Any]) -> Difference:
        return Difference(step, tick, what, vehicle, field, values)

    mine, theirs = ({int(row["id"]): row for row in state["vehicles"]} for state in (one, other))
    for vehicle in sorted(mine.keys() | theirs.keys()):
        if vehicle not in mine or vehicle not in theirs:
            one_id, other_id = (vehicle if vehicle in rows else None for rows in (mine, theirs))
            return found("vehicle", vehicle, "id", (one_id, other_id))
        for name in STATE_FIELDS:
            a, b = mine[vehicle][name], theirs[vehicle][name]
            if a.tobytes() != b.tobytes():
                return found("vehicle", vehicle, name, (a.tolist(), b.tolist()))
    for name in one:
        if name == "vehicles" or one[name].tobytes() == other[name].tobytes():
            continue
        if one[name].shape != other[name].shape:
            return found(name, None, "shape", (one[name].shape, other[name].shape))
        arrays = [np.ascontiguousarray(state[name]) for state in (one, other)]
        raw = [array.view(f"V{array.itemsize}") for array in arrays]
        place = tuple(int(k) for k in np.argwhere(raw[0] != raw[1])[0])
        values = (one[name][place].item(), other[name][place].item())
        return found(name, None, str(list(place)), values)
    return found("hidden state", None, "queue or random keys", (None, None))
