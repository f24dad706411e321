"""Every error that cavmarl raises on purpose.

    CavmarlError
    ├── ConfigError            a key, a value, a combination or a division that cannot work
    │   ├── UnknownEnvironmentError   no entry, path or map of that name
    │   └── ScenarioError         a map without a place for a scenario
    ├── MapError               a map that cannot be read, built or driven
    │   └── RouteError            no way from here to there
    ├── DemandError            a file of traffic that cannot be read or does not fit its map
    ├── PolicyError            a policy that cannot be loaded or does not fit
    ├── RegisteredFunctionError   a registered function answers what it must not
    ├── MissingExtraError      an optional dependency is not installed
    ├── ActionError            refused before any state has changed
    ├── EpisodeError           the call does not fit the state of the episode: reset first
    ├── KernelError            a kernel that has to be compiled, and may not or cannot be
    ├── CapacityError          more vehicles or seats than the world can take
    ├── EvaluationError        an evaluation that failed, or worlds that differ and must not
    │   └── ManifestError         results whose origin is not on record
    ├── TrainingError          a run of training that cannot begin, go on or be written
    ├── ProtocolError          the hand-off protocol was broken, or cannot go on
    │   ├── LostTickError         a tick that every process died of
    │   ├── MessageError          bytes that are no message or vehicle of this run
    │   └── JournalError          a log, or a file of a lost tick, that cannot be written or read
    ├── WorkerError            worker processes that cannot start or go on
    │   ├── WorkerDeathError      every process that took up a step died of it
    │   ├── WorkerFailureError    an exception in a worker, with its traceback
    │   ├── NodeRefusedError      a node that its caller does not want
    │   └── NoAdmissibleWorkerError   every worker is too busy to be given a shard
    ├── ClockError             time that another than its master advances, or wants to
    ├── FollowerError          an external stack with which the world cannot go on
    │   └── FollowerLostError     it has ended, or has not answered in time
    ├── ServiceError           the coordination service, a node of it, or a request to it
    └── SumoError              SUMO as global traffic that cannot go on

A message names the thing, the place and the cure.
"""

from __future__ import annotations

import importlib
from types import ModuleType


class CavmarlError(Exception):
    """Base of all errors of this package."""


class ConfigError(CavmarlError):
    """A configuration that cannot work: unknown key, wrong value, impossible combination.

    So are zones that overlap or see less far than exactness needs, loads or workers by which no
    shard can be placed, and scenarios that are unknown or broken.
    """


class UnknownEnvironmentError(ConfigError):
    """No environment, folder or map file of that name."""


class ScenarioError(ConfigError):
    """A map that has no place for a scenario."""


class MapError(CavmarlError):
    """A map that cannot be read, built or driven."""


class RouteError(MapError):
    """The lane graph has no way between two places."""


class DemandError(CavmarlError):
    """A file of traffic demand that cannot be read, contradicts itself or does not fit its map."""


class PolicyError(CavmarlError):
    """A policy that cannot be found, loaded, or seated in this environment."""


class MissingExtraError(CavmarlError, ImportError):
    """An optional dependency is not installed; the message is the command that installs it."""


class ActionError(CavmarlError):
    """An action of the wrong shape, dtype or value, for an unknown agent, or none for a live one.

    No state has changed and the step can be repeated.
    """


class EpisodeError(CavmarlError):
    """A call that does not fit the state of the episode.

    `step` before the first `reset`, or after every agent has left.
    """


class KernelError(CavmarlError):
    """A kernel that has to be compiled, and may not or cannot be."""


class CapacityError(CavmarlError):
    """More vehicles, agents or points than this world can take."""


class EvaluationError(CavmarlError):
    """A process of an evaluation died, or worlds differ that should be the same bit for bit."""


class ManifestError(EvaluationError):
    """Results without a manifest, with one that was never closed, or with one of other results."""


class RecordingError(CavmarlError):
    """A recording that cannot be written, or one that is cut short, damaged or of another version.

    The message names the file and what to do.
    """


class TrainingError(CavmarlError):
    """A run of training that cannot begin, go on or be written.

    Another process writes its folder, another run lies there, its checkpoint is damaged, or the
    disk is full.
    """


class ProtocolError(CavmarlError):
    """The hand-off protocol was broken, or cannot go on.

    An event that a state does not know, a vehicle lost, doubled, born twice or at another epoch
    than planned, an invariant that does not hold.
    """


class LostTickError(ProtocolError):
    """A tick that every host of a zone died of: it is not tried for ever.

    Attributes:
        tick: the tick.
        zone: the zone whose hosts died.
    """

    def __init__(self, tick: int, deaths: int, zone: int) -> None:
        super().__init__(f"zone {zone} could not reach tick {tick}: {deaths} hosts in a row died")
        self.tick, self.zone = tick, zone


class MessageError(ProtocolError):
    """Bytes that are no message of this run, or from which no vehicle can go on here.

    They are cut short, damaged, of another version, build, environment, run, vehicle or tick. So is
    an answer of a network simulator that fits no packet.
    """


class JournalError(ProtocolError):
    """A log that cannot be written, read or replayed."""


class WorkerError(CavmarlError):
    """Worker processes that cannot be started, or cannot go on."""


class WorkerDeathError(WorkerError):
    """Every process that took up a step died of it: it is not tried for ever.

    Attributes:
        worker: number of the worker.
        part: what it hosts, in words.
        order: number of the worker's order that could not be carried out.
        causes: what each process died of.
    """

    def __init__(self, worker: int, part: str, order: int, what: str, causes: list[str]) -> None:
        super().__init__(
            f"worker {worker} ({part}) could not do its {what} (order {order}): {len(causes)} "
            f"processes died of it ({', '.join(causes)}). SIGKILL is sent by a user, or by the "
            "system when memory runs out; what a process prints stands on standard error; "
            "backend='local' runs the same in this process"
        )
        self.worker, self.part, self.order, self.causes = worker, part, order, tuple(causes)


class WorkerFailureError(WorkerError):
    """An exception in a worker, with its traceback.

    Attributes:
        worker: number of the worker.
        kind: name of the exception's class.
        text: its message.
        traceback: as the worker would have printed it.
    """

    def __init__(self, worker: int, part: str, kind: str, text: str, traceback: str) -> None:
        super().__init__(f"worker {worker} ({part}): {kind}: {text}\n{traceback}")
        self.worker, self.kind, self.text, self.traceback = worker, kind, text, traceback


class NodeRefusedError(WorkerError):
    """A node that its caller does not want, and why."""


class NoAdmissibleWorkerError(WorkerError):
    """Every worker is too busy, or does not answer.

    Attributes:
        rejections: (worker, resource, value, threshold) of each reason; see `balance.load_score`.
    """

    def __init__(
        self, message: str, rejections: tuple[tuple[int, str, float | None, float | None], ...]
    ) -> None:
        super().__init__(message)
        self.rejections = rejections


class ClockError(CavmarlError):
    """Time that another than its master advances, or a second master.

    Also a world that is not at the tick at which its time master has left it.
    """


class FollowerError(CavmarlError):
    """An external stack with which it cannot go on; the world is whole and can be stepped on.

    It has sent what cannot be understood or carried out, or is not due.
    """


class FollowerLostError(FollowerError):
    """A follower, or the connection to it, has ended, or has not answered in time.

    Attributes:
        is_late: it may still be there, but has not answered in time.
    """

    def __init__(self, message: str, is_late: bool = False) -> None:
        super().__init__(message)
        self.is_late = is_late


class ServiceError(CavmarlError):
    """The coordination service cannot start or go on, or has refused a request.

    Attributes:
        status: of the HTTP answer; 0: there was none.
        problem: name of what was wrong, as in the table of `docs/guides/service.md`.
        retry_s: when to try again; None: that is of no use.
    """

    retry_s: float | None = None

    def __init__(self, message: str, status: int = 0, problem: str = "") -> None:
        super().__init__(message)
        self.status, self.problem = status, problem


class SumoError(CavmarlError):
    """SUMO as global traffic cannot go on.

    A second simulation in one process, a SUMO that has ended or hangs, or one that says what does
    not fit the world.
    """


class RegisteredFunctionError(CavmarlError):
    """A function that was registered from outside answers what it must not."""


def missing(module: str | None, extra: str) -> MissingExtraError:
    """What to raise where a `module` cannot be imported: it says which `extra` brings that."""
    return MissingExtraError(
        f"'{module}' is not installed: pip install '.[{extra}]' in a checkout of cavmarl"
    )


def require(module: str, extra: str) -> ModuleType:
    """Import an optional `module` or say which `extra` brings it.

    Raises:
        MissingExtraError: the module is not installed.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is not None and module.split(".")[0] != error.name.split(".")[0]:
            raise
        raise missing(error.name, extra) from error
