"""A command that a page holds is asked for again until it is answered; no process is started."""

from __future__ import annotations

from typing import Any

import httpx
import pytest

from cavmarl.client.service_protocol import Ask, Rest, ServiceFlows
from cavmarl.client.world_protocol import WorldFlows


def test_while_a_page_has_paused_commands_are_asked_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cavmarl.client.world_protocol.AGAIN_S", 0.0)
    paused = {"title": "paused", "detail": "a page has paused the session"}
    answers = [httpx.Response(503, json=paused), httpx.Response(200, json={"hashes": ["1"]})]
    flows = WorldFlows(ServiceFlows("http://nowhere", ""))
    flows.assignment, flows._renew_s = {"token": ""}, float("inf")
    flow, said = flows.look("hash"), None
    asked: list[Any] = []
    while answers:
        asked.append(flow.send(said))
        said = answers.pop(0) if isinstance(asked[-1], Ask) else None
    assert [type(one) for one in asked] == [Ask, Rest, Ask]
    with pytest.raises(StopIteration) as ended:
        flow.send(said)
    assert ended.value.value == {"hashes": ["1"]}
