"""Makes the coordinators of a divided world, as `zones` in an environment's settings asks for."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from numpy.typing import NDArray

from cavmarl.config.zones import ZonesConfig
from cavmarl.core.errors import ConfigError
from cavmarl.handoff.coordinator.coordinator import Coordinator
from cavmarl.handoff.coordinator.coordinators import Coordinators, RowStates
from cavmarl.handoff.coordinator.handoff_log import HandoffLog
from cavmarl.handoff.coordinator.invariant_monitor import InvariantMonitor, OwnersOnRecord
from cavmarl.handoff.coordinator.journal import Journal, MemoryJournal
from cavmarl.handoff.coordinator.local_coordinator import LocalCoordinator
from cavmarl.handoff.coordinator.row_digests import RowDigests
from cavmarl.handoff.division import Division
from cavmarl.handoff.fault_injection.committed_store import CommittedStore
from cavmarl.handoff.fault_injection.fault_plan import Faults, read_faults
from cavmarl.handoff.fault_injection.injected_faults import Crashes, FaultyCoordinator, FaultyPhases
from cavmarl.handoff.fault_injection.message_coordinator import MessageCoordinator
from cavmarl.handoff.fault_injection.recovery import Recovery
from cavmarl.handoff.shard_setup import limits_of, neighbours_of
from cavmarl.ownership.directory import Directory
from cavmarl.ownership.limits import Limits
from cavmarl.ownership.messages import RUN_BYTES
from cavmarl.ownership.safeguards import ALL_ON, Safeguards
from cavmarl.ownership.transfers import TransferLog
from cavmarl.ownership.transport import Network
from cavmarl.shards.shard import Shard


class CoordinatorSetup(NamedTuple):
    """The coordinators of a divided environment."""

    coordination: Coordinators  # of all worlds
    transfers: tuple[TransferLog, ...]  # world → what became of each hand-over
    recovery: Recovery | None = None  # runs the ticks of the one world in which hosts may die
    phases: FaultyPhases | None = None  # runs the phases of its ticks
    store: CommittedStore | None = None  # its committed state


class WorldRun(NamedTuple):
    """One world's, where another process has said what it is."""

    run: bytes  # 16 bytes that no other run has
    journal: Path | None  # its file, which is there and is begun anew; None: it has none


def prepare_runs(settings: ZonesConfig, num_worlds: int) -> list[WorldRun]:
    """What `make_coordinators` chooses for each world, for processes that may do it repeatedly.

    Raises:
        JournalError: a journal cannot be begun.
    """
    runs = []
    for w in range(num_worlds):
        path = None
        if settings.journal:
            path = journal_path(settings.journal, w, num_worlds).absolute()
            Journal(path).close()
        runs.append(WorldRun(secrets.token_bytes(RUN_BYTES), path))
    return runs


def check_faults(settings: ZonesConfig, zones: int, num_worlds: int) -> tuple[Faults | None, bool]:
    """The plan of faults, and whether hosts may die by it or be given up."""
    faults = read_faults(settings.faults) if settings.faults else None
    if settings.reproducers and faults is None:
        faults = Faults()  # none on purpose
    deaths = faults is not None and (faults.may_crash or bool(settings.reproducers))
    if faults is not None:
        faults.check_zones(zones)
    if deaths and num_worlds > 1:
        raise ConfigError(
            "zones.faults and zones.reproducers: hosts die in one world at a time, not in "
            f"{num_worlds}; messages may be lost in any number"
        )
    if settings.reproducers and not Path(settings.reproducers).is_dir():
        raise ConfigError(f"zones.reproducers = {settings.reproducers!r}: no such folder; make it")
    return faults, deaths


def make_coordinators(
    settings: ZonesConfig,  # journal, faults, checks and deadlines
    shards: Sequence[Shard],  # one a zone
    division: Division,  # of them
    shared: Callable[[], Iterable[NDArray[Any]]],  # the arrays beside theirs that a tick changes
    longest_move_m: float,  # of a vehicle in a tick
    safeguards: Safeguards = ALL_ON,  # remedies of the protocol; tests take one away
    # one a world; None: they are chosen, and their journals must not be there
    runs: Sequence[WorldRun] | None = None,
) -> CoordinatorSetup:
    """The coordinators of a divided world.

    Raises:
        ConfigError: faults that cannot be, deaths in several worlds at once, or no folder for
            reproducers.
        JournalError: a journal cannot be begun.
    """
    limits = limits_of(settings, division.codec.schema)
    faults, deaths = check_faults(settings, division.count, division.num_worlds)
    crashes = Crashes(faults) if faults is not None and deaths else None
    states = [RowStates(division, w) for w in range(division.num_worlds)]
    transfers = tuple(TransferLog(limits.lifetime, known.borders) for known in states)
    coordinators = [
        _referee(
            settings,
            w,
            division,
            states[w],
            limits,
            transfers[w],
            faults,
            crashes,
            safeguards,
            None if runs is None else runs[w],
        )
        for w in range(division.num_worlds)
    ]
    digests = RowDigests() if settings.journal or deaths else None
    monitor = (
        _monitor(division, coordinators, limits, longest_move_m)
        if settings.check_invariants
        else None
    )
    dying = coordinators[0]
    if crashes is None or not isinstance(dying, MessageCoordinator):
        coordination = Coordinators(division, coordinators, states, digests, monitor=monitor)
        return CoordinatorSetup(coordination, transfers)
    store = CommittedStore(shards, shared, safeguards)
    phases = FaultyPhases(shards, crashes)
    coordination = Coordinators(division, coordinators, states, digests, store, monitor)
    recovery = Recovery(shards, coordination, dying, store, phases, crashes, limits.repeats)
    return CoordinatorSetup(coordination, transfers, recovery, phases, store)


def _referee(
    settings: ZonesConfig,
    w: int,
    division: Division,
    states: RowStates,
    limits: Limits,
    transfers: TransferLog,
    faults: Faults | None,
    crashes: Crashes | None,
    safeguards: Safeguards,
    given: WorldRun | None,
) -> Coordinator:
    """Of one world; over messages where a plan says what may be lost, and directly else."""
    run = secrets.token_bytes(RUN_BYTES) if given is None else given.run
    zones = division.count
    journal: Journal | MemoryJournal | None = None
    if given is not None and given.journal is not None:
        journal = Journal(given.journal, anew=True)
    elif settings.journal:
        journal = Journal(journal_path(settings.journal, w, division.num_worlds))
    elif crashes is not None:
        journal = MemoryJournal()
    if faults is None:
        directory = Directory(run, range(zones), states, limits, safeguards)
        counts = partial(division.counts, w)
        book = HandoffLog(division, w)
        return LocalCoordinator(directory, journal, book, counts, transfers)
    network, near = Network(faults.plan()), neighbours_of(division)
    arguments = (run, zones, states, limits, network, journal, safeguards, near)
    coordinator = (
        MessageCoordinator(*arguments)
        if crashes is None
        else FaultyCoordinator(*arguments, crashes=crashes)
    )
    coordinator.watch(transfers)
    return coordinator


def _monitor(
    division: Division, coordinators: Sequence[Coordinator], limits: Limits, longest_move_m: float
) -> InvariantMonitor:
    """The monitor of all worlds, and is told what their coordinators do."""
    is_direct = isinstance(coordinators[0], LocalCoordinator)
    near = None if is_direct else neighbours_of(division).near  # else zones may be cut anew
    records = [OwnersOnRecord(division.count, limits, is_direct, near) for _ in coordinators]
    for coordinator, record in zip(coordinators, records, strict=True):
        coordinator.watch(record)
        if isinstance(coordinator, LocalCoordinator):
            coordinator.foretell, record.ask = record.foretold, coordinator.catch_up
    return InvariantMonitor(division, records, longest_move_m)


def journal_path(journal: str, w: int, num_worlds: int) -> Path:
    """Of several worlds each has a file: `run.jsonl` becomes `run.0.jsonl` and so on."""
    path = Path(journal)
    return path if num_worlds == 1 else path.with_suffix(f".{w}{path.suffix}")
