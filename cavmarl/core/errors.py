"""Every error that cavmarl raises on purpose.

    CavmarlError
    ├── ConfigError            a key, a value or a combination that cannot work
    │   ├── UnknownEnvironmentError   no entry, path or map of that name
    │   ├── ZoneError                 zones that overlap, leak or do not fit the map
    │   ├── CoverageError         a zone sees less than its vehicles may need
    │   └── PlacementError        loads, weights or workers that no shard can be placed by
    ├── MapError               a map that cannot be read, built or driven
    │   └── RouteError         no way from here to there
    ├── DemandError            a file of traffic that cannot be read or does not fit its map
    ├── ScenarioError          a scenario that is none, or has no room for so many agents
    │   └── NoPlaceError       a map without a place for it
    ├── ActionError            refused before any state has changed
    │   ├── InvalidActionError    wrong shape, dtype or value
    │   ├── MissingActionError    a live agent without an action
    │   └── UnknownAgentError     an action for nobody
    ├── EpisodeError           the call does not fit the state of the episode
    │   ├── ResetNeededError      step before reset
    │   └── EpisodeEndedError     step after the end
    ├── CapacityError          more vehicles or seats than the world can take
    ├── EvaluationError        an evaluation that could not be brought to its end
    │   ├── ManifestError         results whose origin is not on record
    │   └── UnequalWorldsError    divided and undivided worlds that are not the same
    ├── ProtocolError          the hand-off protocol was broken, or cannot go on
    │   ├── TransitionError       an event that its state does not know
    │   ├── SpawnError            a vehicle id that has been used, or a zone that is none
    │   ├── LedgerError           a vehicle lost, doubled, or at another epoch
    │   ├── StoreError            what is stored is not what the zones say they stored
    │   ├── ZoneStepError         a tick that every host of a zone died of
    │   ├── ReproducerError       a file from which no tick can be run again
    │   ├── InvariantError        what always holds did not hold
    │   ├── MessageError          bytes that are no message of this run
    │   │   ├── TruncatedMessageError
    │   │   ├── CorruptMessageError
    │   │   ├── UnknownVersionError
    │   │   └── ForeignRunError
    │   ├── TransferError         bytes from which no vehicle can go on here
    │   │   ├── TruncatedTransferError
    │   │   ├── TransferVersionError
    │   │   ├── TransferLayoutError   of another build, or of another environment
    │   │   └── ForeignTransferError  of another vehicle or tick
    │   └── JournalError          a log that cannot be written or replayed
    │       ├── TornJournalError     only its last line is cut short
    │       └── CorruptJournalError  a line is damaged, missing or out of order
    ├── ClockError             time that somebody else than its master advances, or wants to
    │   ├── SecondMasterError     there is a time master already
    │   ├── TickRefusedError      who follows does not tick
    │   └── ClockDriftError       a world is not where its master has left it
    ├── FollowerError          an external stack with which it cannot go on
    │   ├── FollowerLostError     it, or the connection to it, has ended
    │   │   └── FollowerTimeoutError   it has not answered in time
    │   ├── FollowerMessageError  what it says cannot be understood
    │   └── ControlError          controls that cannot be carried out
    ├── NoAdmissibleWorkerError   every worker is too busy to be given a shard
    ├── WorkerError            worker processes that cannot go on
    │   ├── WorkerStartError      no process, or no memory for it
    │   ├── WorkerDeathError      every process that took up a step died of it
    │   ├── SensorFrameError      a frame that is not of the present tick
    │   └── WorkerFailureError    an exception in a worker, with its traceback
    ├── V2xError               a message that cannot be read, or an impossible reception
    ├── SumoError              SUMO as global traffic that cannot go on
    │   ├── SumoBusyError         a second simulation in one process
    │   ├── SumoDiedError         its process ended, or hangs
    │   └── SumoStateError        it says what does not fit the world
    ├── PolicyError            a policy that cannot be loaded or does not fit
    └── MissingExtraError      an optional dependency is not installed

A message names the thing, the place and the cure.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

__all__ = [
    "ActionError",
    "CapacityError",
    "CavmarlError",
    "ClockDriftError",
    "ClockError",
    "ConfigError",
    "ControlError",
    "CorruptJournalError",
    "CorruptMessageError",
    "CoverageError",
    "DemandError",
    "EpisodeEndedError",
    "EpisodeError",
    "EvaluationError",
    "FollowerError",
    "FollowerLostError",
    "FollowerMessageError",
    "FollowerTimeoutError",
    "ForeignRunError",
    "ForeignTransferError",
    "InvalidActionError",
    "InvariantError",
    "JournalError",
    "LedgerError",
    "ManifestError",
    "MapError",
    "MessageError",
    "MissingActionError",
    "MissingExtraError",
    "NoAdmissibleWorkerError",
    "PlacementError",
    "PolicyError",
    "ProtocolError",
    "ReproducerError",
    "ResetNeededError",
    "RouteError",
    "SecondMasterError",
    "SensorFrameError",
    "SpawnError",
    "StoreError",
    "SumoBusyError",
    "SumoDiedError",
    "SumoError",
    "SumoStateError",
    "TickRefusedError",
    "TornJournalError",
    "TransferError",
    "TransferLayoutError",
    "TransferVersionError",
    "TransitionError",
    "TruncatedMessageError",
    "TruncatedTransferError",
    "UnequalWorldsError",
    "UnknownAgentError",
    "UnknownEnvironmentError",
    "UnknownVersionError",
    "V2xError",
    "WorkerDeathError",
    "WorkerError",
    "WorkerFailureError",
    "WorkerStartError",
    "ZoneError",
    "ZoneStepError",
    "missing",
    "require",
]


class CavmarlError(Exception):
    """Base of all errors of this package."""


class ConfigError(CavmarlError):
    """A configuration that cannot work: unknown key, wrong value, impossible combination."""


class UnknownEnvironmentError(ConfigError):
    """No environment, folder or map file of that name."""


class ZoneError(ConfigError):
    """Zones that overlap, leave a gap, do not fit the map or see less far than exactness needs."""


class CoverageError(ConfigError):
    """A zone would see less than a vehicle may need before it is handed over."""


class PlacementError(ConfigError):
    """Loads, weights or workers by which no shard can be placed."""


class ScenarioError(CavmarlError):
    """No scenario of that name, a broken file of one, or no room for so many agents."""


class NoPlaceError(ScenarioError):
    """A map that has no place for a scenario."""


class MapError(CavmarlError):
    """A map that cannot be read, built or driven."""


class RouteError(MapError):
    """The lane graph has no way between two places."""


class DemandError(CavmarlError):
    """A file of traffic demand that cannot be read, contradicts itself or does not fit its map."""


class ActionError(CavmarlError):
    """An action that was refused; no state has changed and the step can be repeated."""


class InvalidActionError(ActionError):
    """An action of the wrong shape, dtype or value."""


class MissingActionError(ActionError):
    """A live agent was given no action."""


class UnknownAgentError(ActionError):
    """An action for an agent that is not in the world."""


class EpisodeError(CavmarlError):
    """A call that does not fit the state of the episode."""


class ResetNeededError(EpisodeError):
    """`step` before the first `reset`."""


class EpisodeEndedError(EpisodeError):
    """`step` after every agent has left."""


class CapacityError(CavmarlError):
    """More vehicles, agents or points than this world can take."""


class V2xError(CavmarlError):
    """Bytes that are no message, an unknown cause, or a network simulator that answers nonsense."""


class EvaluationError(CavmarlError):
    """A process of an evaluation died, or did something else than it was asked to."""


class ManifestError(EvaluationError):
    """Results without a manifest, with one that was never closed, or with one of other results."""


class UnequalWorldsError(EvaluationError):
    """Worlds of different division that should be the same bit for bit and are not."""


class ProtocolError(CavmarlError):
    """The hand-off protocol was broken, or cannot go on."""


class TransitionError(ProtocolError):
    """An event that the state does not know."""


class SpawnError(ProtocolError):
    """A vehicle whose id has been in the episode before, or whose zone does not exist."""


class LedgerError(ProtocolError):
    """A vehicle was lost, doubled, or is at another epoch than planned."""


class StoreError(ProtocolError):
    """What is stored is not what the zones say they stored.

    Attributes:
        zones: those that have to be hosted anew and step again.
    """

    def __init__(self, zones: tuple[int, ...]) -> None:
        super().__init__(f"zones {list(zones)} stored other rows than they told: host them anew")
        self.zones = zones


class LostTickError(ProtocolError):
    """A tick that everybody died of who tried to reach it: it is not tried for ever.

    Attributes:
        tick: the tick.
        zone: whose hosts died; None: the coordinators.
        reproducer: the file from which `cavmarl verify --replay` runs that tick again, or why there
            is none; nothing if none was asked for.
    """

    reproducer: Path | str = ""

    def __init__(self, tick: int, zone: int | None, words: str) -> None:
        super().__init__(words)
        self.tick, self.zone = tick, zone

    def __str__(self) -> str:
        """With the way to see it again."""
        match self.reproducer:
            case Path():
                again = f"; to run that tick again: cavmarl verify --replay {self.reproducer}"
            case "":
                again = ""
            case why:
                again = f"; it cannot be run again: {why}"
        return super().__str__() + again


class ZoneStepError(LostTickError):
    """Every host of a zone died of a tick.

    Attributes:
        cause: what the last one died of; nothing if nobody knows.
    """

    def __init__(self, zone: int, tick: int, hosts: int, cause: str = "") -> None:
        of = f", the last one {cause}" if cause else ""
        words = f"zone {zone} could not reach tick {tick}: {hosts} hosts in a row died{of}"
        super().__init__(tick, zone, words)
        self.cause = cause


class CoordinatorStepError(LostTickError):
    """Every coordinator died of a tick, at the same point."""

    def __init__(self, tick: int, coordinators: int, point: str) -> None:
        words = (
            f"the coordinator could not reach tick {tick}: {coordinators} of them died at '{point}'"
        )
        super().__init__(tick, None, words)


class ReproducerError(ProtocolError):
    """A file from which no tick can be run again: damaged, of another build or of another world."""


class InvariantError(ProtocolError):
    """What always holds did not hold."""


class MessageError(ProtocolError):
    """Bytes that are no message of this run."""


class TruncatedMessageError(MessageError):
    """A message that ends too early, or goes on after its end."""


class CorruptMessageError(MessageError):
    """A message whose checksum or content is wrong."""


class UnknownVersionError(MessageError):
    """A message of another version of the wire form."""


class ForeignRunError(MessageError):
    """A message of another run."""


class TransferError(ProtocolError):
    """Bytes from which no vehicle can go on here."""


class TruncatedTransferError(TransferError):
    """The state of a vehicle that ends too early, or goes on after its end."""


class TransferVersionError(TransferError):
    """The state of a vehicle in another major version."""


class TransferLayoutError(TransferError):
    """The state of a vehicle from another build, or from another environment."""


class ForeignTransferError(TransferError):
    """The state of another vehicle, or of another tick."""


class JournalError(ProtocolError):
    """A log that cannot be written or replayed."""


class TornJournalError(JournalError):
    """Only the last line of the log is cut short: what precedes it is whole."""


class CorruptJournalError(JournalError):
    """A line of the log is damaged, missing or out of order."""


class ClockError(CavmarlError):
    """Time that somebody else than its master advances, or wants to."""


class SecondMasterError(ClockError):
    """An environment that has a time master was given another."""


class TickRefusedError(ClockError):
    """Somebody who is not the time master wanted to advance the world."""


class ClockDriftError(ClockError):
    """A world is not at the tick at which its time master has left it."""


class FollowerError(CavmarlError):
    """An external stack with which it cannot go on; the world is whole and can be stepped on."""


class FollowerLostError(FollowerError):
    """A follower, or the connection to it, has ended."""


class FollowerTimeoutError(FollowerLostError):
    """A follower has not answered in time."""


class FollowerMessageError(FollowerError):
    """A follower has sent what cannot be understood, or is not due."""


class ControlError(FollowerError):
    """Controls of a follower that cannot be carried out: not numbers, out of range, missing."""


class NoAdmissibleWorkerError(CavmarlError):
    """Every worker is too busy, or does not answer.

    Attributes:
        rejections: (worker, resource, value, threshold) of each reason; see `balance.load_score`.
    """

    def __init__(
        self, message: str, rejections: tuple[tuple[int, str, float | None, float | None], ...]
    ) -> None:
        super().__init__(message)
        self.rejections = rejections


class WorkerError(CavmarlError):
    """Worker processes that cannot go on."""


class WorkerStartError(WorkerError):
    """No process could be started, or there is no memory for it."""


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
            f"processes died of it ({', '.join(causes)}). SIGKILL is sent by somebody, or by the "
            "system when memory runs out; what a process prints stands on standard error; "
            "workers=0 runs the same in this process"
        )
        self.worker, self.part, self.order, self.causes = worker, part, order, tuple(causes)


class SensorFrameError(WorkerError):
    """A sensor worker has delivered a frame that is not of the present tick.

    Attributes:
        sensor: its name in the rig.
        tick: that was to be sensed.
        found: tick of the frame; -1: there is none.
    """

    def __init__(self, sensor: str, tick: int, found: int) -> None:
        super().__init__(
            f"rig.{sensor}: the frame of tick {tick} is not there, but one of tick {found}; "
            "sensor_workers=0 senses in this process"
        )
        self.sensor, self.tick, self.found = sensor, tick, found


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


class SumoError(CavmarlError):
    """SUMO as global traffic cannot go on."""


class SumoBusyError(SumoError):
    """A second simulation in a process that holds one already."""


class SumoDiedError(SumoError):
    """The process of SUMO ended, or does not answer; the message ends with its last output."""


class SumoStateError(SumoError):
    """SUMO says what does not fit the world: another time, an unknown signal state."""


class RegisteredFunctionError(CavmarlError):
    """A function that was registered from outside answers what it must not."""


class PolicyError(CavmarlError):
    """A policy that cannot be found, loaded, or seated in this environment."""


class MissingExtraError(CavmarlError, ImportError):
    """An optional dependency is not installed; the message is the command that installs it."""


def missing(error: ModuleNotFoundError, extra: str) -> MissingExtraError:
    """What to raise in the place of an import `error`: it says which `extra` brings the module."""
    return MissingExtraError(f"'{error.name}' is not installed: pip install 'cavmarl[{extra}]'")


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
        raise missing(error, extra) from error
