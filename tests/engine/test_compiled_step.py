"""A step in one compiled call gives the same bytes as a step that runs phase by phase."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl.engine.simulation import Simulation
from cavmarl.shards.phases import Phase
from cavmarl.shards.shard import TICKS_IN_ORDER, Commands
from tests.support.actuated import actuated_grid
from tests.support.driving import idle, make_simulation, start, suggested
from tests.support.world import is_compiled, log_phases

STEPS = 2 * TICKS_IN_ORDER
WORLDS = {
    "open": ("merge", "open", {}),
    "respawn": ("grid4x4", "respawn", {}),
    "closed": ("grid4x4", "closed", {}),
    "discrete": ("town", "respawn", {"action.kind": "discrete"}),
    "late": ("merge", "respawn", {"clock.control_latency_ticks": 2}),
    "stacked": ("grid4x4", "respawn", {"sensors.stack": 3, "sensors.lidar.rays": 12}),
    "optional": ("town", "respawn", {"sensors.history.steps": 3}),
    "team": ("grid4x4", "respawn", {"terms.team_share": 0.5, "terms.team_range_m": 80.0}),
}


def same(one: Simulation, other: Simulation, step: int) -> None:
    for world in range(one.num_worlds):
        assert one.state_hash(world) == other.state_hash(world), f"step {step}, world {world}"
    for name, array, expected in zip(one.outputs._fields, one.outputs, other.outputs, strict=True):
        assert array.tobytes() == expected.tobytes(), f"step {step}, {name}"


def compare(compiled: Simulation, plain: Simulation, steps: int = STEPS) -> None:
    log = log_phases(plain)
    start(compiled, seed=4)
    start(plain, seed=4)
    for step in range(steps):
        controls = suggested(compiled)
        actions = idle(compiled).meta_actions
        if compiled.config.action.kind == "discrete":
            actions = controls[..., 0].astype(np.int64)
        for simulation in (compiled, plain):
            simulation.step(Commands(controls, actions))
        same(compiled, plain, step)
        for simulation in (compiled, plain):
            simulation.retire_agents()
        if step == steps // 2:
            chosen = np.arange(compiled.num_worlds) == 0
            compiled.reset(chosen)
            plain.reset(chosen)
        same(compiled, plain, step)
    assert is_compiled(compiled)
    assert not is_compiled(plain)
    assert {Phase.ADVANCE, Phase.RESOLVE, Phase.COMMIT} <= set(log.phases)


@pytest.mark.parametrize("name", WORLDS)
def test_compiled_steps_equal_steps_by_phase(name: str) -> None:
    env, mode, overrides = WORLDS[name]
    made = [
        make_simulation(env, mode=mode, agents=5, background=20, num_worlds=2, overrides=overrides)
        for _ in range(2)
    ]
    compare(*made)


def test_compiled_steps_with_actuated_signals_and_demand_equal_steps_by_phase(
    tmp_path: Path,
) -> None:
    env = actuated_grid(tmp_path)
    made = [make_simulation(env, mode="respawn", agents=4, num_worlds=2) for _ in range(2)]
    assert made[0].config.traffic.source != "sumo-traffic"
    compare(*made)


def test_compiled_steps_with_changed_lanes_equal_steps_by_phase() -> None:
    compiled, plain = (
        make_simulation("grid4x4", mode="respawn", agents=4, overrides={"map.changed_lanes": 3})
        for _ in range(2)
    )
    log_phases(plain)
    start(compiled, seed=2)
    start(plain, seed=2)
    changes = np.zeros((1, 3, 3))
    for step in range(40):
        if step in (3, 20):
            changes[0, 0] = (5, 13.89, 511) if step == 3 else (0, 0.0, 0)
            changes[0, 1] = 9, 2.0, 0
        for simulation in (compiled, plain):
            controls = suggested(simulation)
            commands = idle(simulation)
            simulation.step(Commands(controls, commands.meta_actions, lane_changes=changes))
        same(compiled, plain, step)
    assert is_compiled(compiled)


@pytest.mark.parametrize(
    "overrides",
    [{"zones.count": 4}, {"v2x.enabled": True}, {"scenario.name": "pedestrian_crossing"}],
    ids=["zones", "messages", "scenario"],
)
def test_worlds_with_unsupported_settings_run_phase_by_phase(overrides: dict[str, Any]) -> None:
    simulation = make_simulation("grid4x4", mode="respawn", agents=2, overrides=overrides)
    start(simulation, seed=0)
    simulation.step(idle(simulation))
    assert not is_compiled(simulation)
