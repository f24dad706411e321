"""Almost valid requests cause no internal error, traceback or wait, and get no local paths."""

from __future__ import annotations

import json
import sys
import time
from collections import Counter
from pathlib import Path
from random import Random

import httpx
import pytest

from cavmarl.service.event_log import EventLog
from cavmarl.service.event_store import EventStore
from cavmarl.service.service_records import ROLES
from tests.support.loopback_service import LoopbackService, loopback_service
from tests.support.request_fuzz import (
    NODE_TEMPLATES,
    TEMPLATES,
    Answer,
    RawRequest,
    RequestFuzz,
    send,
)

ROOT = Path(__file__).resolve().parents[2]
PLACES = [str(ROOT), sys.prefix, str(Path.home())]
RENEWED_EVERY = 100  # number of requests
LONGEST_LINE = 500  # longest log line in characters
WORLD = {"environment": "ring", "agents": 1, "background": 1}


def renew(service: LoopbackService, fuzz: RequestFuzz) -> None:
    """Renew tokens and ids, which earlier random requests may have invalidated."""
    link = service.nodes["a"][0]
    state = service.events.state
    for role in ROLES:
        if not any(one.name == role and not one.revoked for one in state.identities.values()):
            service.grant(role, role)
        fuzz.tokens[role] = service.token(role)
    if state.nodes["a"].incarnation != link.incarnation:
        service.run(link.register())
    service.ask("operator", "POST", "/nodes/a/resume")
    service.wait_until_ready("a")
    found = service.ask("client", "POST", "/configurations", json=WORLD).json()["hash"]
    body = {"configuration": found, "node": "a"}
    for one in service.ask("client", "GET", "/sessions").json()["sessions"]:
        if one["state"] in ("active", "queued"):
            service.ask("client", "DELETE", f"/sessions/{one['id']}")
    opened = [service.ask("client", "POST", "/sessions", json=body).json() for _ in range(2)]
    fuzz.tokens["lease"] = opened[0]["token"]
    bearer = {"Authorization": f"Bearer {opened[0]['token']}"}
    world = f"{service.nodes['a'][1]}/v1/worlds/{opened[0]['session']}"
    for command in ("", "/reset?number=1&seed=0"):
        until_s = time.monotonic() + 20.0  # until the node has the new keys
        while (answer := service.http.post(world + command, headers=bearer)).status_code != 200:
            assert time.monotonic() < until_s, answer.text
            time.sleep(0.05)
    service.ask("node", "PUT", f"/jobs/{opened[0]['session']}/results/a.csv", content=b"1,2")
    refresh = service.access.exchange(service.secrets["viewer"])["refresh_token"]
    fuzz.known = {
        "node": "a",
        "session": opened[0]["session"],
        "closable": opened[1]["session"],
        "next": "2",
        "sha256": found,
        "secret": service.secrets["viewer"],
        "refresh": refresh,
        "identity": next(one.id for one in state.identities.values() if one.name == "viewer"),
    }


def check(request: RawRequest, answer: Answer) -> None:
    shown = request.content()[:2000]
    assert answer.status not in (500, 501, 502, 504), (shown, answer)
    text = (answer.head + answer.body).decode("latin-1")
    assert "Traceback" not in text, shown
    for place in PLACES:
        assert f"{place}/" not in text, (shown, text)
    if answer.status >= 400 and b"application/problem+json" in answer.head and answer.body:
        assert json.loads(answer.body)["status"] == answer.status


def run_fuzz(store: Path, count: int, seed: int) -> Counter[int]:
    """Send random requests and check the answers; return the number of answers by status."""
    fuzz, found = RequestFuzz(Random(seed)), Counter[int]()
    with loopback_service(store, max_nodes=50) as service:
        service.start_node("a", "node", slots=1000)
        for k in range(count):
            if k % RENEWED_EVERY == 0:
                renew(service, fuzz)
            is_node = fuzz.random.random() < 0.2
            request = fuzz.make(NODE_TEMPLATES if is_node else TEMPLATES)
            answer = send(service.nodes["a"][1] if is_node else service.url, request)
            check(request, answer)
            found[answer.status] += 1
            for line in service.log.lines:
                assert "Traceback" not in line, (request.content()[:2000], line)
                assert len(line) <= LONGEST_LINE, line
            service.log.lines.clear()
        assert httpx.get(f"{service.url}/v1/health").json()["status"] == "ok"
        state = service.events.state
    again = EventLog(EventStore(store))
    assert again.state == state
    again.store.close()
    return found


def test_almost_valid_requests_are_refused(tmp_path: Path) -> None:
    found = run_fuzz(tmp_path / "store.sqlite", 1000, seed=1)
    assert min(found[status] for status in (200, 401, 404, 405, 422)) >= 10


@pytest.mark.slow  # the test above with more requests
def test_many_almost_valid_requests_are_refused(tmp_path: Path) -> None:
    found = run_fuzz(tmp_path / "store.sqlite", 25_000, seed=2)
    print(f"answers by status, 0 for a closed connection: {dict(sorted(found.items()))}")
    assert min(found[status] for status in (200, 401, 403, 404, 405, 409, 413, 422)) >= 20
