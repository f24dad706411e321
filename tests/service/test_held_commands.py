"""While a page pauses a session, its client repeats a command until it gets an answer."""

from __future__ import annotations

from typing import Any

import httpx
import pytest

from cavmarl.client.service_protocol import Ask, Rest, ServiceFlows
from cavmarl.client.world_protocol import WorldFlows


def test_commands_are_repeated_while_a_page_has_paused_the_session(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("cavmarl.client.world_protocol.AGAIN_S", 0.0)
    paused = {"title": "paused", "detail": "a page has paused the session"}
    lease = {
        "session": "s", "assigned": "n", "token": "", "scheme": "http", "address": "nowhere",
        "client_port": 1, "lease_s": 60.0,
    }  # fmt: skip
    answers = [
        httpx.Response(200, json={"access_token": "", "expires_in": 60.0}),
        httpx.Response(200, json=lease),
        httpx.Response(503, json=paused),
        httpx.Response(200, json={"hashes": ["1"]}),
    ]
    flows = WorldFlows(ServiceFlows("http://nowhere", ""))
    flows.assignment = lease
    flow, said = flows.state_hash(), None
    asked: list[Any] = []
    while answers:
        asked.append(flow.send(said))
        said = answers.pop(0) if isinstance(asked[-1], Ask) else None
    assert [type(one) for one in asked] == [Ask, Ask, Ask, Rest, Ask]
    with pytest.raises(StopIteration) as ended:
        flow.send(said)
    assert ended.value.value == "1"
