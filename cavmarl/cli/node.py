"""`cavmarl node`: hosts zones of one world, or worlds for a coordination service."""

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

from cavmarl.cli.output import about
from cavmarl.cli.service import Authority, Certificate, Key, SecretFile, read_secret
from cavmarl.core.errors import ConfigError, WorkerError, require

AGAIN_S = 0.5  # between two calls while no caller listens


def node(
    program: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="PROGRAM", help="With --mpi: what rank 0 runs, with its own options behind it."
        ),
    ] = None,
    join: Annotated[
        str | None, about("Where the caller of a world listens.", "--join", metavar="HOST:PORT")
    ] = None,
    key_file: Annotated[
        Path | None, about("With --join: file with the key that the caller has, too.")
    ] = None,
    mpi: Annotated[
        bool, about("Be a rank of an MPI run, whose rank 0 is the caller.", "--mpi")
    ] = False,
    wait_s: Annotated[
        float, about("With --join and --mpi: seconds that the caller may take to listen.")
    ] = 300.0,
    service: Annotated[
        str | None, about("URL of a coordination service.", "--service", metavar="URL")
    ] = None,
    name: Annotated[str | None, about("Name of the node; default: the machine's.")] = None,
    host: Annotated[str, about("Address that clients reach it at.")] = "127.0.0.1",
    port: Annotated[int, about("Port of clients; 0: any.", min=0, max=65535)] = 0,
    slots: Annotated[int, about("Sessions and jobs at most.", min=1)] = 4,
    capability: Annotated[
        list[str] | None, about("What sessions can ask for; may be repeated.")
    ] = None,
    allow: Annotated[
        list[str] | None, about("Names of identities that it serves; default: all.")
    ] = None,
    snapshot: Annotated[
        Literal["measured", "idle"], about("Load that it tells: this machine's, or none.")
    ] = "measured",
    secret_file: SecretFile = None,
    certificate: Certificate = None,
    key: Key = None,
    authority: Authority = None,
) -> None:
    """Host zones of a world until its caller ends (--join, --mpi), or work for a service.

    Exit code 1: the caller is gone. SIGTERM drains a node of a service.
    """
    if (join is not None) + (service is not None) + mpi != 1:
        raise ConfigError("give one of --join HOST:PORT, --mpi and --service URL")
    if program and not mpi:
        raise ConfigError(f"{program[0]!r}: only rank 0 of MPI (--mpi) runs a program")
    if mpi:
        _be_rank(program or [], wait_s)
        return
    if service is None:
        if key_file is None:
            raise ConfigError("--join needs --key-file, the file with the caller's key")
        _join(str(join), key_file, wait_s)
    require("fastapi", "service")
    from cavmarl.service.node_host import NodeOptions, host_node

    options = NodeOptions(
        service=str(service),
        secret=read_secret(secret_file),
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
    )
    host_node(options, typer.echo)


def _join(join: str, key_file: Path, wait_s: float) -> NoReturn:
    """Host zones until the caller ends; it does not return."""
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
                    f"no caller lets this node in at {join} within {wait_s:g} s ({error}): start "
                    "the caller, and look whether the two can reach each other"
                ) from error
            time.sleep(AGAIN_S)


def _be_rank(program: list[str], wait_s: float) -> None:
    """Run the program as rank 0 of MPI; as another one host zones until the caller ends."""
    from cavmarl.parallel.network.mpi_transport import CALLER, HOW, MPI, mpi_transport
    from cavmarl.parallel.nodes.node_process import run_node
    from cavmarl.parallel.nodes.node_system import Machine

    require("mpi4py", MPI)
    # MPI begins when all ranks have begun, and waits for them so that no signal is heard.
    faulthandler.dump_traceback_later(wait_s, exit=True)
    transport = mpi_transport()
    faulthandler.cancel_dump_traceback_later()
    transport.wait_s = wait_s
    if transport.rank != CALLER:
        try:
            run_node((MPI, CALLER), b"", transport.rank - 1, _note, Machine(transport))
            _end(is_done=True)  # a caller that does not end by itself is MPI's affair
        except (OSError, EOFError) as error:
            raise WorkerError(f"no caller is there within {wait_s:g} s: {error}") from error
    if not program:
        raise ConfigError(f"rank {CALLER} is the caller: name its program behind --mpi, or {HOW}")
    sys.argv = program
    sys.path[0] = str(Path(program[0]).resolve().parent)
    runpy.run_path(program[0], run_name="__main__")


def _note(text: str) -> None:
    Console().print(f"node {text}")


def _end(is_done: bool) -> NoReturn:
    Console().print("the caller has ended" if is_done else "the caller is gone")
    raise SystemExit(0 if is_done else 1)
