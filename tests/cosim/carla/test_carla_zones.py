"""Zones that CARLA servers run: the official client, in its own process, uses cavmarl's server."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cavmarl
from cavmarl.core.errors import ZoneSimulatorError
from cavmarl.engine.simulator_component import SimulatorComponent
from cavmarl.handoff.simulators.carla_zone import PYTHON, CarlaZone
from tests.cosim.carla.conftest import VERSION, client_python, run_client, running_server
from tests.support.zone_simulators import step_on

# No snapshot has vehicles before the first tick, so this program waits for one that has vehicles.
DESTROY = """
import time
until = time.monotonic() + 10.0
cars = []
while not cars and time.monotonic() < until:
    cars = [one for one in world.get_actors() if one.type_id.startswith("vehicle.")]
found["destroyed"] = sum(one.destroy() for one in cars)
"""


@contextmanager
def carla_zones(
    zones: int,
    *hosted: int,
    options: str = "",
    background: int = 40,
    overrides: Mapping[str, Any] | None = None,
    backend: str = "local",
    **server: Any,
) -> Iterator[cavmarl.CavVectorEnv]:
    """Create worlds some of whose zones CARLA servers run."""
    python = client_python(VERSION)
    with ExitStack() as stack, pytest.MonkeyPatch.context() as patch:
        patch.setenv(PYTHON, python)
        server = {"agents": 1, "background": 0, **server}
        ports = {zone: stack.enter_context(running_server(**server)) for zone in hosted}
        vec = cavmarl.make_vec(
            "grid4x4",
            zones=zones,
            zone_simulators={
                zone: f"carla://127.0.0.1:{port}{options}" for zone, port in ports.items()
            },
            agents=4,
            background=background,
            seed=3,
            backend=backend,
            overrides={"zones.check_invariants": True, **(overrides or {})},
        )
        try:
            yield vec
        finally:
            vec.close()


def clients_of(vec: cavmarl.CavVectorEnv) -> list[CarlaZone]:
    """Return the clients of all hosted zones."""
    (part,) = (one for one in vec.simulation.attached if isinstance(one, SimulatorComponent))
    found = part.simulators
    assert all(isinstance(one, CarlaZone) for one in found)
    return found  # type: ignore[return-value]


def is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return Path(f"/proc/{pid}/stat").read_text().split()[2] != "Z"


@pytest.mark.parametrize(("zones", "hosted"), [(2, (1,)), (4, (1, 2))])
def test_vehicles_cross_the_borders_of_carla_zones_and_none_is_lost(
    zones: int, hosted: tuple[int, ...], caplog: pytest.LogCaptureFixture
) -> None:
    with carla_zones(zones, *hosted) as vec:
        vec.reset()
        pids = [client.pid for client in clients_of(vec)]
        assert len(pids) == len(hosted)
        assert all(map(is_running, pids))
        before = vec.traffic_stats()
        far: list[float] = []
        for _ in range(70):
            vec.step(vec.suggest_actions())
            rows = vec.simulation.vehicles(0)
            stats = vec.traffic_stats()
            assert len(set(rows["id"].tolist())) == len(rows) == stats["running"]
            there = np.isin(rows["owner"], hosted)
            assert there.any()
            far += np.abs(rows["d"][there]).tolist()
        rows_of = vec.simulation.transfers[0].rows
        into = sum(row.target in hosted and row.source not in hosted for row in rows_of)
        out = sum(row.source in hosted and row.target not in hosted for row in rows_of)
        assert into > 2
        assert out > 2
        stats = vec.traffic_stats()
        entered = stats["departed"] - before["departed"]
        gone = stats["arrived"] - before["arrived"]
        assert stats["running"] == before["running"] + entered - gone
        assert stats["contacts"] <= 2
        assert np.quantile(far, 0.9) < 0.5, "the vehicles do not drive in the middle of their lanes"
    assert not any(map(is_running, pids))
    # The client sets CARLA's traffic lights to the states of this world without an error.
    assert "set_traffic_light_state" not in caplog.text


def test_a_reset_uses_the_same_client() -> None:
    with carla_zones(2, 0, background=10) as vec:
        vec.reset()
        (first,) = clients_of(vec)
        step_on(vec, 5)
        vec.reset()
        step_on(vec, 5)
        assert clients_of(vec) == [first]


def test_a_dead_client_is_an_error_or_returns_its_zone_to_cavmarl() -> None:
    with carla_zones(2, 1, background=10) as vec:
        vec.reset()
        (client,) = clients_of(vec)
        step_on(vec, 3)
        os.kill(client.pid, signal.SIGKILL)
        with pytest.raises(ZoneSimulatorError, match=r"zone 1: carla://.*its client has ended"):
            vec.step(vec.suggest_actions())
        vec.reset()
        (second,) = clients_of(vec)
        assert second.pid != client.pid
        step_on(vec, 3)
    settings = {"zones.simulator_failure": "return"}
    with carla_zones(2, 1, background=10, overrides=settings) as vec:
        vec.reset()
        (client,) = clients_of(vec)
        step_on(vec, 3)
        vehicles = set(vec.simulation.vehicles(0)["id"].tolist())
        os.kill(client.pid, signal.SIGKILL)
        step_on(vec, 3)
        assert vehicles <= set(vec.simulation.vehicles(0)["id"].tolist())
        assert not clients_of(vec)


def test_a_client_that_does_not_answer_is_an_error() -> None:
    with carla_zones(2, 1, background=10, options="?timeout_s=0.5") as vec:
        vec.reset()
        (client,) = clients_of(vec)
        step_on(vec, 3)
        os.kill(client.pid, signal.SIGSTOP)
        begin_s = time.monotonic()
        with pytest.raises(ZoneSimulatorError, match=r"has not answered in time \(timeout_s = 0.5"):
            vec.step(vec.suggest_actions())
        assert time.monotonic() - begin_s < 15.0
        assert not is_running(client.pid)


def test_an_actor_that_another_client_destroys_is_an_error() -> None:
    with carla_zones(2, 1, background=10) as vec:
        vec.reset()
        step_on(vec, 3)
        port = int(vec.config.zones.simulators[1].rpartition(":")[2])
        found = run_client(port, DESTROY)
        assert found["destroyed"] > 0
        with pytest.raises(ZoneSimulatorError, match="CARLA no longer has the actor of vehicle"):
            step_on(vec, 3)


def test_a_server_with_no_place_for_a_vehicle_is_an_error() -> None:
    # The server's limit of external vehicles is below the number of vehicles in the zone.
    with carla_zones(2, 1, background=150, overrides={"zones.max_deferred_ticks": 3}) as vec:
        vec.reset()
        with pytest.raises(ZoneSimulatorError, match=r"refused vehicle .*all 64 places of"):
            step_on(vec, 300)


def test_a_server_that_does_not_answer_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(PYTHON, client_python(VERSION))
    vec = cavmarl.make_vec(
        "grid4x4",
        zones=2,
        zone_simulators={1: "carla://127.0.0.1:9?timeout_s=1"},
        agents=2,
        background=4,
    )
    with pytest.raises(ZoneSimulatorError, match=r"zone 1: carla://127.0.0.1:9: start: RuntimeErr"):
        vec.reset()
    vec.close()


def test_a_server_with_another_map_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(PYTHON, client_python(VERSION))
    with running_server(agents=1, background=0) as port:
        vec = cavmarl.make_vec(
            "ring",
            zones=2,
            zone_simulators={1: f"carla://127.0.0.1:{port}"},
            agents=2,
            background=4,
        )
        with pytest.raises(ZoneSimulatorError, match="its map Carla/Maps/grid4x4 is wrong"):
            vec.reset()
        vec.close()


@pytest.mark.parametrize("backend", ["processes:2", "nodes:2"])
def test_a_carla_zone_survives_the_death_of_its_process(backend: str) -> None:
    with carla_zones(2, 1, background=20, backend=backend) as vec:
        vec.reset()
        step_on(vec, 40)
        before = vec.traffic_stats()
        assert before["running"] > 10
        for number in (0, 1):
            pids = list(vec.worlds.worker_pids.values())
            os.kill(pids[min(number, len(pids) - 1)], signal.SIGKILL)
            step_on(vec, 10)
        after = vec.traffic_stats()
        entered = after["departed"] - before["departed"]
        gone = after["arrived"] - before["arrived"]
        assert after["running"] == before["running"] + entered - gone
        saved = vec.save_state()
        hash_then = vec.state_hash(0)
        step_on(vec, 5)
        vec.load_state(saved)
        assert vec.state_hash(0) == hash_then
        step_on(vec, 5)


@pytest.mark.parametrize("backend", ["processes:2", "nodes:2"])
def test_a_server_that_does_not_answer_is_an_error_on_each_backend(
    backend: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(PYTHON, client_python(VERSION))
    vec = cavmarl.make_vec(
        "grid4x4",
        zones=2,
        zone_simulators={1: "carla://127.0.0.1:9?timeout_s=1"},
        agents=2,
        background=4,
        backend=backend,
    )
    with pytest.raises(ZoneSimulatorError, match=r"zone 1: carla://127.0.0.1:9: start: RuntimeErr"):
        vec.reset()
    vec.close()
