"""`cavmarl replay`: shows or exports a recording."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape

from cavmarl.cli.output import (
    OUTPUT,
    PAGE,
    RECORD_EXTRAS,
    VIDEO_EXTRAS,
    WEB_EXTRAS,
    WINDOW_EXTRAS,
    Imports,
    JsonPath,
    about,
    about_file,
    flag,
    grid,
    write_json,
)
from cavmarl.cli.view import check_display
from cavmarl.cli.web import WatchToken, WebHost, WebPort, WebToken, say
from cavmarl.core.progress import progress_bar
from cavmarl.viewer.web_options import DEFAULT_PORT, WebOptions

if TYPE_CHECKING:
    from cavmarl.recordings.recording import Recording


def replay(
    path: Annotated[
        Path,
        typer.Argument(metavar="RECORDING", help="Recording, or a folder of recordings."),
    ],
    world: Annotated[int, about("Number of the world, from 0.", metavar="N")] = 0,
    episode: Annotated[int, about("Number of the episode, from 0.", metavar="N")] = 0,
    video: Annotated[
        Path | None,
        about(
            "Write the video to this .mp4 file [default: show a window unless data are exported].",
            metavar="FILE",
            panel=OUTPUT,
        ),
    ] = None,
    ghosts_of: Annotated[
        int | None, about("Outline the ghosts of this zone.", metavar="ZONE")
    ] = None,
    fcd: Annotated[Path | None, about_file("Write floating car data in SUMO's format.")] = None,
    emissions: Annotated[
        Path | None, about_file("Write energy, CO₂ and fuel of each vehicle in SUMO's format.")
    ] = None,
    csv: Annotated[Path | None, about_file("Write CSV with a line per vehicle and frame.")] = None,
    mcap: Annotated[Path | None, about_file("Write an MCAP file for Foxglove.")] = None,
    rosbag2: Annotated[
        Path | None,
        about("Write a rosbag2 bag to a new folder.", metavar="FOLDER", panel=OUTPUT),
    ] = None,
    minari: Annotated[
        Path | None,
        about(
            "Write the agents' trips of all worlds as a Minari data set to a new folder.",
            metavar="FOLDER",
            panel=OUTPUT,
        ),
    ] = None,
    web: Annotated[
        bool, flag("Serve a page that shows the whole recording in a browser.", panel=PAGE)
    ] = False,
    port: WebPort = DEFAULT_PORT,
    host: WebHost = "127.0.0.1",
    token: WebToken = "",
    watch_token: WatchToken = "",
    watch_only: Annotated[bool, flag("Do not let browsers pause or seek.", panel=PAGE)] = False,
    imports: Imports = None,
    json_path: JsonPath = None,
) -> None:
    """Show a recording from above, or export it.

    If the folder contains several recordings, list them.
    """
    from cavmarl.core.errors import ConfigError, RecordingError, require_all

    given = {
        "fcd": fcd,
        "emissions": emissions,
        "csv": csv,
        "mcap": mcap,
        "rosbag2": rosbag2,
        "minari": minari,
    }
    wanted = {name: file for name, file in given.items() if file}
    shows = video is not None or not (web or wanted)
    require_all(
        RECORD_EXTRAS
        | (WEB_EXTRAS if web else {})
        | (VIDEO_EXTRAS if video else WINDOW_EXTRAS if shows else {})
        | ({"mcap": "record"} if mcap else {})
        | ({"rosbags": "ros2"} if rosbag2 else {})
    )
    from cavmarl.recordings.recording import Recording, recordings_in
    from cavmarl.recordings.recording_exports import EXPORTS

    if web and video is not None:
        raise ConfigError(f"--web and --video {video}: use only one of the two")
    if folders := recordings_in(path):
        if web or video or wanted:
            raise ConfigError(f"{path}: holds {len(folders)} recordings; name one: {folders[0]}")
        _list(folders, json_path)
        return
    recording = Recording.open(path)
    ticks = recording.ticks(world, episode)
    if not ticks:
        raise RecordingError(
            f"{path}: world {world} has no episode {episode}; it has "
            f"{recording.episodes(world) or 'none'}"
        )
    console = Console()
    if not recording.is_whole:
        console.print(f"{path}: never closed; shown up to its last complete part", markup=False)
    exports = dict(EXPORTS)
    if rosbag2:
        from cavmarl.cosim.ros2.recording_bag import write_recording_bag

        exports["rosbag2"] = write_recording_bag
    if minari:
        from cavmarl.recordings.minari_export import write_minari

        trips, decisions = write_minari(recording, minari)
        console.print(f"minari: {minari}, {trips} trips, {decisions} decisions", markup=False)
    for name, file in wanted.items():
        if name not in exports:
            continue
        with progress_bar(console) as bar:
            track = partial(bar.track, total=len(ticks), description=f"{name}: {file}")
            frames = exports[name](recording, file, world, episode, track)
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


def _list(folders: Sequence[Path], json_path: Path | None) -> None:
    """List recordings."""
    from cavmarl.recordings.recording import Recording

    found: dict[str, dict[str, Any]] = {}
    for folder in folders:
        recording = Recording.open(folder)
        found[str(folder)] = {
            "environment": recording.head.environment,
            "worlds": len(recording.worlds),
            "episodes": sum(len(recording.episodes(world)) for world in recording.worlds),
            "whole": recording.is_whole,
        }
    rows = [
        (escape(name), escape(one["environment"]), str(one["worlds"]), str(one["episodes"]))
        for name, one in found.items()
    ]
    heads = ("recording", "environment", "worlds", "episodes")
    Console().print(grid(heads, rows, caption="`cavmarl replay RECORDING` shows one", lefts=2))
    write_json(json_path, {"recordings": found})


def _show(
    recording: Recording,
    world: int,
    episode: int,
    count: int,
    video: Path | None,
    ghosts_of: int | None,
    console: Console,
) -> None:
    """Draw the frames in a window or a video."""
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
