"""`cavmarl node`: a process that hosts worlds for a coordination service."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Annotated, Literal

import typer

from cavmarl.cli.output import about
from cavmarl.cli.service import Authority, Certificate, Key, SecretFile, read_secret
from cavmarl.core.errors import require


def node(
    service: Annotated[str, about("URL of the service.", "--service", metavar="URL")],
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
    """Host worlds and evaluations for a service; SIGTERM drains it."""
    require("fastapi", "service")
    from cavmarl.service.node_host import NodeOptions, host_node

    options = NodeOptions(
        service=service,
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
        authority=None if authority is None else str(Path(authority)),
    )
    host_node(options, typer.echo)
