"""Memory does not grow with the number of steps."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from cavmarl import make_vec, parallel_env
from cavmarl.config.registry import load_config
from cavmarl.verify.equivalence import verify_zones

STATM = Path("/proc/self/statm")
GROWTH_MB = 5.0
RESETS = 1000
AGENT_STEPS = 1_000_000
CITY_TICKS = 100_000

DEMAND = """<routes>
  <flow id="f" begin="0" end="60" period="1"><route edges="bottom0A0 A0B0 B0C0 C0D0"/></flow>
  <flow id="g" from="left0A0" to="A3top0" begin="0" end="60" probability="0.5"/>
</routes>
"""

pytestmark = pytest.mark.skipif(not STATM.exists(), reason="memory is read from /proc")


@pytest.fixture(params=["closed", "open", "respawn", "demand"])
def world(request: pytest.FixtureRequest, tmp_path: Path) -> dict[str, Any]:
    """Return the arguments of a world with this population mode, or with demand."""
    overrides: dict[str, Any] = {"population.mode": request.param}
    if request.param == "demand":
        path = tmp_path / "x.rou.xml"
        path.write_text(DEMAND, encoding="utf-8")
        overrides = {"population.mode": "open", "traffic.demand": [str(path)]}
    return {"env": "grid4x4", "agents": 8, "background": 20, "seed": 0, "overrides": overrides}


def resident_mb() -> float:
    return int(STATM.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def growth_mb(work: Callable[[], object], times: int) -> float:
    """Return the growth of the process in `times` calls, measured after a warm-up."""
    for _ in range(times // 10):
        work()
    before = resident_mb()
    for _ in range(times):
        work()
    return resident_mb() - before


@pytest.mark.slow
def test_memory_does_not_grow_in_a_thousand_resets(world: dict[str, Any]) -> None:
    env = parallel_env(**world)

    def episode() -> None:
        env.reset()
        for _ in range(5):
            env.step(env.suggest_actions())
            env.state()

    assert growth_mb(episode, RESETS) < GROWTH_MB


@pytest.mark.slow
def test_memory_does_not_grow_in_a_million_agent_steps(world: dict[str, Any]) -> None:
    vec = make_vec(**world, num_envs=8)
    _, infos = vec.reset()
    acted = int(infos["mask"].sum())

    def step() -> None:
        nonlocal acted
        *_, infos = vec.step(vec.suggest_actions())
        acted += int(infos["acted"].sum())

    number = AGENT_STEPS // (vec.num_envs * world["agents"])
    assert growth_mb(step, number) < GROWTH_MB
    assert acted > AGENT_STEPS // 10, "too few decisions of agents"


@pytest.mark.slow
def test_memory_does_not_grow_in_a_hundred_thousand_ticks_of_a_divided_city() -> None:
    # Two divided worlds and the undivided one run step by step.
    step_ticks = load_config("rush")[0].clock.ticks_per_step
    steps = CITY_TICKS // step_ticks
    memory_mb: list[float] = []

    def look(step: int, steps: int) -> None:
        if step % (steps // 20) == 0:
            memory_mb.append(resident_mb())

    watched = {"zones.check_invariants": True}
    found = verify_zones("rush", (4, 9), steps=steps, agents=100, overrides=watched, progress=look)
    assert found.holds, found.results
    assert all(result.crossings > 1000 for result in found.results)
    assert max(memory_mb[2:]) - memory_mb[2] < GROWTH_MB


@pytest.mark.slow
def test_memory_does_not_grow_while_a_thousand_worlds_are_made() -> None:
    def make() -> None:
        parallel_env("ring", agents=2, background=2, seed=0).reset()

    assert growth_mb(make, 1000) < GROWTH_MB


def test_memory_does_not_grow_in_a_hundred_resets_of_divided_worlds() -> None:
    """This is the short variant of `test_memory_does_not_grow_in_a_thousand_resets`."""
    vec = make_vec("grid4x4", num_envs=2, zones=4, agents=8, background=20, seed=0)

    def episode() -> None:
        vec.reset()
        for _ in range(5):
            vec.step(vec.suggest_actions())

    vec.reset()
    while not vec.step(vec.suggest_actions())[4]["vehicle_done"].any():
        pass  # the first end of a trip loads kernels
    assert growth_mb(episode, 100) < GROWTH_MB / 5
