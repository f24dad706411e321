"""Attacks on the service by a node, by a client and by a caller without a token."""

from __future__ import annotations

import asyncio
import hashlib
import os
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from random import Random
from typing import Any

import httpx
import jwt
import pytest
from sqlalchemy import create_engine, text

from cavmarl.client import Client
from cavmarl.client.service_protocol import Ask, Flow, ServiceFlows
from cavmarl.core.errors import ConfigError, ServiceError
from cavmarl.service.broker import MOST_RESULTS
from cavmarl.service.configurations import read_configuration
from cavmarl.service.event_log import EventLog
from cavmarl.service.event_store import EventStore, digest_of
from cavmarl.service.node_app import make_node_app
from cavmarl.service.node_link import NodeLink
from cavmarl.service.request_bodies import MOST_WORLDS, ConfigurationBody, TransfersBody
from cavmarl.service.session_worlds import SessionWorld, SessionWorlds
from tests.support.fleet import Fleet
from tests.support.loopback_service import LoopbackService, loopback_service

ROOT = Path(__file__).resolve().parents[2]
JSON = {"Content-Type": "application/json"}
WORLD = {"environment": "ring", "agents": 1, "background": 1}


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LoopbackService]:
    with loopback_service(tmp_path_factory.mktemp("service") / "store.sqlite") as running:
        running.start_node("a", "node", slots=100)
        yield running


@pytest.fixture
def fleet(tmp_path: Path) -> Iterator[Fleet]:
    made = Fleet(tmp_path / "store.sqlite")
    yield made
    made.close()


def title_of(answer: httpx.Response) -> str:
    assert answer.headers["content-type"] == "application/problem+json"
    return str(answer.json()["title"])


def change(path: Path, statement: str, **values: Any) -> None:
    """Change the file of a store as another program could."""
    engine = create_engine(f"sqlite:///{path}")
    with engine.begin() as connection:
        connection.execute(text(statement), values)
    engine.dispose()


# Saved states


def open_session(service: LoopbackService) -> dict[str, Any]:
    found = service.ask("client", "POST", "/configurations", json=WORLD).json()["hash"]
    answer = service.ask("client", "POST", "/sessions", json={"configuration": found, "node": "a"})
    opened: dict[str, Any] = answer.json()
    return opened


def open_on_node(service: LoopbackService, opened: dict[str, Any]) -> httpx.Response:
    url = f"{service.nodes['a'][1]}/v1/worlds/{opened['session']}"
    bearer = {"Authorization": f"Bearer {opened['token']}"}
    return httpx.post(url, headers=bearer, timeout=300.0)


def save(service: LoopbackService, opened: dict[str, Any], content: bytes) -> None:
    path = f"/sessions/{opened['session']}/state?at=1"
    assert service.ask("node", "PUT", path, content=content).status_code == 204


@pytest.mark.parametrize("what", ["session", "number", "content", "node", "use", "key", "absent"])
def test_a_node_refuses_a_state_that_the_service_has_not_signed_for_it(
    service: LoopbackService, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    opened, other = open_session(service), open_session(service)["session"]
    save(service, opened, b"state")
    link = service.nodes["a"][0]
    assert service.run(link.saved_state(opened["session"])) == (b"state", 1)
    sign = service.access.state_token

    def forge_token(session: Any, number: int, content: bytes) -> str:
        good = sign(session, number, content)
        claims = jwt.decode(good, options={"verify_signature": False})
        if what == "absent":
            return ""
        if what == "session":
            return sign(service.broker.log.state.sessions[other], number, content)
        if what == "number":
            return sign(session, number + 1, content)
        if what == "content":
            return sign(session, number, b"another")
        if what == "use":
            return service.access.session_token(session, 60.0)
        if what == "node":
            session = service.broker.log.state.sessions[session.id]
            monkeypatch.setattr(session, "node", "b")
            found = sign(session, number, content)
            monkeypatch.setattr(session, "node", "a")
            return found
        kid = jwt.get_unverified_header(good)["kid"]
        return jwt.encode(claims, "k" * 32, "HS256", headers={"kid": kid})

    monkeypatch.setattr(service.access, "state_token", forge_token)
    with pytest.raises(ServiceError) as refused:
        service.run(link.saved_state(opened["session"]))
    assert refused.value.problem == "damaged"


def test_a_state_that_cannot_be_used_ends_only_its_session(service: LoopbackService) -> None:
    good, bad, changed = (open_session(service) for _ in range(3))
    save(service, bad, b"no state of any world")
    save(service, changed, b"a state that is changed in the store")
    service.run(service.events.settle())
    sha256 = hashlib.sha256(b"a state that is changed in the store").hexdigest()
    path = Path(service.events.store.where)
    change(path, "UPDATE blobs SET content = 'x' WHERE sha256 = :sha256", sha256=sha256)
    for opened in (bad, changed):
        answer = open_on_node(service, opened)
        assert (answer.status_code, title_of(answer)) == (410, "damaged")
        found = service.ask("client", "GET", f"/sessions/{opened['session']}").json()
        assert found["state"] == "failed"
        assert found["message"]
    assert open_on_node(service, good).status_code == 200
    assert not [line for line in service.log.lines if "Traceback" in line]


def test_a_randomly_changed_state_is_refused_or_can_be_used() -> None:
    """Nodes do not sign states, so the state from another node may consist of any bytes."""
    document = {**WORLD, "max_cycles": None, "num_envs": 2, "seed": 0, "overrides": {}}
    world = SessionWorld(document, None, 0, {})
    world.command(1, lambda: world.reset(0), is_quiet=False)
    state = world.state()
    world.close()
    assert state is not None
    SessionWorld(document, state, 1, {}).close()
    random = Random(0)
    changed = [b"x", state[:1], state[1:], state[:-1], state + b"\0", b"\0" * len(state)]
    for _ in range(24):
        place, length = random.randrange(len(state)), random.choice([1, 8, 100])
        changed.append(state[:place] + random.randbytes(length) + state[place + length :])
        changed.append(state[:place] + state[place + length :])
    problems = Counter(problem_of_state(document, content) for content in changed)
    assert problems.keys() <= {"", "damaged"}
    assert problems["damaged"] > 0.9 * len(changed)


def problem_of_state(document: dict[str, Any], state: bytes) -> str:
    try:
        SessionWorld(document, state, 1, {}).close()
    except ServiceError as error:
        return error.problem
    return ""


def test_the_token_of_a_state_is_refused_as_a_session_token(service: LoopbackService) -> None:
    opened = open_session(service)
    session = service.broker.log.state.sessions[opened["session"]]
    opened["token"] = service.access.state_token(session, 0, b"")
    answer = open_on_node(service, opened)
    assert (answer.status_code, title_of(answer)) == (401, "bad-token")


# Content


@pytest.mark.parametrize("how", ["state", "result", "closed", "forgotten"])
def test_content_is_kept_while_a_configuration_uses_it(fleet: Fleet, how: str) -> None:
    """A node stores the bytes of a configuration as a state or a result, and then replaces them.

    In the variants `closed` and `forgotten`, the session ends instead.
    """
    found = fleet.add_configuration(ConfigurationBody(environment="merge"))
    fleet.log.flush()
    content = fleet.log.content(found["hash"])
    fleet.join("a")
    session = fleet.open()
    if how in ("state", "closed"):
        fleet.broker.save(session, 1, content)
    else:
        fleet.broker.add_result(session, "a.csv", content)
    if how == "state":
        fleet.broker.save(session, 2, b"another")
    elif how == "result":
        fleet.broker.add_result(session, "a.csv", b"another")
    else:
        fleet.broker.close(fleet.client, session.id)
        fleet.now_s += 3601.0 if how == "forgotten" else 0.0
        fleet.broker.sweep()
    fleet.log.flush()
    assert read_configuration(fleet.log, found["hash"])["environment"] == "merge"


def test_content_without_users_is_deleted(fleet: Fleet) -> None:
    fleet.join("a")
    first, second = fleet.open(), fleet.open()
    for session in (first, second):
        fleet.broker.save(session, 1, b"shared")
        fleet.broker.add_result(session, "a.csv", b"old")
        fleet.broker.add_result(session, "a.csv", b"new")
    hashes = {name: hashlib.sha256(name).hexdigest() for name in (b"shared", b"old", b"new")}

    def stored() -> set[bytes]:
        fleet.log.flush()
        return {name for name, sha256 in hashes.items() if fleet.log.store.blob(sha256)}

    assert stored() == {b"shared", b"new"}
    fleet.broker.save(first, 2, b"x")
    assert stored() == {b"shared", b"new"}
    fleet.broker.close(fleet.client, second.id)
    assert stored() == {b"new"}
    fleet.broker.close(fleet.client, first.id)
    fleet.now_s += 3601.0
    fleet.broker.sweep()
    assert stored() == set()


def test_the_results_and_transfers_of_a_node_are_limited(fleet: Fleet) -> None:
    fleet.join("a")
    session = fleet.open()
    for k in range(MOST_RESULTS):
        fleet.broker.add_result(session, f"{k}.csv", b"x")
    fleet.broker.add_result(session, "0.csv", b"y")
    with pytest.raises(ServiceError, match="a job can have at most") as refused:
        fleet.broker.add_result(session, "another.csv", b"x")
    assert refused.value.problem == "too-many"
    body = TransfersBody(at=1, transfers=[[MOST_WORLDS, 0, 1, 2, 0, 1, 1]])
    with pytest.raises(ServiceError, match="world 1024"):
        fleet.broker.hand_over(session, body)


# Bodies


def test_a_node_registers_again_after_a_forged_heartbeat(tmp_path: Path) -> None:
    """The service refuses the real heartbeats after the forged one, so the node registers again."""
    with loopback_service(tmp_path / "store.sqlite") as service:
        link = service.start_node("a", "node")
        service.ask("operator", "POST", "/nodes/a/drain")
        while not link.is_draining:
            time.sleep(0.02)
        beat = {"incarnation": link.incarnation, "sequence": 2**53, "sent_s": 0.0,
                "cpu": 0.0, "ram": 0.0}  # fmt: skip
        assert service.ask("node", "POST", "/nodes/a/beat", json=beat).status_code == 200
        service.ask("operator", "POST", "/nodes/a/resume")
        service.wait_until_ready("a")
        assert link.incarnation == 2
        beat["sequence"] += 1
        assert service.ask("node", "POST", "/nodes/a/beat", json=beat).status_code == 409
        service.wait_until_ready("a")
        assert link.incarnation == 2


@pytest.mark.parametrize("depth", [33, 100, 500, 900, 1000, 30_000])
@pytest.mark.parametrize("key", ["environment", "overrides", "new"])
def test_deeply_nested_bodies_are_refused_with_one_log_line(
    service: LoopbackService, depth: int, key: str
) -> None:
    service.log.lines.clear()
    for opening, closing in ("[]", ('[{"a":', "}]")):
        nested = f"{opening * depth}1{closing * depth}"
        body = f'{{"environment": "merge", "{key}": {{"a": {nested}}}}}'
        answer = service.ask("client", "POST", "/configurations", content=body, headers=JSON)
        assert (answer.status_code, title_of(answer)) == (422, "bad-body")
    assert sum(map(len, service.log.lines)) <= 400


@pytest.mark.parametrize(
    "body",
    [
        '{"environment": "merge", "overrides": {"\\ud800": 1}}',
        '{"environment": "merge", "overrides": {"a": NaN}}',
        '{"environment": "merge", "\\udfff": 1}',
        '{"environment": "merge", "seed": 1' + "0" * 5000 + "}",
        '{"environment": "merge", "seed": Infinity}',
        '{"environment": "merge", "overrides": {"clock.sim_dt_s": 1e400}}',
        '{"environment": "merge", "name": "\xff"}'.encode("latin-1"),
    ],
)
def test_bodies_that_are_not_valid_json_are_refused(
    service: LoopbackService, body: str | bytes
) -> None:
    answer = service.ask("client", "POST", "/configurations", content=body, headers=JSON)
    assert (answer.status_code, title_of(answer)) == (422, "bad-body")


def test_the_body_of_a_request_without_a_token_is_not_read(service: LoopbackService) -> None:
    for body in (b"[" * 200_000, b"x" * 300_000, b"{"):
        answer = service.ask("", "POST", "/configurations", content=body, headers=JSON)
        assert title_of(answer) == "bad-token"


def test_a_repeated_internal_error_is_one_log_line_after_the_first_traceback(
    service: LoopbackService, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(_: object) -> None:
        raise RuntimeError("first line\nsecond line")

    monkeypatch.setattr(service.broker, "session", lambda *_: fails(None))
    service.log.lines.clear()
    for _ in range(3):
        answer = service.ask("client", "GET", "/sessions/s-" + "0" * 24)
        assert (answer.status_code, title_of(answer)) == (500, "broken")
    assert [line.count("Traceback") for line in service.log.lines] == [1, 0, 0]
    assert service.log.lines[1].count("\n") == 0
    assert "test_attacks.py" in service.log.lines[1]


# Rates


def test_a_flood_from_an_address_does_not_lock_an_identity_out(tmp_path: Path) -> None:
    with loopback_service(tmp_path / "store.sqlite", address_hz=2.0) as service:
        for attack in ("/health", "/keys"):
            found = [service.ask("", "GET", attack).status_code for _ in range(15)]
            assert found[-1] == 429
        for body in (
            {"secret": "x"}, {"secret": "cav." + service.secrets["client"].split(".")[1] + ".x"},
            {"refresh_token": "x"},
        ):  # fmt: skip
            for _ in range(15):
                last = service.ask("", "POST", "/token", json=body)
            assert last.status_code == 429
        for _ in range(15):
            refused = service.ask("", "GET", "/nodes", headers={"Authorization": "Bearer x"})
            # The answer is 401 instead of 429, so that a client with an old token gets a new token.
            assert refused.status_code == 401
        secret = {"secret": service.secrets["client"]}
        tokens = service.ask("", "POST", "/token", json=secret)
        assert tokens.status_code == 200
        again = {"refresh_token": tokens.json()["refresh_token"]}
        assert service.ask("", "POST", "/token", json=again).status_code == 200


def test_the_rate_of_token_requests_is_limited_for_each_identity(tmp_path: Path) -> None:
    with loopback_service(tmp_path / "store.sqlite", rate_hz=5.0) as service:
        for _ in range(30):
            last = service.ask("", "POST", "/token", json={"secret": service.secrets["viewer"]})
        assert last.status_code == 429
        assert service.ask("client", "GET", "/nodes").status_code == 200


def test_a_node_asks_for_unknown_keys_at_most_once_per_second(service: LoopbackService) -> None:
    opened = open_session(service)
    url = f"{service.nodes['a'][1]}/v1/worlds/{opened['session']}/hash"
    assert open_on_node(service, opened).status_code == 200
    asked: list[str] = []
    keys = service.access.public_keys
    service.access.public_keys = lambda: asked.append("keys") or keys()  # type: ignore[method-assign,func-returns-value]
    began_s = time.monotonic()
    for k in range(60):
        token = jwt.encode({"sub": "x"}, "k" * 32, "HS256", headers={"kid": f"key-{k:08x}"})
        bearer = {"Authorization": f"Bearer {token}"}
        assert service.http.get(url, headers=bearer).status_code == 401
    service.access.public_keys = keys  # type: ignore[method-assign]
    assert len(asked) <= 2.0 + (time.monotonic() - began_s)
    bearer = {"Authorization": f"Bearer {opened['token']}"}
    assert httpx.get(url, headers=bearer).status_code != 401


def test_a_node_drops_keys_that_the_service_has_replaced(
    service: LoopbackService, monkeypatch: pytest.MonkeyPatch
) -> None:
    link = service.nodes["a"][0]
    old = next(reversed(service.events.state.keys))
    service.run(link.public_key(old, 0.0))
    for _ in range(2):
        service.ask("admin", "POST", "/keys")
    service.run(link.public_key(old))  # the node keeps the old key until it asks for keys again
    monkeypatch.setattr("cavmarl.service.node_link.KEYS_KEPT_S", 0.0)
    with pytest.raises(KeyError):
        service.run(link.public_key(old))


def test_states_are_signed_with_a_new_key_at_once(service: LoopbackService) -> None:
    opened = open_session(service)
    save(service, opened, b"state")
    link = service.nodes["a"][0]
    for _ in range(3):
        service.ask("admin", "POST", "/keys")
        assert service.run(link.saved_state(opened["session"])) == (b"state", 1)


def test_a_node_answers_503_if_it_cannot_ask_the_service_for_keys() -> None:
    """The client repeats its request to the service until the service answers again."""
    body = {"name": "a", "address": "127.0.0.1", "client_port": 1, "simulator_port": 1}
    link = NodeLink("http://127.0.0.1:1", "x", body)
    token = jwt.encode({"sub": "x"}, "k" * 32, "HS256", headers={"kid": "key-00000000"})
    transport = httpx.ASGITransport(make_node_app(link, SessionWorlds(1)))

    async def ask() -> httpx.Response:
        async with httpx.AsyncClient(transport=transport, base_url="http://node") as http:
            bearer = {"Authorization": f"Bearer {token}"}
            found = await http.get("/v1/worlds/s/hash", headers=bearer)
        await link.close()
        return found

    answer = asyncio.run(ask())
    assert (answer.status_code, title_of(answer)) == (503, "unreachable")


# The event log


def make_store(tmp_path: Path) -> Path:
    path = tmp_path / "store.sqlite"
    fleet = Fleet(path)
    fleet.join("a")
    session = fleet.open()
    fleet.broker.save(session, 1, b"state")
    fleet.access.rotate_key()
    fleet.open()
    fleet.close()
    return path


def recompute(path: Path) -> None:
    """Recompute all digests of a store, as an attacker could after a change."""
    store = EventStore(path)
    lines, last = list(store.read()), ""
    store.close()
    for line in lines:
        last = digest_of(last, line)
        statement = "UPDATE events SET digest = :digest WHERE sequence = :number"
        change(path, statement, digest=last, number=line.sequence)
    change(path, "UPDATE head SET digest = :digest, sequence = :n", digest=last, n=len(lines))


@pytest.mark.parametrize(
    "statements",
    [
        ["DELETE FROM events WHERE sequence = (SELECT max(sequence) FROM events)"],
        ["DELETE FROM events WHERE sequence > 3", "recompute"],
        ["DELETE FROM events"],
        ["UPDATE events SET actor = 'another' WHERE sequence = 3", "recompute"],
        ["UPDATE events SET time_s = 0", "recompute"],
        ["UPDATE events SET kind = 'another.kind' WHERE sequence = 3", "recompute"],
        ["UPDATE events SET data = '{' WHERE sequence = 3"],
        ["UPDATE events SET data = x'ff' WHERE sequence = 3"],
        ["DELETE FROM head"],
        ["UPDATE head SET seal = 'x'"],
        ["UPDATE head SET key = (SELECT subject FROM events WHERE kind = 'key.added' LIMIT 1)"],
    ],
)
def test_a_service_does_not_start_on_a_changed_log(tmp_path: Path, statements: list[str]) -> None:
    path = make_store(tmp_path)
    for statement in statements:
        recompute(path) if statement == "recompute" else change(path, statement)
    store = EventStore(path)
    with pytest.raises(ServiceError, match="the log was modified"):
        EventLog(store)
    store.close()


@pytest.mark.parametrize("statement", ["UPDATE blobs SET content = x'78'", "DELETE FROM blobs"])
def test_changed_content_is_refused(tmp_path: Path, statement: str) -> None:
    path = make_store(tmp_path)
    change(path, statement)
    log = EventLog(EventStore(path))
    sha256 = hashlib.sha256(b"state").hexdigest()
    with pytest.raises(ServiceError, match="the store was changed") as refused:
        log.content(sha256)
    assert refused.value.problem == "damaged"
    log.store.close()


# The file of the store


def test_a_second_service_cannot_open_a_store_through_a_link(tmp_path: Path) -> None:
    path = tmp_path / "store.sqlite"
    store = EventStore(path)
    (tmp_path / "soft.sqlite").symlink_to(path)
    (tmp_path / "folder").symlink_to(tmp_path)
    for other in (tmp_path / "soft.sqlite", tmp_path / "folder" / "store.sqlite", path):
        with pytest.raises(ServiceError, match="is in use by another service"):
            EventStore(other)
    os.link(path, tmp_path / "hard.sqlite")
    with pytest.raises(ServiceError, match="is in use by another service"):
        EventStore(tmp_path / "hard.sqlite")
    store.close()
    with pytest.raises(
        ServiceError, match="has 2 names"
    ):  # SQLite derives the name of its own log from the name of the store
        EventStore(tmp_path / "hard.sqlite")
    (tmp_path / "hard.sqlite").unlink()
    EventStore(tmp_path / "soft.sqlite").close()


@pytest.mark.parametrize(
    "where",
    [":memory:", "sqlite://", "sqlite:///:memory:", "sqlite:///file:x?mode=memory&uri=true"],
)
def test_a_store_in_memory_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ServiceError, match="must be a file"):
        EventStore(where)
    assert not list(tmp_path.iterdir())


def test_a_store_that_others_can_read_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "store.sqlite"
    EventStore(path).close()
    path.chmod(0o644)
    with pytest.raises(ConfigError, match="chmod 600"):
        EventStore(path)


# Paths and names


@pytest.mark.parametrize(
    "overrides", [{"population.types": "x"}, {"agents": 1}, {"sensors.lidar.rays": -1}]
)
def test_answers_do_not_contain_local_paths(
    service: LoopbackService, overrides: dict[str, Any]
) -> None:
    body = {"environment": "merge", "overrides": overrides}
    answer = service.ask("client", "POST", "/configurations", json=body)
    assert title_of(answer) == "refused"
    assert "env.yaml" in answer.json()["detail"]
    for place in (ROOT, sys.prefix, Path.home(), Path.cwd()):
        assert f"{place}/" not in answer.text


def drive(flow: Flow[Any], *answers: dict[str, Any]) -> None:
    """Run a flow with the answers of a malicious server."""
    said: Any = None
    for answer in answers:
        assert isinstance(flow.send(said), Ask)
        said = httpx.Response(200, json=answer)
    flow.send(said)


TOKENS = {"access_token": "x", "expires_in": 900.0}
OUTSIDE = ["..", ".", "", "../x", "a/b", "a\\b", "/x", "a\0b", ".x", "x" * 99]


@pytest.mark.parametrize("name", OUTSIDE)
def test_a_result_name_that_leaves_the_folder_is_refused(name: str) -> None:
    flow = ServiceFlows("http://127.0.0.1:1", "").results("s-" + "0" * 24)
    with pytest.raises(ServiceError, match="is not a name"):
        drive(flow, TOKENS, {"results": [name]})


@pytest.mark.parametrize("job", ["../../x", "..", "", "s-1/../../x"])
def test_a_job_id_that_is_a_path_is_refused(job: str) -> None:
    flow = ServiceFlows("http://127.0.0.1:1", "").submit("merge")
    with pytest.raises(ServiceError, match="is not a name"):
        drive(flow, TOKENS, {"hash": "0" * 64}, {"id": job})


# Secrets


@pytest.mark.parametrize(
    "url", ["http://192.0.2.1:8700", "http://example.org", "HTTP://[2001:db8::1]"]
)
def test_a_secret_is_not_sent_to_another_machine_without_tls(url: str) -> None:
    with Client(url, "secret") as client, pytest.raises(ServiceError, match="without TLS"):
        client.get("/health")


def test_a_token_is_not_sent_to_a_node_on_another_machine_without_tls(
    service: LoopbackService, monkeypatch: pytest.MonkeyPatch
) -> None:
    node = service.broker.log.state.nodes["a"]
    monkeypatch.setattr(node, "address", "192.0.2.1")
    with service.client("client") as client, pytest.raises(ServiceError, match="without TLS"):
        client.open("ring", agents=1, background=1, recovery_s=0.5)
