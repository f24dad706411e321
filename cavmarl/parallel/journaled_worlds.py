"""Worlds with a journal: where they can run, and what workers receive."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from cavmarl.config.zones import ZonesConfig
from cavmarl.core.errors import ConfigError
from cavmarl.engine.world_setup import World
from cavmarl.handoff.coordinator.coordinator_setup import WorldRun, prepare_runs
from cavmarl.parallel.work_shares import Part

RunText = tuple[str, str]  # the run in hex, and its journal; empty: it has none


def is_watched(zones: ZonesConfig) -> bool:
    """Whether what coordinators do is written down, beside the results."""
    return bool(zones.journal)


def unwatched(world: World) -> World:
    """The same world without that, to make tables or load kernels with."""
    zones = replace(world.config.zones, journal="")
    return world._replace(config=replace(world.config, zones=zones))


def refuse_watched(zones: ZonesConfig, where: str, cure: str) -> None:
    """Refuse what only the workers of whole worlds on this machine can have."""
    if zones.journal:
        raise ConfigError(f"zones.journal = {zones.journal!r} {where}: {cure}")


def check_watched(world: World, parts: Sequence[Part], may_change: bool) -> None:
    """See that worlds with a journal can be run by these workers.

    Raises:
        ConfigError: a world is divided among workers, or moves.
    """
    zones = world.config.zones
    if not is_watched(zones):
        return
    num_worlds = parts[-1].last
    if any(len(part.zones) > 1 for part in parts):
        refuse_watched(
            zones,
            "of one world over several workers",
            "its coordinator has to share a process with all zones; use at most "
            f"workers={num_worlds}",
        )
    if may_change:
        refuse_watched(
            zones,
            "of worlds that move from worker to worker",
            "a journal stays in its process; leave workers.balance_steps 0",
        )


def runs_as_text(zones: ZonesConfig, num_worlds: int) -> list[RunText]:
    """What the workers are told of all worlds; journals are begun.

    Raises:
        JournalError: one cannot be.
    """
    if not is_watched(zones):
        return []
    return [
        (run.hex(), "" if journal is None else str(journal))
        for run, journal in prepare_runs(zones, num_worlds)
    ]


def runs_of(texts: Sequence[RunText], part: Part) -> list[WorldRun]:
    """The same of the worlds of one worker."""
    return [
        WorldRun(bytes.fromhex(run), Path(journal) if journal else None)
        for run, journal in texts[part.first : part.last]
    ]
