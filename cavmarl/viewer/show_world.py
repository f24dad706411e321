"""Shows a world to pages until it is interrupted: server, watchers and run together."""

from __future__ import annotations

import secrets
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from cavmarl.core.errors import require
from cavmarl.core.listening import is_loopback
from cavmarl.env.parallel import CavEnv
from cavmarl.policies.policy import load_policy
from cavmarl.viewer.audience import Audience
from cavmarl.viewer.frame_messages import FrameEncoder
from cavmarl.viewer.map_geometry import map_message, unpack
from cavmarl.viewer.shown_run import ShownRun
from cavmarl.viewer.vehicle_details import hello_of
from cavmarl.viewer.web_options import WebOptions


def show_world(
    env: CavEnv,
    policy: str,
    seed: int,
    options: WebOptions,
    tell: Callable[[str], None],
    seconds: float | None = None,
) -> dict[str, float]:
    """Drive `env`, which is closed at the end, and serve pages that watch it.

    Args:
        env: one world.
        policy: name or path of what drives its agents.
        seed: of the first episode.
        options: where pages are served; off the loopback address a token is made if it has none.
        tell: told the address, and a token that was made.
        seconds: of the world; None: until it is interrupted.

    Returns:
        the traffic of the last episode.

    Raises:
        ServiceError: the port is taken.
        MissingExtraError: starlette, uvicorn or websockets are not installed.
    """
    for module in ("starlette", "uvicorn", "httptools", "websockets"):
        require(module, "viewer")
    from cavmarl.viewer.web_server import WebServer

    try:
        if not options.token and not is_loopback(options.host):
            options = replace(options, token=secrets.token_urlsafe(18))
            tell(f"token: {options.token}")
        driver = load_policy(policy, env)
        map_bytes = map_message(env.network)
        origin = np.array(unpack(map_bytes)[0]["origin"])
        audience = Audience()
        with WebServer(options, audience, hello_of(env, origin, policy), map_bytes) as server:
            run = ShownRun(env, driver, audience, FrameEncoder(origin), seed)
            tell(f"viewer: {server.address}")
            try:
                run.run(seconds)
            except KeyboardInterrupt:
                tell("viewer: ended")
        return env.traffic_stats()
    finally:
        env.close()
