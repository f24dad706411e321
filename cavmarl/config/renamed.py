"""Names of keys, modes and terms that have changed, and keys that are no longer there.

Old names still work, and warn; they go with the version after this one. Removed keys are refused.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

from cavmarl.core.errors import ConfigError

# Dotted key before → now.
KEYS = {
    "workers.repeats": "workers.max_retries",
    "workers.watch": "workers.monitor_cpu",
    "workers.tolerance": "workers.imbalance_tolerance",
    "zones.check": "zones.check_invariants",
    "zones.recut_steps": "zones.repartition_steps",
    "zones.recut_tolerance": "zones.repartition_tolerance",
    "terms.weights.speed": "terms.weights.speeding",
    "terms.weights.comfort": "terms.weights.jerk",
    "terms.weights.time_to_collision": "terms.weights.ttc_risk",
}
OLD_TERMS = tuple(key.rpartition(".")[2] for key in KEYS if key.startswith("terms.weights."))
MODES = {"seats": "respawn", "entering": "open"}
# Dotted key → what to do instead.
REMOVED = {
    "zones.policy": "a vehicle is handed over after zones.max_deferred_ticks, as with 'force'",
    "zones.grace_ticks": "add these ticks to zones.max_deferred_ticks",
    "zones.faults": "run `cavmarl verify ENV --nodes N --faults campaign`, which injects faults "
    "into simulated nodes and real ones",
    "zones.reproducers": "run `cavmarl verify ENV --nodes N --faults simulated`, which names the "
    "seed of each run that fails",
}


def with_current_names(raw: object, where: str) -> object:
    """The same keys and values as of an env.yaml, by the names that they have now.

    An old name warns (`FutureWarning`) and takes the place of the new one.

    Args:
        raw: mappings, sequences, strings, numbers, bools, None.
        where: begins every message: the file that `raw` comes from.

    Raises:
        ConfigError: a key that has been removed; the message says what to do instead.
    """
    if not isinstance(raw, Mapping):
        return raw
    found = {
        key: dict(value) if isinstance(value, Mapping) else value for key, value in raw.items()
    }
    for old, instead in REMOVED.items():
        *folders, name = old.split(".")
        if name in (_inner(found, folders) or {}):
            raise ConfigError(f"{where}: {old} has been removed: {instead}")
    for old, new in KEYS.items():
        *folders, name = old.split(".")
        place = _inner(found, folders)
        if place is not None and name in place:
            _warn(old, new)
            place[new.rpartition(".")[2]] = place.pop(name)
    population = _inner(found, ["population"])
    mode = None if population is None else population.get("mode")
    if isinstance(mode, str) and mode in MODES and population is not None:
        _warn(f"population.mode = {mode}", f"population.mode = {MODES[mode]}")
        population["mode"] = MODES[mode]
    return found


def _inner(found: dict[Any, Any], folders: list[str]) -> dict[Any, Any] | None:
    place: Any = found
    for folder in folders:
        inner = place.get(folder)
        if not isinstance(inner, Mapping):
            return None
        place[folder] = place = dict(inner)
    return place if isinstance(place, dict) else None


def _warn(old: str, new: str) -> None:
    warnings.warn(
        f"{old} is now called {new}; the old name goes with the next version",
        FutureWarning,
        stacklevel=5,
    )
