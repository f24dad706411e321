"""Files that users upload: hashes, kinds, quotas, lifetimes, and worlds and drivers from files."""

from __future__ import annotations

import gzip
import hashlib
import itertools
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import create_engine, text
from typer.testing import CliRunner

import cavmarl
from cavmarl.cli import app
from cavmarl.client import Client
from cavmarl.config.registry import agent_entries, entries
from cavmarl.core.errors import ServiceError
from cavmarl.evaluate import evaluate
from cavmarl.recordings.recording import Recording
from cavmarl.service.artefacts import Quota, check_content, is_same_kind
from cavmarl.service.event_log import EventLog
from cavmarl.service.event_store import EventStore
from cavmarl.service.request_bodies import ConfigurationBody
from tests.service.test_sessions import assert_same
from tests.support.fleet import Fleet
from tests.support.loopback_service import loopback_service
from tests.support.service import Cluster, running_service

NUMBERS = itertools.count()
NET = b"<net><location/></net>"
ENV = b"name: mine\nmap:\n  source: map.net.xml\n"


@pytest.fixture
def fleet(tmp_path: Path) -> Iterator[Fleet]:
    quota = Quota(files=4, total_bytes=1000, days=1.0)
    made = Fleet(tmp_path / "store.sqlite", artefacts=quota)
    yield made
    made.close()


def put(fleet: Fleet, name: str, content: bytes, owner: str = "client") -> str:
    sha256 = hashlib.sha256(content).hexdigest()
    fleet.broker.artefacts.add(getattr(fleet, owner), sha256, name, "CC0", content)
    return sha256


def put_world(fleet: Fleet, env: bytes = ENV) -> dict[str, str]:
    return {"env.yaml": put(fleet, "env.yaml", env), "map.net.xml": put(fleet, "map.net.xml", NET)}


def configure(fleet: Fleet, files: dict[str, str], **given: Any) -> str:
    body = ConfigurationBody(**{"environment": "mine", "files": files, **given})
    return str(fleet.add_configuration(body)["hash"])


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("code.py", b"import os", "code is never"),
        ("model.pt", b"x", "code is never"),
        ("map.net.xml", b"import os", "syntax error"),
        ("map.net.xml", b"<configuration><input/></configuration>", "only names files"),
        ("map.net.xml", b"<net>\0", "is no .xml file"),
        ("map.net.xml", b"<net><a></net>", "mismatched tag"),
        ("map.net.xml", b"<!DOCTYPE net [<!ENTITY a SYSTEM '/etc/passwd'>]><net>&a;</net>", "DOCT"),
        ("a.osm", "<!DOCTYPE a SYSTEM 'http://a/a.dtd'><a/>".encode("utf-16"), "document type"),
        ("a.rou.xml", b"<routes><include href='/etc/passwd'/></routes>", "could name a file"),
        ("a.rou.xml", b"<routes><include href='a/../../b.xml'/></routes>", "could name a file"),
        ("a.rou.xml", "<routes><include href='/dev/zero'/></routes>".encode("utf-16"), "could"),
        ("a.rou.xml", b"<routes><include href='&#47;etc/passwd'/></routes>", "could name a file"),
        ("a.add.xml", b"<additional><rerouter file='/etc/passwd'/></additional>", "could name"),
        ("a.add.xml.gz", gzip.compress(b"<a><rerouter file='~/a'/></a>", mtime=0), "could name"),
        ("map.net.xml.gz", NET, "is no .xml.gz file"),
        ("map.net.xml.gz", gzip.compress(b"import os", mtime=0), "syntax error"),
        ("map.net.xml.gz", gzip.compress(NET, mtime=0)[:-9], "is no .xml.gz file"),
        ("rig.yaml", b"- 1\n- 2\n", "must be a mapping"),
        ("rig.yaml", b"a: !!python/object/apply:os.getcwd []", "is no .yaml file"),
        ("zones.json", b"[" * 100_000, "is no .json file"),
        ("zones.json", b"[]", "must be an object"),
        ("rig.yaml", b"a: 1" + b" " * (1 << 20), "at most 1048576"),
        ("model.safetensors", b"\xff" * 64, "header"),
        ("model.safetensors", (2).to_bytes(8, "little") + b"[]", "must be an object"),
    ],
)
def test_content_that_does_not_fit_its_kind_or_names_other_files_is_refused(
    name: str, content: bytes, words: str
) -> None:
    with pytest.raises(ServiceError, match=words) as refused:
        check_content(name, hashlib.sha256(content).hexdigest(), content)
    assert refused.value.problem == "refused"


def test_uploaded_xml_files_may_refer_to_other_files() -> None:
    for inner in ("<include href='b/c.rou.xml'/>", "<e1Detector file='/dev/null'/>"):
        content = f"<additional>{inner}</additional>".encode()
        check_content("a.add.xml", hashlib.sha256(content).hexdigest(), content)


def test_the_number_of_elements_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cavmarl.service.artefacts.MOST_ELEMENTS", 100)
    content = gzip.compress(b"<a>" + 100 * b"<b/>" + b"</a>", mtime=0)
    with pytest.raises(ServiceError, match="over 100 elements"):
        check_content("a.xml.gz", hashlib.sha256(content).hexdigest(), content)


def test_a_compressed_file_that_is_too_large_when_unpacked_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("cavmarl.service.artefacts.MOST_UNPACKED_BYTES", 1 << 20)
    content = gzip.compress(NET + b" " * (1 << 21))
    with pytest.raises(ServiceError, match="when unpacked"):
        check_content("map.net.xml.gz", hashlib.sha256(content).hexdigest(), content)


def test_quotas_count_files_and_bytes_of_each_identity(fleet: Fleet) -> None:
    for k in range(3):
        put(fleet, "map.net.xml", NET + b" " * k)
    with pytest.raises(ServiceError, match="exceed the limit of 1000") as refused:
        put(fleet, "map.net.xml", NET + b" " * 950)
    assert refused.value.problem == "quota"
    put(fleet, "map.net.xml", NET + b" " * 3)
    put(fleet, "map.net.xml", NET)  # this file is already stored
    with pytest.raises(ServiceError, match="4 of at most 4"):
        put(fleet, "map.net.xml", NET + b" " * 4)
    fleet.other = fleet.identity("bob", "client")  # type: ignore[attr-defined]
    put(fleet, "map.net.xml", NET, owner="other")
    assert len(fleet.broker.artefacts.of(fleet.client.id)) == 4


def test_content_is_stored_until_its_last_owner_deletes_it(fleet: Fleet, tmp_path: Path) -> None:
    fleet.other = fleet.identity("bob", "client")  # type: ignore[attr-defined]
    sha256 = put(fleet, "map.net.xml", NET)
    with pytest.raises(ServiceError, match="of yours"):
        fleet.broker.artefacts.content(fleet.other, sha256)  # type: ignore[attr-defined]
    put(fleet, "map.net.xml", NET, owner="other")
    fleet.broker.artefacts.delete(fleet.client, sha256)
    assert fleet.broker.artefacts.content(fleet.other, sha256) == NET  # type: ignore[attr-defined]
    with pytest.raises(ServiceError, match="of yours"):
        fleet.broker.artefacts.delete(fleet.client, sha256)
    fleet.broker.artefacts.delete(fleet.other, sha256)  # type: ignore[attr-defined]
    fleet.log.flush()
    assert fleet.log.store.blob(sha256) is None
    state = fleet.log.state
    fleet.close()
    again = EventLog(EventStore(tmp_path / "store.sqlite"))
    assert again.state == state
    again.store.close()


def test_only_the_owner_and_nodes_that_need_a_file_get_it(fleet: Fleet) -> None:
    files = put_world(fleet)
    sha256 = files["map.net.xml"]
    others = [fleet.identity(role, role) for role in ("viewer", "operator", "admin")]
    others += [fleet.identity("other-node", "node"), fleet.nodes]
    fleet.join("a")
    session = fleet.broker.open(fleet.client, configure(fleet, files))
    assert fleet.broker.artefacts.content(fleet.client, sha256) == NET
    assert fleet.broker.artefacts.content(fleet.nodes, sha256) == NET
    fleet.broker.close(fleet.client, session.id)
    for one in others:
        with pytest.raises(ServiceError, match="of yours, or of a session") as refused:
            fleet.broker.artefacts.content(one, sha256)
        assert refused.value.problem == "not-found"


def test_an_unused_file_is_deleted_after_its_lifetime(fleet: Fleet) -> None:
    files = put_world(fleet)
    unused = put(fleet, "other.net.xml", NET + b" ")
    configuration = configure(fleet, files)
    fleet.join("a")
    session = fleet.broker.open(fleet.client, configuration)
    with pytest.raises(ServiceError, match="end it first"):
        fleet.broker.artefacts.delete(fleet.client, files["map.net.xml"])
    for _ in range(2):
        fleet.now_s += 86_400.0
        session = fleet.broker.resolve(
            fleet.client, session.id
        )  # a request, so that the session does not count as idle
        fleet.beat("a")
        fleet.broker.sweep()
        fleet.now_s += 1.0
    own = fleet.broker.artefacts.of(fleet.client.id)
    assert unused not in own
    assert set(files.values()) == set(own)
    fleet.broker.close(fleet.client, session.id)
    fleet.broker.sweep()
    assert not fleet.broker.artefacts.of(fleet.client.id)
    fleet.beat("a")
    with pytest.raises(ServiceError, match="upload it") as refused:
        fleet.broker.open(fleet.client, configuration)
    assert refused.value.problem == "not-found"
    assert fleet.kinds().count("artefact.expired") == 3


@pytest.mark.parametrize(
    ("env", "words"),
    [
        (b"map: {source: /etc/passwd}", "could name a file that was not uploaded"),
        (b"map: {source: ../map.net.xml}", "could name a file that was not uploaded"),
        (b"map: {source: 'sumo:../../map.net.xml'}", "could name a file that was not uploaded"),
        (b"map: {source: map.net.xml}\ntraffic: {demand: [other.rou.xml]}", "not uploaded"),
        (b"map: {source: map.net.xml}\nplugins: [antigravity]", "plugins: its entries name"),
        (b"map: {source: map.net.xml}\nzones: {journal: log}", "zones.journal: an uploaded"),
        (b"map: {source: map.net.xml}\nzones: {simulators: {1: carla}}", "zones.simulators"),
        (b"map: {source: map.net.xml}\nscenario: {name: code.py}", "code.py"),
        (b"map: {source: map.net.xml}\nworkers: {key_file: key}", "workers.key_file"),
        (b"map: {source: map.net.xml}\ntraffic: {model: 'zoo:tmp'}", "no driver 'tmp'"),
        (b"map: {source: map.net.xml}\nrig: other", "no such rig"),
        (b"map: {sauce: map.net.xml}", "map.sauce"),
    ],
)
def test_an_environment_that_refers_to_a_file_outside_of_its_upload_is_refused(
    fleet: Fleet, env: bytes, words: str
) -> None:
    files = put_world(fleet, b"name: mine\n" + env)
    with pytest.raises(ServiceError, match=words) as refused:
        configure(fleet, files)
    assert refused.value.problem == "refused"


@pytest.mark.parametrize(
    ("places", "words"),
    [
        (["map.net.xml"], "belongs to no environment"),
        (["env.yaml", "agents/idm/config.json"], "the folder name agents is reserved"),
        (["env.yaml", "drivers/a/config.json"], "must have exactly"),
        (["env.yaml", "drivers/idm/config.json", "drivers/idm/model.safetensors"], "driver 'idm'"),
    ],
)
def test_a_file_at_a_place_that_is_not_allowed_is_refused(
    fleet: Fleet, places: list[str], words: str
) -> None:
    sha256 = put(fleet, "env.yaml", ENV)
    kinds = {place: Path(place).suffix for place in places}
    files = {place: put(fleet, f"a{kind}", kind.encode()) for place, kind in kinds.items()}
    with pytest.raises(ServiceError, match=words):
        configure(fleet, files)
    for place in ("../env.yaml", "/env.yaml", "a/b/c/d", "drivers/../env.yaml"):
        with pytest.raises(ValueError, match="pattern"):
            configure(fleet, {place: sha256})


@pytest.mark.parametrize(
    ("place", "words"),
    [
        ("sitecustomize.py", "must end in one of"),
        ("matplotlibrc", "must end in one of"),
        ("a.net.xml", "uploaded as rig.yaml, a file of another kind"),
        ("drivers/a/config.json", "uploaded as rig.yaml"),
    ],
)
def test_a_file_cannot_be_used_as_another_kind_than_it_was_checked_for(
    fleet: Fleet, place: str, words: str
) -> None:
    code = put(fleet, "rig.yaml", b'x: int = __import__("os").system("id")\n')
    with pytest.raises(ServiceError, match=words) as refused:
        configure(fleet, {**put_world(fleet), place: code})
    assert refused.value.problem == "refused"
    assert is_same_kind("map.net.xml", "map.osm")


def test_a_file_at_many_places_is_not_read_many_times(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = put_world(fleet)
    read: list[str] = []
    content = EventLog.content

    def note(log: EventLog, sha256: str) -> bytes:
        read.append(sha256)
        return content(log, sha256)

    monkeypatch.setattr(EventLog, "content", note)
    configure(fleet, files | {f"{k}.net.xml": files["map.net.xml"] for k in range(200)})
    assert read == [files["env.yaml"]]
    monkeypatch.setattr("cavmarl.service.configuration_files.MOST_FILES_BYTES", 1000)
    with pytest.raises(ServiceError, match=r"all files together have \d+ bytes: at most 1000"):
        configure(fleet, files | {f"{k}.net.xml": files["map.net.xml"] for k in range(200)})
    monkeypatch.setattr("cavmarl.service.configuration_files.MOST_YAML_BYTES", 100)
    with pytest.raises(ServiceError, match="all YAML files together"):
        configure(fleet, files | {f"{k}.yaml": files["env.yaml"] for k in range(9)})


def test_a_configuration_with_files_of_another_owner_is_refused(fleet: Fleet) -> None:
    files = put_world(fleet)
    fleet.client = fleet.identity("bob", "client")
    with pytest.raises(ServiceError, match="of yours: upload it"):
        configure(fleet, files)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    store = tmp_path_factory.mktemp("service") / "store.sqlite"
    with running_service(store, "--lease-s", "6", "--beat-s", "0.6") as service:
        started = Cluster(service)
        started.start("a", "victim")
        yield started
        started.stop()


@pytest.fixture
def client(cluster: Cluster) -> Iterator[Client]:
    secret = cluster.service.grant(f"user-{next(NUMBERS)}", "client")
    with cluster.service.client(secret) as made:
        yield made


def own_world(folder: Path) -> Path:
    """Return a copy of an environment and its map with a new name."""
    path = folder / "mine"
    shutil.copytree(entries()["merge"], path)
    text = (path / "env.yaml").read_text(encoding="utf-8")
    (path / "env.yaml").write_text(text.replace("name: merge", "name: mine"), encoding="utf-8")
    return path


def test_an_uploaded_world_continues_after_its_node_is_killed(
    cluster: Cluster, client: Client, tmp_path: Path
) -> None:
    world = own_world(tmp_path)
    driver = agent_entries()["merge_ippo"]
    keys: dict[str, Any] = {"agents": 3, "background": 6}
    remote = client.open(
        world, node="victim", wait_s=30.0, drivers={"trained": driver}, licence="CC0",
        overrides={"traffic.model": "zoo:trained"}, **keys,
    )  # fmt: skip
    model = f"zoo:{driver}"
    local = cavmarl.make_vec(str(world), overrides={"traffic.model": model}, **keys)
    remote.record()
    remote.reset(seed=1)
    local.reset(seed=1)
    assert_same(remote, local, range(3))
    remote.save_state()
    cluster.processes["victim"].kill()
    assert_same(remote, local, range(3))
    assert remote.flows.moves == 1
    for part in remote.recording(tmp_path / "recording"):
        head = (part / "recording.json").read_text(encoding="utf-8")
        assert "zoo:trained" in head
        assert tempfile.gettempdir() not in head
        assert list(Recording.open(part).frames())
    own = {one["name"] for one in client.get("/artefacts")["artefacts"]}
    assert own >= {"env.yaml", "config.json", "model.safetensors"}
    before = client.get("/events", limit=1000)["events"][-1]["sequence"]
    client.open(world, wait_s=30.0, **keys).close()  # no file is uploaded again
    kinds = [one["kind"] for one in client.get("/events", limit=1000, after=before)["events"]]
    assert "artefact.added" not in kinds
    remote.close()
    local.close()


def test_an_evaluation_of_an_uploaded_driver_equals_the_local_evaluation(
    cluster: Cluster, client: Client, tmp_path: Path
) -> None:
    world, driver = own_world(tmp_path), tmp_path / "trained"
    shutil.copytree(agent_entries()["merge_ippo"], driver)
    secret = tmp_path / "secret"
    secret.touch(mode=0o600)
    secret.write_text(cluster.service.grant("bob", "client"), encoding="utf-8")
    out = tmp_path / "there"
    words = ["submit", str(world), "--policy", str(driver), "--episodes", "2", "--agents", "3"]
    words += ["--service", cluster.service.url, "--secret-file", str(secret), "--out", str(out)]
    found = CliRunner().invoke(app, words, catch_exceptions=False)
    assert found.exit_code == 0, found.output
    evaluate(str(world), [str(driver)], episodes=2, repeats=1, agents=3, out=tmp_path / "here")
    for name in ("episodes.csv", "trips.csv"):
        assert table(out / name) == table(tmp_path / "here" / name)
    manifest = (out / "manifest.json").read_text(encoding="utf-8")
    assert "cavmarl-files-" not in manifest
    shown = CliRunner().invoke(app, ["artefacts", *words[-6:-2]], catch_exceptions=False)
    assert "env.yaml" in shown.output


def test_a_job_restarts_on_another_node_if_its_node_dies(
    cluster: Cluster, client: Client, tmp_path: Path
) -> None:
    cluster.start("late")
    world = own_world(tmp_path)
    # The evaluation takes several heartbeats, so the client sees its progress.
    keys: dict[str, Any] = {"episodes": 50, "repeats": 1, "agents": 3}
    job = client.submit(world, node="late", wait_s=30.0, **keys)
    killed = False

    def kill_once(found: dict[str, Any]) -> None:
        nonlocal killed
        if not killed and found["progress"]:
            assert found["node"] == "late"
            cluster.processes["late"].kill()
            killed = True

    found = client.wait(job, tmp_path / "there", 120.0, kill_once)
    assert killed
    assert found["placements"] == 2
    evaluate(str(world), ["idm"], out=tmp_path / "here", **keys)
    for name in ("episodes.csv", "trips.csv"):
        assert (tmp_path / "there" / name).read_bytes() == (tmp_path / "here" / name).read_bytes()


def test_a_node_refuses_a_file_that_was_changed_in_the_store(tmp_path: Path) -> None:
    with loopback_service(tmp_path / "store.sqlite") as service:
        link = service.start_node("a", "node")
        path = f"/artefacts/{hashlib.sha256(NET).hexdigest()}?name=map.net.xml"
        assert service.ask("client", "PUT", path, content=NET).status_code == 200
        files = {"map.net.xml": hashlib.sha256(NET).hexdigest()}
        document = {"environment": "map.net.xml", "files": files}
        found = service.ask("client", "POST", "/configurations", json=document).json()
        opened = {"configuration": found["hash"]}
        assert service.ask("client", "POST", "/sessions", json=opened).status_code == 201
        folder = service.run(link.fetch_files(document))
        assert folder is not None
        assert (Path(folder.name) / "map.net.xml").read_bytes() == NET
        folder.cleanup()
        more = (
            NET + b" "
        )  # a further file, because the log caches the last content that it has written
        path = f"/artefacts/{hashlib.sha256(more).hexdigest()}?name=map.net.xml"
        assert service.ask("client", "PUT", path, content=more).status_code == 200
        service.run(service.events.settle())
        engine = create_engine(f"sqlite:///{tmp_path / 'store.sqlite'}")
        with engine.begin() as connection:
            connection.execute(text("UPDATE blobs SET content = 'x'"))
        engine.dispose()
        with pytest.raises(ServiceError, match="the store was changed") as refused:
            service.run(link.fetch_files(document))
        assert refused.value.problem == "damaged"


def test_a_node_refuses_a_file_whose_hash_the_service_did_not_check(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with loopback_service(tmp_path / "store.sqlite") as service:
        link = service.start_node("a", "node")
        monkeypatch.setattr(type(service.broker.artefacts), "content", lambda *_: b"changed")
        files = {"map.net.xml": hashlib.sha256(NET).hexdigest()}
        with pytest.raises(ServiceError, match="does not have the SHA-256") as refused:
            service.run(link.fetch_files({"environment": "map.net.xml", "files": files}))
        assert refused.value.problem == "damaged"


def table(path: Path) -> list[str]:
    """Return the lines of a table without the name of the driver."""
    lines = path.read_text(encoding="utf-8").splitlines()
    return [",".join(line.split(",")[1:]) for line in lines]


def test_a_map_that_cannot_be_read_ends_its_session(client: Client, tmp_path: Path) -> None:
    (tmp_path / "broken.net.xml").write_bytes(b"<net><edge/></net>")
    with pytest.raises(ServiceError) as refused:
        client.open(tmp_path / "broken.net.xml", wait_s=30.0)
    assert refused.value.problem == "refused"
    assert "cavmarl-files-" not in str(refused.value)
    (session,) = [one for one in client.get("/sessions")["sessions"] if one["state"] == "failed"]
    assert session["message"]


def test_paths_that_cannot_be_uploaded_are_refused(client: Client, tmp_path: Path) -> None:
    with pytest.raises(ServiceError, match="neither a map nor a folder"):
        client.open(tmp_path)
    with pytest.raises(ServiceError, match="folder of a trained driver"):
        client.open("merge", drivers={"x": tmp_path})


def test_routes_check_the_hash_and_the_owner(cluster: Cluster, client: Client) -> None:
    sha256 = hashlib.sha256(NET).hexdigest()
    with pytest.raises(ServiceError, match="not " + "0" * 64):
        client.run(client.flows.ask("PUT", f"/artefacts/{'0' * 64}", content=NET,
                                    params={"name": "map.net.xml"}))  # fmt: skip
    client.run(client.flows.ask("PUT", f"/artefacts/{sha256}", content=NET,
                                params={"name": "map.net.xml"}))  # fmt: skip
    assert client.run(client.flows.ask("GET", f"/artefacts/{sha256}")).content == NET
    client.delete(f"/artefacts/{sha256}")
    with pytest.raises(ServiceError, match="of yours"):
        client.run(client.flows.ask("GET", f"/artefacts/{sha256}"))
