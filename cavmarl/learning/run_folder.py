"""`RunFolder`: what a run leaves behind, written by one process at a time and never overwritten."""

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
from types import TracebackType
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
from cavmarl.learning.log import CSV_FILE, Log, cut_logs
from cavmarl.learning.options import given_options, settings_of
from cavmarl.policies.network_files import NetworkConfig

if sys.platform != "win32":
    import fcntl

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    class RunSettings(DataclassInstance, Protocol):
        """Settings of a program; those that it may lack: see `RunFolder`."""

        program: ClassVar[str]

        @property
        def folder(self) -> Path: ...


LOCK_FILE = ".lock"  # holds the number of the process that writes here, or did so last
DRIVER_FILES = (WEIGHTS_FILE, CONFIG_FILE, CSV_FILE)

# Settings that a resumed run may be given anew.
CAN_CHANGE = frozenset(
    "total_agent_steps minutes resume threads device zones backend workers tensorboard "
    "checkpoint_updates".split()
)

S = TypeVar("S", bound="RunSettings")


def parse_run(kind: type[S], words: Sequence[str] | None, text: str | None) -> S:
    """As `options.parse_settings`; of a resumed run, the settings that it began with."""
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
        raise ConfigError(f"--resume {folder}: is a run of {state.program}: go on with that one")
    return replace(validate(kind, state.settings, CHECKPOINT_FILE), **given)


class RunFolder:
    """The folder of a run, from its first file to its last; one process has it at a time.

    Args:
        settings: of the run; if they have `resume` and it is not empty, the run goes on.
        world: that it trains in.
        plans: which worker hosts what.

    Raises:
        TrainingError: another process writes there, a run has begun there that is not to go on, or
            the one that is to go on cannot; or nothing can be written.
    """

    def __init__(
        self, settings: RunSettings, world: World | Simulation, plans: Sequence[Plan] = ()
    ) -> None:
        self.path = path = settings.folder
        self._settings = settings
        self._environment = _digest(world)
        resumes = bool(getattr(settings, "resume", ""))
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
                self._refuse_begun()
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
                f"--resume {self.path}: the environment has changed since that run: put its files "
                "back, or train anew under another --name"
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

    def _refuse_begun(self) -> None:
        can_go_on = hasattr(self._settings, "resume")
        left = [self.path / name for name in (CHECKPOINT_FILE, WEIGHTS_FILE)]
        left += [] if can_go_on else [self.path / MANIFEST_FILE]
        table = self.path / CSV_FILE
        if any(path.exists() for path in left) or (table.exists() and table.stat().st_size):
            cure = f"go on with it (--resume {self.path}), or " if can_go_on else ""
            raise TrainingError(
                f"{self.path}: a run has begun here, which is not overwritten: {cure}give this one "
                "another --name"
            )

    @cached_property
    def log(self) -> Log:
        return Log(self.path, getattr(self._settings, "tensorboard", False))

    @property
    def seconds(self) -> float:
        """That the run has taken, without those between its end and its going on."""
        return self.began.seconds + time.perf_counter() - self._began_at

    def has_time(self, minutes: float) -> bool:
        """Whether the run has taken less than these; 0: no limit."""
        return not minutes or self.seconds < 60.0 * minutes

    def resume(self) -> Parts:
        """What `save` was given, with all random numbers as they were; empty: the run begins.

        Its clock begins to run here.
        """
        self._began_at = time.perf_counter()
        if self.began.random:
            set_random_states(self.began.random)
        return self.began.parts

    def is_due(self, updates: int) -> bool:
        """Whether to save after so many updates, though the run goes on."""
        every: int = getattr(self._settings, "checkpoint_updates", 1)
        return updates % every == 0

    def save(self, agent_steps: int, updates: int, parts: Parts) -> None:
        """Write a checkpoint in the place of the last one.

        Raises:
            TrainingError: it cannot be written; the last one is whole.
        """
        settings = {**asdict(self._settings), "resume": ""}
        state = RunState(
            self._settings.program,
            settings,
            self._environment,
            agent_steps,
            updates,
            self.seconds,
            self.log.sync(),
            random_states(),
            parts,
        )
        with writing(self.path / CHECKPOINT_FILE):
            write_checkpoint(self.path, state)

    def save_driver(self, network: ActorCritic, config: NetworkConfig) -> None:
        """Write the driver as it is, for others to read; a run does not go on from it."""
        with writing(self.path / WEIGHTS_FILE):
            save_network(self.path, network, config)

    def end(self, files: Sequence[str] = DRIVER_FILES, plans: Sequence[Plan] = ()) -> Path:
        """Close the manifest over what the run has left."""
        with writing(self.path / MANIFEST_FILE):
            end_training(self.path, files, plans)
        return self.path

    def close(self) -> None:
        """Let others write here."""
        if "log" in vars(self):
            self.log.close()
        os.close(self._lock)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def _locked(folder: Path) -> int:
    """Descriptor of the lock, which goes with the process however that ends."""
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
            f"{folder}: process {pid} trains here: wait until it has ended, end it (kill {pid}), "
            "or give this run another --name"
        ) from error
    except OSError:
        os.close(lock)
        raise
    return lock


def _digest(world: World | Simulation) -> str:
    """Of the environment but for what changes no result: its zones and workers."""
    config = asdict(world.config)
    for name in ("zones", "workers"):
        del config[name]
    demand = "" if world.demand is None else world.demand.content_hash
    text = json.dumps([config, world.network.content_hash, demand], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()
