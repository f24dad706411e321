"""A session whose zones are on several nodes (its members), which the tests kill.

The leader is the session's own node: it steps the world and gives its zones to the members.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import psutil
import pytest

import cavmarl
from cavmarl.client import Client, RemoteWorld
from cavmarl.core.errors import ServiceError
from tests.service.test_sessions import assert_same
from tests.support.service import Cluster, running_service

CHANGED: dict[str, Any] = {"map.changed_lanes": 8}
WORLD: dict[str, Any] = {"zones": 2, "agents": 6, "background": 24, "overrides": CHANGED}
SOON_S = 60.0


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    store = tmp_path_factory.mktemp("service") / "store.sqlite"
    with running_service(store, "--lease-s", "6", "--beat-s", "0.4") as service:
        started = Cluster(service)
        started.start("a", "b", "c")
        yield started
        started.stop()


@pytest.fixture(scope="module")
def client(cluster: Cluster) -> Iterator[Client]:
    with cluster.service.client(cluster.service.grant("ada", "client")) as made:
        yield made


def wait_for(what: Callable[[], bool]) -> None:
    until_s = time.monotonic() + SOON_S
    while not what():
        assert time.monotonic() < until_s
        time.sleep(0.1)


def test_a_session_over_nodes_survives_kills_of_its_nodes(cluster: Cluster, client: Client) -> None:
    remote = client.open("grid4x4", nodes=2, wait_s=30.0, **WORLD)
    session = f"/sessions/{remote.flows.session}"
    local = cavmarl.make_vec("grid4x4", **WORLD)
    remote.reset(seed=3)
    local.reset(seed=3)
    assert_same(remote, local, range(55))  # until a state has been saved
    check_reported_owners(client, session, remote, local)
    found = client.get(session)
    assert len(set(found["members"])) == 2
    victim = next(name for name in found["members"] if name != found["node"])
    cluster.processes[victim].kill()
    edge = next(name for name in local.network.edge_ids if not name.startswith(":"))
    for world in (remote, local):
        world.close_road(edge, shuts_in=True)
    assert_same(remote, local, range(55, 65))
    wait_for(lambda: victim not in client.get(session)["members"])
    assert_same(remote, local, range(65, 70))
    cluster.processes[found["node"]].kill()
    assert_same(remote, local, range(70, 80))
    assert remote.flows.moves == 1
    kinds = [one["kind"] for one in client.get("/events", limit=1000)["events"]]
    assert kinds.count("session.repartitioned") >= 2
    assert "session.handed_over" in kinds
    remote.close()


def check_reported_owners(
    client: Client, session: str, remote: RemoteWorld, local: cavmarl.CavVectorEnv
) -> None:
    """Check that the service reports the owners of vehicles that have changed their zones."""
    rows = local.simulation.transfers[0].rows
    last = {row.vehicle: {"zone": row.target, "epoch": row.epoch} for row in rows}
    assert last

    def told() -> dict[int, dict[str, int]]:
        found = client.get(f"{session}/transfers")["owners"]
        return {one["vehicle"]: {"zone": one["zone"], "epoch": one["epoch"]} for one in found}

    wait_for(lambda: told() == last)
    assert {row["vehicle"] for row in remote.transfers()} == {*last}


def test_a_job_on_several_nodes_is_refused(client: Client) -> None:
    with pytest.raises(ServiceError, match="runs on one node"):
        client.submit("grid4x4", nodes=2, zones=2)


def test_closing_a_job_ends_its_process(cluster: Cluster, client: Client) -> None:
    job = client.submit("grid4x4", agents=20, episodes=1000)
    client.delete(f"/sessions/{job}")
    node = next(one for one in cluster.processes.values() if one.poll() is None)

    def is_over() -> bool:
        return not [
            one for one in psutil.Process(node.pid).children() if "fresh" in command_line_of(one)
        ]

    wait_for(is_over)


def command_line_of(process: psutil.Process) -> str:
    try:
        return " ".join(process.cmdline())
    except psutil.NoSuchProcess:
        return ""
