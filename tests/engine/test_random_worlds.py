"""Worlds with random maps, populations, clocks and zones: divided worlds equal undivided ones.

Agents take the actions of the built-in driver with noise, or random actions. With random actions,
they leave their lanes, turn around, block other vehicles and drive against the traffic.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl.core.errors import CapacityError
from cavmarl.core.records.codes import ACTION_IDLE
from cavmarl.engine.simulation import Simulation
from cavmarl.shards.shard import Commands
from tests.support.driving import make_simulation, start, suggested
from tests.support.netgenerate import netgenerate

NUM_META_ACTIONS = 5
SHAPES = {
    "grid": ("--grid", "--grid.number", "4", "--grid.length", "90", "--grid.attach-length", "60"),
    "rand": ("--rand", "--rand.iterations", "40", "--rand.min-distance", "80"),
    "spider": ("--spider", "--spider.arm-number", "4", "--spider.space-radius", "80"),
}
JUNCTIONS = "traffic_light priority right_before_left allway_stop zipper priority_stop".split()
OUTPUTS = ("observations", "rewards", "terminated", "present")


def pick(rng: np.random.Generator, *choices: Any) -> Any:
    return choices[rng.integers(len(choices))]


def random_map(rng: np.random.Generator, path: Path) -> Path:
    options = [
        *SHAPES[pick(rng, *SHAPES)],
        *("--default-junction-type", pick(rng, *JUNCTIONS)),
        *("-L", str(rng.integers(1, 4)), "--seed", str(rng.integers(1 << 20))),
        *("--default.speed", pick(rng, "8.3", "13.9", "25", "33")),
        *pick(rng, (), ("--no-turnarounds",)),
        *pick(rng, (), ("--no-internal-links",)),  # then vehicles jump over junctions
        *pick(rng, (), ("--tls.default-type", "actuated")),
    ]
    return netgenerate(path, *options)


def random_world(rng: np.random.Generator, folder: Path) -> tuple[Simulation, Simulation]:
    """Return an undivided world and the same world with zones, at the start of an episode."""
    path = random_map(rng, folder / "drawn.net.xml")
    tick_s = pick(rng, 0.05, 0.1, 0.2)
    world = {
        "clock.sim_dt_s": tick_s,
        "clock.ctrl_dt_s": tick_s * int(rng.integers(1, 5)),
        "action.kind": pick(rng, "continuous", "discrete"),
        "sensors.lidar.rays": pick(rng, 0, 16),
    }
    zones = {
        "zones.count": pick(rng, 2, 3, 5, 9, 16),
        "zones.layout": pick(rng, "grid", "bisection", "strips"),
        "zones.hysteresis_m": pick(rng, 0.0, 2.0, 8.0),
        "zones.check_invariants": pick(rng, False, True),
    }
    agents, background = pick(rng, 1, 4, 8), pick(rng, 10, 30, 60)
    mode, seed = pick(rng, "respawn", "open", "closed"), int(rng.integers(1 << 20))

    def make(overrides: dict[str, Any]) -> Simulation:
        simulation = make_simulation(
            path, mode=mode, agents=agents, background=background, overrides=overrides
        )
        start(simulation, seed)
        return simulation

    return make(world), make(world | zones)


def acts(rng: np.random.Generator, whole: Simulation) -> Iterator[Commands]:
    """Yield random actions, or suggested actions with noise."""
    shape = whole.outputs.present.shape
    wild = bool(rng.random() < 0.5)
    drift = np.zeros((*shape, 2))
    while True:
        drift = 0.9 * drift + rng.normal(0.0, (0.6, 0.06), drift.shape)
        told = suggested(whole)
        meta = rng.integers(0, NUM_META_ACTIONS, shape)
        if whole.config.action.kind == "discrete":
            kept = (rng.random(shape) > 0.2) & (not wild)
            yield Commands(np.zeros_like(drift), np.where(kept, told[..., 0], meta).astype(int))
        else:
            base = np.array([1.0, 0.0]) if wild else told
            yield Commands(base + drift, np.full(shape, ACTION_IDLE, dtype=np.int64))


def check(seed: int, steps: int, folder: Path) -> None:
    rng = np.random.default_rng(seed)
    try:
        whole, divided = random_world(rng, folder)
    except CapacityError as error:
        pytest.skip(f"the map that was drawn is too small: {error}")
    for commands, _ in zip(acts(rng, whole), range(steps), strict=False):
        assert suggested(divided).tobytes() == suggested(whole).tobytes()
        for simulation in (whole, divided):
            simulation.step(commands)
            simulation.retire_agents()
        assert divided.state_hash() == whole.state_hash()
        for name in OUTPUTS:
            found, expected = (getattr(s.outputs, name) for s in (divided, whole))
            assert found.tobytes() == expected.tobytes(), name


@pytest.mark.parametrize("seed", range(12))
def test_random_divided_worlds_equal_undivided_worlds(seed: int, tmp_path: Path) -> None:
    check(seed, 120, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(12, 400))
def test_many_random_divided_worlds_equal_undivided_worlds(seed: int, tmp_path: Path) -> None:
    check(seed, 400, tmp_path)
