"""The message from which another process makes the same world."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from cavmarl.config.env import EnvConfig
from cavmarl.core.errors import WorkerError
from cavmarl.core.extensions import extension_modules, load_plugins
from cavmarl.engine.world_setup import World, make_world
from cavmarl.networks.background_driver import background_drivers

CHANGED = "have changed while workers were starting: try again"


def make_world_message(world: World, base_dir: Path, **more: Any) -> dict[str, Any]:
    """Return the message of a world, a JSON value, with further entries."""
    return {
        "config": asdict(world.config),
        "extensions": extension_modules(world.config.registered, world.config.plugins),
        "base_dir": str(base_dir.resolve()),
        "fingerprint": fingerprint(world),
        **more,
    }


def world_of(message: Mapping[str, Any], trouble: str = "") -> World:
    """Make the world of a message.

    Args:
        message: made by `make_world_message`.
        trouble: text for the error if files of the world differ; empty: do not compare.

    Raises:
        CavmarlError: the files cannot be read.
        WorkerError: the files differ.
    """
    from cavmarl.config.io import validate  # pydantic is slow to import

    load_plugins(message["extensions"], WorkerError)
    config = validate(EnvConfig, message["config"], "the environment")
    world = make_world(config, Path(message["base_dir"]))
    if trouble and fingerprint(world) != message["fingerprint"]:
        raise WorkerError(f"the files of '{config.name}' {trouble.format(message['base_dir'])}")
    return world


def fingerprint(world: World) -> str:
    """Return a text that differs if a file of the world has changed."""
    drivers = background_drivers(world.config.traffic)
    made_of = (world.network, world.demand, world.partition, *drivers)
    return " ".join("none" if part is None else part.content_hash for part in made_of)
