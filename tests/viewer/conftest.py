"""Fixtures: a server with a small divided world, and a browser."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any

import pytest

from cavmarl.env.parallel import CavEnv, parallel_env
from cavmarl.policies.loading import load_policy
from cavmarl.viewer.live_run import ShownRun
from cavmarl.viewer.subscribers import Audience
from cavmarl.viewer.vehicle_details import hello_of
from cavmarl.viewer.viewed_world import first_stage
from cavmarl.viewer.web_options import WebOptions
from cavmarl.viewer.web_server import WebServer
from tests.support.chromium import chromium


@dataclass
class Served:
    """A world with its server; a thread can step the world."""

    env: CavEnv
    run: ShownRun
    audience: Audience
    server: WebServer
    map_bytes: bytes

    def note_actions(self, monkeypatch: pytest.MonkeyPatch) -> list[Any]:
        """Return a list to which each further step appends the action of the first agent."""
        noted: list[Any] = []
        step = self.env.step

        def noting(actions: dict[str, Any]) -> Any:
            noted.append(actions.get("car_0"))
            return step(actions)

        monkeypatch.setattr(self.env, "step", noting)
        return noted


@contextmanager
def served(env: CavEnv, options: WebOptions, drives: bool = True) -> Iterator[Served]:
    """Serve a world; a thread steps the world unless `drives` is false."""
    with ExitStack() as stack:
        stack.callback(env.close)
        stage = first_stage("world 0", env.network, hello_of(env, "idm"))
        run = ShownRun(env, load_policy("idm", env), stage, seed=1)
        server = stack.enter_context(WebServer(options, [stage]))
        over = threading.Event()
        if drives:
            thread = threading.Thread(target=_drive, args=(run, over))
            thread.start()
            stack.callback(thread.join)
            stack.callback(over.set)
        yield Served(env, run, stage.audience, server, stage.map_bytes)


def _drive(run: ShownRun, over: threading.Event) -> None:
    while not over.is_set():
        over.wait(min(run.turn(), 0.02))


@pytest.fixture(scope="module")
def chromium_browser() -> Iterator[Any]:
    with chromium() as found:
        yield found


@pytest.fixture
def browser(chromium_browser: Any) -> Iterator[Any]:
    """Yield a browser; close its pages after the test."""
    yield chromium_browser
    for context in chromium_browser.contexts:
        context.close()


@pytest.fixture
def serve() -> Iterator[Callable[..., Served]]:
    """Yield a function that serves worlds until the test ends."""
    with ExitStack() as stack:

        def begin(
            *,
            env: str = "grid4x4",
            zones: int = 4,
            background: int = 20,
            options: WebOptions | None = None,
            drives: bool = True,
            rig: dict[str, Any] | None = None,
            insertions: int = 0,
        ) -> Served:
            more = {
                "rig": rig or {},
                "population.insertions": insertions,
                "map.changed_lanes": 2 * insertions,
            }
            made = parallel_env(env, zones=zones, agents=3, background=background, overrides=more)
            return stack.enter_context(served(made, options or WebOptions(port=0), drives))

        yield begin
