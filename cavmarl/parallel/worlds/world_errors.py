"""Errors of worlds in other processes: unsupported calls, and errors that workers have raised."""

from __future__ import annotations

import cavmarl.core.errors
from cavmarl.config.v2x import V2xConfig
from cavmarl.core.errors import (
    CavmarlError,
    ConfigError,
    WorkerFailureError,
    ZoneSimulatorError,
)


def copy_error() -> ConfigError:
    """Return the error for a copy or a pickle of worlds in other processes."""
    return ConfigError(
        "workers: worlds in worker processes cannot be copied; use backend='local', or make "
        "another environment with the same seed"
    )


def network_error() -> ConfigError:
    """Return the error for a network simulator with worlds in worker processes."""
    return ConfigError(
        "v2x.channel.external: worlds in worker processes cannot call a network simulator in the "
        "process of the caller; use backend='local', or nodes"
    )


def refuse_external(v2x: V2xConfig) -> None:
    """Refuse an external channel, which needs the process of the caller in each tick.

    Raises:
        ConfigError: the channel is external.
    """
    if v2x.enabled and v2x.channel.external:
        raise network_error()


def original_error(failure: WorkerFailureError) -> CavmarlError:
    """Return the error of cavmarl that a worker has raised, or else the failure itself."""
    kind = getattr(cavmarl.core.errors, failure.kind, None)
    if not isinstance(kind, type) or not issubclass(kind, CavmarlError):
        return failure
    if kind is ZoneSimulatorError:
        return ZoneSimulatorError.of_text(failure.text)
    takes_text = "__init__" not in vars(kind)
    return kind(failure.text) if takes_text else failure
