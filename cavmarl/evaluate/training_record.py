"""The manifest of a training run: what a driver was trained with, beside its checkpoint.

It is written before the first update and closed after the last one, with the hashes of what the run
left; a run that died has an open one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cavmarl.errors import ManifestError
from cavmarl.evaluate.manifest import (
    MANIFEST_FILE,
    close_manifest,
    describe_world,
    open_manifest,
    read_closed,
)
from cavmarl.runtime.simulation import Simulation
from cavmarl.worlds import World

__all__ = ["begin_training", "end_training", "is_trained"]


def begin_training(
    folder: Path, program: str, settings: Mapping[str, Any], world: World | Simulation
) -> None:
    """Put on record what is about to be trained, in place of the record of an earlier run there.

    Args:
        folder: of the run; it exists.
        program: that trains.
        settings: its own, whole; `seed` is one of them.
        world: that it learns in, or many of it.
    """
    (folder / MANIFEST_FILE).unlink(missing_ok=True)
    open_manifest(
        folder,
        {
            "program": program,
            "settings": dict(settings),
            "seeds": [settings["seed"]],
            "world": describe_world(world.config, world.network, world.demand, world.partition),
        },
    )


def end_training(folder: Path, files: Sequence[str]) -> None:
    """Close the record with the hashes of the `files` that the run left beside it."""
    close_manifest(folder, list(files))


def is_trained(folder: Path) -> bool:
    """Whether a run has ended there and its files are what it left."""
    try:
        read_closed(folder)
    except ManifestError:
        return False
    return True
