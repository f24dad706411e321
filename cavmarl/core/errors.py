"""The errors that cavmarl raises on purpose.

    CavmarlError
    ├── ConfigError            an invalid key, value, combination or division
    │   ├── UnknownEnvironmentError   no environment, folder or map has that name
    │   ├── UnknownArgumentError      a keyword argument that does not exist
    │   └── ScenarioError         a map without a place for a scenario
    ├── MapError               a map that cannot be read, built or driven on
    │   └── RouteError            there is no route between two places
    ├── DemandError            a traffic file that is invalid or does not fit its map
    ├── PolicyError            a policy that cannot be loaded or does not fit
    ├── RegisteredFunctionError   a registered function returns an invalid result
    ├── MissingExtraError      an optional dependency is not installed
    ├── ActionError            an invalid action; no state has changed
    │   └── OccupiedPlaceError    another vehicle covers the place of a new one
    ├── EpisodeError           a call that the episode's state does not allow: reset first
    ├── KernelError            a kernel must be compiled, which is not allowed or possible
    ├── CapacityError          more vehicles or agents than the world has room for
    ├── EvaluationError        a failed evaluation, or worlds that differ but must not
    │   └── ManifestError         results of unknown origin
    ├── RecordingError         a recording that cannot be written or read
    ├── TrainingError          a training run that cannot start, continue or be written
    ├── ProtocolError          the hand-off protocol was violated, or cannot continue
    │   ├── LostTickError         a tick in which every process died
    │   ├── MessageError          bytes that are not a message or vehicle of this run
    │   └── JournalError          a log, or a file of a lost tick, that cannot be read or written
    ├── WorkerError            worker processes that cannot start or continue
    │   ├── WorkerDeathError      every process that ran a step died
    │   ├── WorkerFailureError    an exception in a worker, with its traceback
    │   ├── NodeRefusedError      a node that its caller has rejected
    │   └── NoAdmissibleWorkerError   every worker is too busy to get a shard
    ├── ClockError             a clock that is not advanced by its master
    ├── FollowerError          an external stack that sends invalid data
    │   └── FollowerLostError     a stack that has ended, or has not answered in time
    ├── RosError               ROS cannot start or write, or has a second clock
    ├── ServiceError           the coordination service, one of its nodes, or a request failed
    ├── ZoneSimulatorError     another simulator that runs a zone cannot continue, or refuses
    └── SumoError              SUMO as global traffic cannot continue

Each message says what is wrong, where, and what to do.
"""

from __future__ import annotations

import importlib
import re
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType


class CavmarlError(Exception):
    """Base of all errors of this package."""


class ConfigError(CavmarlError):
    """An invalid configuration: unknown key, wrong value, impossible combination.

    Also raised if zones overlap or do not see far enough for exact results, if the workers or their
    loads allow no placement of a shard, and if a scenario is unknown or invalid.
    """


class UnknownEnvironmentError(ConfigError):
    """No environment, folder or map file has that name."""


class UnknownArgumentError(ConfigError, TypeError):
    """A keyword argument that does not exist."""


class ScenarioError(ConfigError):
    """A map that has no place for a scenario."""


class MapError(CavmarlError):
    """A map that cannot be read, built or driven on."""


class RouteError(MapError):
    """The lane graph has no route between two places."""


class DemandError(CavmarlError):
    """A traffic file that cannot be read, contradicts itself or does not fit its map."""


class PolicyError(CavmarlError):
    """A policy that cannot be found or loaded, or does not fit the environment."""


class MissingExtraError(CavmarlError, ImportError):
    """An optional dependency is not installed; the message gives the command that installs it."""


class ActionError(CavmarlError):
    """An action with a wrong shape, dtype or value or an unknown agent, or a missing action.

    No state has changed, and the step can be repeated.
    """


class OccupiedPlaceError(ActionError):
    """Another vehicle covers the place where a vehicle is to enter; it may be free later."""


class EpisodeError(CavmarlError):
    """A call that the state of the episode does not allow.

    For example, `step` before the first `reset`, or after all agents have left.
    """


class KernelError(CavmarlError):
    """A kernel must be compiled, which is not allowed or not possible."""


class CapacityError(CavmarlError):
    """More vehicles, agents or points than the world has room for."""


class EvaluationError(CavmarlError):
    """A process of an evaluation died, or worlds differ that must be equal bit for bit."""


class ManifestError(EvaluationError):
    """Results whose manifest is missing, unfinished, or belongs to other results."""


class RecordingError(CavmarlError):
    """A recording that cannot be written, or is truncated, damaged or of another version.

    The message names the file and says what to do.
    """


class TrainingError(CavmarlError):
    """A training run that cannot start, continue or be written.

    Causes: another process writes to the folder, the folder has another run, the checkpoint is
    damaged, or the disk is full.
    """


class ProtocolError(CavmarlError):
    """The hand-off protocol was violated, or cannot continue.

    For example: an event that is not allowed in a state; a vehicle that is lost, duplicated,
    created twice or at another epoch than planned; an invariant that does not hold.
    """


class LostTickError(ProtocolError):
    """A tick in which every host of a zone died; no further host is started.

    Attributes:
        tick: the tick.
        zone: the zone whose hosts died.
    """

    def __init__(self, tick: int, deaths: int, zone: int) -> None:
        super().__init__(f"zone {zone} could not reach tick {tick}: {deaths} hosts in a row died")
        self.tick, self.zone = tick, zone


class MessageError(ProtocolError):
    """Bytes that are not a message of this run, or vehicles that cannot continue here.

    The bytes are truncated, damaged, or of another version, build, environment, run, vehicle or
    tick. Also raised if the answer of a network simulator fits no packet.
    """


class JournalError(ProtocolError):
    """A log that cannot be written, read or replayed."""


class WorkerError(CavmarlError):
    """Worker processes that cannot start or continue."""


class WorkerDeathError(WorkerError):
    """Every process that ran a step of a worker died; no further process is started.

    Attributes:
        worker: number of the worker.
        part: description of the worker's worlds or zones.
        order: number of the command that the worker could not execute.
        causes: cause of each death.
    """

    def __init__(
        self,
        worker: int,
        part: str,
        order: int,
        what: str,
        causes: list[str],
        cure: str = "SIGKILL comes from a user, or from the system if memory runs out; processes "
        "print to standard error; backend='local' runs the same worlds in this process",
    ) -> None:
        super().__init__(
            f"worker {worker} ({part}) could not do its {what} (command {order}): {len(causes)} "
            f"processes died ({', '.join(causes)}). {cure}"
        )
        self.worker, self.part, self.order, self.causes = worker, part, order, tuple(causes)


class WorkerFailureError(WorkerError):
    """An exception in a worker, with its traceback.

    Attributes:
        worker: number of the worker.
        kind: name of the exception's class.
        text: message of the exception.
        traceback: traceback as the worker would have printed it.
    """

    def __init__(self, worker: int, part: str, kind: str, text: str, traceback: str) -> None:
        super().__init__(f"worker {worker} ({part}): {kind}: {text}\n{traceback}")
        self.worker, self.kind, self.text, self.traceback = worker, kind, text, traceback


class NodeRefusedError(WorkerError):
    """A node that its caller has rejected; the message gives the reason."""


class NoAdmissibleWorkerError(WorkerError):
    """Every worker is too busy or does not answer.

    Attributes:
        rejections: (worker, resource, value, threshold) of each reason; see `balance.load_score`.
    """

    def __init__(
        self, message: str, rejections: tuple[tuple[int, str, float | None, float | None], ...]
    ) -> None:
        super().__init__(message)
        self.rejections = rejections


class ClockError(CavmarlError):
    """A clock that is not advanced by its master, or a second master.

    Also raised if a world is not at the tick at which its time master left it.
    """


class FollowerError(CavmarlError):
    """An external stack has sent data that is invalid, not executable or not expected.

    The world is intact and can continue.
    """


class FollowerLostError(FollowerError):
    """A follower, or the connection to it, has ended, or has not answered in time.

    Attributes:
        is_late: the follower may still run, but has not answered in time.
    """

    def __init__(self, message: str, is_late: bool = False) -> None:
        super().__init__(message)
        self.is_late = is_late


class RosError(CavmarlError):
    """DDS cannot be started, a topic cannot be written, or another node publishes the clock."""


class ZoneSimulatorError(CavmarlError):
    """Another simulator that runs a zone cannot start or continue, or sends invalid data.

    The step is not finished. In this process, the next reset starts the simulators again. Worker
    processes and nodes return to the state before the step, and fill the simulators from it.

    Attributes:
        zone: number of the zone.
    """

    def __init__(self, message: str, zone: int) -> None:
        super().__init__(message)
        self.zone = zone

    @classmethod
    def of_text(cls, text: str) -> ZoneSimulatorError:
        """Return the error with this text, which another process has raised."""
        zone = re.match(r"zone (\d+): ", text)
        return cls(text, -1 if zone is None else int(zone[1]))


class ServiceError(CavmarlError):
    """The coordination service cannot start or continue, or has refused a request.

    Attributes:
        status: status of the HTTP response; 0: there was none.
        problem: name of the problem, from the table in `docs/guides/service.md`.
        retry_s: delay until another attempt; None: do not retry.
    """

    retry_s: float | None = None

    def __init__(self, message: str, status: int = 0, problem: str = "") -> None:
        super().__init__(message)
        self.status, self.problem = status, problem


class SumoError(CavmarlError):
    """SUMO as global traffic cannot continue.

    Causes: a second simulation in one process, a SUMO process that has ended or hangs, or SUMO data
    that does not fit the world.
    """


class RegisteredFunctionError(CavmarlError):
    """A function that was registered by a user returns an invalid result."""


def missing(module: str | None, extra: str) -> MissingExtraError:
    """Return the error for a `module` that cannot be imported; it names the `extra` to install."""
    return MissingExtraError(f"'{module}' is not installed: {_installation([extra])}")


def require_all(needed: Mapping[str, str]) -> None:
    """Check optional modules without importing them; `needed`: module → extra.

    Raises:
        MissingExtraError: names all modules that are not installed, and one command for them.
    """
    absent = {module: extra for module, extra in needed.items() if find_spec(module) is None}
    if absent:
        names = " and ".join(f"'{module}'" for module in absent)
        verb = "is" if len(absent) == 1 else "are"
        extras = sorted(set(absent.values()))
        raise MissingExtraError(f"{names} {verb} not installed: {_installation(extras)}")


def _installation(extras: Sequence[str]) -> str:
    """Return the command that adds extras to this installation: of a checkout, or of a wheel."""
    checkout = Path(__file__).resolve().parents[2]
    wanted = f"[{','.join(extras)}]"
    if not (checkout / "pyproject.toml").is_file():
        return f"pip install 'cavmarl{wanted}'"
    place = "." if Path.cwd() == checkout else str(checkout)
    return f"pip install -e '{place}{wanted}'"


def require(module: str, extra: str) -> ModuleType:
    """Import an optional `module`; if it is missing, the error names the `extra` to install.

    Raises:
        MissingExtraError: the module is not installed.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is not None and module.split(".")[0] != error.name.split(".")[0]:
            raise
        raise missing(error.name, extra) from error
