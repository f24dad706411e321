"""Reading plans and snapshots from JSON written by `to_dict`, with all values checked."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cavmarl.balance.balance_plan import SCHEMA, VERSION, Plan
from cavmarl.balance.load_score import RESOURCES, Candidate, LoadRule, Utilisation
from cavmarl.balance.load_snapshot import LoadSnapshot
from cavmarl.balance.problem import MEASURED_COSTS, BalanceRule, Problem, ShardCost
from cavmarl.core.errors import ConfigError

# Keys of a manifest: the plans at the start and at the end of the run.
PLACEMENT, PLACEMENT_AT_END = "placement", "placement_at_end"

LARGEST = 1 << 53  # larger integers are not exact in every JSON reader
LONGEST = 40  # maximum number of characters of a wrong value in a message


def read_plan(path: Path) -> Plan:
    plans = read_plans(path)
    if len(plans) != 1:
        raise ConfigError(f"{path}: has {len(plans)} plans; use a file with one plan")
    return plans[0]


def read_plans(path: Path) -> list[Plan]:
    """Return the plan of a file, or the plans of a manifest: at the start, then at the end."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: cannot be read ({error}); make the plan again") from error
    try:
        if not isinstance(document, dict) or PLACEMENT not in document:
            return [plan_from_dict(document)]
        rows = [
            row
            for name in (PLACEMENT, PLACEMENT_AT_END)
            for row in _list(document.get(name, []), name)
        ]
        if not rows:
            raise ConfigError("the manifest has no plan, as its run had no workers")
        return [plan_from_dict(row) for row in rows]
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def plan_from_dict(document: Mapping[str, Any]) -> Plan:
    """Return the plan of a document; derived values are not read."""
    if not isinstance(document, Mapping) or document.get("schema") != SCHEMA:
        raise ConfigError(f"not a plan: there is no schema '{SCHEMA}'")
    if document.get("version") != VERSION:
        raise ConfigError(
            f"a plan of version {document.get('version')!r}, but cavmarl reads version {VERSION}"
        )
    get = document.get
    shards = [_table(row, "shard") for row in _list(get("shards"), "shards")]
    present = get("present")
    problem = Problem(
        shards=tuple(
            ShardCost(
                _whole(row.get("world"), "world"),
                _whole(row.get("zone"), "zone"),
                _real(row.get("cost_s"), "cost_s"),
            )
            for row in shards
        ),
        neighbors=tuple(_wholes(row, "neighbors") for row in _list(get("neighbors"), "neighbors")),
        snapshot=snapshot_from_dict(_table(get("snapshot"), "snapshot")),
        rule=_rule(_table(get("rule"), "rule")),
        present=None if present is None else _wholes(present, "present"),
        in_row=_truth(get("in_row", False), "in_row"),
        cost_source=_text(get("cost_source", MEASURED_COSTS), "cost_source"),
    )
    homes = tuple(_whole(row.get("worker"), "worker") for row in shards)
    return Plan(problem, homes, _text(get("method"), "method"))


def snapshot_from_dict(document: Mapping[str, Any]) -> LoadSnapshot:
    """Return the snapshot of a document. Raises ConfigError: a key or a value is invalid."""
    rows = _list(document.get("workers"), "workers")
    return LoadSnapshot(
        workers=tuple(_candidate(_table(row, "worker")) for row in rows),
        gpu_source=_text(document.get("gpu_source"), "gpu_source"),
        origin=_text(document.get("origin"), "origin"),
    )


def _candidate(row: Mapping[str, Any]) -> Candidate:
    use = _table(row.get("use"), "use")
    cpu, ram, gpu = (_real(use.get(name), name) for name in RESOURCES)
    return Candidate(
        worker=_whole(row.get("worker"), "worker"),
        use=Utilisation(cpu, ram, gpu),
        hosted=_whole(row.get("hosted"), "hosted"),
        available=_truth(row.get("available"), "available"),
    )


def _rule(document: Mapping[str, Any]) -> BalanceRule:
    load = _table(document.get("load"), "load")
    return BalanceRule(
        load=LoadRule(
            _three(load.get("weights"), "weights"),
            _three(load.get("thresholds"), "thresholds"),
            _real(load.get("margin"), "margin"),
        ),
        tolerance=_real(document.get("tolerance"), "tolerance"),
        max_moves=_whole(document.get("max_moves"), "max_moves"),
        move_s=_real(document.get("move_s"), "move_s"),
        payback_ticks=_whole(document.get("payback_ticks"), "payback_ticks"),
        keeps_one=_truth(document.get("keeps_one", False), "keeps_one"),
    )


def _three(value: object, name: str) -> tuple[float, float, float]:
    values = [_real(one, name) for one in _list(value, name)]
    if len(values) != 3:
        raise _invalid(name, value, "three numbers")
    cpu, ram, gpu = values
    return cpu, ram, gpu


def _table(value: object, name: str) -> Mapping[str, Any]:
    if not isinstance(value, dict):
        raise _invalid(name, value, "a table")
    return value


def _list(value: object, name: str) -> Sequence[Any]:
    if not isinstance(value, list | tuple):
        raise _invalid(name, value, "a list")
    return value


def _text(value: object, name: str) -> str:
    if not isinstance(value, str):
        raise _invalid(name, value, "text")
    return value


def _truth(value: object, name: str) -> bool:
    if not isinstance(value, bool):
        raise _invalid(name, value, "true or false")
    return value


def _whole(value: object, name: str) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= LARGEST:
        raise _invalid(name, value, "a whole number of at least 0")
    return value


def _wholes(value: object, name: str) -> tuple[int, ...]:
    return tuple(_whole(one, name) for one in _list(value, name))


def _real(value: object, name: str) -> float:
    if isinstance(value, float):
        return value
    return float(_whole(value, name))


def _invalid(name: str, value: object, needed: str) -> ConfigError:
    text = repr(value)
    shown = text if len(text) <= LONGEST else f"{text[:LONGEST]}…"
    return ConfigError(f"not a plan: {name} is {shown}, must be {needed}")
