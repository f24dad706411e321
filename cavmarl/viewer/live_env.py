"""`show`: a page for an environment that a program steps, as in a notebook or in training."""

from __future__ import annotations

import html
import time
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from typing import Any
from weakref import WeakValueDictionary

from cavmarl.engine.world_frame import WorldFrame
from cavmarl.viewer.frame_publisher import FramePublisher
from cavmarl.viewer.inserted_here import handle_insertion
from cavmarl.viewer.page_requests import PageRequest
from cavmarl.viewer.run_clock import RunClock
from cavmarl.viewer.run_loads import RunLoads
from cavmarl.viewer.show_world import check_extra, serve_stages
from cavmarl.viewer.subscribers import Audience
from cavmarl.viewer.vehicle_details import ViewedEnv, hello_of, vehicle_details
from cavmarl.viewer.viewed_world import first_stage
from cavmarl.viewer.web_options import DEFAULT_PORT, WebOptions

FRAME_HEIGHT_PX = 560  # height of the page in a notebook


# Pages of `show` by the id of their environment; a page keeps its environment alive.
_SHOWN: WeakValueDictionary[int, ShownEnv] = WeakValueDictionary()


class ShownEnv:
    """Serves pages that watch the worlds of an environment; a context manager.

    A notebook displays it as the embedded page.

    Args:
        env: environment that the program steps.
        options: options of the server. With control, a step waits while a page has paused the
            worlds.
        title: description of what drives the worlds.
        looks_itself: whether to call `look` after each reset and step of `env`. If not, the caller
            calls `look`, or, if the caller must not wait, `turn` and `moved`.
        tell: called with lines of text: the address, and a generated token.
        reset: restarts the episode of a world by index; None: pages may not restart episodes.

    Attributes:
        address: address of the page.
        audiences: the pages that watch each world.
        publishers: publish the frames of each world.
        changes: number of requests that have changed a world.
    """

    def __init__(
        self,
        env: ViewedEnv,
        options: WebOptions,
        *,
        title: str = "",
        looks_itself: bool = True,
        tell: Callable[[str], None] = lambda _: None,
        reset: Callable[[int], None] | None = None,
    ) -> None:
        check_extra()
        self._env = env
        self._reset = reset
        self.changes = 0
        self._controlled = options.control
        self._clock = RunClock(pace=0.0)
        count = len(env.worlds.arrays.mask)
        hello = hello_of(env, title, is_driven_here=False)
        hello["may"] += ["reset"] if reset is not None else []
        first = first_stage("world 0", env.network, hello)
        stages = [first, *(first.named(f"world {k}") for k in range(1, count))]
        self.audiences = [stage.audience for stage in stages]
        self.publishers = [FramePublisher(stage.audience, stage.encoder) for stage in stages]
        with ExitStack() as stack:
            self.address = serve_stages(stack, stages, options, tell)
            self._loads = stack.enter_context(RunLoads(env.worlds, first.audience))
            if looks_itself:
                stack.callback(env.watch(self.look))
            self._stack = stack.pop_all()

    def look(self) -> None:
        """Update the pages; while a page has paused the worlds, wait."""
        self._renew()
        while wait_s := self.turn():
            self.audiences[0].wait(wait_s)
        self._clock.tick(time.monotonic(), self._env.step_s)

    def turn(self) -> float:
        """Handle requests and update the pages; return how long the next step must wait, in s."""
        self._handle()
        wait_s = self._clock.wait_s(time.monotonic()) if self._controlled else 0.0
        if self._env.is_ready:
            self._publish()
            self._loads.look()
        return wait_s

    def tell_others(self, rows: list[dict[str, Any]]) -> None:
        """Set the load rows of other processes, as from `run_loads.load_rows`."""
        self._loads.others = rows

    def moved(self) -> None:
        """Advance the clock after a step of the worlds, and mark the frames as new."""
        self._clock.tick(time.monotonic(), self._env.step_s)
        self._renew()

    @property
    def is_watched(self) -> bool:
        """Return whether a page is open."""
        return any(audience.wishes.watchers for audience in self.audiences)

    def _renew(self) -> None:
        for publisher in self.publishers:
            publisher.is_new = True

    def _handle(self) -> None:
        for world, audience in enumerate(self.audiences):
            for number, request in audience.requests():
                if not self._clock.handle(request) and self._controlled and self._env.is_ready:
                    self._change(world, audience, number, request)

    def _change(self, world: int, audience: Audience, number: int, request: PageRequest) -> None:
        tick = int(self._env.worlds.arrays.ticks[world])
        if request.kind == "reset" and self._reset is not None:
            self._reset(world)
            self._renew()
        elif not handle_insertion(self._env, world, audience, number, request, tick):
            return
        self.changes += 1

    def _publish(self) -> None:
        for world, publisher in enumerate(self.publishers):
            frame_of, details_of = partial(self._frame, world), partial(self._details, world)
            publisher.publish(time.monotonic(), self._clock, frame_of, details_of)

    def _frame(self, world: int, ghosts: bool) -> WorldFrame:
        return self._env.world_frames([world], ghosts)[0]

    def _details(
        self, world: int, frame: WorldFrame, vehicle: int, sensors: bool
    ) -> dict[str, Any]:
        return vehicle_details(self._env, world, frame, vehicle, sensors)

    def refresh(self) -> None:
        """Publish the present frame, even without watchers or right after another frame."""
        for world, publisher in enumerate(self.publishers):
            publisher.keep(self._frame(world, ghosts=False), self._clock)

    def _repr_html_(self) -> str:
        if self._env.is_ready:
            self.refresh()
        source = html.escape(self.address, quote=True)
        return f'<iframe src="{source}" width="100%" height="{FRAME_HEIGHT_PX}"></iframe>'

    def close(self) -> None:
        """Stop the server; the environment stays open."""
        self._stack.close()

    def __enter__(self) -> ShownEnv:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def show(
    env: ViewedEnv,
    *,
    port: int = DEFAULT_PORT,
    host: str = "127.0.0.1",
    token: str = "",
    control: bool = False,
    title: str = "",
) -> ShownEnv:
    """Serve a page that shows an environment while a program steps it (docs/guides/viewer.md).

    Args:
        env: from `parallel_env` or `make_vec`.
        port: port of the page; 0 picks a free port.
        host: address; any other than the loopback address needs a token.
        token: token that a page must give; if missing and needed, one is generated and printed.
        control: whether pages may pause, step and slow the program; `step` then waits for them.
        title: description of what drives the worlds.

    If the environment is already shown, its earlier page is closed, so that the new one can have
    the same port.

    Raises:
        ServiceError: the port is taken.
        MissingExtraError: starlette, uvicorn or websockets are not installed.
    """
    options = WebOptions(host, port, token, control=control, framed=True)
    if (earlier := _SHOWN.get(id(env))) is not None:
        earlier.close()
    _SHOWN[id(env)] = shown = ShownEnv(env, options, title=title, tell=print)
    return shown
