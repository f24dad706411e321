"""Commands of a session other than reset and step: changes, frames, saved states, recordings."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cavmarl
from cavmarl.client import AsyncClient, Client, RemoteWorld
from cavmarl.core.errors import ActionError, RecordingError, ServiceError
from cavmarl.recordings.recording import Recording
from tests.service.test_sessions import assert_same
from tests.support.service import Cluster, running_service

CHANGES = {
    "population.insertions": 4,
    "map.changed_lanes": 8,
    "v2x.enabled": True,
    "rig": {"roof": {"type": "lidar", "rate_hz": 10.0}},
}
WORLD: dict[str, Any] = {"agents": 3, "background": 8, "overrides": CHANGES}


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    store = tmp_path_factory.mktemp("service") / "store.sqlite"
    with running_service(store, "--lease-s", "6", "--beat-s", "0.6") as service:
        started = Cluster(service)
        started.start("a", "victim")
        yield started
        started.stop()


@pytest.fixture(scope="module")
def client(cluster: Cluster) -> Iterator[Client]:
    with cluster.service.client(cluster.service.grant("ada", "client")) as made:
        yield made


def test_changes_take_effect_at_their_command_and_are_repeated_after_a_loss(
    cluster: Cluster, client: Client, tmp_path: Path
) -> None:
    remote = client.open("grid4x4", node="victim", wait_s=30.0, **WORLD)
    local = cavmarl.make_vec("grid4x4", **WORLD)
    local.record(tmp_path / "here")
    remote.record()
    remote.reset(seed=3)
    local.reset(seed=3)
    edge, lane = first_road(local)
    other = next(name for name in local.network.edge_ids if name not in (edge, "")
                 and not name.startswith(":"))  # fmt: skip
    done: list[Callable[[Any], None]] = [
        lambda world: world.insert_vehicle(lane, 5.0),
        lambda world: world.close_road(edge, shuts_in=True),
        lambda world: world.damage_road(other, 3.0),
        lambda world: world.declare_event(0, 1, "obstacle"),
        lambda world: world.open_road(edge),
    ]
    for change in done[:3]:
        change(remote)
        change(local)
        assert_same(remote, local, range(2))
    remote.save_state()
    for change in done[3:]:
        change(remote)
        change(local)
    cluster.processes["victim"].kill()
    assert_same(remote, local, range(3))
    assert remote.flows.moves == 1
    for name, frames in local.frames().items():
        for ours, theirs in zip(remote.frames()[name], frames, strict=True):
            np.testing.assert_array_equal(ours, theirs)
    remote.recording(tmp_path / "there")
    remote.close()
    local.close()
    assert_recorded(tmp_path)


def first_road(local: cavmarl.CavVectorEnv) -> tuple[str, str]:
    row = int(np.flatnonzero(~local.network.lanes["internal"])[0])
    lane = local.network.lane_ids[row]
    return lane.rpartition("_")[0], lane


def assert_recorded(folder: Path) -> None:
    here = list(Recording.open(folder / "here").frames())
    parts = sorted((folder / "there").iterdir())
    assert len(parts) >= 2
    there = [frame for part in parts for frame in Recording.open(part).frames()]
    assert [one.tick for one in there] == [one.tick for one in here]
    for one, other in zip(there, here, strict=True):
        assert one.vehicles.tobytes() == other.vehicles.tobytes()
        assert one.asked == other.asked


def test_a_saved_state_continues_in_a_local_world(client: Client) -> None:
    remote = client.open("merge", agents=3, background=8, wait_s=30.0)
    local = cavmarl.make_vec("merge", agents=3, background=8)
    with pytest.raises(ServiceError, match="reset"):
        remote.save_state()
    remote.reset(seed=1)
    for _ in range(3):
        remote.step(remote.suggest_actions())
    local.reset(seed=0)
    local.load_state(remote.save_state())
    assert_same(remote, local, range(3))
    session = client.get(f"/sessions/{remote.flows.session}")
    assert session["saved_number"] == 4
    remote.close()
    local.close()


def test_a_scenario_is_set_by_a_command(cluster: Cluster, client: Client) -> None:
    overrides = {"scenario.name": "road_closure"}
    remote = client.open("grid4x4", agents=3, background=8, wait_s=30.0)
    local = cavmarl.make_vec("grid4x4", agents=3, background=8, overrides=overrides)
    remote.reset(seed=0)
    with pytest.raises(ServiceError, match="choose one of"):
        remote.scenario("nothing")
    with pytest.raises(ServiceError, match="params"):
        remote.scenario("road_closure", params={"nothing": 1.0})
    remote.scenario("road_closure")
    with pytest.raises(ServiceError, match="before reset"):
        remote.step(np.zeros(remote.flows.description["action"]["shape"], np.float32))
    remote.reset(seed=2)
    local.reset(seed=2)
    assert_same(remote, local, range(2))
    remote.save_state()
    with cluster.service.client() as admin:
        place = remote.flows.assignment["assigned"]
        cluster.start("c")
        admin.post(f"/nodes/{place}/drain")
        while remote.flows.assignment["assigned"] == place:
            assert_same(remote, local, range(1))
        admin.post(f"/nodes/{place}/resume")
    assert_same(remote, local, range(2))
    remote.close()
    local.close()


@pytest.mark.parametrize(
    ("ask", "error", "words"),
    [
        (lambda world: world.insert_vehicle("nothing", 1.0), ServiceError, "no such lane"),
        (lambda world: world.close_road("nothing"), ServiceError, "nothing"),
        (lambda world: world.close_road("nothing", lanes=[-1]), ServiceError, "lanes"),
        (lambda world: world.close_road("nothing", world=9), ServiceError, "world 9"),
        (lambda world: world.damage_road("nothing", float("inf")), ActionError, "inf"),
        (lambda world: world.declare_event(0, "car_99", "obstacle"), ActionError, "car_99"),
        (lambda world: world.declare_event(0, 99, "obstacle"), ServiceError, "agent 99"),
        (lambda world: world.declare_event(0, 0, "nothing"), ServiceError, "nothing"),
        (lambda world: world.record(["nothing"]), ServiceError, "observations"),
        (lambda world: world.scenario("../a.py"), ServiceError, "pattern"),
    ],
)
def test_a_refused_change_has_no_effect(
    open_world: RemoteWorld, ask: Callable[[RemoteWorld], None], error: type[Exception], words: str
) -> None:
    number, before = open_world.flows.number, open_world.state_hash()
    with pytest.raises(error, match=words):
        ask(open_world)
    assert (open_world.flows.number, open_world.state_hash()) == (number, before)
    open_world.step(open_world.suggest_actions())


@pytest.fixture(scope="module")
def open_world(client: Client) -> Iterator[RemoteWorld]:
    with client.open("grid4x4", wait_s=30.0, **WORLD) as world:
        world.reset(seed=0)
        yield world


def test_a_world_is_recorded_once_and_into_a_new_folder(
    open_world: RemoteWorld, tmp_path: Path
) -> None:
    open_world.record(["observations"])
    with pytest.raises(ServiceError, match="already"):
        open_world.record()
    open_world.step(open_world.suggest_actions())
    with pytest.raises(RecordingError, match="new folder"):
        open_world.recording(tmp_path)
    (found,) = open_world.recording(tmp_path / "there")
    assert len(list(Recording.open(found).frames())) == 1


def test_the_asynchronous_client_has_the_same_commands(cluster: Cluster) -> None:
    secret = cluster.service.grant("bob", "client")

    async def drive() -> str:
        client = AsyncClient(cluster.service.url, secret)
        world = await client.open("grid4x4", wait_s=30.0, **WORLD)
        await world.reset(seed=0)
        local = cavmarl.make_vec("grid4x4", **WORLD)
        edge, lane = first_road(local)
        local.close()
        await world.insert_vehicle(lane, 5.0)
        await world.close_road(edge, shuts_in=True)
        await world.step(await world.suggest_actions())
        await world.damage_road(edge, 2.0)
        await world.open_road(edge)
        await world.declare_event(0, "car_0", "obstacle")
        assert set(await world.frames()) == {"roof"}
        assert await world.transfers() == []
        await world.save_state()
        found = await world.state_hash()
        await world.close()
        await client.close()
        return found

    assert asyncio.run(drive())


def test_both_clients_have_the_same_methods() -> None:
    def methods(kind: type) -> set[str]:
        return {name for name in vars(kind) if not name.startswith("_")}

    assert methods(RemoteWorld) == methods(cavmarl.client.AsyncWorld)
