"""Keys, keywords and command-line options that were removed, and their replacements.

An entry here only improves the error message: a removed name is unknown and has no effect.
"""

from __future__ import annotations

# Dotted key of env.yaml → advice. An entry also covers the keys inside it.
REMOVED_KEYS = {
    "sensors.roadgraph": "use sensors.lanes, sensors.route and sensors.way for the roads ahead",
    "terms.weights.comfort": "use terms.weights.jerk",
    "terms.weights.speed": "use terms.weights.speeding",
    "terms.weights.time_to_collision": "use terms.weights.ttc_risk",
    "workers.repeats": "use workers.max_retries",
    "workers.tolerance": "use workers.imbalance_tolerance",
    "workers.watch": "use workers.monitor_cpu",
    "zones.check": "use zones.check_invariants",
    "zones.faults": "run `cavmarl verify nodes ENV --faults campaign`, which injects faults into "
    "simulated nodes and real ones",
    "zones.grace_ticks": "add these ticks to zones.max_deferred_ticks",
    "zones.policy": "a vehicle is handed over after zones.max_deferred_ticks, as with 'force'",
    "zones.recut_steps": "use zones.repartition_steps",
    "zones.recut_tolerance": "use zones.repartition_tolerance",
    "zones.reproducers": "run `cavmarl verify nodes ENV --faults simulated`, which names the seed "
    "of each run that fails",
}

# Option of the command line → advice.
REMOVED_OPTIONS = {
    "--hosts": "use --backend; nodes are killed by cavmarl verify nodes --kill K",
    "--cut-anew": "use --write-zones",
}

# Keyword of `make_vec` and `parallel_env` → advice.
REMOVED_ARGUMENTS = {"hosts": "use backend='ray:N' or backend='nodes:N@HOST:PORT'"}


def removed_key(key: str) -> str | None:
    """Return the error message for a key that was removed, or that is inside a removed key."""
    parts = key.split(".")
    names = (".".join(parts[:depth]) for depth in range(len(parts), 0, -1))
    return next((_refusal(name, REMOVED_KEYS) for name in names if name in REMOVED_KEYS), None)


def removed_option(option: str | None) -> str | None:
    """Return the error message for an option that was removed."""
    return _refusal(option, REMOVED_OPTIONS) if option in REMOVED_OPTIONS else None


def removed_argument(name: str) -> str | None:
    """Return the error message for a keyword that was removed."""
    return _refusal(name, REMOVED_ARGUMENTS) if name in REMOVED_ARGUMENTS else None


def _refusal(name: str, table: dict[str, str]) -> str:
    return f"{name} was removed: {table[name]}"
