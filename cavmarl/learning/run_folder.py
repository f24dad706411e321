"""`RunFolder`: the files of a run. One process writes at a time; no other run overwrites them."""

from __future__ import annotations

import hashlib
import json
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Protocol, Self, TypeVar

from cavmarl.balance.balance_plan import Plan
from cavmarl.config.driver_form import CONFIG_FILE, WEIGHTS_FILE
from cavmarl.config.io import validate
from cavmarl.core.atomic_file import remove_dead_drafts
from cavmarl.core.errors import ConfigError, TrainingError
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.world_setup import World
from cavmarl.evaluate.provenance.manifest import MANIFEST_FILE
from cavmarl.evaluate.provenance.training_record import (
    CHECKPOINT_FILE,
    CSV_FILE,
    begin_training,
    end_training,
    is_trained,
)
from cavmarl.learning.actor_critic import ActorCritic, save_network
from cavmarl.learning.checkpoint import (
    Parts,
    RunState,
    random_states,
    read_checkpoint,
    set_random_states,
    write_checkpoint,
    writing,
)
from cavmarl.learning.data_parallel import ALONE, Ranks
from cavmarl.learning.log import Log, cut_logs
from cavmarl.learning.loggers import logger_names
from cavmarl.learning.options import given_options, settings_of
from cavmarl.networks.background_driver import background_drivers
from cavmarl.networks.network_files import NetworkConfig
from cavmarl.roads.road_kinds import road_kinds

if sys.platform != "win32":
    import fcntl

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    class RunSettings(DataclassInstance, Protocol):
        """Settings of a program."""

        # Optional: resume, loggers, checkpoint_updates, total_agent_steps, minutes.

        program: ClassVar[str]

        @property
        def folder(self) -> Path: ...


LOCK_FILE = ".lock"  # contains the id of the process that writes here or did so last
DRIVER_FILES = (WEIGHTS_FILE, CONFIG_FILE, CSV_FILE)

# Settings that may change when a run is resumed.
CAN_CHANGE = frozenset(
    "total_agent_steps minutes resume threads device zones backend workers loggers "
    "checkpoint_updates".split()
)

S = TypeVar("S", bound="RunSettings")


def parse_run(kind: type[S], words: Sequence[str] | None, text: str | None) -> S:
    """Parse settings as `options.parse_settings`; a resumed run keeps its own settings."""
    given = given_options(kind, words, text)
    if not given.get("resume"):
        return settings_of(kind, given)
    given.pop("config", None)
    if refused := given.keys() - CAN_CHANGE:
        names = ", ".join(f"--{name.replace('_', '-')}" for name in sorted(refused))
        raise ConfigError(f"{names}: cannot change when a run is resumed")
    folder = Path(given["resume"])
    state = read_checkpoint(folder)
    if state.program != kind.program:
        raise ConfigError(f"--resume {folder}: is a run of {state.program}; use that program")
    return replace(validate(kind, state.settings, CHECKPOINT_FILE), **given)


class RunFolder:
    """The folder of a run and its files; only one process at a time may use it.

    Args:
        settings: settings of the run; a non-empty `resume` continues the run.
        world: the environment of the training.
        plans: assignment of shards to workers.
        ranks: the processes of the run; the first one writes the files.

    Raises:
        ConfigError: the resumed run had another number of processes.
        TrainingError: another process uses the folder, it contains a run and `resume` is empty,
            the run cannot be resumed, or the folder cannot be written.
    """

    def __init__(
        self,
        settings: RunSettings,
        world: World | Simulation,
        plans: Sequence[Plan] = (),
        ranks: Ranks = ALONE,
    ) -> None:
        self.path = path = settings.folder
        self._settings, self._ranks = settings, ranks
        self._environment = _digest(world)
        self._maps = road_kinds(world.network)
        self._lock: int | None = None
        resumes = bool(getattr(settings, "resume", ""))
        if ranks.rank:
            self.began = self._read() if resumes else RunState(settings.program, {}, "")
            self._began_at = time.perf_counter()
            return
        try:
            path.mkdir(parents=True, exist_ok=True)
            self._lock = _locked(path)
        except OSError as error:
            raise TrainingError(
                f"{path}: cannot be written ({error.strerror or error}); give another --runs"
            ) from error
        try:
            self.began = self._read() if resumes else RunState(settings.program, {}, "")
            if not resumes:
                refuse_begun(path, hasattr(settings, "resume"))
            remove_dead_drafts(path)
            with writing(path / MANIFEST_FILE):
                if resumes:
                    cut_logs(path, self.began.logs)
                begin_training(path, settings.program, asdict(settings), world, plans)
        except BaseException:
            self.close()
            raise
        self._began_at = time.perf_counter()

    def _read(self) -> RunState:
        state, settings = read_checkpoint(self.path), self._settings
        if state.environment != self._environment:
            raise TrainingError(
                f"--resume {self.path}: the environment has changed since that run; restore its "
                "files, or train again under another --name"
            )
        if (size := 1 + len(state.shares)) != self._ranks.size:
            raise ConfigError(
                f"--resume {self.path}: the run has {size} processes, not {self._ranks.size}; "
                + ("start it without torchrun" if size == 1 else f"torchrun has to start {size}")
            )
        if is_trained(self.path):
            total, minutes = (
                getattr(settings, name, 0) for name in ("total_agent_steps", "minutes")
            )
            if total and state.agent_steps >= total:
                raise ConfigError(
                    f"--total-agent-steps {total}: the run has {state.agent_steps}; ask for more"
                )
            if minutes and state.seconds >= 60.0 * minutes:
                raise ConfigError(
                    f"--minutes {minutes:g}: the run has {state.seconds / 60.0:.3g}; ask for more"
                )
        return state

    @cached_property
    def log(self) -> Log:
        names = logger_names(getattr(self._settings, "loggers", ""))
        return Log(self.path, names, asdict(self._settings))

    @property
    def seconds(self) -> float:
        """Training time of the run, without breaks before it was resumed."""
        return self.began.seconds + time.perf_counter() - self._began_at

    def has_time(self, minutes: float) -> bool:
        """Return whether the run has taken less than this time; 0: no limit."""
        return not minutes or self.seconds < 60.0 * minutes

    def resume(self) -> Parts:
        """Restore all random states, and return the parts of the program's state given to `save`.

        A new run has no parts. Starts the clock of the run.
        """
        self._began_at = time.perf_counter()
        state = self.began
        parts, random = state.parts, state.random
        if self._ranks.rank and state.shares:
            share = state.shares[self._ranks.rank - 1]
            parts, random = {**parts, **share["parts"]}, share["random"]
        if random:
            set_random_states(random)
        return parts

    def is_due(self, updates: int) -> bool:
        """Return whether a checkpoint is due after this number of updates."""
        every: int = getattr(self._settings, "checkpoint_updates", 1)
        return updates % every == 0

    def save(self, agent_steps: int, updates: int, parts: Parts) -> None:
        """Replace the checkpoint by a new one; all processes call this.

        When a process other than the first resumes, it gets the parts of the first process, but its
        own parts replace those with the same name.

        Raises:
            TrainingError: it cannot be written; the previous one is intact.
        """
        shares = self._ranks.gather_in_first({"random": random_states(), "parts": parts})
        if self._ranks.rank:
            return
        settings = {**asdict(self._settings), "resume": ""}
        state = RunState(
            self._settings.program,
            settings,
            self._environment,
            agent_steps,
            updates,
            self.seconds,
            self.log.sync(),
            shares[0]["random"],
            shares[0]["parts"],
            shares[1:],
        )
        with writing(self.path / CHECKPOINT_FILE):
            write_checkpoint(self.path, state)

    def save_driver(self, network: ActorCritic, config: NetworkConfig) -> None:
        """Write the current driver for evaluation, with the kinds of its training maps.

        See `roads.road_kinds` for the kinds. A run cannot be resumed from this file.
        """
        if self._ranks.rank:
            return
        with writing(self.path / WEIGHTS_FILE):
            save_network(self.path, network, replace(config, maps=self._maps))

    def end(self, files: Sequence[str] = DRIVER_FILES, plans: Sequence[Plan] = ()) -> Path:
        """Complete the manifest with the files of the run."""
        if self._ranks.rank:
            return self.path
        with writing(self.path / MANIFEST_FILE):
            end_training(self.path, files, plans)
        return self.path

    def close(self) -> None:
        """Close the log and release the folder."""
        if "log" in vars(self):
            self.log.close()
        if self._lock is not None:
            os.close(self._lock)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def refuse_begun(folder: Path, can_resume: bool) -> None:
    """Raise a TrainingError if the folder contains a run."""
    left = [folder / name for name in (CHECKPOINT_FILE, WEIGHTS_FILE)]
    left += [] if can_resume else [folder / MANIFEST_FILE]
    table = folder / CSV_FILE
    if any(path.exists() for path in left) or (table.exists() and table.stat().st_size):
        cure = f"continue it (--resume {folder}), or " if can_resume else ""
        raise TrainingError(
            f"{folder}: contains a run, which is not overwritten; {cure}give this run another "
            "--name"
        )


def _locked(folder: Path) -> int:
    """Lock the folder until this process ends in any way; return the lock's descriptor."""
    path = folder / LOCK_FILE
    lock = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        if sys.platform != "win32":
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.ftruncate(lock, 0)
        os.pwrite(lock, str(os.getpid()).encode(), 0)
    except BlockingIOError as error:
        pid = os.pread(lock, 20, 0).decode("ascii", "replace") or "unknown"
        os.close(lock)
        raise TrainingError(
            f"{folder}: process {pid} trains here; wait until it has ended, end it (kill {pid}), "
            "or give this run another --name"
        ) from error
    except OSError:
        os.close(lock)
        raise
    return lock


def _digest(world: World | Simulation) -> str:
    """Return a digest of the environment without zones and workers, which do not affect results."""
    config = asdict(world.config)
    for name in ("zones", "workers"):
        del config[name]
    demand = "" if world.demand is None else world.demand.content_hash
    drivers = [driver.content_hash for driver in background_drivers(world.config.traffic)]
    text = json.dumps([config, world.network.content_hash, demand, *drivers], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()
