"""A node continues while its service does not answer, and reports the ends of its jobs."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from cavmarl.service import node_host, node_link
from cavmarl.service.error_names import problem
from tests.support.flaky_node import make_host, run_until
from tests.support.loopback_service import LoopbackService, loopback_service
from tests.support.service import Cluster, running_service

JOB = {"policies": ["idm"], "episodes": 1, "repeats": 1}


@pytest.fixture
def service(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[LoopbackService]:
    monkeypatch.setattr(node_link, "ANSWER_S", 0.01)
    with loopback_service(tmp_path / "store.sqlite", beat_s=0.05, missed_beats=100) as running:
        yield running


def submit(service: LoopbackService) -> str:
    world = {"environment": "ring", "agents": 1, "background": 1}
    found = service.ask("client", "POST", "/configurations", json=world).json()["hash"]
    answer = service.ask("client", "POST", "/jobs", json={"configuration": found, **JOB})
    return str(answer.json()["id"])


def test_a_node_registers_again_as_soon_as_the_service_can_be_reached(
    service: LoopbackService,
) -> None:
    host, link = make_host(service, [], [])
    service.run(link.register())
    service.ask("operator", "DELETE", "/nodes/a")  # its heartbeats are refused from now on
    link.lost = ["nodes"] * 3
    node = service.events.state.nodes["a"]

    def is_back() -> bool:
        return service.events.state.nodes["a"].state == "up" and link.incarnation == 2

    assert node.state == "left"
    service.run(run_until(host, is_back))
    assert link.lost == []


@pytest.mark.parametrize(
    ("lost", "unanswered"),
    [
        (["outcome"] * 3, []),
        ([], ["outcome"]),
        (["a.csv"] * 2, ["a.csv"]),
        (["outcome"], ["outcome", "a.csv"]),
    ],
)
def test_the_end_of_a_job_is_reported_until_the_service_has_it(
    service: LoopbackService,
    monkeypatch: pytest.MonkeyPatch,
    lost: list[str],
    unanswered: list[str],
) -> None:
    runs: list[str] = []

    def evaluates(*given: Any, **_: Any) -> None:
        runs.append(given[0])
        given[4].mkdir()
        (given[4] / "a.csv").write_text("x")

    monkeypatch.setattr(node_host, "call_in_fresh_process", evaluates)
    host, link = make_host(service, lost, unanswered)
    service.run(link.register())
    job = submit(service)
    session = service.events.state.sessions[job]
    beats = 0

    def is_over() -> bool:
        nonlocal beats
        beats = beats or (link.beats if session.state == "done" else 0)
        return bool(beats) and link.beats > beats + 3 and not host.jobs

    service.run(run_until(host, is_over))
    assert runs == [f"job {job}"]
    assert list(session.results) == ["a.csv"]
    with service.client("admin") as client:
        kinds = [one["kind"] for one in client.events(job)]
    assert kinds.count("session.done") == 1
    assert link.lost == link.unanswered == []


def test_a_refused_report_is_not_repeated_and_the_job_runs_again(
    service: LoopbackService, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After the first report of a job was refused, the same node gets the job again."""
    runs: list[str] = []

    def evaluates(*given: Any, **_: Any) -> None:
        runs.append(given[0])
        given[4].mkdir()

    monkeypatch.setattr(node_host, "call_in_fresh_process", evaluates)
    host, link = make_host(service, [], [])
    service.run(link.register())
    ask = link.ask

    async def refused_once(method: str, path: str, **given: Any) -> Any:
        if path.endswith("/outcome") and len(runs) == 1:
            raise problem("lost", "the job is on no node of this identity")
        return await ask(method, path, **given)

    monkeypatch.setattr(link, "ask", refused_once)
    job = submit(service)
    session = service.events.state.sessions[job]
    service.run(run_until(host, lambda: session.state == "done"))
    assert len(runs) == 2


def test_a_job_that_ends_while_its_service_is_down_is_done_after_a_restart(tmp_path: Path) -> None:
    with running_service(tmp_path / "store.sqlite") as service:
        cluster = Cluster(service)
        cluster.start("a")
        with service.client(service.grant("ada", "client")) as client:
            job = client.submit("ring", policies=["idm"], episodes=1, max_cycles=5)
            node = psutil.Process(cluster.processes["a"].pid)
            wait_until(lambda: client.get(f"/sessions/{job}")["state"] != "queued")
            wait_until(lambda: bool(node.children()))
            service.kill()
            wait_until(lambda: not node.children())  # the evaluation has ended
            service.start_again()
            found = client.wait(job, tmp_path / "results", timeout_s=60.0)
            assert found["placements"] == 1
        assert (tmp_path / "results" / "manifest.json").is_file()
        cluster.stop()


def wait_until(holds: Any) -> None:
    until_s = time.monotonic() + 60.0
    while not holds():
        assert time.monotonic() < until_s
        time.sleep(0.01)
