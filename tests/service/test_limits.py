"""Limits of a service for each caller: sizes, times, rates and numbers."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import pytest

from cavmarl.core.errors import ServiceError
from cavmarl.service.configurations import MOST_CONFIGURATIONS
from cavmarl.service.request_bodies import ConfigurationBody
from cavmarl.service.route_access import MOST_HELD
from cavmarl.service.service_records import ROLES
from tests.service.test_routes import ask, problem_of, token_of
from tests.support.fleet import Fleet
from tests.support.service import RunningService, running_service


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningService]:
    with running_service(tmp_path_factory.mktemp("service") / "store.sqlite") as running:
        yield running


@pytest.fixture(scope="module")
def tokens(service: RunningService) -> dict[str, dict[str, Any]]:
    return {role: token_of(service, service.grant(f"a-{role}", role)).json() for role in ROLES}


def test_large_and_deeply_nested_bodies_are_refused(service: RunningService) -> None:
    token = token_of(service, service.secret).json()
    headers = {"Content-Type": "application/json"}
    large = ask(service, token, "POST", "/configurations", content=b"x" * 300_000, headers=headers)
    assert (large.status_code, problem_of(large)) == (413, "too-large")
    deep = ask(service, token, "POST", "/configurations", content=b"[" * 200_000, headers=headers)
    assert deep.status_code in (400, 422)
    assert problem_of(deep) == "bad-body"
    long = ask(service, token, "GET", "/events?after=" + "0" * 2000)
    assert problem_of(long) == "bad-body"


def test_only_the_content_of_states_and_results_may_be_larger(
    service: RunningService, tokens: dict[str, Any]
) -> None:
    path, headers = "/sessions/s-" + "0" * 24, {"Content-Type": "application/json"}
    for name in (f"{path}/transfers", f"{path}/door"):
        content = b"[" * 300_000
        answer = ask(service, tokens["node"], "PUT", name, content=content, headers=headers)
        assert (answer.status_code, problem_of(answer)) == (413, "too-large"), name
    large = ask(service, tokens["node"], "PUT", f"{path}/state?at=1", content=b"x" * 300_000)
    assert problem_of(large) == "lost"
    secret = {"secret": "x" * 100_000}  # this route reads the body before it knows the caller
    assert httpx.post(f"{service.url}/v1/token", json=secret).status_code == 413


def test_the_number_of_streams_of_an_identity_is_limited(service: RunningService) -> None:
    secret = service.grant("listener", "viewer")
    token = token_of(service, secret).json()["access_token"]
    place = urlsplit(service.url)
    head = f"GET /v1/events/stream HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {token}\r\n\r\n"
    lines = [socket.create_connection((place.hostname, place.port)) for _ in range(MOST_HELD)]
    for line in lines:
        line.sendall(head.encode())
        assert b" 200 " in line.recv(4096)
    answer = ask(service, token, "GET", "/events/stream")
    assert (answer.status_code, problem_of(answer)) == (429, "too-many")
    for line in lines:
        line.close()
    until_s = time.monotonic() + 30.0
    with service.client() as admin:
        while ask(service, token, "GET", "/nodes").status_code != 200:
            time.sleep(0.1)
        for k in range(100):  # the service detects closed streams at the next event
            admin.post("/identities", {"name": f"heard-{k}", "role": "viewer"})
            with httpx.stream(
                "GET", f"{service.url}/v1/events/stream",
                headers={"Authorization": f"Bearer {token}"},
            ) as again:  # fmt: skip
                if again.status_code == 200:
                    break
            assert time.monotonic() < until_s


def test_a_world_that_no_node_could_hold_is_refused(
    service: RunningService, tokens: dict[str, Any]
) -> None:
    body = {"environment": "merge", "agents": 100_000, "num_envs": 2}
    answer = ask(service, tokens["client"], "POST", "/configurations", json=body)
    assert problem_of(answer) == "refused"
    assert "at most 200000" in answer.json()["detail"]


def test_vehicles_that_pages_may_insert_count_towards_the_size_of_a_world(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path / "store.sqlite")
    keys: dict[str, Any] = {"environment": "merge", "agents": 5, "background": 0, "num_envs": 1000}
    for insertions in (195, 196):
        overrides = {"population.insertions": insertions}
        body = ConfigurationBody(**keys, overrides=overrides)
        if insertions == 195:
            fleet.add_configuration(body)
            continue
        with pytest.raises(ServiceError, match=r"201000 .* in 1000 worlds: at most 200000"):
            fleet.add_configuration(body)
    fleet.close()


def test_the_number_of_configurations_of_an_identity_is_limited(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path / "store.sqlite")
    fleet.log.state.configurations_of[fleet.client.id] = MOST_CONFIGURATIONS - 1
    for agents, refused in ((3, False), (3, False), (4, True)):
        body = ConfigurationBody(environment="merge", agents=agents)
        if not refused:
            fleet.add_configuration(body)
            continue
        with pytest.raises(ServiceError, match="configurations, the limit"):
            fleet.add_configuration(body)
    fleet.close()


def test_invalid_reports_of_a_node_are_recorded_once(
    service: RunningService, tokens: dict[str, Any]
) -> None:
    node = {"name": "odd", "address": "127.0.0.1", "client_port": 1, "simulator_port": 1}
    assert ask(service, tokens["node"], "POST", "/nodes", json=node).status_code == 201
    beat = {"incarnation": 1, "sequence": 1, "cpu": 85.0, "ram": 0.1, "sent_s": time.time()}
    for cpu in (85.0, 90.0, 0.5):
        ask(service, tokens["node"], "POST", "/nodes/odd/beat", json={**beat, "cpu": cpu})
    told = ask(service, tokens["admin"], "GET", "/events?subject=odd").json()["events"]
    assert [one["kind"] for one in told] == ["node.registered", "node.misreported"]
    assert "percent" in told[1]["data"]["detail"]
    page = ask(service, tokens["viewer"], "GET", "/metrics").text
    assert 'cavmarl_rejections_total{problem="bad-body"}' in page
    assert ask(service, tokens["node"], "DELETE", "/nodes/odd").status_code == 200


def test_a_long_head_ends_the_connection(service: RunningService) -> None:
    place = urlsplit(service.url)
    with socket.create_connection((place.hostname, place.port)) as line:
        line.sendall(b"GET /v1/health HTTP/1.1\r\nHost: x\r\nX-Long: ")
        with pytest.raises(ConnectionError):
            line.sendall(b"a" * 2**26)
    assert httpx.get(f"{service.url}/v1/health").status_code == 200


@pytest.mark.slow  # the test waits for the time limit of a body
def test_slow_heads_and_bodies_end_the_connection(service: RunningService) -> None:
    token = token_of(service, service.secret).json()["access_token"]
    place = urlsplit(service.url)
    with socket.create_connection((place.hostname, place.port)) as line:
        line.sendall(b"GET /v1/health HTTP/1.1\r\nX-Slow: ")
        line.settimeout(20.0)
        assert line.recv(4096) == b""  # the connection ends although the head is incomplete
    with socket.create_connection((place.hostname, place.port)) as line:
        line.sendall(
            b"POST /v1/configurations HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\n"
            b"Authorization: Bearer " + token.encode() + b"\r\nContent-Length: 100\r\n\r\n{"
        )
        line.settimeout(20.0)
        assert b" 408 " in line.recv(4096).split(b"\r\n")[0]
