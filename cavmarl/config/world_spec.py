"""`WorldSpec`: the arguments by which a world is named, as they travel together."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypedDict, Unpack

from cavmarl.core.seeds import check_seed


class WorldKeys(TypedDict, total=False):
    """Keywords of functions that take a world; as the fields of `WorldSpec`."""

    agents: int | None
    background: int | None
    max_cycles: int | None
    seed: int
    overrides: Mapping[str, Any] | None


@dataclass(frozen=True, kw_only=True)
class WorldSpec:
    """Which world to make: `make_vec(spec.env, **spec.keywords)` makes some of it."""

    env: str  # name, folder or map file of an environment
    agents: int | None = None  # shadows population.agents
    background: int | None = None  # shadows population.background
    max_cycles: int | None = None  # shadows horizon_s, in steps
    seed: int = 0  # root of all random numbers
    overrides: Mapping[str, Any] = field(default_factory=dict)  # values for any other key

    def __post_init__(self) -> None:
        object.__setattr__(self, "seed", check_seed(self.seed))

    @classmethod
    def of(cls, env: str | Path | WorldSpec, **keys: Unpack[WorldKeys]) -> WorldSpec:
        """What a function is given that takes a world: a spec, or an environment and keywords."""
        if isinstance(env, WorldSpec):
            return env
        given: dict[str, Any] = {**keys, "overrides": dict(keys.get("overrides") or {})}
        return cls(env=str(env), **given)

    @property
    def keywords(self) -> dict[str, Any]:
        """For `load_world`, `make_vec` and `parallel_env`, which take the seed elsewhere."""
        return {
            "agents": self.agents,
            "background": self.background,
            "max_cycles": self.max_cycles,
            "overrides": self.overrides,
        }
