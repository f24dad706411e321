"""Shows worlds and recordings to pages until interrupted: runs both the server and the worlds."""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from typing import Protocol

from cavmarl.core.errors import require
from cavmarl.core.server_address import is_loopback
from cavmarl.env.parallel import CavEnv
from cavmarl.policies.loading import load_policy
from cavmarl.recordings.recording import Recording
from cavmarl.viewer.live_recording import ShownRecording, recording_stages
from cavmarl.viewer.live_run import ShownRun
from cavmarl.viewer.run_loads import RunLoads
from cavmarl.viewer.vehicle_details import hello_of
from cavmarl.viewer.viewed_world import Stage, first_stage
from cavmarl.viewer.web_options import PACKAGES, WebOptions

Tell = Callable[[str], None]


class ShownWorld(Protocol):
    """A run or a recording on a stage."""

    def turn(self) -> float:
        """Do what is due; return how long to wait then, in s."""
        ...


def show_worlds(
    envs: Sequence[CavEnv],
    policy: str,
    seed: int,
    options: WebOptions,
    tell: Tell,
    seconds: float | None = None,
) -> dict[str, float]:
    """Drive worlds and serve pages that watch them; the worlds are closed at the end.

    Args:
        envs: environments of one world each, with equal settings.
        policy: name or path of the agents' policy.
        seed: seed of the first episode of the first world; the other worlds have the next numbers.
        options: options of the server; outside the loopback address, a missing token is generated.
        tell: called with lines of text: the address, and a generated token.
        seconds: simulated duration of the first world; None: until interrupted.

    Returns:
        traffic statistics of the first world's last episode.

    Raises:
        ServiceError: the port is taken.
        MissingExtraError: starlette, uvicorn or websockets are not installed.
    """
    with ExitStack() as stack:
        for env in envs:
            stack.callback(env.close)
        check_extra()
        first = first_stage("world 0", envs[0].network, hello_of(envs[0], policy))
        stages = [first, *(first.named(f"world {k}") for k in range(1, len(envs)))]
        serve_stages(stack, stages, options, tell)
        stack.enter_context(RunLoads(envs[0].worlds, first.audience))
        runs = [
            ShownRun(env, load_policy(policy, env), stage, seed + k)
            for k, (env, stage) in enumerate(zip(envs, stages, strict=True))
        ]
        most = None if seconds is None else max(1, round(seconds / runs[0].step_s))
        _go_on(runs, first, tell, lambda: most is None or runs[0].steps < most)
        return envs[0].traffic_stats()


def show_recording(
    recording: Recording, options: WebOptions, tell: Tell, seconds: float | None = None
) -> None:
    """Serve pages that watch a recording.

    Args:
        recording: the recording to show.
        options: options of the server, see `show_worlds`.
        tell: called with lines of text, see `show_worlds`.
        seconds: duration in wall time; None: until interrupted.

    Raises:
        RecordingError: the recording cannot be read, or its map is missing.
        ServiceError: the port is taken.
        MissingExtraError: starlette, uvicorn or websockets are not installed.
    """
    check_extra()
    found = recording_stages(recording)
    with ExitStack() as stack:
        stages = [stage for _, _, stage in found]
        serve_stages(stack, stages, options, tell)
        # Each episode has its own reader, since a reader caches one part of the recording.
        shown = [ShownRecording(Recording(recording.path), *one) for one in found]
        end = None if seconds is None else time.monotonic() + seconds
        _go_on(shown, stages[0], tell, lambda: end is None or time.monotonic() < end)


def check_extra() -> None:
    """Raise MissingExtraError if the server's packages are not installed."""
    for module in PACKAGES:
        require(module, "viewer")


def serve_stages(stack: ExitStack, stages: Sequence[Stage], options: WebOptions, tell: Tell) -> str:
    """Serve the pages of some stages until `stack` closes; return the address.

    Raises ServiceError: the port is taken.
    """
    from cavmarl.viewer.web_server import WebServer

    if not options.token and not is_loopback(options.host):
        options = replace(options, token=secrets.token_urlsafe(18))
        tell(f"token: {options.token}")
    server = stack.enter_context(WebServer(options, stages))
    tell(f"viewer: {server.address}")
    return server.address


def _go_on(
    shown: Sequence[ShownWorld], first: Stage, tell: Tell, goes_on: Callable[[], bool]
) -> None:
    try:
        while goes_on():
            wait_s = min([one.turn() for one in shown])
            if wait_s:
                first.audience.wait(wait_s)
    except KeyboardInterrupt:
        tell("viewer: ended")
