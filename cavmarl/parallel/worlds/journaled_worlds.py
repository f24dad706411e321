"""Worlds with a journal: where they can run, and what workers receive."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from cavmarl.config.zones import ZonesConfig
from cavmarl.core.errors import ConfigError
from cavmarl.engine.world_setup import World
from cavmarl.handoff.coordinator.coordinator_setup import OpenRun, WorldRun, prepare_runs

RunText = tuple[str, str]  # the run in hex, and its journal; empty: it has none


def without_journals(world: World) -> World:
    """The same world without a journal, to make tables, copies or load kernels with."""
    zones = replace(world.config.zones, journal="")
    return world._replace(config=replace(world.config, zones=zones))


def refuse_journal(zones: ZonesConfig, where: str, cure: str) -> None:
    """Refuse a journal where none can be written.

    Raises:
        ConfigError: there is one.
    """
    if zones.journal:
        raise ConfigError(f"zones.journal = {zones.journal!r} {where}: {cure}")


def runs_as_text(zones: ZonesConfig, num_worlds: int) -> list[RunText]:
    """What the workers are told of all worlds; journals are begun.

    Raises:
        JournalError: one cannot be.
    """
    if not zones.journal:
        return []
    return [
        (run.hex(), "" if journal is None else str(journal))
        for run, journal in prepare_runs(zones, num_worlds)
    ]


def open_runs(texts: Sequence[RunText]) -> list[OpenRun]:
    """The same of all worlds, with the journals open for the workers that are forked.

    Raises:
        JournalError: one cannot be opened.
    """
    return [
        OpenRun.of(WorldRun(bytes.fromhex(run), Path(journal) if journal else None))
        for run, journal in texts
    ]
