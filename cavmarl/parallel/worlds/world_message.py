"""What a process is told of the worlds that it is to run, and what it makes of that."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from cavmarl.config.env import EnvConfig
from cavmarl.core.errors import WorkerError
from cavmarl.core.extensions import extension_modules, load_extensions
from cavmarl.engine.world_setup import World, make_world

CHANGED = "have changed while workers were started: try again"


def make_world_message(world: World, base_dir: Path, **more: Any) -> dict[str, Any]:
    """The message of a world, and more, as JSON knows it."""
    return {
        "config": asdict(world.config),
        "extensions": extension_modules(world.config.registered),
        "base_dir": str(base_dir.resolve()),
        "fingerprint": fingerprint(world),
        **more,
    }


def world_of(message: Mapping[str, Any], trouble: str = "") -> World:
    """The world of a message, made anew; `trouble` says what it means if its files differ.

    Raises:
        CavmarlError: they cannot be read.
    """
    from cavmarl.config.io import validate  # pydantic is slow to import

    load_extensions(message["extensions"])
    config = validate(EnvConfig, message["config"], "the environment")
    world = make_world(config, Path(message["base_dir"]))
    if trouble and fingerprint(world) != message["fingerprint"]:
        raise WorkerError(f"the files of '{config.name}' {trouble.format(message['base_dir'])}")
    return world


def fingerprint(world: World) -> str:
    """Differs between two readings of the same files if one was changed in between."""
    made_of = (world.network, world.demand, world.partition)
    return " ".join("none" if part is None else part.content_hash for part in made_of)
