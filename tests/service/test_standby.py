"""A standby takes over from a killed service, and no acknowledged request is lost."""

from __future__ import annotations

import itertools
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Thread

import httpx
import pytest
from sqlalchemy import create_engine, text

from cavmarl.client import Client
from cavmarl.client.service_protocol import Ask, Rest, ServiceFlows
from cavmarl.core.errors import ServiceError
from cavmarl.service.event_log import EventLog
from cavmarl.service.event_store import EventStore
from cavmarl.service.server import follow_store
from tests.service.test_event_store import empty_postgresql, postgresql
from tests.service.test_sessions import assert_same, make_local, open_world
from tests.support.fleet import Fleet
from tests.support.forked_processes import ForkedProcess
from tests.support.service import Cluster, running_service

__all__ = ["empty_postgresql", "postgresql"]

TAKEOVER_S = 5.0


@contextmanager
def running_standby(store: str) -> Iterator[str]:
    """Run a standby process within the block, and yield its URL."""
    words = ["-m", "cavmarl", "serve", "--standby", "--port", "0", "--store", store]
    process = ForkedProcess([*words, "--beat-s", "0.6"], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        url = process.stdout.readline().split()[1].rstrip(",")
        assert "ready to take over" in process.stdout.readline()
        yield url
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def test_a_standby_takes_over_within_5_s_and_loses_no_acknowledged_request(
    empty_postgresql: str,
) -> None:
    acknowledged: list[str] = []
    with (
        running_service(empty_postgresql, "--beat-s", "0.6") as service,
        running_standby(empty_postgresql) as other,
    ):
        primary, service.url = service.url, f"{service.url},{other}"
        cluster = Cluster(service)
        cluster.start("a")

        def ask_without_end(asker: int) -> None:
            with service.client() as client:
                for k in itertools.count():
                    body = {"name": f"guest-{asker}-{k}", "role": "viewer"}
                    with suppress(ServiceError):
                        acknowledged.append(client.post("/identities", body)["identity"])
                    if is_over:
                        return

        is_over: list[bool] = []
        with service.client(service.grant("ada", "client")) as client:
            remote, local = open_world(client), make_local()
            remote.reset(seed=5)
            local.reset(seed=5)
            assert_same(remote, local, range(3))
            askers = [Thread(target=ask_without_end, args=(k,)) for k in range(2)]
            for one in askers:
                one.start()
            while len(acknowledged) < 20:
                time.sleep(0.001)
            service.kill()
            began_s, count = time.monotonic(), len(acknowledged) + len(askers)
            while len(acknowledged) <= count:  # answers of the killed service may still arrive
                assert time.monotonic() < began_s + TAKEOVER_S
                time.sleep(0.001)
            is_over.append(True)
            for one in askers:
                one.join()
            assert_same(
                remote, local, range(3, 60)
            )  # enough steps for a state to be saved at the new service
            assert client.get(f"/sessions/{remote.flows.session}")["saved_number"] > 0
            assert client.flows.url == other != primary
            with service.client() as admin:
                known = {one["id"] for one in admin.get("/identities")["identities"]}
                told = admin.get("/events", subject="service", limit=1000)["events"]
            assert known >= set(acknowledged)
            starts = [one["data"] for one in told if one["kind"] == "service.started"]
            assert [one["is_standby"] for one in starts] == [False, True]
            assert starts[0]["load"]["weights"] == [0.6, 0.2, 0.2]
            remote.close()
            local.close()
        cluster.stop()


def test_a_standby_follows_the_log_until_the_store_is_free(empty_postgresql: str) -> None:
    fleet = Fleet(empty_postgresql)
    store = EventStore(empty_postgresql, is_standby=True)
    assert not store.try_lock()
    fleet.log.flush()
    log = EventLog(store, is_own=False)
    fleet.join("a", "b")
    fleet.log.flush()
    assert log.catch_up() > 0
    assert log.state == fleet.log.state
    fleet.open()
    fleet.close()
    found = follow_store(store, lambda _: None)
    assert found.sequence == fleet.log.sequence
    assert found.state == fleet.log.state
    store.close()


def test_a_standby_refuses_a_changed_log_when_it_takes_over(empty_postgresql: str) -> None:
    fleet = Fleet(empty_postgresql)
    fleet.join("a")
    fleet.close()
    change(
        empty_postgresql, "DELETE FROM events WHERE sequence = (SELECT max(sequence) FROM events)"
    )
    store = EventStore(empty_postgresql, is_standby=True)
    with pytest.raises(ServiceError, match="head"):
        follow_store(store, lambda _: None)
    store.close()


def test_a_service_that_loses_its_connection_to_the_store_stops_writing(
    empty_postgresql: str,
) -> None:
    fleet = Fleet(empty_postgresql)
    fleet.log.flush()
    others = "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE pid <> pg_backend_pid()"
    change(empty_postgresql, f"{others} AND datname = current_database()")
    for _ in range(2):  # the second check must not open a new connection, which has no lock
        with pytest.raises(ServiceError, match="does not answer"):
            fleet.log.store.check_lock()
    fleet.register("a")
    with pytest.raises(ServiceError):
        fleet.log.flush()
    fleet.log.store.close()
    again = EventLog(EventStore(empty_postgresql))
    assert "a" not in again.state.nodes
    again.store.close()


def test_no_message_shows_the_password_of_the_store(
    empty_postgresql: str, capfd: pytest.CaptureFixture[str]
) -> None:
    user, at, place = empty_postgresql.removeprefix("postgresql://").partition("@")
    secret = f"postgresql://{user if at else 'postgres'}:hidden@{place if at else user}"
    store = EventStore(secret)
    assert "hidden" not in store.where
    with pytest.raises(ServiceError, match=r"\*\*\*.* is in use") as taken:
        EventStore(secret)
    assert "hidden" not in str(taken.value)
    others = "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE pid <> pg_backend_pid()"
    change(empty_postgresql, f"{others} AND datname = current_database()")
    with pytest.raises(ServiceError, match="does not answer") as lost:
        store.check_lock()
    assert "hidden" not in str(lost.value)
    store.close()
    with running_service(secret) as service:
        assert service.url.startswith("http://")
    assert "hidden" not in "".join(capfd.readouterr())


def change(url: str, statement: str) -> None:
    engine = create_engine(url.replace("postgresql:", "postgresql+psycopg:"))
    with engine.begin() as connection:
        connection.execute(text(statement))
    engine.dispose()


def test_a_standby_with_an_sqlite_store_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ServiceError, match="postgresql://"):
        EventStore(tmp_path / "store.sqlite", is_standby=True)
    assert not (tmp_path / "store.sqlite").exists()


def test_a_configuration_is_sent_again_to_the_service_that_takes_over() -> None:
    flow = ServiceFlows("http://a,http://b", "secret").add_configuration("merge", {})
    request = httpx.Request("POST", "http://a")
    tokens = httpx.Response(200, json={"access_token": "t", "expires_in": 900}, request=request)
    assert isinstance(next(flow), Ask)
    sent = flow.send(tokens)
    assert isinstance(sent, Ask)
    assert sent.url == "http://a/v1/configurations"
    assert isinstance(flow.throw(httpx.ReadError("the service was killed")), Rest)
    again = flow.send(None)
    assert isinstance(again, Ask)
    assert again.url == "http://b/v1/configurations"
    with pytest.raises(StopIteration) as end:
        flow.send(httpx.Response(201, json={"hash": "0" * 64}, request=request))
    assert end.value.value == "0" * 64


def test_services_that_do_not_answer_are_asked_in_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cavmarl.client.service_protocol.TAKEOVER_S", 0.5)
    began_s = time.monotonic()
    with (
        Client("http://127.0.0.1:9,http://127.0.0.1:19", "secret") as client,
        pytest.raises(ServiceError, match=r"127\.0\.0\.1"),
    ):
        client.get("/nodes")
    assert 0.4 < time.monotonic() - began_s < 5.0
