"""Every error that cavmarl raises on purpose.

    CavmarlError
    ├── ConfigError            a key, a value or a combination that cannot work
    │   ├── UnknownEnvironmentError   no entry, path or map of that name
    │   └── ZoneError                 zones that overlap, leak or do not fit the map
    ├── MapError               a map that cannot be read, built or driven
    │   └── RouteError         no way from here to there
    ├── DemandError            a file of traffic that cannot be read or does not fit its map
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
    ├── PolicyError            a policy that cannot be loaded or does not fit
    └── MissingExtraError      an optional dependency is not installed

A message names the thing, the place and the cure.
"""

from __future__ import annotations

import importlib
from types import ModuleType

__all__ = [
    "ActionError",
    "CapacityError",
    "CavmarlError",
    "ConfigError",
    "DemandError",
    "EpisodeEndedError",
    "EpisodeError",
    "EvaluationError",
    "InvalidActionError",
    "ManifestError",
    "MapError",
    "MissingActionError",
    "MissingExtraError",
    "PolicyError",
    "ResetNeededError",
    "RouteError",
    "UnequalWorldsError",
    "UnknownAgentError",
    "UnknownEnvironmentError",
    "ZoneError",
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


class EvaluationError(CavmarlError):
    """A process of an evaluation died, or did something else than it was asked to."""


class ManifestError(EvaluationError):
    """Results without a manifest, with one that was never closed, or with one of other results."""


class UnequalWorldsError(EvaluationError):
    """Worlds of different division that should be the same bit for bit and are not."""


class PolicyError(CavmarlError):
    """A policy that cannot be found, loaded, or seated in this environment."""


class MissingExtraError(CavmarlError, ImportError):
    """An optional dependency is not installed; the message is the command that installs it."""


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
        raise MissingExtraError(
            f"'{module}' is not installed: pip install 'cavmarl[{extra}]'"
        ) from error
