"""`cavmarl node`: hosts zones of one world, or worlds of a coordination service."""

from __future__ import annotations

import faulthandler
import runpy
import socket
import sys
import time
from pathlib import Path
from typing import Annotated, Literal, NoReturn

import typer
from rich.console import Console

from cavmarl.cli.output import (
    SERVICE,
    Imports,
    about,
    flag,
)
from cavmarl.cli.service import Authority, Certificate, Key, PlainHttp, UserSecretFile, user_secret
from cavmarl.core.errors import ConfigError, WorkerError, require

AGAIN_S = 0.5  # pause between two attempts while no caller listens


def node(
    program: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="PROGRAM",
            help="With --mpi: the program that rank 0 runs, followed by the program's own options.",
        ),
    ] = None,
    join: Annotated[
        str | None,
        about("Address of the caller, which has made the world.", "--join", metavar="HOST:PORT"),
    ] = None,
    key_file: Annotated[
        Path | None, about("With --join: file with the key of the caller.", metavar="FILE")
    ] = None,
    mpi: Annotated[
        bool, flag("Join the MPI run as one of its ranks; rank 0 is the caller.", "--mpi")
    ] = False,
    imports: Imports = None,
    wait_s: Annotated[
        float, about("With --join and --mpi: seconds to wait for the caller.", metavar="S")
    ] = 300.0,
    service: Annotated[
        str | None,
        about(
            "URL of the coordination service; URLs of standbys may follow, comma-separated.",
            "--service",
            metavar="URL",
            panel=SERVICE,
        ),
    ] = None,
    name: Annotated[
        str | None,
        about("Name of the node [default: name of the machine].", metavar="NAME", panel=SERVICE),
    ] = None,
    host: Annotated[
        str, about("Address at which clients reach the node.", metavar="ADDRESS", panel=SERVICE)
    ] = "127.0.0.1",
    port: Annotated[
        int,
        about(
            "Port for clients; 0 picks a free port.",
            metavar="PORT",
            min=0,
            max=65535,
            panel=SERVICE,
        ),
    ] = 0,
    slots: Annotated[
        int,
        about(
            "Maximum number of sessions and jobs at the same time.",
            metavar="N",
            min=1,
            panel=SERVICE,
        ),
    ] = 4,
    capability: Annotated[
        list[str] | None,
        about(
            "Capability that sessions can require. Repeat it for more.",
            metavar="NAME",
            panel=SERVICE,
        ),
    ] = None,
    allow: Annotated[
        list[str] | None,
        about(
            "Identity whose sessions the node accepts. Repeat it for more [default: all].",
            metavar="NAME",
            panel=SERVICE,
        ),
    ] = None,
    snapshot: Annotated[
        Literal["measured", "idle"],
        about("Load that the node reports: as measured on this machine, or idle.", panel=SERVICE),
    ] = "measured",
    secret_file: UserSecretFile = None,
    certificate: Certificate = None,
    key: Key = None,
    authority: Authority = None,
    plain_http: PlainHttp = False,
) -> None:
    """Host zones of a world until its caller ends, or work for a coordination service.

    If the connection to the caller is lost, exit with 1. On SIGTERM, a node of a service finishes
    its sessions and accepts no new ones.
    """
    if (join is not None) + (service is not None) + mpi != 1:
        raise ConfigError("give exactly one of --join HOST:PORT, --mpi and --service URL")
    if program and not mpi:
        raise ConfigError(f"{program[0]!r}: only rank 0 of an MPI run has a program; add --mpi")
    if mpi:
        _be_rank(program or [], wait_s)
        return
    if service is None:
        if key_file is None:
            raise ConfigError("--join needs the key of the caller: add --key-file FILE")
        _join(str(join), key_file, wait_s)
    require("fastapi", "service")
    from cavmarl.service.node_host import NodeOptions, host_node

    options = NodeOptions(
        service=str(service),
        secret=user_secret(secret_file),
        name=name or socket.gethostname(),
        host=host,
        port=port,
        slots=slots,
        capabilities=tuple(capability or ()),
        allowed=tuple(allow or ()),
        is_supposed_idle=snapshot == "idle",
        certificate=certificate,
        key=key,
        authority=None if authority is None else str(authority),
        allow_plain_http=plain_http,
    )
    host_node(options, typer.echo)


def _join(join: str, key_file: Path, wait_s: float) -> NoReturn:
    """Host zones until the caller ends, then exit."""
    from cavmarl.parallel.nodes.joining_nodes import ANYONE
    from cavmarl.parallel.nodes.node_process import run_node
    from cavmarl.parallel.nodes.node_starters import read_key
    from cavmarl.parallel.placement.backend_name import read_address

    place, key = read_address(join), read_key(key_file)
    until_s = time.monotonic() + wait_s
    while True:
        try:
            _end(run_node(place, key, ANYONE, _note))
        except (OSError, EOFError) as error:
            if time.monotonic() > until_s:
                raise WorkerError(
                    f"no caller admitted this node at {join} within {wait_s:g} s ({error}): start "
                    "the caller, and check that the two machines can reach each other"
                ) from error
            time.sleep(AGAIN_S)


def _be_rank(program: list[str], wait_s: float) -> None:
    """Run the program if this is rank 0 of MPI; otherwise host zones until the caller ends."""
    from cavmarl.parallel.network.mpi_transport import CALLER, HOW, MPI, mpi_transport
    from cavmarl.parallel.nodes.node_process import run_node
    from cavmarl.parallel.nodes.node_system import Machine

    require("mpi4py", MPI)
    # MPI starts only when all ranks have started, and ignores signals while it waits.
    faulthandler.dump_traceback_later(wait_s, exit=True)
    transport = mpi_transport()
    faulthandler.cancel_dump_traceback_later()
    transport.wait_s = wait_s
    if transport.rank != CALLER:
        try:
            run_node((MPI, CALLER), b"", transport.rank - 1, _note, Machine(transport))
            _end(is_done=True)  # MPI itself ends all ranks if the caller fails
        except (OSError, EOFError) as error:
            raise WorkerError(f"no caller answered within {wait_s:g} s: {error}") from error
    if not program:
        raise ConfigError(f"rank {CALLER} is the caller: name its program after --mpi, or {HOW}")
    sys.argv = program
    sys.path[0] = str(Path(program[0]).resolve().parent)
    runpy.run_path(program[0], run_name="__main__")


def _note(text: str) -> None:
    Console().print(f"node {text}")


def _end(is_done: bool) -> NoReturn:
    Console().print("the caller has ended" if is_done else "the connection to the caller is lost")
    raise SystemExit(0 if is_done else 1)
