"""Keeps a tick that no host survives, so that it can be run again."""

from __future__ import annotations

import platform
import secrets
import tempfile
from collections.abc import Mapping
from dataclasses import asdict, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import NamedTuple

from cavmarl.config.env import EnvConfig
from cavmarl.core.compiled import sources_digest
from cavmarl.core.errors import LostTickError, ProtocolError
from cavmarl.handoff.coordinator.coordinator import Coordinator
from cavmarl.handoff.fault_injection.committed_store import CommittedStore
from cavmarl.handoff.fault_injection.fault_plan import read_faults
from cavmarl.handoff.fault_injection.reproducer_file import Reproducer, needed_records
from cavmarl.roads.network import RoadNetwork
from cavmarl.shards.shard import Commands
from cavmarl.traffic.demand import DemandFile
from cavmarl.traffic.sumo.sumo_demand import SumoDemand
from cavmarl.zones.partition.zone_partition import ZonePartition


class RecordedTick(NamedTuple):
    """A tick among all ticks."""

    seed: int  # root of all random numbers
    first_world: int  # number of the world among all worlds of the seed
    episode: int  # number of the world's episode since the seed, from 1 on
    commands: Commands  # of the agents
    is_first: bool  # whether the tick begins a step
    is_last: bool  # whether it ends one


class Keeper:
    """Writes reproducers of one world."""

    def __init__(
        self,
        config: EnvConfig,
        sources: Mapping[str, str | None],  # hashes of what it names
        store: CommittedStore,  # the committed state
        coordinator: Coordinator,
    ) -> None:
        self._config = config
        self._sources = sources
        self._store = store
        self._coordinator = coordinator

    def keep(self, error: LostTickError, moment: RecordedTick) -> Path | str:
        """Write a file from which the tick can be run again.

        Returns:
            the file, or why there is none: another error is on its way already.
        """
        journal = self._coordinator.journal
        if journal is None:
            raise ProtocolError("a world whose hosts may die has a journal")
        reproducer = Reproducer(
            made_with(),
            asdict(_portable(self._config)),
            self._sources,
            **moment._asdict(),
            tick=error.tick,
            zone=error.zone,
            cause=str(error),
            records=needed_records(journal.read()),
            image=self._store.truth(),
        )
        place = Path(self._config.zones.reproducers or tempfile.gettempdir())
        of = "coordinator" if error.zone is None else f"zone-{error.zone}"
        path = place / f"cavmarl-tick-{error.tick}-{of}-{secrets.token_hex(4)}.json"
        try:
            reproducer.write(path)
        except OSError as failure:
            return f"{path} cannot be written ({failure.strerror})"
        return path


def made_with() -> dict[str, str | None]:
    """Versions of what runs a world; None of what is not installed as a package."""
    return {
        **{name: _version(name) for name in ("cavmarl", "numpy", "numba")},
        "python": platform.python_version(),
        "machine": platform.machine(),
        "kernels": sources_digest(),
    }


def sources_of(
    network: RoadNetwork, demand: DemandFile | SumoDemand | None, partition: ZonePartition
) -> dict[str, str | None]:
    """Hashes of what a configuration names and does not hold."""
    return {
        "map": network.content_hash,
        "demand": None if demand is None else demand.content_hash,
        "zones": partition.content_hash,
    }


def _portable(config: EnvConfig) -> EnvConfig:
    """The environment with its faults in it, and without monitors."""
    zones = config.zones
    faults = read_faults(zones.faults).to_json() if zones.faults else ""
    return replace(config, zones=replace(zones, faults=faults, journal="", check_invariants=False))


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
