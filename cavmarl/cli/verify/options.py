"""Options of `cavmarl verify`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cavmarl.cli.output import about
from cavmarl.config.zones import ZONE_LAYOUTS

Env = Annotated[
    str | None,
    typer.Argument(
        metavar="[ENV]",
        help="Name, folder or map file of an environment.",
    ),
]
Zones = Annotated[
    str | None,
    about(
        "Numbers of zones; default: 1,2,4,9, or what a zone file has.",
        metavar="K,K,…",
    ),
]
Steps = Annotated[int | None, about("Compared steps; default: 200, of a campaign fewer a run.")]
Layout = Annotated[
    str | None, about(f"{', '.join(ZONE_LAYOUTS)}, or a zone file; default: the environment's.")
]
Worlds = Annotated[
    int | None, about("Number of parallel worlds; default: 1, with --kill two a worker.")
]
Faults = Annotated[
    str | None,
    about(
        "With --nodes: faults between simulated nodes, and with `campaign` between processes, too.",
        metavar="simulated|campaign",
    ),
]
Seeds = Annotated[
    int,
    about("Of a campaign: runs of each fault."),
]
Kill = Annotated[
    int | None,
    about(
        "Kill or stop N workers at random times instead of dividing worlds, and compare.",
        metavar="N",
    ),
]
Nodes = Annotated[
    str | None,
    about(
        "Numbers of nodes, processes that share nothing; with --kill N of them are killed, "
        "with --faults campaign connections and nodes fail, simulated ones and processes; "
        "with --faults simulated only the former.",
        metavar="N,N,…",
    ),
]
Backend = Annotated[
    str | None,
    about("With --kill: where the worlds run, processes:N [default: processes:2]."),
]
Workers = Annotated[int | None, about("Short form: N for --backend processes:N.")]
Check = Annotated[bool, about("Check the invariants of ownership, too.", "--check")]
Journal = Annotated[
    Path | None, about("Folder for the journals of the divided worlds.", metavar="DIR")
]
