"""`cavmarl node`: hosts zones of a world whose caller is on this machine or another one."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

from rich.console import Console

from cavmarl.cli.output import about
from cavmarl.core.errors import WorkerError

AGAIN_S = 0.5  # between two calls while nobody listens


def node(
    join: Annotated[str, about("Where the caller listens.", "--join", metavar="HOST:PORT")],
    key_file: Annotated[Path, about("File with the key that the caller has, too.")],
    wait_s: Annotated[float, about("Seconds that the caller may take to listen.")] = 300.0,
) -> None:
    """Host zones of a world, until its caller ends; exit code 1: the caller is gone."""
    from cavmarl.parallel.nodes.newcomers import ANYONE
    from cavmarl.parallel.nodes.node_process import run_node
    from cavmarl.parallel.nodes.node_starters import place_of, read_key

    place, key = place_of(join), read_key(key_file)
    console = Console()
    until_s = time.monotonic() + wait_s
    while True:
        try:
            is_done = run_node(place, key, ANYONE, lambda text: console.print(f"node {text}"))
            break
        except (OSError, EOFError) as error:
            if time.monotonic() > until_s:
                raise WorkerError(
                    f"no caller lets this node in at {join} within {wait_s:g} s ({error}): start "
                    "the caller, and look whether the two can reach each other"
                ) from error
            time.sleep(AGAIN_S)
    console.print("the caller has ended" if is_done else "the caller is gone")
    raise SystemExit(0 if is_done else 1)
