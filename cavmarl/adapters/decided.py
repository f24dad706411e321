"""Keys of `env.yaml` that an adapter fixes, since its library allows one value only."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from cavmarl.core.errors import ConfigError


def refuse_decided(keys: Iterable[str], *given: Mapping[str, Any] | None) -> None:
    """Refuse what a caller gave for keys that the view decides.

    Args:
        keys: decided ones.
        given: keywords and overrides.

    Raises:
        ConfigError: one of the keys was given.
    """
    for key in keys:
        if any(key in mapping for mapping in given if mapping is not None):
            raise ConfigError(
                f"{key}: this view decides it; cavmarl.parallel_env and make_vec leave it to you"
            )
