"""A service that continues from a snapshot has the records of a complete replay."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import fields, replace
from pathlib import Path
from random import Random

import pytest
from sqlalchemy import create_engine, text

from cavmarl.core.errors import ServiceError
from cavmarl.service.event_log import EventLog
from cavmarl.service.event_store import EventStore
from cavmarl.service.request_bodies import ConfigurationBody, TransfersBody
from cavmarl.service.server import follow_store
from cavmarl.service.service_records import Infrastructure
from cavmarl.service.snapshots import SNAPSHOT_SCHEMA, SealedSnapshot, is_same, records_of, text_of
from tests.service.test_event_store import damage, empty_postgresql, postgresql
from tests.support.fleet import Fleet
from tests.support.service import running_service

__all__ = ["empty_postgresql", "postgresql"]

JOB = {"policies": ["idm"], "episodes": 1, "repeats": 1}
FIELDS = SealedSnapshot._fields


def random_history(fleet: Fleet, random: Random, steps: int) -> None:
    """Send requests of all kinds, including refused requests, to a service in random order."""
    names = ["a", "b", "c", "d"]
    fleet.join(*names)

    def session() -> str:
        return random.choice(list(fleet.log.state.sessions) or ["none"])

    def hosted() -> object:
        return fleet.broker.hosted(fleet.nodes, session())

    def content() -> bytes:
        return b"content %d" % random.randrange(8)  # some content has several users

    def transfers() -> TransfersBody:
        rows = [[random.randrange(2), random.randrange(3), 1, random.randrange(9), 0, 1, 2]
                for _ in range(5)]  # fmt: skip
        return TransfersBody(at=random.randrange(100), transfers=rows)

    def refresh() -> None:
        fleet.access.refresh(fleet.access.exchange(fleet.secrets["ada"])["refresh_token"])

    def configuration() -> None:
        world = ConfigurationBody(environment="merge", seed=random.randrange(5))
        fleet.add_configuration(world)

    def artefact() -> None:
        name = f"{random.randrange(4)}.yaml"
        sha256 = hashlib.sha256(name.encode()).hexdigest()
        broker.artefacts.add(fleet.client, sha256, name, "CC0", name.encode())

    def delete() -> None:
        own = broker.artefacts.of(fleet.client.id)
        broker.artefacts.delete(fleet.client, random.choice(list(own)))

    broker = fleet.broker
    acts: list[Callable[[], object]] = [
        *[lambda: fleet.open(zone_nodes=random.choice([0, 0, 2]))] * 4,
        *[lambda: fleet.open(job=JOB, wait_s=random.choice([None, 30.0]))] * 2,
        *[lambda: broker.save(hosted(), random.randrange(100), content())] * 4,
        *[lambda: broker.add_result(hosted(), random.choice("xyz"), content())] * 4,
        *[lambda: broker.hand_over(hosted(), transfers())] * 4,
        *[lambda: broker.resolve(fleet.client, session())] * 2,
        *[lambda: fleet.beat(random.choice(names), cpu=random.random())] * 4,
        lambda: broker.finish(hosted(), random.choice(["done", "failed"]), "message"),
        lambda: broker.close(fleet.client, session()),
        lambda: broker.drain(fleet.nodes, random.choice(names), random.random() < 0.5),
        lambda: broker.leave(fleet.nodes, random.choice(names)),
        lambda: fleet.register(random.choice(names), capabilities=["gpu"]),
        lambda: fleet.identity(f"guest-{random.random()}", "viewer"),
        lambda: fleet.access.revoke(random.choice(list(fleet.log.state.identities)[2:]), "x"),
        lambda: fleet.access.rotate_key() if random.random() < 0.2 else None,
        refresh, configuration, artefact, delete, broker.sweep, broker.sweep,
    ]  # fmt: skip
    for _ in range(steps):
        fleet.now_s += random.choice([0.1, 1.0, 5.0, 700.0])
        with suppress(ServiceError, IndexError):
            random.choice(acts)()


def reopened(where: Path | str, snapshot_events: int = 10_000) -> Iterator[EventLog]:
    store = EventStore(where)
    try:
        yield EventLog(store, snapshot_events=snapshot_events)
    finally:
        store.close()


@pytest.mark.parametrize("seed", range(8))
def test_a_snapshot_and_later_events_give_the_records_of_a_replay(
    tmp_path: Path, seed: int
) -> None:
    path, random = tmp_path / "store.sqlite", Random(seed)
    fleet = Fleet(path)
    random_history(fleet, random, 400)
    fleet.log.end()
    ended = fleet.log.sequence
    random_history(fleet, random, 100)
    known = fleet.log.state
    fleet.close()
    for log in reopened(path, snapshot_events=0):
        replayed, stored = log.state, stored_content(path)
        assert stored == set(log.state.users)
    for log in reopened(path):
        assert log.origin.startswith(f"snapshot after event {ended}, ")
        assert log.sequence > ended
        assert is_same(log.state, replayed)
        assert log.state == known
        assert log.check_older(60.0)
    assert {line.kind.partition(".")[0] for line in lines_of(path)} >= {
        "artefact", "configuration", "identity", "key", "node", "session"
    }  # fmt: skip
    empty = Infrastructure()
    kept = [
        one.name for one in fields(empty) if getattr(replayed, one.name) != getattr(empty, one.name)
    ]
    assert {"nodes", "sessions", "identities", "keys", "configurations", "users"} <= set(kept)


def stored_content(path: Path) -> set[str]:
    engine = create_engine(f"sqlite:///{path}")
    with engine.connect() as connection:
        found = {row[0] for row in connection.execute(text("SELECT sha256 FROM blobs"))}
    engine.dispose()
    return found


def lines_of(path: Path) -> list[object]:
    store = EventStore(path)
    found = list(store.read())
    store.close()
    return found


def test_content_that_loses_its_user_after_a_snapshot_is_deleted(tmp_path: Path) -> None:
    path = tmp_path / "store.sqlite"
    fleet = Fleet(path)
    fleet.join("a")
    session = fleet.open()
    fleet.broker.save(session, 1, b"state")
    fleet.log.end()
    fleet.close()
    again = Fleet(path, identities=False)
    again.client = again.log.state.identities[session.owner]
    again.broker.close(again.client, session.id)
    again.log.flush()
    assert again.log.store.blob(hashlib.sha256(b"state").hexdigest()) is None
    again.close()


def test_a_snapshot_is_written_after_ten_events_and_only_the_last_one_is_kept(
    tmp_path: Path,
) -> None:
    path = tmp_path / "store.sqlite"
    store = EventStore(path)
    log = EventLog(store, snapshot_events=10)
    log.record("key.added", "key-0", private={"pem": "pem"})
    found = []
    for _ in range(35):
        log.record("clock.right", "service")
        log.flush()
        kept = store.snapshot()
        found.append(kept.sequence if kept else 0)
    assert sorted(set(found)) == [0, 10, 20, 30]
    log.end()
    last = store.snapshot()
    assert last is not None
    assert (last.sequence, last.digest) == (36, list(store.read())[-1].digest)
    log.end()  # without new events, there is no new snapshot
    assert store.snapshot() == last
    store.close()


def make_store(path: Path) -> SealedSnapshot:
    """Make a store with a snapshot and three later events; return the snapshot."""
    fleet = Fleet(path)
    fleet.join("a")
    fleet.broker.save(fleet.open(), 1, b"state")
    fleet.log.end()
    found = fleet.log.store.snapshot()
    fleet.broker.drain(fleet.nodes, "a")
    fleet.access.rotate_key()
    fleet.broker.drain(fleet.nodes, "a", is_on=False)
    fleet.close()
    assert found is not None
    return found


def put(path: Path, snapshot: SealedSnapshot | None) -> None:
    """Replace the snapshot of a store as another program could do."""
    engine = create_engine(f"sqlite:///{path}")
    marks = ", ".join(f":{name}" for name in FIELDS)
    with engine.begin() as connection:
        connection.execute(text("DELETE FROM snapshot"))
        if snapshot is not None:
            words = f"INSERT INTO snapshot ({', '.join(FIELDS)}) VALUES ({marks})"
            connection.execute(text(words), snapshot._asdict())
    engine.dispose()


def refusal(path: Path, snapshot_events: int = 10_000) -> str:
    with pytest.raises(ServiceError) as refused:
        next(reopened(path, snapshot_events))
    assert "restore an older copy" in str(refused.value)
    return str(refused.value)


@pytest.mark.parametrize("name", FIELDS)
def test_a_changed_snapshot_is_refused(tmp_path: Path, name: str) -> None:
    path, random = tmp_path / "store.sqlite", Random(0)
    good = make_store(path)
    value = getattr(good, name)
    changed: list[object] = [value + 1, value - 1] if name == "sequence" else [b"\xff", "", "é"]
    for _ in range(0 if name == "sequence" else 20):
        place = random.randrange(len(value))
        changed.append(value[:place] + chr(ord(value[place]) ^ 1) + value[place + 1 :])
    for one in changed:
        put(path, good._replace(**{name: one}))
        assert "snapshot" in refusal(path)
    put(path, good)
    for log in reopened(path):
        assert log.origin.startswith("snapshot after event")


def test_a_forged_snapshot_is_refused(tmp_path: Path) -> None:
    """A forger without a key of the log adds its own key to the records and seals with this key."""
    path = tmp_path / "store.sqlite"
    good = make_store(path)
    records = records_of(good.content)
    records.keys["key-forged"] = "forged"
    forged = good._replace(key="key-forged", content=text_of(records)).sealed("forged")
    for one in (forged, forged._replace(key=good.key), good._replace(content=forged.content)):
        put(path, one)
        assert "is not sealed with a key of this log" in refusal(path)


def test_a_snapshot_of_another_store_is_refused(tmp_path: Path) -> None:
    make_store(tmp_path / "store.sqlite")
    put(tmp_path / "store.sqlite", make_store(tmp_path / "other.sqlite"))
    assert "is not sealed with a key of this log" in refusal(tmp_path / "store.sqlite")


def test_an_old_snapshot_gives_the_same_records(tmp_path: Path) -> None:
    path = tmp_path / "store.sqlite"
    old = make_store(path)
    for log in reopened(path):
        known = log.state
        log.record("clock.right", "service")
        log.end()
        assert log.store.snapshot() != old
    put(path, old)
    for log in reopened(path):
        assert log.origin == f"snapshot after event {old.sequence}, 4 later events replayed"
        assert is_same(log.state, known)
        assert log.check_older(60.0)


def test_a_snapshot_that_is_newer_than_the_log_is_refused(tmp_path: Path) -> None:
    """The events and the head of an older copy are put back, but not its snapshot."""
    path = tmp_path / "store.sqlite"
    old = make_store(path)
    for log in reopened(path):
        head, count = log.store.head(), log.sequence
        log.record("clock.right", "service")
        log.end()
    assert head is not None
    damage(path, f"DELETE FROM events WHERE sequence > {count}")
    damage(path, f"UPDATE head SET sequence = {head.sequence}, digest = '{head.digest}', "
                 f"seal = '{head.seal}'")  # fmt: skip
    assert f"follows an event {count + 1} that this log does not have" in refusal(path)
    put(path, old)
    for log in reopened(path):
        assert log.sequence == count


@pytest.mark.parametrize("is_dropped", [True, False])
def test_without_a_usable_snapshot_all_events_are_replayed_and_the_reason_is_given(
    tmp_path: Path, is_dropped: bool
) -> None:
    path = tmp_path / "store.sqlite"
    good = make_store(path)
    pem = records_of(good.content).keys[good.key]
    other = good._replace(schema="cavmarl.snapshot/9", content="{}").sealed(pem)
    put(path, None if is_dropped else other)
    for log in reopened(path):
        why = "a snapshot" if is_dropped else "the snapshot, which is of another version"
        assert log.origin.startswith(f"without {why}")
        assert log.origin.endswith(f"{log.sequence} events replayed")
        log.end()  # writes a new snapshot
    for log in reopened(path):
        assert log.origin == f"snapshot after event {log.sequence}, 0 later events replayed"


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE events SET actor = 'another' WHERE sequence = 2",
        "UPDATE events SET data = '{' WHERE sequence = 2",
        "UPDATE events SET time_s = 0 WHERE sequence = 1",
        "DELETE FROM events WHERE sequence = 3",
        "DELETE FROM events WHERE sequence IN (3, 4)",
    ],
)
def test_a_change_of_an_event_before_the_snapshot_is_found_after_the_start(
    tmp_path: Path, statement: str
) -> None:
    path = tmp_path / "store.sqlite"
    assert make_store(path).sequence > 4
    damage(path, statement)
    for log in reopened(path):
        with pytest.raises(ServiceError, match="the log was modified"):
            log.check_older(60.0)


def test_records_that_the_events_do_not_give_are_found_after_the_start(tmp_path: Path) -> None:
    """A holder of a key seals other records; the events are those of the service."""
    path = tmp_path / "store.sqlite"
    good = make_store(path)
    records = records_of(good.content)
    number = next(iter(records.identities))
    records.identities[number] = replace(records.identities[number], role="admin")
    put(path, good._replace(content=text_of(records)).sealed(records.keys[good.key]))
    for log in reopened(path):
        with pytest.raises(ServiceError, match="do not give the records of its snapshot"):
            log.check_older(60.0)


def test_older_events_are_checked_in_parts(tmp_path: Path) -> None:
    path = tmp_path / "store.sqlite"
    make_store(path)
    for log in reopened(path):
        assert not log.check_older(0.0)
        log.record("clock.right", "service")
        log.flush()
        while not log.check_older(0.0):
            pass
        assert log.check_older(0.0)


def test_a_service_ends_when_it_finds_a_changed_older_event(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "store.sqlite"
    with running_service(path) as service:
        service.grant("ada", "client")
        service.terminate()
        before = len(lines_of(path))
        service.start_again()
        told = service.process.stdout.readline()
        origin = f"snapshot after event {before}, 0 later events replayed"
        assert told == f"log: {before} events, {origin}\n"
        service.grant("bob", "client")
        service.terminate()
        damage(path, "UPDATE events SET actor = 'another' WHERE sequence = 1")
        service.start_again()
        assert service.process.wait(30.0) == 2
        service.process.stdout.close()
    assert "event 1 does not follow from the previous one" in capfd.readouterr().err
    assert "event 1 does not follow" in refusal(path, snapshot_events=0)


def test_a_standby_reads_the_snapshot_first(empty_postgresql: str) -> None:
    fleet = Fleet(empty_postgresql)
    fleet.join("a", "b")
    fleet.log.end()
    fleet.open()
    fleet.close()
    store, told = EventStore(empty_postgresql, is_standby=True), list[str]()
    log = EventLog(store, is_own=False)
    assert log.origin.endswith("2 later events replayed")
    assert log.state == fleet.log.state
    assert log.check_older(60.0)
    log = follow_store(store, told.append)
    assert log.state == fleet.log.state
    store.close()


def test_the_schema_follows_from_the_fields_of_the_records() -> None:
    assert SNAPSHOT_SCHEMA.startswith("cavmarl.snapshot/1 ")
    assert len(SNAPSHOT_SCHEMA) <= 128  # width of the database column
    assert json.loads(text_of(Infrastructure())).keys() == {
        one.name for one in fields(Infrastructure) if one.name != "unused"
    }
