"""Worlds with a journal: the backends that support it, and what workers receive."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from cavmarl.config.zones import ZonesConfig
from cavmarl.core.errors import ConfigError
from cavmarl.engine.world_setup import World
from cavmarl.handoff.coordinator.coordinator_setup import OpenRun, WorldRun, prepare_runs

RunText = tuple[str, str]  # the run in hex, and the path of its journal; "": no journal


def without_journals(world: World) -> World:
    """Return the world without a journal, for tables, copies and the loading of kernels."""
    zones = replace(world.config.zones, journal="")
    return world._replace(config=replace(world.config, zones=zones))


def refuse_journal(zones: ZonesConfig, where: str, cure: str) -> None:
    """Refuse a journal where it is not supported.

    Raises:
        ConfigError: the configuration names a journal.
    """
    if zones.journal:
        raise ConfigError(f"zones.journal = {zones.journal!r} {where}: {cure}")


def runs_as_text(zones: ZonesConfig, num_worlds: int) -> list[RunText]:
    """Create the journals of all worlds, and return what workers need to open them.

    Raises:
        JournalError: a journal cannot be created.
    """
    if not zones.journal:
        return []
    return [
        (run.hex(), "" if journal is None else str(journal))
        for run, journal in prepare_runs(zones, num_worlds)
    ]


def open_runs(texts: Sequence[RunText]) -> list[OpenRun]:
    """Open the journals of `runs_as_text`; forked workers inherit the open files.

    Raises:
        JournalError: a journal cannot be opened.
    """
    return [
        OpenRun.of(WorldRun(bytes.fromhex(run), Path(journal) if journal else None))
        for run, journal in texts
    ]
