"""A node in this process; a test chooses which of its requests, or their answers, are lost."""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

import pytest

from cavmarl.core.errors import ServiceError
from cavmarl.service import node_host
from cavmarl.service.node_link import NodeLink
from cavmarl.service.session_worlds import SessionWorlds
from tests.support.loopback_service import LoopbackService

__all__ = ["FlakyLink", "make_host", "run_until"]


class FlakyLink(NodeLink):
    """The link of a node; a test chooses which requests, or their answers, are lost."""

    lost: list[str]  # last parts of paths; each makes one request fail
    unanswered: list[str]  # last parts of paths; each loses one answer
    asked: Counter[str]

    async def ask(self, method: str, path: str, **given: Any) -> Any:
        word = path.rsplit("/", 1)[-1]
        self.asked[word] += 1
        if word in self.lost:
            self.lost.remove(word)
            raise ServiceError("the service cannot be reached")
        answer = await super().ask(method, path, **given)
        if word in self.unanswered:
            self.unanswered.remove(word)
            raise ServiceError("the answer was lost")
        return answer


def make_host(
    service: LoopbackService, lost: list[str], unanswered: list[str]
) -> tuple[node_host._Host, FlakyLink]:
    body = {"name": "a", "address": "127.0.0.1", "client_port": 1, "simulator_port": 1}
    link = FlakyLink(service.url, service.secrets["node"], body, is_supposed_idle=True)
    link.lost, link.unanswered, link.asked = lost, unanswered, Counter()
    return node_host._Host(link, SessionWorlds(4), lambda _: None), link


async def run_until(host: node_host._Host, is_over: Callable[[], bool]) -> None:
    """Send heartbeats until a condition holds; fail if the node ends earlier."""
    beating = asyncio.create_task(node_host._beat_until_end(host))
    until_s = time.monotonic() + 30.0
    while not is_over():
        assert time.monotonic() < until_s
        if beating.done():
            beating.result()
            pytest.fail(f"the node has ended: {host.failure}")
        await asyncio.sleep(0.01)
    beating.cancel()
    for job in host.jobs.values():
        job.cancel()
    await asyncio.gather(beating, *host.jobs.values(), return_exceptions=True)
    await host.link.close()
