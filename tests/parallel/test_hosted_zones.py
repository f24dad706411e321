"""Zones that other simulators run, over worker processes and nodes: the results stay the same."""

from __future__ import annotations

import os
import signal
from collections.abc import Mapping
from typing import Any

import pytest

import cavmarl
from cavmarl.core.errors import ConfigError, ZoneSimulatorError
from tests.support.exact_zone import EXACT, FAILING, HESITANT, UNWILLING
from tests.support.zone_simulators import step_on, steps_alike

ENV = "grid4x4"
SEEN: dict[str, Any] = {"agents": 4, "background": 40, "seed": 3}
BACKENDS = ["processes:1", "processes:2", "nodes:2"]


def make_hosted(
    name: str,
    *zones: int,
    backend: str,
    overrides: Mapping[str, Any] | None = None,
    **keys: Any,
) -> cavmarl.CavVectorEnv:
    """Create worlds of four zones; the simulator `name` runs some of the zones."""
    return cavmarl.make_vec(
        ENV,
        zones=4,
        zone_simulators=dict.fromkeys(zones, name),
        backend=backend,
        overrides=dict(overrides or {}),
        **{**SEEN, **keys},
    )


def changes_to(vec: cavmarl.CavVectorEnv, *zones: int) -> int:
    """Return the number of vehicles that were handed over to these zones."""
    return sum(row.target in zones for row in vec.worlds.transfers[0].rows)  # type: ignore[attr-defined]


@pytest.mark.parametrize("backend", BACKENDS)
def test_exact_simulators_give_the_undivided_world_even_if_a_process_dies(backend: str) -> None:
    whole = cavmarl.make_vec(ENV, **SEEN)
    vec = make_hosted(EXACT, 1, 2, backend=backend, overrides={"zones.check_invariants": True})
    whole.reset(), vec.reset()
    steps_alike(whole, vec, 20)
    os.kill(next(iter(vec.worlds.worker_pids.values())), signal.SIGKILL)
    steps_alike(whole, vec, 60)
    if backend == "nodes:2":
        assert changes_to(vec, 1, 2) > 4
        assert vec.worlds.pool.losses == 1  # type: ignore[attr-defined]
    vec.reset(seed=5), whole.reset(seed=5)
    steps_alike(whole, vec, 10)
    vec.close()


@pytest.mark.parametrize("backend", ["local", *BACKENDS])
def test_simulators_get_their_vehicles_from_a_loaded_state(backend: str) -> None:
    whole = cavmarl.make_vec(ENV, **SEEN)
    vec = make_hosted(EXACT, 0, 3, backend=backend)
    whole.reset(), vec.reset()
    steps_alike(whole, vec, 20)
    saved, of_whole = vec.save_state(), whole.save_state()
    steps_alike(whole, vec, 10)
    later = vec.state_hash(0)
    vec.load_state(saved), whole.load_state(of_whole)
    steps_alike(whole, vec, 10)
    assert vec.state_hash(0) == later
    vec.load_state(of_whole), whole.load_state(saved)
    steps_alike(whole, vec, 10)
    assert vec.state_hash(0) == later
    vec.close()


def test_simulators_over_nodes_work_with_several_worlds_and_several_ticks_per_lease() -> None:
    settings = {"clock.ctrl_dt_s": 0.2, "zones.max_deferred_ticks": 4}
    whole = cavmarl.make_vec(ENV, num_envs=2, overrides=settings, **SEEN)
    for nodes in (2, 3):
        vec = make_hosted(HESITANT, 1, 2, backend=f"nodes:{nodes}", num_envs=2, overrides=settings)
        whole.reset(seed=3), vec.reset(seed=3)
        steps_alike(whole, vec, 40)
        vec.close()


def test_refused_vehicles_enter_later_over_nodes() -> None:
    whole = cavmarl.make_vec(ENV, **SEEN)
    settings = {"zones.check_invariants": True, "zones.max_deferred_ticks": 6}
    vec = make_hosted(HESITANT, 1, 2, backend="nodes:2", overrides=settings)
    whole.reset(), vec.reset()
    steps_alike(whole, vec, 80)
    counts = vec.worlds.transfers[0].counts  # type: ignore[attr-defined]
    assert counts["deferred"] > 4
    assert counts.get("forced", 0) == 0
    assert changes_to(vec, 1, 2) > 4
    waited = {row.waited for row in vec.worlds.transfers[0].rows}  # type: ignore[attr-defined]
    assert waited == {0, 2}
    vec.close()


@pytest.mark.parametrize("backend", ["processes:2", "nodes:2"])
def test_a_vehicle_that_is_refused_for_too_long_is_an_error(backend: str) -> None:
    vec = make_hosted(UNWILLING, 1, 2, backend=backend)
    vec.reset()
    message = r"zone \d: its simulator has refused vehicle \d+.*the place is occupied"
    with pytest.raises(ZoneSimulatorError, match=message) as caught:
        step_on(vec, 200)
    assert caught.value.zone in {1, 2}
    vec.close()


@pytest.mark.parametrize("backend", BACKENDS)
def test_cavmarl_takes_a_zone_back_that_refuses_vehicles_for_too_long(backend: str) -> None:
    whole = cavmarl.make_vec(ENV, **SEEN)
    settings = {"zones.simulator_failure": "return", "zones.check_invariants": True}
    vec = make_hosted(UNWILLING, 1, 2, backend=backend, overrides=settings)
    whole.reset(), vec.reset()
    steps_alike(whole, vec, 80)
    vec.close()


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_step_whose_simulator_fails_can_be_repeated(backend: str) -> None:
    whole = cavmarl.make_vec(ENV, **SEEN)
    vec = make_hosted(FAILING, 1, backend=backend)
    whole.reset(), vec.reset()
    before = ""
    message = r"zone 1: its simulator.*cannot run a tick: OSError"
    with pytest.raises(ZoneSimulatorError, match=message) as caught:  # noqa: PT012
        while True:
            before = vec.state_hash(0)
            vec.step(vec.suggest_actions())
            whole.step(whole.suggest_actions())
    assert caught.value.zone == 1
    assert vec.state_hash(0) == before == whole.state_hash(0)
    steps_alike(whole, vec, 1)
    vec.close()


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        (
            {"backend": "processes:2", "overrides": {"zones.journal": "run.jsonl"}},
            "zones.journal: worlds of the backend 'processes' with zones.simulators",
        ),
        (
            {"backend": "nodes:2", "num_envs": 2, "overrides": {"workers.balance_steps": 5}},
            "workers.balance_steps: worlds of the backend 'nodes' with zones.simulators",
        ),
    ],
)
def test_settings_that_need_one_process_are_refused_by_name(
    keys: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        make_hosted(EXACT, 1, **keys)


def test_a_carla_server_runs_one_world_on_each_backend() -> None:
    with pytest.raises(ConfigError, match="num_envs = 2: a CARLA server runs a zone of one world"):
        cavmarl.make_vec(
            ENV, num_envs=2, zones=4, backend="nodes:2", zone_simulators={1: "carla://a:1"}
        )
