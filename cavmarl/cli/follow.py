"""`cavmarl follow`: drives agents of a world that another process runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from rich.console import Console
from rich.table import Table

from cavmarl.cli.lead import DEFAULT_PLACE, SecretFile, address_of, read_secret
from cavmarl.cli.output import (
    Environment,
    Imports,
    JsonPath,
    Settings,
    about,
    grid,
    parse_settings,
    write_json,
)
from cavmarl.core.errors import ConfigError


def follow(
    env: Environment,
    at: Annotated[
        str, about("Unix socket or port of the world.", "--at", metavar="ADDRESS")
    ] = DEFAULT_PLACE,
    vehicles: Annotated[
        str, about("Agents to drive, comma-separated.", metavar="NAME,…")
    ] = "car_0",
    name: Annotated[str, about("Name of this follower in messages.", metavar="NAME")] = "reference",
    stage: Annotated[
        list[str] | None,
        about(
            "Replace a stage of the driving stack. Repeat it for more stages.", metavar="STAGE=NAME"
        ),
    ] = None,
    cloud: Annotated[
        Path | None,
        about("Point-cloud map for localisation=scan_matching.", metavar="FILE", exists=True),
    ] = None,
    settings: Settings = None,
    imports: Imports = None,
    joins_s: Annotated[float, about("Seconds to wait for the world.", metavar="S")] = 60.0,
    secret_file: SecretFile = None,
    json_path: JsonPath = None,
) -> None:
    """Drive agents of a world that `cavmarl lead` runs.

    The reference driving stack uses the sensors of the agents and the map of ENV.
    """
    from cavmarl.config.registry import load_config
    from cavmarl.cosim.followers.follower_client import Follower
    from cavmarl.cosim.followers.follower_driver import StackDriver
    from cavmarl.cosim.stack.stack import STAGES, StackConfig
    from cavmarl.engine.world_setup import load_roads

    config = StackConfig(**_stages(stage or [], tuple(STAGES)), cloud=cloud)
    network = load_roads(*load_config(env, overrides=parse_settings(settings, imports)))
    steps = 0
    secret = read_secret(secret_file)
    with Follower(address_of(at), vehicles.split(","), name, joins_s, secret) as follower:
        driver = StackDriver(network, follower.welcome, config)
        for sight in follower:
            if not sight.snapshot.is_over:
                steps += 1
                follower.answer(driver.drive(sight))
    found = {"steps": steps, "stages": driver.report()}
    Console().print(_table(found))
    write_json(json_path, found)


def _stages(words: list[str], known: tuple[str, ...]) -> dict[str, str]:
    chosen = {}
    for word in words:
        stage, equals, name = word.partition("=")
        if not equals or stage not in known:
            raise ConfigError(f"--stage {word}: must be STAGE=NAME; stages are {', '.join(known)}")
        chosen[stage] = name
    return chosen


def _table(found: dict[str, Any]) -> Table:
    rows = (
        (stage, f"{row['mean_wall_ms']:.2f}", f"{row['worst_wall_ms']:.2f}")
        for stage, row in found["stages"].items()
    )
    return grid(("stage", "mean, ms", "worst, ms"), rows, f"{found['steps']} steps")
