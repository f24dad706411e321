"""What the store promises, on SQLite and on a real PostgreSQL.

A real service is killed in each run: no cheaper test shows what outlives that.
"""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from sqlalchemy import create_engine, text

from cavmarl.core.errors import ServiceError
from cavmarl.service.event_log import EventLog
from cavmarl.service.event_store import EventStore
from tests.support.fleet import Fleet
from tests.support.service import running_service


@pytest.fixture(scope="module")
def postgresql() -> Iterator[str]:
    """URL of a real server that is started for these tests."""
    if shutil.which("initdb") is None or shutil.which("postgres") is None:
        pytest.skip("no PostgreSQL on this machine: initdb and postgres are not in the path")
    folder = Path(tempfile.mkdtemp(prefix="cavmarl-pg-"))  # where every user may go
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    user = ["setpriv", "--reuid=65534", "--regid=65534", "--clear-groups"]
    prefix = user if os.geteuid() == 0 else []  # it does not run for root
    if prefix:
        os.chown(folder, 65534, 65534)
    data = folder / "data"
    words = ["initdb", "-D", str(data), "-U", "postgres", "-A", "trust", "--no-sync"]
    subprocess.run([*prefix, *words], check=True, capture_output=True)
    options = f"-p {port} -k {folder} -c listen_addresses=127.0.0.1"
    server = [*prefix, "pg_ctl", "-D", str(data), "-w", "-l", str(folder / "log")]
    subprocess.run([*server, "-o", options, "start"], check=True, capture_output=True)
    yield f"postgresql://postgres@127.0.0.1:{port}/postgres"
    subprocess.run([*server, "-m", "immediate", "stop"], check=False, capture_output=True)
    shutil.rmtree(folder, ignore_errors=True)


def history(where: str | Path) -> tuple[list[str], EventLog]:
    """The kinds of events of one day at a service, and its log."""
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
    assert again.store.check_chain() == again.sequence
    return kinds, again


def test_postgresql_keeps_what_sqlite_keeps(postgresql: str, tmp_path: Path) -> None:
    kinds, log = history(postgresql)
    with pytest.raises(ServiceError, match="another service has it"):
        EventStore(postgresql)
    log.store.close()
    expected, other = history(tmp_path / "store.sqlite")
    other.store.close()
    assert kinds == expected


def test_a_store_is_one_service_s(tmp_path: Path) -> None:
    store = EventStore(tmp_path / "store.sqlite")
    with pytest.raises(ServiceError, match="another service has it"):
        EventStore(tmp_path / "store.sqlite")
    store.close()
    EventStore(tmp_path / "store.sqlite").close()


def test_a_store_of_another_version_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "store.sqlite"
    EventStore(path).close()
    damage(path, "UPDATE about SET schema = 'cavmarl.service/9'")
    with pytest.raises(ServiceError, match="this version knows"):
        EventStore(path)


@pytest.mark.parametrize(
    ("where", "words"),
    [
        ("mysql://x/y", "postgresql://"),
        ("nonsense://x", "postgresql://"),
        ("/proc/none/store.sqlite", "cannot be opened"),
    ],
)
def test_a_store_that_cannot_be_is_refused(where: str, words: str) -> None:
    with pytest.raises(ServiceError, match=words):
        EventStore(where)


def test_a_file_that_is_no_store_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "store.sqlite"
    path.write_bytes(b"no database, but long enough to be read as one" * 100)
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
def test_a_changed_log_is_noticed(tmp_path: Path, change: str) -> None:
    path = tmp_path / "store.sqlite"
    history(path)[1].store.close()
    damage(path, change)
    store = EventStore(path)
    with pytest.raises(ServiceError, match="does not follow from the one before"):
        store.check_chain()
    store.close()


def test_the_store_s_file_is_its_owner_s_alone(tmp_path: Path) -> None:
    EventStore(tmp_path / "store.sqlite").close()
    assert (tmp_path / "store.sqlite").stat().st_mode & 0o077 == 0


def test_what_was_acknowledged_outlives_a_kill(tmp_path: Path) -> None:
    path = tmp_path / "store.sqlite"
    acknowledged = []
    with running_service(path) as service, service.client() as client:
        for k in range(20):
            body = {"name": f"guest-{k}", "role": "viewer"}
            acknowledged.append(client.post("/identities", body)["identity"])
        secret = service.secret
        service.kill()
    with running_service(path) as service:
        assert service.secret == ""  # it is shown once
        with service.client(secret) as client:
            known = [one["id"] for one in client.get("/identities")["identities"]]
            assert known[1:] == acknowledged


def test_nothing_is_acknowledged_that_could_not_be_written(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path / "store.sqlite")
    fleet.log.flush()
    before = fleet.log.durable
    fleet.log.store._connection.close()
    fleet.register("a")
    with pytest.raises(ServiceError, match="cannot be written"):
        fleet.log.flush()
    assert fleet.log.is_broken
    fleet.log.store.close()
    again = EventStore(tmp_path / "store.sqlite")
    assert sum(1 for _ in again.read()) == before
    again.close()


def damage(path: Path, statement: str) -> None:
    engine = create_engine(f"sqlite:///{path}")
    with engine.begin() as connection:
        connection.execute(text(statement))
    engine.dispose()
