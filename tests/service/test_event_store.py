"""Guarantees of the event store, on SQLite and on a real PostgreSQL.

Every test run kills a real service, because no cheaper test shows which data survive.
"""

from __future__ import annotations

import itertools
import time
import uuid
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from threading import Thread

import pytest
from sqlalchemy import create_engine, inspect, text

from cavmarl.core.errors import ServiceError
from cavmarl.service.event_log import EventLog
from cavmarl.service.event_store import EventStore
from cavmarl.service.server import first_admin
from tests.support.fleet import Fleet
from tests.support.postgresql import running_postgresql
from tests.support.service import running_service


@pytest.fixture(scope="module")
def postgresql() -> Iterator[str]:
    with running_postgresql() as url:
        yield url


@pytest.fixture
def empty_postgresql(postgresql: str) -> str:
    """Return a new database on the same server."""
    name = f"d{uuid.uuid4().hex}"
    engine = create_engine(postgresql.replace("postgresql:", "postgresql+psycopg:"))
    with engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
        connection.execute(text(f"CREATE DATABASE {name}"))
    engine.dispose()
    return f"{postgresql.rpartition('/')[0]}/{name}"


def history(where: str | Path) -> tuple[list[str], EventLog]:
    """Run a service through typical events; return their kinds, and the log read again."""
    fleet = Fleet(where)
    fleet.join("a", "b")
    session = fleet.open(preferred="b")
    fleet.broker.save(session, 1, b"\x00state\xff")
    fleet.log.flush()
    fleet.broker.save(session, 2, b"later")
    fleet.broker.drain(fleet.nodes, "b")
    fleet.broker.resolve(fleet.client, session.id)
    fleet.now_s += 100.0
    fleet.broker.sweep()
    kinds = fleet.kinds()
    state = fleet.log.state
    fleet.close()
    again = EventLog(EventStore(where))
    assert again.state == state
    assert again.content(session.saved_blob or "") == b"later"
    assert len(list(again.store.read_checked())) == again.sequence
    return kinds, again


def test_postgresql_stores_the_same_data_as_sqlite(empty_postgresql: str, tmp_path: Path) -> None:
    kinds, log = history(empty_postgresql)
    with pytest.raises(ServiceError, match="is in use by another service"):
        EventStore(empty_postgresql)
    log.store.close()
    expected, other = history(tmp_path / "store.sqlite")
    other.store.close()
    assert kinds == expected


def test_a_store_has_only_one_service(tmp_path: Path) -> None:
    store = EventStore(tmp_path / "store.sqlite")
    with pytest.raises(ServiceError, match="is in use by another service"):
        EventStore(tmp_path / "store.sqlite")
    store.close()
    EventStore(tmp_path / "store.sqlite").close()


def test_a_store_of_another_version_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "store.sqlite"
    EventStore(path).close()
    damage(path, "UPDATE about SET schema = 'cavmarl.service/9'")
    with pytest.raises(ServiceError, match="this version needs"):
        EventStore(path)


@pytest.mark.parametrize(
    ("where", "words"),
    [
        ("mysql://x/y", "postgresql://"),
        ("nonsense://x", "postgresql://"),
        ("/proc/none/store.sqlite", "cannot be opened"),
    ],
)
def test_an_invalid_place_of_a_store_is_refused(where: str, words: str) -> None:
    with pytest.raises(ServiceError, match=words):
        EventStore(where)


def test_a_file_without_a_store_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "store.sqlite"
    path.write_bytes(b"no database, but long enough to be read as one" * 100)
    path.chmod(0o600)
    with pytest.raises(ServiceError, match="cannot be opened"):
        EventStore(path)


@pytest.mark.parametrize(
    "change",
    [
        "UPDATE events SET actor = 'another' WHERE sequence = 2",
        'UPDATE events SET data = \'{"role": "admin"}\' WHERE sequence = 2',
        "DELETE FROM events WHERE sequence = 2",
    ],
)
def test_a_changed_log_is_refused(tmp_path: Path, change: str) -> None:
    path = tmp_path / "store.sqlite"
    history(path)[1].store.close()
    damage(path, change)
    store = EventStore(path)
    with pytest.raises(ServiceError, match="does not follow from the previous one"):
        EventLog(store)
    store.close()


def test_only_the_owner_can_read_the_file_of_a_store(tmp_path: Path) -> None:
    EventStore(tmp_path / "store.sqlite").close()
    assert (tmp_path / "store.sqlite").stat().st_mode & 0o077 == 0


@pytest.mark.parametrize("kind", ["sqlite", "postgresql"])
def test_acknowledged_requests_survive_a_kill(
    kind: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    where: str | Path = tmp_path / "store.sqlite"
    if kind == "postgresql":
        where = request.getfixturevalue("empty_postgresql")
    acknowledged: list[str] = []
    with running_service(where) as service:

        def ask_until_killed(asker: int) -> None:
            with service.client() as client, suppress(ServiceError):
                for k in itertools.count():
                    body = {"name": f"guest-{asker}-{k}", "role": "viewer"}
                    acknowledged.append(client.post("/identities", body)["identity"])

        askers = [Thread(target=ask_until_killed, args=(k,)) for k in range(3)]
        for one in askers:
            one.start()
        while len(acknowledged) < 20 and any(one.is_alive() for one in askers):
            time.sleep(0.001)
        service.kill()  # requests are in progress now
        for one in askers:
            one.join()
        service.start_again()  # the service prints no secret, because an admin exists
        with service.client() as client:
            known = {one["id"] for one in client.get("/identities")["identities"]}
    assert len(acknowledged) >= 20
    assert known >= set(acknowledged)


def test_the_secret_of_the_first_admin_is_shown_only_once(tmp_path: Path) -> None:
    for is_new in (True, False):
        fleet = Fleet(tmp_path / "store.sqlite", identities=is_new)
        assert (first_admin(fleet.log, fleet.access) is not None) == is_new
        fleet.close()


def test_missing_indices_of_an_older_store_are_added(tmp_path: Path) -> None:
    path = tmp_path / "store.sqlite"
    EventStore(path).close()
    damage(path, "DROP INDEX events_of_owner")
    EventStore(path).close()
    engine = create_engine(f"sqlite:///{path}")
    names = {one["name"] for one in inspect(engine).get_indexes("events")}
    engine.dispose()
    assert names == {"events_of_owner", "events_of_actor", "events_of_subject"}


def test_a_request_that_could_not_be_written_is_not_acknowledged(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path / "store.sqlite")
    fleet.log.flush()
    before = fleet.log.durable
    full = "BEGIN SELECT RAISE(FAIL, 'the disk is full'); END"
    damage(tmp_path / "store.sqlite", f"CREATE TRIGGER full BEFORE INSERT ON events {full}")
    fleet.register("a")
    with pytest.raises(ServiceError, match="cannot be written"):
        fleet.log.flush()
    assert fleet.log.failure is not None
    fleet.log.store.close()
    again = EventStore(tmp_path / "store.sqlite")
    assert sum(1 for _ in again.read()) == before
    again.close()


def damage(path: Path, statement: str) -> None:
    engine = create_engine(f"sqlite:///{path}")
    with engine.begin() as connection:
        connection.execute(text(statement))
    engine.dispose()
