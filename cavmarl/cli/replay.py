"""`cavmarl replay`: shows a recording, or exports it."""

from __future__ import annotations

from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from cavmarl.cli.output import JsonPath, about, about_file, write_json
from cavmarl.cli.view import check_display
from cavmarl.cli.web import WatchToken, WebHost, WebPort, WebToken, say
from cavmarl.core.progress import progress_bar
from cavmarl.viewer.web_options import DEFAULT_PORT, WebOptions

if TYPE_CHECKING:
    from cavmarl.recordings.recording import Recording


def replay(
    path: Annotated[Path, typer.Argument(help="What --record was given.")],
    world: Annotated[int, about("Number of the world.")] = 0,
    episode: Annotated[int, about("Number of its episode, from 0.")] = 0,
    video: Annotated[
        Path | None, about("Write an .mp4 here; default: show a window, unless exported.")
    ] = None,
    ghosts_of: Annotated[int | None, about("Outline the ghosts of this zone.")] = None,
    fcd: Annotated[Path | None, about_file("Write SUMO's floating car data here.")] = None,
    csv: Annotated[Path | None, about_file("Write a line a vehicle and frame here.")] = None,
    mcap: Annotated[Path | None, about_file("Write MCAP for Foxglove here.")] = None,
    web: Annotated[bool, about("Show all of it in a browser, from a page served here.")] = False,
    port: WebPort = DEFAULT_PORT,
    host: WebHost = "127.0.0.1",
    token: WebToken = "",
    watch_token: WatchToken = "",
    watch_only: Annotated[bool, about("Pages may not pause it or go to another moment.")] = False,
    json_path: JsonPath = None,
) -> None:
    """Show a recording from above, or export it; see docs/guides/recordings.md."""
    from cavmarl.core.errors import ConfigError, RecordingError
    from cavmarl.recordings.recording import Recording
    from cavmarl.recordings.recording_exports import EXPORTS

    if web and video is not None:
        raise ConfigError(f"--web and --video {video}: give one of them")
    recording = Recording.open(path)
    ticks = recording.ticks(world, episode)
    if not ticks:
        raise RecordingError(
            f"{path}: no episode {episode} of world {world}; there are "
            f"{recording.episodes(world) or 'none'}"
        )
    console = Console()
    if not recording.is_whole:
        console.print(f"{path}: was not closed: it has what was committed", markup=False)
    wanted = {name: file for name, file in {"fcd": fcd, "csv": csv, "mcap": mcap}.items() if file}
    for name, file in wanted.items():
        with progress_bar(console) as bar:
            track = partial(bar.track, total=len(ticks), description=f"{name}: {file}")
            frames = EXPORTS[name](recording, file, world, episode, track)
        console.print(f"{name}: {file}, {frames} frames", markup=False)
    if web:
        from cavmarl.viewer.show_world import show_recording

        show_recording(
            recording, WebOptions(host, port, token, watch_token, control=not watch_only), say
        )
    elif video is not None or not wanted:
        _show(recording, world, episode, len(ticks), video, ghosts_of, console)
    document = {
        "environment": recording.head.environment,
        "whole": recording.is_whole,
        "worlds": recording.worlds,
        "episodes": recording.episodes(world),
        "frames": len(ticks),
        "exports": {name: str(file) for name, file in wanted.items()},
        "video": None if video is None else str(video),
    }
    write_json(json_path, document)


def _show(
    recording: Recording,
    world: int,
    episode: int,
    count: int,
    video: Path | None,
    ghosts_of: int | None,
    console: Console,
) -> None:
    """Draw the frames, into a window or a video."""
    from cavmarl.recordings.replay_pictures import ReplayPictures
    from cavmarl.render.video import VideoWriter

    if video is None:
        check_display()
    pictures = ReplayPictures(recording, ghosts_of)
    with ExitStack() as stack:
        stack.callback(pictures.close)
        writer = None
        if video is not None:
            writer = stack.enter_context(VideoWriter(video, pictures.fps))
        bar = stack.enter_context(progress_bar(console))
        frames = recording.frames(world, episode)
        for frame in bar.track(frames, count, description=f"{recording.path}"):
            if writer is not None:
                writer.write(pictures.picture(frame))
            elif not pictures.show(frame):
                return
    if video is not None:
        console.print(f"video: {video}", markup=False)
