"""A client written only from the OpenAPI documents, without the client of cavmarl."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import httpx
import numpy as np

import cavmarl
from tests.support.service import Cluster, running_service

WORLD = {"environment": "ring", "agents": 2, "background": 2, "seed": 0}


class Document:
    """Sends requests that are found by their summaries in an OpenAPI document."""

    def __init__(self, base: str) -> None:
        self.base = base
        self.document = httpx.get(f"{base}/v1/openapi.json").json()

    def ask(self, summary: str, token: str = "", **given: Any) -> httpx.Response:
        for path, methods in self.document["paths"].items():
            for method, operation in methods.items():
                if operation["summary"] != summary:
                    continue
                places = {one["name"]: one["in"] for one in operation.get("parameters", ())}
                filled = path.format(**{k: v for k, v in given.items() if places.get(k) == "path"})
                params = {k: v for k, v in given.items() if places.get(k) == "query"}
                body = {k: given[k] for k in ("json", "content") if k in given}
                assert bool(operation.get("security")) == bool(token), summary
                assert ("requestBody" in operation) == bool(body), summary
                headers = {"Authorization": f"Bearer {token}"} if token else {}
                answer = httpx.request(
                    method,
                    self.base + filled,
                    params=params,
                    headers=headers,
                    timeout=300.0,
                    **body,
                )
                assert answer.is_success, answer.text
                kinds = operation["responses"][str(answer.status_code)].get("content", {})
                if kinds:
                    kind = answer.headers["content-type"]
                    assert kind in kinds, summary
                    assert kind != "application/json" or "$ref" in kinds[kind]["schema"], summary
                return answer
        raise AssertionError(f"no operation is called {summary}")


def arrays(answer: httpx.Response) -> dict[str, Any]:
    return dict(np.load(io.BytesIO(answer.content), allow_pickle=False))


def test_a_client_can_be_written_from_the_documents_alone(tmp_path: Path) -> None:
    with running_service(tmp_path / "store.sqlite", "--beat-s", "0.4") as running:
        cluster = Cluster(running)
        cluster.start("a")
        service = Document(running.url)
        secret = running.grant("ada", "client")
        token = service.ask("Token", json={"secret": secret}).json()["access_token"]
        found = service.ask("Add Configuration", token, json=WORLD).json()["hash"]
        wanted = {"configuration": found, "wait_s": 30.0}
        place = service.ask("Open Session", token, json=wanted).json()
        node = Document(f"{place['scheme']}://{place['address']}:{place['client_port']}")
        opened = {"session": place["session"], "token": place["token"]}
        world = node.ask("Open Worlds", **opened).json()
        node.ask("Reset", **opened, number=world["number"] + 1, seed=3)
        driven = arrays(node.ask("Get Suggestion", **opened))["actions"]
        form = world["action"]
        assert [list(driven.shape), driven.dtype.str] == [form["shape"], form["dtype"]]
        told = arrays(node.ask("Step", **opened, number=2, content=driven.tobytes()))
        digests = node.ask("Get Hashes", **opened).json()["hashes"]
        assert node.ask("Get Transfers", **opened).json()["transfers"] == []
        service.ask("Close Session", token, number=place["session"])
        cluster.stop()
    local = cavmarl.make_vec("ring", agents=2, background=2, seed=0)
    local.reset(seed=3)
    observations, rewards = local.step(driven)[:2]
    np.testing.assert_array_equal(told["observations"], observations)
    np.testing.assert_array_equal(told["rewards"], rewards)
    assert digests == [local.state_hash(0)]
    local.close()
