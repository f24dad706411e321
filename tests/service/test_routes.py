"""The interface over a real socket: permissions and error answers."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import jwt
import pytest
from fastapi.routing import APIRoute

from cavmarl.service.error_names import PROBLEMS
from cavmarl.service.route_access import open_to_all, rule_of
from cavmarl.service.routes import ROUTERS
from cavmarl.service.service_records import ROLES
from tests.support.generated import check_block
from tests.support.service import RunningService, running_service

ROOT = Path(__file__).resolve().parents[2]
ALL = {*ROLES}
READERS = ALL - {"node"}
WATCHERS = {"viewer", "operator", "admin"}
CLIENTS = {"client", "operator", "admin"}
OPEN = None  # marks a route that needs no token

# Route → roles that may use it. A test fails if a route is missing here.
MATRIX: dict[str, set[str] | None] = {
    "GET /v1/health": OPEN,
    "GET /v1/keys": OPEN,
    "POST /v1/token": OPEN,
    "DELETE /v1/token": ALL,
    "GET /v1/nodes": READERS,
    "POST /v1/nodes": {"node"},
    "POST /v1/nodes/{name}/beat": {"node"},
    "POST /v1/nodes/{name}/drain": {"node", "operator", "admin"},
    "POST /v1/nodes/{name}/resume": {"operator", "admin"},
    "DELETE /v1/nodes/{name}": {"node", "operator", "admin"},
    "POST /v1/configurations": CLIENTS,
    "GET /v1/configurations/{sha256}": ALL,
    "POST /v1/sessions": CLIENTS,
    "GET /v1/sessions": READERS,
    "GET /v1/sessions/{number}": READERS,
    "DELETE /v1/sessions/{number}": CLIENTS,
    "POST /v1/sessions/{number}/resolve": CLIENTS,
    "GET /v1/sessions/{number}/state": {"node"},
    "PUT /v1/sessions/{number}/state": {"node"},
    "GET /v1/sessions/{number}/transfers": READERS,
    "PUT /v1/sessions/{number}/transfers": {"node"},
    "PUT /v1/sessions/{number}/door": {"node"},
    "GET /v1/artefacts": READERS,
    "PUT /v1/artefacts/{sha256}": CLIENTS,
    "GET /v1/artefacts/{sha256}": ALL,
    "DELETE /v1/artefacts/{sha256}": CLIENTS,
    "POST /v1/jobs": CLIENTS,
    "POST /v1/trainings": CLIENTS,
    "POST /v1/jobs/{number}/outcome": {"node"},
    "GET /v1/jobs/{number}/results/{name}": READERS,
    "PUT /v1/jobs/{number}/results/{name}": {"node"},
    "GET /v1/events": READERS,
    "GET /v1/events/stream": READERS,
    "GET /v1/metrics": WATCHERS,
    "POST /v1/identities": {"admin"},
    "GET /v1/identities": {"admin"},
    "DELETE /v1/identities/{number}": {"admin"},
    "POST /v1/keys": {"admin"},
}


def all_routes() -> dict[str, APIRoute]:
    found = [one for router in ROUTERS for one in router.routes if isinstance(one, APIRoute)]
    return {f"{method} {one.path}": one for one in found for method in one.methods}


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningService]:
    with running_service(tmp_path_factory.mktemp("service") / "store.sqlite") as running:
        yield running


@pytest.fixture(scope="module")
def secrets(service: RunningService) -> dict[str, str]:
    return {role: service.grant(f"a-{role}", role) for role in ROLES}


@pytest.fixture(scope="module")
def tokens(service: RunningService, secrets: dict[str, str]) -> dict[str, dict[str, Any]]:
    return {role: token_of(service, secret).json() for role, secret in secrets.items()}


def token_of(service: RunningService, secret: str) -> httpx.Response:
    return httpx.post(f"{service.url}/v1/token", json={"secret": secret})


def ask(
    service: RunningService, token: dict[str, Any] | str, method: str, path: str, **given: Any
) -> httpx.Response:
    bearer = token if isinstance(token, str) else token["access_token"]
    headers = {"Authorization": f"Bearer {bearer}", **given.pop("headers", {})}
    return httpx.request(method, f"{service.url}/v1{path}", headers=headers, **given)


def problem_of(answer: httpx.Response) -> str:
    assert answer.headers["content-type"] == "application/problem+json"
    found = answer.json()
    assert found["status"] == answer.status_code
    assert found["detail"]
    assert found["cure"]
    return str(found["title"])


def test_the_matrix_lists_all_routes() -> None:
    assert set(all_routes()) == set(MATRIX)


@pytest.mark.parametrize("name", MATRIX)
def test_a_role_may_use_a_route_if_and_only_if_the_matrix_says_so(
    service: RunningService, tokens: dict[str, dict[str, Any]], name: str
) -> None:
    method, path = name.split()
    path = path.removeprefix("/v1").format(name="nobody", number="s-" + "0" * 24, sha256="0" * 64)
    allowed = MATRIX[name]
    bare = httpx.request(method, f"{service.url}/v1{path}", timeout=10.0)
    assert (bare.status_code == 401) == (allowed is not None)
    refused = set()
    for role in ROLES:
        if name in ("DELETE /v1/token", "GET /v1/events/stream") and role in (allowed or ()):
            continue  # DELETE would end sessions of other tests; the stream never ends
        answer = ask(service, tokens[role], method, path)
        assert answer.status_code != 401
        refused |= {role} if answer.status_code == 403 else set()
    assert refused == ALL - (allowed or ALL)


def test_the_page_has_the_routes_and_the_problems() -> None:
    rows = ["| route | for | what |", "|---|---|---|"]
    for name, route in all_routes().items():
        rule = rule_of(route)
        assert rule is not None
        roles = (
            "all"
            if isinstance(rule, open_to_all)
            else ", ".join(role for role in ROLES if role in rule.roles)
        )
        rows.append(f"| `{name}` | {roles} | {route.description.splitlines()[0]} |")
    check_block(ROOT / "docs" / "guides" / "service.md", "routes", "\n".join(rows))
    rows = ["| problem | status | what |", "|---|---|---|"]
    rows += [f"| `{name}` | {status} | {text} |" for name, (status, text) in PROBLEMS.items()]
    check_block(ROOT / "docs" / "guides" / "service.md", "problems", "\n".join(rows))


@pytest.mark.parametrize(
    ("path", "body", "status", "title", "words"),
    [
        ("/configurations", {"environment": "merge", "agent": 3}, 422, "bad-body", "agent"),
        ("/configurations", {"environment": "merge", "agents": "3"}, 422, "bad-body", "integer"),
        ("/configurations", {"environment": "../etc"}, 422, "bad-body", "pattern"),
        ("/configurations", {"environment": "mergf"}, 422, "refused", "choose one of"),
        (
            "/configurations",
            {"environment": "merge", "overrides": {"sensors.lidar.ray": 3}},
            422, "refused", "lidar.rays",
        ),
        (
            "/configurations",
            {"environment": "merge", "overrides": {"plugins": ["antigravity"]}},
            422,
            "refused",
            "name modules, which are code",
        ),
        (
            "/configurations",
            {"environment": "grid4x4", "overrides": {"signals.agents": "all"}},
            422, "refused", "a session of the service has only vehicles as agents",
        ),
        (
            "/configurations",
            {"environment": "merge", "overrides": {"zones.journal": "log"}},
            422, "refused", "zones.journal",
        ),
        (
            "/configurations",
            {"environment": "merge", "overrides": {"zones": {"journal": "log"}}},
            422, "refused", "zones",
        ),
        (
            "/configurations",
            {"environment": "merge", "overrides": {"scenario.name": "/tmp/code.py"}},
            422, "refused", "code.py",
        ),
        (
            "/configurations",
            {"environment": "merge", "overrides": {"traffic.model": {"zoo:/tmp/a": 1.0}}},
            422, "refused", "there is no driver 'a': choose one of",
        ),
        (
            "/configurations",
            {"environment": "merge", "overrides": {"traffic": {"model": "zoo:cavmarl"}}},
            422, "refused", "there is no driver 'cavmarl': choose one of",
        ),
        ("/sessions", {"configuration": "0" * 64}, 404, "not-found", "add it first"),
        ("/sessions", {"configuration": "x"}, 422, "bad-body", "configuration"),
    ],
)  # fmt: skip
def test_bad_input_is_refused_with_the_cause(
    service: RunningService, tokens: dict[str, Any],
    path: str, body: Any, status: int, title: str, words: str,
) -> None:  # fmt: skip
    answer = ask(service, tokens["client"], "POST", path, json=body)
    assert (answer.status_code, problem_of(answer)) == (status, title)
    assert words in answer.json()["detail"]


def test_a_path_instead_of_the_name_of_a_driver_is_refused(
    service: RunningService, tokens: dict[str, Any]
) -> None:
    found = ask(service, tokens["client"], "POST", "/configurations", json={"environment": "merge"})
    body = {"configuration": found.json()["hash"], "policies": ["idm.py"]}
    answer = ask(service, tokens["client"], "POST", "/jobs", json=body)
    assert problem_of(answer) == "refused"
    body["policies"] = ["../agents/idm"]
    assert ask(service, tokens["client"], "POST", "/jobs", json=body).status_code == 422


def test_an_equal_configuration_gets_the_same_version(
    service: RunningService, tokens: dict[str, Any]
) -> None:
    body = {"environment": "merge", "name": "mine", "agents": 3}
    versions = []
    for agents in (3, 4, 3):
        answer = ask(
            service, tokens["client"], "POST", "/configurations", json={**body, "agents": agents}
        )
        versions.append(answer.json()["version"])
    assert versions == [1, 2, 1]


def test_without_a_node_the_answer_is_503_with_a_time_to_retry(
    service: RunningService, tokens: dict[str, Any]
) -> None:
    found = ask(service, tokens["client"], "POST", "/configurations", json={"environment": "merge"})
    body = {"configuration": found.json()["hash"]}
    answer = ask(service, tokens["client"], "POST", "/sessions", json=body)
    assert (answer.status_code, problem_of(answer)) == (503, "no-node")
    assert answer.headers["retry-after"] == "1"
    began_s = time.monotonic()
    body["wait_s"] = 0.5
    assert ask(service, tokens["client"], "POST", "/sessions", json=body).status_code == 503
    assert time.monotonic() - began_s > 0.4
    params = {"subject": body["configuration"], "limit": 2}
    told = ask(service, tokens["client"], "GET", "/events", params=params).json()["events"]
    assert [one["kind"] for one in told] == ["session.refused", "session.timeout"]
    assert told[1]["data"] == {"of": "request for a node", "after_s": 0.5}


def test_a_load_in_percent_is_refused_and_the_error_names_the_fraction(
    service: RunningService, tokens: dict[str, Any]
) -> None:
    beat = {"incarnation": 1, "sequence": 1, "cpu": 85.0, "ram": 0.1, "sent_s": 0.0}
    answer = ask(service, tokens["node"], "POST", "/nodes/a/beat", json=beat)
    assert problem_of(answer) == "bad-body"
    assert "0.85" in answer.json()["detail"]


def test_forged_expired_and_foreign_tokens_are_refused(
    service: RunningService, tokens: dict[str, Any]
) -> None:
    good = tokens["viewer"]["access_token"]
    head, claims, signature = good.split(".")
    told = jwt.decode(good, options={"verify_signature": False})
    forged = {
        "another's claims": ".".join([head, tokens["admin"]["access_token"].split(".")[1],
                                      signature]),
        "no algorithm": jwt.encode(told, None, "none", headers={"kid": "x"}),
        "symmetric": jwt.encode(told, "k" * 32, "HS256", headers={"kid": jwt.get_unverified_header(
            good)["kid"]}),
        "cut": f"{head}.{claims}",
        "refresh for access": tokens["viewer"]["refresh_token"],
        "nothing": "x",
    }  # fmt: skip
    for what, token in forged.items():
        answer = ask(service, token, "GET", "/nodes")
        assert (answer.status_code, problem_of(answer)) == (401, "bad-token"), what
        assert answer.headers["www-authenticate"] == "Bearer"
    assert ask(service, good, "GET", "/nodes").status_code == 200


def test_a_refresh_token_can_be_used_once(service: RunningService) -> None:
    secret = service.grant("refresher", "viewer")
    first = token_of(service, secret).json()
    body = {"refresh_token": first["refresh_token"]}
    second = httpx.post(f"{service.url}/v1/token", json=body).json()
    assert ask(service, second, "GET", "/nodes").status_code == 200
    again = httpx.post(f"{service.url}/v1/token", json=body)
    assert problem_of(again) == "bad-token"
    for stolen in (first, second):  # the repeated use invalidates all tokens of the identity
        assert ask(service, stolen, "GET", "/nodes").status_code == 401
    assert token_of(service, secret).status_code == 200


def test_a_revoked_identity_is_refused_at_once(
    service: RunningService, tokens: dict[str, Any]
) -> None:
    secret = service.grant("guest", "viewer")
    token = token_of(service, secret).json()
    path = f"/identities/{token['identity']}"
    assert ask(service, tokens["admin"], "DELETE", path).status_code == 204
    assert ask(service, token, "GET", "/nodes").status_code == 401
    assert token_of(service, secret).status_code == 401


def test_a_token_is_valid_after_one_key_rotation_but_not_after_two(
    service: RunningService, secrets: dict[str, str]
) -> None:
    admin = token_of(service, secrets["admin"]).json()
    old = token_of(service, secrets["viewer"]).json()
    assert ask(service, admin, "POST", "/keys").status_code == 201
    assert ask(service, old, "GET", "/nodes").status_code == 200
    fresh = token_of(service, secrets["admin"]).json()
    assert ask(service, fresh, "POST", "/keys").status_code == 201
    assert ask(service, old, "GET", "/nodes").status_code == 401


def test_no_answer_and_no_file_of_the_store_contains_a_secret(
    service: RunningService, secrets: dict[str, str], tokens: dict[str, Any]
) -> None:
    admin = token_of(service, service.secret).json()
    shown = ask(service, admin, "GET", "/events", params={"limit": 1000}).text
    shown += (
        ask(service, admin, "GET", "/identities").text + ask(service, "x", "GET", "/nodes").text
    )
    for name in ("store.sqlite", "store.sqlite-wal"):
        shown += Path(service.store).with_name(name).read_bytes().decode("latin-1")
    for secret in (*secrets.values(), service.secret):
        assert secret not in shown
        assert secret.split(".")[2] not in shown
    assert "private" not in ask(service, admin, "GET", "/events").json()["events"][0]


def test_answers_have_security_headers(service: RunningService) -> None:
    answer = httpx.get(f"{service.url}/v1/nothing")
    assert problem_of(answer) == "not-found"
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert answer.headers["cache-control"] == "no-store"
    assert "access-control-allow-origin" not in answer.headers
    assert "uvicorn" not in answer.headers.get("server", "")
    assert httpx.get(f"{service.url}/docs").status_code == 404
    assert httpx.put(f"{service.url}/v1/health").status_code == 405


def test_the_document_of_the_interface_has_each_route(service: RunningService) -> None:
    paths = httpx.get(f"{service.url}/v1/openapi.json").json()["paths"]
    found = {f"{method.upper()} {path}" for path, one in paths.items() for method in one}
    assert found == set(MATRIX)


def test_a_stream_of_events_can_start_after_a_given_event(service: RunningService) -> None:
    with service.client() as client:
        last = client.get("/health")["events"]
        following = client.follow(after=last - 1)
        assert next(following)["sequence"] == last
        service.grant("seen", "viewer")
        found = next(following)
        assert (found["kind"], found["data"]["name"]) == ("identity.added", "seen")


def test_a_page_of_events_has_only_events_that_the_client_may_read(service: RunningService) -> None:
    secret = service.grant("quiet", "client")
    with service.client() as admin, service.client(secret) as quiet:
        after = admin.get("/health")["events"]
        for k in range(5):
            admin.post("/identities", {"name": f"loud-{k}", "role": "viewer"})
        quiet.post("/configurations", {"environment": "merge", "agents": 9, "name": "quiet"})
        (found,) = quiet.get("/events", after=after, limit=2)["events"]
        assert (found["kind"], found["subject"]) == ("configuration.added", "quiet")


def test_an_unknown_parameter_is_refused(service: RunningService, secrets: dict[str, str]) -> None:
    viewer = token_of(service, secrets["viewer"]).json()
    answer = ask(service, viewer, "GET", "/events?afer=3")
    assert problem_of(answer) == "bad-body"
    assert "after, limit, subject" in answer.json()["detail"]


def test_the_error_for_a_wrong_method_lists_allowed_methods(service: RunningService) -> None:
    answer = httpx.put(f"{service.url}/v1/nodes/a")
    assert (answer.status_code, answer.headers["allow"]) == (405, "DELETE")
    assert httpx.put(f"{service.url}/v1/nodes").headers["allow"] == "GET, POST"


def test_prometheus_can_read_the_metrics(service: RunningService, secrets: dict[str, str]) -> None:
    from prometheus_client.parser import text_string_to_metric_families

    viewer = token_of(service, secrets["viewer"]).json()
    page = ask(service, viewer, "GET", "/metrics").text
    names = {family.name for family in text_string_to_metric_families(page)}
    assert {"cavmarl_nodes", "cavmarl_selection_seconds", "cavmarl_refusals"} <= names
