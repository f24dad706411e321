"""The OpenAPI document of the service is correct for requests that Schemathesis generates.

Answers have the status, type and fields of the document. Requests that the document does not allow
are refused. No request causes an internal error.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from random import Random
from typing import Any

import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from schemathesis import GenerationMode
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi.checks import positive_data_acceptance

from cavmarl.service.app import make_app
from cavmarl.service.rate_limit import RateLimit
from cavmarl.service.request_bodies import ConfigurationBody
from cavmarl.service.route_access import Service, open_to_all, rule_of
from cavmarl.service.routes import ROUTERS
from tests.support.fleet import Fleet

ENDLESS = "GET /v1/events/stream"
RULES = {
    f"{method} {route.path}": rule_of(route)
    for router in ROUTERS
    for route in router.routes
    for method in route.methods
}
OPERATIONS = sorted(RULES.keys() - {ENDLESS})


class Served:
    """A service in this process with a node and a session, and its OpenAPI document."""

    def __init__(self, store: Path) -> None:
        self.fleet = Fleet(store, max_nodes=50, max_sessions=20)
        self.fleet.identity("root", "admin")
        body = ConfigurationBody(environment="merge")
        found = self.fleet.add_configuration(body)
        self.configuration = str(found["hash"])
        never = RateLimit(1e9, 1e9)
        app = make_app(Service(self.fleet.broker, self.fleet.access, never, never))
        document = schemathesis.openapi.from_asgi("/v1/openapi.json", app)
        self.operations = {one.ok().label: one.ok() for one in document.get_all_operations()}

    def known(self) -> dict[str, str]:
        """Create node and session again; return values for the parameters of paths."""
        fleet = self.fleet
        fleet.join("a", slots=1000)
        for one in list(fleet.log.state.sessions.values()):
            fleet.broker.close(fleet.client, one.id)
        session = fleet.open(zone_nodes=1)
        fleet.broker.save(session, 1, b"state")
        fleet.broker.add_result(session, "table.csv", b"1,2")
        return {"name": "a", "number": session.id, "sha256": self.configuration}

    def headers(self, name: str) -> dict[str, str]:
        rule = RULES[name]
        if isinstance(rule, open_to_all):
            return {}
        names = {"node": "nodes", "client": "ada", "admin": "root"}
        role = next(role for role in names if role in rule.roles)
        return {"Authorization": f"Bearer {self.fleet.token(names[role])}"}


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    made = Served(tmp_path_factory.mktemp("interface") / "store.sqlite")
    yield made
    made.fleet.close()


def plain(value: Any) -> Any:
    """Replace whole floats by integers, because the service refuses 3.0 for an integer."""
    if isinstance(value, dict):
        return {key: plain(one) for key, one in value.items()}
    if isinstance(value, list):
        return [plain(one) for one in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value


def check(served: Served, name: str, mode: GenerationMode, examples: int) -> None:
    operation = served.operations[name]

    @given(operation.as_strategy(generation_mode=mode), st.randoms())
    @settings(
        max_examples=examples,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    def run(case: Any, random: Random) -> None:
        known = served.known()
        for part in case.path_parameters or ():
            is_known = part in known and "identities" not in name and random.random() < 0.5
            if mode is GenerationMode.POSITIVE and is_known:
                case.path_parameters[part] = known[part]
        case.body = plain(case.body)
        if isinstance(case.body, dict) and mode is GenerationMode.POSITIVE:
            if "configuration" in case.body:
                case.body["configuration"] = known["sha256"]
            if "wait_s" in case.body:
                case.body["wait_s"] = 0
        answer = case.call_and_validate(
            headers=served.headers(name),
            excluded_checks=[positive_data_acceptance, not_a_server_error],
        )
        if answer.status_code >= 400:
            title = answer.json()["title"]
            assert answer.status_code < 500 or title == "no-node", answer.text
            assert mode is not GenerationMode.POSITIVE or title != "bad-body", answer.text

    run()


@pytest.mark.parametrize("name", OPERATIONS)
def test_answers_to_valid_requests_agree_with_the_document(served: Served, name: str) -> None:
    check(served, name, GenerationMode.POSITIVE, 8)


def can_be_wrong(name: str) -> bool:
    """Return whether a request can be invalid: it has parameters, or content with a schema."""
    method, path = name.split()
    if method == "PUT" and path.endswith(("/state", "/results/{name}")):
        return False
    return method != "GET" or "{" in path or path == "/v1/events"


@pytest.mark.parametrize("name", list(filter(can_be_wrong, OPERATIONS)))
def test_requests_that_the_document_does_not_allow_are_refused(served: Served, name: str) -> None:
    check(served, name, GenerationMode.NEGATIVE, 8)


def test_the_document_names_the_fields_of_each_answer(served: Served) -> None:
    """Check that each JSON answer refers to a schema."""
    for name, operation in served.operations.items():
        for status, answer in operation.definition.raw["responses"].items():
            for kind, content in answer.get("content", {}).items():
                if status.startswith("2") and kind == "application/json":
                    assert "$ref" in content["schema"], name
