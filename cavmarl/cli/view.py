"""`cavmarl view`: shows a driver in a window, in a video or on a page."""

from __future__ import annotations

import os
import sys
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rich.console import Console

from cavmarl.cli.output import (
    OUTPUT,
    PAGE,
    RECORD_EXTRAS,
    VIDEO_EXTRAS,
    WEB_EXTRAS,
    WINDOW_EXTRAS,
    Backend,
    JsonPath,
    PolicyName,
    RecordAlso,
    RecordPath,
    Workers,
    Zones,
    about,
    check_extras,
    flag,
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

MOST_WORLDS = 16  # limit of one page

if TYPE_CHECKING:
    from cavmarl.env.parallel import CavEnv
    from cavmarl.render.animation import AnimationWriter
    from cavmarl.render.video import VideoWriter


@with_world()
def view(
    world: WorldSpec,
    policy: PolicyName = "idm",
    seconds: Annotated[
        float | None,
        about(
            "Length of the run in simulated seconds [default: 30; unlimited on a page].",
            metavar="S",
        ),
    ] = None,
    video: Annotated[
        Path | None,
        about(
            "Write the video to this .mp4 file [default: show a window].",
            metavar="FILE",
            panel=OUTPUT,
        ),
    ] = None,
    ghosts_of: Annotated[
        int | None, about("Outline the ghosts of this zone of a divided world.", metavar="ZONE")
    ] = None,
    zones: Zones = None,
    backend: Backend = None,
    workers: Workers = None,
    web: Annotated[
        bool, flag("Serve a page that shows the world in a browser.", panel=PAGE)
    ] = False,
    port: WebPort = DEFAULT_PORT,
    host: WebHost = "127.0.0.1",
    token: WebToken = "",
    watch_token: WatchToken = "",
    watch_only: Annotated[bool, flag("Do not let pages pause, step or drive.", panel=PAGE)] = False,
    worlds: Annotated[
        int, about("Number of worlds; the page can show each of them.", metavar="N", panel=PAGE)
    ] = 1,
    record: RecordPath = None,
    record_also: RecordAlso = "",
    json_path: JsonPath = None,
) -> None:
    """Drive a world and show it from above."""
    check_extras(
        world, [policy], (web, WEB_EXTRAS), (not web, WINDOW_EXTRAS), (video, VIDEO_EXTRAS),
        (record, RECORD_EXTRAS),
    )  # fmt: skip
    from cavmarl.env.parallel import parallel_env
    from cavmarl.render.video import VideoWriter

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
        raise ConfigError(f"--worlds {worlds}: only a page shows several worlds; add --web")
    seconds = 30.0 if seconds is None else seconds
    if not 0.0 < seconds <= 3600.0:
        raise ConfigError(f"--seconds {seconds:g}: must be above 0 and at most 3600, or add --web")
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
    with closing(made):
        writer = None if video is None else VideoWriter(video, made.metadata["render_fps"])
        stats = drive(made, policy, seconds, world.seed, writer, console)
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
    """Raise ConfigError for options that a page does not support."""
    check_count("--worlds", worlds, MOST_WORLDS)
    if worlds > 1 and record is not None:
        raise ConfigError(
            f"--worlds {worlds} and --record {record}: only one world can be recorded"
        )
    if seconds is not None and not 0.0 < seconds < float("inf"):
        raise ConfigError(f"--seconds {seconds:g}: must be above 0")
    if video is not None:
        raise ConfigError(f"--web and --video {video}: use only one of the two")
    if ghosts_of is not None:
        raise ConfigError(
            "--web and --ghosts-of: remove --ghosts-of and choose the zone on the page"
        )


def check_display() -> None:
    """Raise ConfigError on Linux without a display, where SDL would draw the window nowhere."""
    shows = ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")
    if sys.platform == "linux" and not any(os.environ.get(name) for name in shows):
        raise ConfigError("this machine has no display for a window: use --video FILE or --web")


def drive(
    world: CavEnv,
    policy: str,
    seconds: float,
    seed: int,
    writer: AnimationWriter | VideoWriter | None,
    console: Console,
) -> dict[str, float]:
    """Drive `world` for some simulated seconds; write its pictures if there is a `writer`.

    When an episode ends, the next one begins. Return the traffic statistics of the last episode.
    """
    from cavmarl.policies.loading import load_policy

    driver = load_policy(policy, world)
    steps = max(1, round(seconds / world.step_s))
    with ExitStack() as stack:
        if writer is not None:
            stack.enter_context(writer)
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
