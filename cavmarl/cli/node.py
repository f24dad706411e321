"""`cavmarl node`: hosts zones of one world, or worlds for a coordination service."""

from __future__ import annotations

import socket
import time
from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.console import Console

from cavmarl.cli.output import about
from cavmarl.cli.service import Authority, Certificate, Key, SecretFile, read_secret
from cavmarl.core.errors import ConfigError, WorkerError, require

AGAIN_S = 0.5  # between two calls while no caller listens


def node(
    join: Annotated[
        str | None, about("Where the caller of a world listens.", "--join", metavar="HOST:PORT")
    ] = None,
    key_file: Annotated[
        Path | None, about("With --join: file with the key that the caller has, too.")
    ] = None,
    wait_s: Annotated[
        float, about("With --join: seconds that the caller may take to listen.")
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
    """Host zones of a world until its caller ends (--join), or work for a service (--service).

    Exit code 1: the caller is gone. SIGTERM drains a node of a service.
    """
    if (join is None) == (service is None):
        raise ConfigError("give one of --join HOST:PORT and --service URL")
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


def _join(join: str, key_file: Path, wait_s: float) -> None:
    """Host zones until the caller ends; it does not return."""
    from cavmarl.parallel.backend_name import read_address
    from cavmarl.parallel.nodes.newcomers import ANYONE
    from cavmarl.parallel.nodes.node_process import run_node
    from cavmarl.parallel.nodes.node_starters import read_key

    place, key = read_address(join), read_key(key_file)
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
