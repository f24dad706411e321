"""`cavmarl carla`: lets programs for CARLA use a world."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from rich.console import Console

from cavmarl.cli.output import SERVICE, about, flag, with_world
from cavmarl.config.world_spec import WorldSpec

if TYPE_CHECKING:
    from cavmarl.cosim.carla import CarlaServer


@with_world("agents", "background", "seed", "settings")
def carla(
    world: WorldSpec,
    port: Annotated[
        int,
        about("Port for RPC calls; streams use the next port.", metavar="N", panel=SERVICE),
    ] = 2000,
    host: Annotated[
        str, about("Address to listen on.", metavar="HOST", panel=SERVICE)
    ] = "127.0.0.1",
    any_host: Annotated[
        bool,
        flag(
            "Allow an address that other machines can reach. The protocol has no login.",
            panel=SERVICE,
        ),
    ] = False,
    client_version: Annotated[
        str, about("Version of the clients: 0.9.15, 0.9.16 or 0.10.0.", metavar="VERSION")
    ] = "0.9.16",
    other_ticks: Annotated[
        Literal["obey", "refuse", "follow"],
        about(
            "The first client that ticks leads. If another client ticks, the world advances "
            "(obey), that client gets an error (refuse), or that client waits for the next tick "
            "of the leading client (follow)."
        ),
    ] = "obey",
    recordings: Annotated[
        Path, about("Folder of the recordings that clients make.", metavar="FOLDER")
    ] = Path("runs/carla"),
    max_clients: Annotated[
        int, about("Maximum number of clients at the same time.", metavar="N", panel=SERVICE)
    ] = 64,
    max_actors: Annotated[
        int, about("Maximum number of actors that clients spawn.", metavar="N", panel=SERVICE)
    ] = 1024,
    max_message_mb: Annotated[
        int, about("Maximum size of a message of a client.", metavar="MB", panel=SERVICE)
    ] = 64,
    max_unsent_mb: Annotated[
        int,
        about("Maximum size of data queued for a slow client.", metavar="MB", panel=SERVICE),
    ] = 64,
) -> None:
    """Let programs for CARLA use a world, through CARLA's own client, until interrupted."""
    from cavmarl.cosim.carla import SessionLimits, serve

    console = Console()
    limits = SessionLimits(
        max_message=max_message_mb << 20,
        max_clients=max_clients,
        max_actors=max_actors,
        max_unsent=max_unsent_mb << 20,
    )

    def tell(server: CarlaServer) -> None:
        map_path = server.session.map.path
        console.print(f"{map_path} at {host}:{server.port}, for client {client_version}")

    serve(
        world,
        port=port,
        host=host,
        any_host=any_host,
        client=client_version,
        limits=limits,
        other_ticks=other_ticks,
        recordings=recordings,
        told=tell,
    )
