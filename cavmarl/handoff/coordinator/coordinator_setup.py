"""Construction of the coordinators of divided worlds from the settings in `zones`."""

from __future__ import annotations

import secrets
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

from cavmarl.config.zones import ZonesConfig
from cavmarl.core.errors import ProtocolError
from cavmarl.handoff.coordinator.coordinator import Coordinator
from cavmarl.handoff.coordinator.coordinators import WorldCoordinators
from cavmarl.handoff.coordinator.handoff_log import HandoffLog
from cavmarl.handoff.coordinator.invariant_monitor import InvariantMonitor, OwnersOnRecord
from cavmarl.handoff.coordinator.journal import Journal
from cavmarl.handoff.coordinator.local_coordinator import LocalCoordinator
from cavmarl.handoff.coordinator.message_coordinator import MessageCoordinator, ZoneGate
from cavmarl.handoff.coordinator.row_digests import RowDigests
from cavmarl.handoff.division import ZonedShards
from cavmarl.handoff.shard_setup import limits_of
from cavmarl.ownership.directory import Directory
from cavmarl.ownership.limits import Limits
from cavmarl.ownership.messages import RUN_BYTES
from cavmarl.ownership.transfers import TransferLog


class CoordinatorSetup(NamedTuple):
    """The coordinators of a divided environment."""

    coordination: WorldCoordinators  # coordinators of all worlds
    transfers: tuple[TransferLog, ...]  # log of transfers of each world


class WorldRun(NamedTuple):
    """The id and the journal of one world's run, chosen by another process."""

    run: bytes  # 16 bytes, a unique id
    journal: Path | None  # an existing file, which is overwritten; None: no journal


class OpenRun(NamedTuple):
    """The id and the open journal of one world's run; a fork of this process may write it."""

    run: bytes
    journal: Journal | None

    @classmethod
    def of(cls, run: WorldRun) -> OpenRun:
        """Open the journal of a run. Raises JournalError if it cannot be opened."""
        journal = None if run.journal is None else Journal(run.journal, anew=True)
        return cls(run.run, journal)


def prepare_runs(settings: ZonesConfig, num_worlds: int) -> list[WorldRun]:
    """Choose the id and the journal of each world, for processes that make coordinators repeatedly.

    Raises:
        JournalError: a journal cannot be created.
    """
    runs = []
    for w in range(num_worlds):
        path = None
        if settings.journal:
            path = journal_path(settings.journal, w, num_worlds).absolute()
            Journal(path).close()
        runs.append(WorldRun(secrets.token_bytes(RUN_BYTES), path))
    return runs


def make_coordinators(
    settings: ZonesConfig,  # journal, checks and deadlines
    division: ZonedShards,
    longest_move_m: float,  # longest move of a vehicle in a tick
    # run of each world; None: new runs, whose journals must not exist
    runs: Sequence[OpenRun] | None = None,
    gate: ZoneGate | None = None,  # the simulators that run zones; None: there are none
) -> CoordinatorSetup:
    """Make the coordinators of divided worlds.

    Raises:
        JournalError: a journal cannot be created.
    """
    limits = limits_of(settings, division.codec.schema)
    # Without simulators, the kernels of changes of owner measure the time.
    clock = None if gate is None else time.perf_counter
    transfers = tuple(TransferLog(limits.lifetime, clock) for _ in range(division.num_worlds))
    coordinators = [
        _coordinator(
            settings, w, division, limits, transfers[w], None if runs is None else runs[w], gate
        )
        for w in range(division.num_worlds)
    ]
    digests = RowDigests() if settings.journal else None
    monitor = (
        _monitor(division, coordinators, limits, longest_move_m)
        if settings.check_invariants
        else None
    )
    return CoordinatorSetup(WorldCoordinators(division, coordinators, digests, monitor), transfers)


class _OwnersRows:
    """States of vehicles where zones share a process: the new owner copies the old owner's row."""

    def digest_of(self, vehicle: int) -> bytes:
        return self.state(vehicle)

    def state(self, vehicle: int) -> bytes:
        raise ProtocolError(f"vehicle {vehicle}: zones of one process send no states")


def _coordinator(
    settings: ZonesConfig,
    w: int,
    division: ZonedShards,
    limits: Limits,
    transfers: TransferLog,
    given: OpenRun | None,
    gate: ZoneGate | None,
) -> Coordinator:
    """Make the coordinator of one world."""
    if given is None:
        journal = None
        if settings.journal:
            journal = Journal(journal_path(settings.journal, w, division.num_worlds))
        given = OpenRun(secrets.token_bytes(RUN_BYTES), journal)
    if gate is not None:
        return MessageCoordinator(given.run, given.journal, division, w, limits, transfers, gate)
    directory = Directory(given.run, range(division.count), _OwnersRows(), limits)
    counts = partial(division.counts, w)
    return LocalCoordinator(directory, given.journal, HandoffLog(division, w), counts, transfers)


def _monitor(
    division: ZonedShards,
    coordinators: Sequence[Coordinator],
    limits: Limits,
    longest_move_m: float,
) -> InvariantMonitor:
    """Make the monitor of all worlds, and let the coordinators send their records to it."""
    records = [OwnersOnRecord(division.count, limits) for _ in coordinators]
    for coordinator, record in zip(coordinators, records, strict=True):
        coordinator.watch(record)
        if isinstance(coordinator, LocalCoordinator):
            coordinator.foretell, record.ask = record.foretold, coordinator.catch_up
    return InvariantMonitor(division, records, longest_move_m)


def journal_path(journal: str, w: int, num_worlds: int) -> Path:
    """Return the journal of world `w`; with several worlds, `run.0.jsonl` for `run.jsonl` etc."""
    path = Path(journal)
    return path if num_worlds == 1 else path.with_suffix(f".{w}{path.suffix}")
