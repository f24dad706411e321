"""Reading plans and snapshots from JSON written by `to_dict`, with all values checked."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from cavmarl.balance.balance_plan import SCHEMA, VERSION, Plan
from cavmarl.balance.load_snapshot import LoadSnapshot
from cavmarl.balance.problem import MEASURED_COSTS, BalanceRule, Problem, ShardCost
from cavmarl.config.io import validate
from cavmarl.core.errors import ConfigError

# Keys of a manifest: the plans at the start and at the end of the run.
PLACEMENT, PLACEMENT_AT_END = "placement", "placement_at_end"

Count = Annotated[int, Field(ge=0, le=1 << 53)]  # some JSON readers round larger numbers


@dataclass(frozen=True)
class _Shard:
    """A shard in a plan's document."""

    world: Count
    zone: Count
    cost_s: float
    worker: Count


@dataclass(frozen=True)
class _Document:
    """A plan's document, without derived values."""

    shards: tuple[_Shard, ...]
    neighbors: tuple[tuple[Count, ...], ...]
    snapshot: LoadSnapshot
    rule: BalanceRule
    present: tuple[Count, ...] | None
    method: str
    in_row: bool = False
    cost_source: str = MEASURED_COSTS


@dataclass(frozen=True)
class _Manifest:
    """The plans of a run's manifest."""

    placement: tuple[dict[str, Any], ...]
    placement_at_end: tuple[dict[str, Any], ...] = ()


def read_plan(path: Path) -> Plan:
    plans = read_plans(path)
    if len(plans) != 1:
        raise ConfigError(f"{path}: has {len(plans)} plans; use a file with one plan")
    return plans[0]


def read_plans(path: Path) -> list[Plan]:
    """Return the plan of a file, or the plans at the start and the end of a manifest's run."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: cannot be read ({error}); make the plan again") from error
    try:
        if not isinstance(document, dict) or PLACEMENT not in document:
            return [plan_from_dict(document)]
        found = validate(_Manifest, document, "not a manifest", extra="ignore")
        rows = found.placement + found.placement_at_end
        if not rows:
            raise ConfigError("the manifest has no plan, as its run had no workers")
        return [plan_from_dict(row) for row in rows]
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def plan_from_dict(document: object) -> Plan:
    """Return the plan of a document; derived values are not read."""
    if not isinstance(document, Mapping) or document.get("schema") != SCHEMA:
        raise ConfigError(f"not a plan: there is no schema '{SCHEMA}'")
    if document.get("version") != VERSION:
        raise ConfigError(
            f"a plan of version {document.get('version')!r}, but cavmarl reads version {VERSION}"
        )
    found = validate(_Document, document, "not a plan", extra="ignore")
    for name, value in (("rule", asdict(found.rule)), ("snapshot", found.snapshot.to_dict())):
        if json.loads(json.dumps(value)) != json.loads(json.dumps(document[name])):
            raise ConfigError(
                f"not a plan: {name} = {document[name]!r} lacks a key or has unknown keys; it "
                f"must have {', '.join(value)}; make the plan again"
            )
    problem = Problem(
        shards=tuple(ShardCost(one.world, one.zone, one.cost_s) for one in found.shards),
        neighbors=found.neighbors,
        snapshot=found.snapshot,
        rule=found.rule,
        present=found.present,
        in_row=found.in_row,
        cost_source=found.cost_source,
    )
    return Plan(problem, tuple(one.worker for one in found.shards), found.method)
