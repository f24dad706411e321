"""`cavmarl view`: shows a driver, in a window or in a video."""

from __future__ import annotations

import os
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rich.console import Console

from cavmarl.cli.output import (
    Backend,
    JsonPath,
    PolicyName,
    RecordAlso,
    RecordPath,
    Workers,
    about,
    recorded,
    with_world,
    write_json,
)
from cavmarl.cli.web import WatchToken, WebHost, WebPort, WebToken, say
from cavmarl.config.checks import check_count
from cavmarl.config.world_spec import WorldSpec, with_sensors_of_drivers
from cavmarl.core.errors import ConfigError
from cavmarl.core.progress import progress_bar
from cavmarl.viewer.web_options import DEFAULT_PORT, WebOptions

MOST_WORLDS = 16  # of a page

if TYPE_CHECKING:
    from cavmarl.env.parallel import CavEnv


@with_world()
def view(
    world: WorldSpec,
    policy: PolicyName = "idm",
    seconds: Annotated[
        float | None, about("Seconds of simulated time; default: 30, on a page without end.")
    ] = None,
    video: Annotated[Path | None, about("Write an .mp4 here; default: show a window.")] = None,
    ghosts_of: Annotated[
        int | None, about("Outline the ghosts of this zone of a divided world.")
    ] = None,
    zones: Annotated[int | None, about("Zones that the world is divided into.")] = None,
    backend: Backend = None,
    workers: Workers = None,
    web: Annotated[bool, about("Show it in a browser, from a page that is served here.")] = False,
    port: WebPort = DEFAULT_PORT,
    host: WebHost = "127.0.0.1",
    token: WebToken = "",
    watch_token: WatchToken = "",
    watch_only: Annotated[bool, about("Pages may not pause, step or drive.")] = False,
    worlds: Annotated[int, about("Worlds that the page can choose among.")] = 1,
    record: RecordPath = None,
    record_also: RecordAlso = "",
    json_path: JsonPath = None,
) -> None:
    """Drive one world and show it from above."""
    from cavmarl.env.parallel import parallel_env

    kept = recorded(record, record_also)
    world = with_sensors_of_drivers(world, [policy])
    if web:
        from cavmarl.viewer.show_world import show_worlds

        _check_web(seconds, video, ghosts_of, worlds, record)
        options = WebOptions(host, port, token, watch_token, control=not watch_only)
        many = [
            parallel_env(
                world.env,
                zones=zones,
                backend=backend,
                workers=workers,
                record=kept,
                **world.keywords,
            )
            for _ in range(worlds)
        ]
        stats = show_worlds(many, policy, world.seed, options, say, seconds)
        write_json(json_path, {"video": None, "traffic": stats})
        return
    if worlds != 1:
        raise ConfigError(f"--worlds {worlds}: only a page shows several; add --web")
    seconds = 30.0 if seconds is None else seconds
    if not 0.0 < seconds <= 3600.0:
        raise ConfigError(f"--seconds {seconds:g}: must be above 0 and at most 3600")
    if video is None:
        check_display()
    mode = "human" if video is None else "rgb_array"
    made = parallel_env(
        world.env,
        zones=zones,
        backend=backend,
        workers=workers,
        render_mode=mode,
        record=kept,
        **world.keywords,
    )
    made.ghosts_of = ghosts_of
    console = Console()
    stats = drive(made, policy, seconds, world.seed, video, console)
    if video is not None:
        console.print(f"video: {video}", markup=False)
    write_json(json_path, {"video": str(video) if video else None, "traffic": stats})


def _check_web(
    seconds: float | None,
    video: Path | None,
    ghosts_of: int | None,
    worlds: int,
    record: Path | None,
) -> None:
    """Refuse what a page cannot be told with its options."""
    check_count("--worlds", worlds, MOST_WORLDS)
    if worlds > 1 and record is not None:
        raise ConfigError(f"--worlds {worlds} and --record {record}: only one world is recorded")
    if seconds is not None and not 0.0 < seconds < float("inf"):
        raise ConfigError(f"--seconds {seconds:g}: must be above 0")
    if video is not None:
        raise ConfigError(f"--web and --video {video}: give one of them")
    if ghosts_of is not None:
        raise ConfigError("--web and --ghosts-of: the page has a choice of zones; leave it out")


def check_display() -> None:
    """Refuse a window where SDL would draw it nowhere and say nothing: Linux without a display."""
    shows = ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")
    if sys.platform == "linux" and not any(os.environ.get(name) for name in shows):
        raise ConfigError("there is no display for a window: use --video FILE")


def drive(
    world: CavEnv, policy: str, seconds: float, seed: int, video: Path | None, console: Console
) -> dict[str, float]:
    """Drive `world` for some seconds, and film it where `video` is a path.

    Episodes follow one another; the traffic of the last one is returned.
    """
    from cavmarl.policies.loading import load_policy
    from cavmarl.render.video import VideoWriter

    driver = load_policy(policy, world)
    steps = max(1, round(seconds / world.step_s))
    with ExitStack() as stack:
        stack.callback(world.close)
        writer = None
        if video is not None:
            writer = stack.enter_context(VideoWriter(video, world.metadata["render_fps"]))
        bar = stack.enter_context(progress_bar(console))
        observations, _ = world.reset(seed=seed)
        driver.reset(seed)
        for _ in bar.track(range(steps), description=f"{policy} drives {world.config.name}"):
            if not world.agents:
                observations, _ = world.reset()
            observations, *_ = world.step(driver.act(observations))
            if writer is not None:
                frame = world.render()
                assert frame is not None  # the render mode is rgb_array
                writer.write(frame)
        return world.traffic_stats()
