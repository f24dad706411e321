"""Errors of worlds that other processes have: what they cannot do, and what they raise there."""

from __future__ import annotations

import cavmarl.core.errors
from cavmarl.config.v2x import V2xConfig
from cavmarl.core.errors import CavmarlError, ConfigError, WorkerFailureError


def copy_error() -> ConfigError:
    """Return the refusal of a copy or a pickle of worlds in other processes."""
    return ConfigError(
        "workers: worlds that worker processes run cannot be copied; use backend='local', "
        "or make the environment once more, with the same seed"
    )


def network_error() -> ConfigError:
    """Return the refusal to connect a network simulator with worlds in workers."""
    return ConfigError(
        "v2x.channel.external: a network simulator is in the caller's process, and worlds over "
        "workers do not ask it; use backend='local', or nodes"
    )


def refuse_external(v2x: V2xConfig) -> None:
    """Refuse what asks a part of the caller's process in each tick."""
    if v2x.enabled and v2x.channel.external:
        raise network_error()


def original_error(failure: WorkerFailureError) -> CavmarlError:
    """Return an error that the worlds raise on purpose, as they would raise it in this process."""
    kind = getattr(cavmarl.core.errors, failure.kind, None)
    if not isinstance(kind, type) or not issubclass(kind, CavmarlError):
        return failure
    takes_text = "__init__" not in vars(kind)
    return kind(failure.text) if takes_text else failure
