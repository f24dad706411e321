"""Worlds and evaluations on nodes in separate processes; tests kill nodes and the service.

Three nodes serve all tests, and their processor time counts for the last test. The last test is
in every run, because no cheaper test shows that sessions outlive their nodes.
"""

from __future__ import annotations

import asyncio
import itertools
import json
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from typer.testing import CliRunner
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

import cavmarl
from cavmarl.cli import app
from cavmarl.client import AsyncClient, Client, RemoteWorld
from cavmarl.core.errors import ServiceError
from cavmarl.evaluate import evaluate, load_report
from cavmarl.viewer.inserted_here import lane_at
from cavmarl.viewer.map_geometry import map_origin
from tests.support.service import Cluster, running_service

AGENTS = 4
NUMBERS = itertools.count()


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    store = tmp_path_factory.mktemp("service") / "store.sqlite"
    with running_service(store, "--lease-s", "6", "--beat-s", "0.6") as service:
        started = Cluster(service)
        started.start("a", "b", "victim")
        yield started
        started.stop()


@pytest.fixture
def client(cluster: Cluster) -> Iterator[Client]:
    with cluster.service.client(cluster.service.grant(f"user-{next(NUMBERS)}", "client")) as made:
        yield made


def open_world(client: Client, node: str | None = None) -> RemoteWorld:
    return client.open("merge", agents=AGENTS, background=8, node=node, wait_s=30.0)


def assert_same(remote: RemoteWorld, local: cavmarl.CavVectorEnv, steps: range) -> None:
    """Check that both worlds give the same bytes for the same actions."""
    for step in steps:
        actions = local.suggest_actions()
        ours, theirs = remote.step(actions), local.step(actions)
        for one, other in zip(ours[:4], theirs[:4], strict=True):
            np.testing.assert_array_equal(one, other, err_msg=f"step {step}")
            assert one.dtype == other.dtype
        assert ours[4].keys() == theirs[4].keys()
        for name, other in theirs[4].items():
            np.testing.assert_array_equal(ours[4][name], other, err_msg=f"{name}, step {step}")
    assert remote.state_hash() == local.state_hash()


def make_local() -> cavmarl.CavVectorEnv:
    return cavmarl.make_vec("merge", agents=AGENTS, background=8)


def test_a_session_continues_bit_for_bit_after_its_node_is_killed(
    cluster: Cluster, client: Client
) -> None:
    remote, local = open_world(client, node="victim"), make_local()
    assert remote.flows.assignment["assigned"] == "victim"
    np.testing.assert_array_equal(remote.reset(seed=5)[0], local.reset(seed=5)[0])
    np.testing.assert_array_equal(remote.suggest_actions(), local.suggest_actions())
    assert_same(remote, local, range(60))  # until a state has been saved
    cluster.processes["victim"].kill()
    assert_same(remote, local, range(60, 75))
    assert remote.flows.moves == 1
    events = client.get("/events", limit=1000)["events"]  # a client can read only its own events
    kinds = [one["kind"] for one in events]
    assert kinds == [
        "configuration.added", "session.opened", "session.assigned", "session.saved",
        "session.redirected",
    ]  # fmt: skip
    remote.close()
    assert client.get(f"/sessions/{remote.flows.session}")["state"] == "closed"


def test_a_session_moves_from_a_drained_node(cluster: Cluster, client: Client) -> None:
    remote, local = open_world(client), make_local()
    remote.reset(seed=1)
    local.reset(seed=1)
    assert_same(remote, local, range(5))
    place = remote.flows.assignment["assigned"]
    with cluster.service.client() as admin:
        admin.post(f"/nodes/{place}/drain")
        while remote.flows.assignment["assigned"] == place:
            assert_same(remote, local, range(1))
        assert remote.flows.moves >= 1  # a slow node may cause another move
    remote.close()


def test_another_client_resumes_a_session(cluster: Cluster, client: Client) -> None:
    remote, local = open_world(client), make_local()
    remote.reset(seed=2)
    local.reset(seed=2)
    assert_same(remote, local, range(3))
    assert_same(client.take_up(remote.flows.session), local, range(3, 6))
    with (
        cluster.service.client(cluster.service.grant("thief", "client")) as thief,
        pytest.raises(ServiceError, match="no session") as refused,
    ):
        thief.take_up(remote.flows.session)
    assert refused.value.problem == "not-found"


def test_a_node_opens_a_world_only_with_the_token_of_its_lease(client: Client) -> None:
    remote = open_world(client)
    other = open_world(client)
    remote.reset(seed=0)
    place = remote.flows.assignment
    url = f"http://{place['address']}:{place['client_port']}/v1/worlds/{place['session']}/hash"
    for token in ("y", "x", other.flows.assignment["token"]):
        answer = httpx.get(url, headers={"Authorization": f"Bearer {token}"})
        assert answer.status_code == 401
        assert answer.json()["title"] == "bad-token"


def test_a_refused_step_changes_nothing(client: Client) -> None:
    remote, local = open_world(client), make_local()
    with pytest.raises(ServiceError, match="before reset"):
        remote.step(np.zeros((1, AGENTS, 2), dtype=np.float32))
    remote.reset(seed=4)
    local.reset(seed=4)
    with pytest.raises(ServiceError, match="nan"):
        remote.step(np.full((1, AGENTS, 2), np.nan, dtype=np.float32))
    with pytest.raises(cavmarl.ActionError, match="shape"):
        remote.step(np.zeros((1, AGENTS + 1, 2), dtype=np.float32))
    assert_same(remote, local, range(3))
    remote.close()


def test_the_async_client_gives_the_same_results(cluster: Cluster) -> None:
    secret = cluster.service.grant("awaiting", "client")

    async def run() -> tuple[str, int]:
        async with AsyncClient(cluster.service.url, secret) as client:
            world = await client.open("merge", agents=AGENTS, background=8, wait_s=30.0)
            async with world:
                await world.reset(seed=6)
                for _ in range(3):
                    await world.step(await world.suggest_actions())
                async for event in client.follow():
                    return await world.state_hash(), event["sequence"]
        raise AssertionError

    local = make_local()
    local.reset(seed=6)
    for _ in range(3):
        local.step(local.suggest_actions())
    found, sequence = asyncio.run(run())
    assert found == local.state_hash()
    assert sequence > 0


def test_a_job_gives_the_results_of_a_local_evaluation(client: Client, tmp_path: Path) -> None:
    world = {"agents": 2, "background": 4, "seed": 3}
    job = client.submit("ring", episodes=1, max_cycles=20, **world)
    done = client.wait(job, tmp_path / "there", timeout_s=120.0)
    assert done["state"] == "done"
    there = load_report(tmp_path / "there")
    evaluate("ring", "idm", episodes=1, max_cycles=20, out=tmp_path / "here", **world)
    for name in ("trips.csv", "episodes.csv", "tracks.csv", "map.json"):
        assert (tmp_path / "there" / name).read_bytes() == (tmp_path / "here" / name).read_bytes()
    manifest = json.loads((tmp_path / "there" / "manifest.json").read_text())
    assert manifest["status"] == "closed"
    assert there.episodes == 1


def test_the_runs_of_a_job_are_spread_over_nodes(
    cluster: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CAVMARL_SECRET", cluster.service.grant("spreader", "client"))
    monkeypatch.chdir(tmp_path)
    words = "submit ring --agents 2 --background 4 --seed 3 --episodes 1 --repeats 2 --spread"
    options = ["--set", "horizon_s=4", "--service", cluster.service.url, "--out", "there"]
    shown = CliRunner().invoke(app, [*words.split(), *options], catch_exceptions=False)
    assert shown.exit_code == 0, shown.output
    here = evaluate(
        "ring", "idm", episodes=1, repeats=2, agents=2, background=4, seed=3,
        overrides={"horizon_s": 4.0}, out=Path("here"),
    )  # fmt: skip
    for name in ("trips.csv", "episodes.csv", "tracks.csv", "map.json"):
        assert Path("there", name).read_bytes() == Path("here", name).read_bytes()
    assert load_report(Path("there"))["idm"].metrics == here["idm"].metrics
    for run in ("0", "1"):
        events = Path("there", "runs", run, "service_events.jsonl").read_text().splitlines()
        kinds = [json.loads(line)["kind"] for line in events]
        assert "session.assigned" in kinds


def test_a_job_that_cannot_run_fails_with_its_cause(client: Client) -> None:
    job = client.submit("merge", policies=["merge_ippo"], overrides={"action.kind": "discrete"})
    with pytest.raises(ServiceError, match="failed"):
        client.wait(job, timeout_s=120.0)


@pytest.mark.slow  # tests in every run cover each kind of kill by itself
def test_kills_of_nodes_and_of_the_service_change_no_bit(tmp_path: Path) -> None:
    options = ("--lease-s", "2", "--beat-s", "0.3")
    with running_service(tmp_path / "store.sqlite", *options) as service:
        nodes = Cluster(service)
        nodes.start("a", "b")
        with service.client() as client:
            remote, local = open_world(client), make_local()
            remote.reset(seed=8)
            local.reset(seed=8)
            assert_same(remote, local, range(40))
            service.kill()
            assert_same(remote, local, range(40, 60))  # the lease is still valid
            service.start_again(*options)
            assert_same(remote, local, range(60, 90))
            nodes.processes[remote.flows.assignment["assigned"]].kill()
            nodes.start("c")
            assert_same(remote, local, range(90, 130))
            service.kill()
            service.start_again(*options)
            nodes.processes[remote.flows.assignment["assigned"]].kill()
            assert_same(remote, local, range(130, 160))
            assert remote.flows.moves == 2
            kinds = [one["kind"] for one in client.get("/events", limit=1000)["events"]]
            assert kinds.count("node.down") >= 1
        nodes.stop()


def test_a_session_is_shown_on_a_page_of_its_node(client: Client) -> None:
    with open_world(client) as world:
        world.reset(seed=1)
        told = world.page()
        assert told["address"].startswith("http://127.0.0.1:")
        assert world.page() == told
        live = told["address"].replace("http", "ws") + "live"
        with connect(live, max_size=None, compression=None) as page:
            page.send(json.dumps({"kind": "hello", "token": "wrong"}))
            with pytest.raises(ConnectionClosed):
                page.recv(timeout=10)
        with connect(live, max_size=None, compression=None) as page:
            page.send(json.dumps({"kind": "hello", "token": told["token"]}))
            hello = json.loads(page.recv(timeout=10))
            assert (hello["policy"], hello["control"]) == ("a client of the service", True)
            for _ in range(3):
                world.step(world.suggest_actions())
            messages = [page.recv(timeout=10) for _ in range(3)]
            assert 3 in [message[0] for message in messages if isinstance(message, bytes)]
            rows: list[Any] = []
            for _ in range(20):
                message = page.recv(timeout=10)
                told_of = json.loads(message) if isinstance(message, str) else {}
                rows = told_of.get("rows", rows)
                if (
                    len(rows) > 1 and rows[-1]["score"] is not None
                ):  # the score is None if the heartbeat is late
                    break
            assert "node of the service" in rows[-1]["name"]
            assert rows[-1]["score"] is not None
        with connect(live, max_size=None, compression=None) as page:
            page.send(json.dumps({"kind": "hello", "token": told["watch_token"]}))
            assert json.loads(page.recv(timeout=10))["control"] is False
    with pytest.raises(httpx.ConnectError):
        httpx.get(told["address"])


def wait_for_event(page: Any, kind: str) -> None:
    """Wait until a page receives an event of a kind."""
    for _ in range(1000):
        message = page.recv(timeout=20)
        if isinstance(message, str) and (told := json.loads(message))["kind"] == "events":
            if kind in [event[1] for event in told["events"]]:
                return
    raise AssertionError(kind)


def test_changes_by_a_page_are_kept_if_the_session_moves(cluster: Cluster, client: Client) -> None:
    keys: dict[str, Any] = {"agents": AGENTS, "background": 8}
    keys["overrides"] = {"population.insertions": 4}
    cluster.start("controlled")
    remote = client.open("merge", node="controlled", wait_s=30.0, **keys)
    local = cavmarl.make_vec("merge", **keys)
    remote.reset(seed=5)
    local.reset(seed=5)
    assert_same(remote, local, range(3))
    network = local.network
    lane = int(np.flatnonzero(~network.lanes["internal"])[0])
    x, y = (network.lane_polyline(lane)[0, :2] - map_origin(network)).tolist()
    told = remote.page()
    live = told["address"].replace("http", "ws") + "live"
    with connect(live, max_size=None, compression=None) as page, ThreadPoolExecutor(1) as pool:
        page.send(json.dumps({"kind": "hello", "token": told["token"]}))
        page.send('{"kind": "pause"}')
        time.sleep(0.5)
        actions = local.suggest_actions()
        held = pool.submit(remote.step, actions)
        page.send(json.dumps({"kind": "insert", "x": x, "y": y}))
        wait_for_event(page, "inserted")
        assert not held.done()
        page.send('{"kind": "play"}')
        held.result(timeout=60)
        row, place_m = lane_at(network, x, y)
        local.insert_vehicle(network.lane_ids[row], place_m)
        local.step(actions)
        assert_same(remote, local, range(2))
        page.send('{"kind": "reset"}')
        wait_for_event(page, "episode")
    local.reset(options={"reset_mask": np.array([True])})
    actions = local.suggest_actions()
    assert remote.step(actions)[4]["begun_anew"].tolist() == [True]
    local.step(actions)
    cluster.processes["controlled"].kill()
    assert_same(remote, local, range(3))
    assert remote.flows.moves == 1
    remote.close()
    local.close()
