"""`LimitsConfig`: roadside units that set variable speed limits."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Annotated, Literal

from cavmarl.config.checks import Section, Whole, Within, check_finite
from cavmarl.core.errors import ConfigError

# The named terms of a unit's reward, in the order of every array of these terms
# (`limits/kernels/limit_steps.py`).
LIMIT_TERMS = ("delay", "change")

NO_LIMITS = "none"
ALL_LIMITS = "all"

BY_AGENTS: Literal["agents"] = "agents"
LIMIT_CONTROLLERS = ("feedback",)  # see `limits.limit_controllers`


@dataclass(frozen=True)
class LimitsConfig(Section, key="limits"):
    """Roadside units that set speed limits; docs/reference/limit_agents.md describes the API.

    Attributes:
        units: variable speed limits: name of a roadside unit → the edges whose lanes get its limit.
        sections: name of a section → the edges whose vehicles are counted together. All units know
            all sections.
        agents: `none`; `all` units; or a list of names of units. Other units set no limit.
        controller: what chooses the limits: `agents` of the environment, or `feedback`; then all
            agents are vehicles.
        speeds_mps: the limits to choose from, ascending. If the map has a lower limit on a
            lane, that limit applies.
        decide_s: time between two decisions; a whole number of steps of `clock.ctrl_dt_s`.
        most_change: largest change per decision, in entries of `speeds_mps`; 0: no limit.
        forbidden: a choice that the action mask excludes is ignored and counted (`ignore`), or is
            an ActionError (`error`).
        terms: weights of the reward's terms; see `LIMIT_TERMS`.
        wanted_per_km: above this density, in vehicles per km and lane, `feedback` sets the lowest
            allowed limit; otherwise, the limit rises to the next entry of `speeds_mps`.
        watched: section whose density `feedback` reads; empty: the last section.
    """

    units: dict[str, tuple[str, ...]] = field(default_factory=dict)
    sections: dict[str, tuple[str, ...]] = field(default_factory=dict)
    agents: str | tuple[str, ...] = NO_LIMITS
    controller: Literal["agents", "feedback"] = BY_AGENTS
    speeds_mps: tuple[float, ...] = (13.9, 19.4, 25.0, 36.1)
    decide_s: Annotated[float, Within(0.001, 3600.0)] = 30.0
    most_change: Annotated[int, Whole(0, 100)] = 1
    forbidden: Literal["ignore", "error"] = "ignore"
    terms: dict[str, float] = field(default_factory=lambda: {"delay": 1.0})
    wanted_per_km: Annotated[float, Within(0.1, 200.0)] = 20.0
    watched: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.need(
            "agents",
            self.agents in (NO_LIMITS, ALL_LIMITS) or isinstance(self.agents, tuple),
            "must be none, all, or a list of names of limits.units",
        )
        self.need("agents", len(self.agents) > 0, "names no unit; use none")
        self.need(
            "agents",
            isinstance(self.agents, str) or len(set(self.agents)) == len(self.agents),
            "names a unit twice",
        )
        speeds = self.speeds_mps
        self.need(
            "speeds_mps",
            len(speeds) >= 2
            and speeds[0] > 0.0
            and all(low < high for low, high in pairwise(speeds))
            and speeds[-1] <= 100.0,
            "must be two or more ascending speeds above 0, at most 100 m/s",
        )
        for name, weight in self.terms.items():
            if name not in LIMIT_TERMS:
                raise ConfigError(
                    f"limits.terms = {name!r}: no such term; must be one of "
                    f"{', '.join(LIMIT_TERMS)}"
                )
            check_finite(f"limits.terms.{name}", weight, -1e6, 1e6)
        for key, named in (("units", self.units), ("sections", self.sections)):
            _check_edges(key, named)
        if self.are_controlled:
            self._check_names()

    def _check_names(self) -> None:
        """Raise a ConfigError for a name that is not defined."""
        self.need("units", bool(self.units), "must name a unit and its edges, or set agents: none")
        self.need("sections", bool(self.sections), "must name a section and its edges")
        if isinstance(self.agents, tuple):
            for name in self.agents:
                if name not in self.units:
                    raise ConfigError(
                        f"limits.agents: no unit {name!r}; must be one of {', '.join(self.units)}"
                    )
        self.need(
            "watched",
            not self.watched or self.watched in self.sections,
            f"must be one of {', '.join(self.sections)}, or empty",
        )

    @property
    def are_controlled(self) -> bool:
        """Whether any unit sets a limit."""
        return self.agents != NO_LIMITS

    @property
    def have_agents(self) -> bool:
        """Whether agents of the environment choose the limits."""
        return self.are_controlled and self.controller == BY_AGENTS

    @property
    def chosen(self) -> tuple[str, ...]:
        """The names of the units that set limits, in the order of `units`."""
        if not self.are_controlled:
            return ()
        return tuple(
            name for name in self.units if self.agents == ALL_LIMITS or name in self.agents
        )

    def refusal_of_agents(self, what: str) -> str:
        """Return why `what` does not support agents for limits; empty without such agents."""
        if not self.have_agents:
            return ""
        return (
            f"limits.agents = {self.agents!r}: {what} has only vehicles as agents; set "
            f"limits.controller to {', '.join(LIMIT_CONTROLLERS)}, or use make_vec, parallel_env "
            "or an adapter of TorchRL, BenchMARL or RLlib"
        )

    @property
    def weight_of_each(self) -> tuple[float, ...]:
        """The weights of all terms, in the order of `LIMIT_TERMS`."""
        return tuple(self.terms.get(name, 0.0) for name in LIMIT_TERMS)

    def check_clock(self, ctrl_dt_s: float) -> None:
        """Raise a ConfigError for a time that is not a whole number of steps."""
        ratio = self.decide_s / ctrl_dt_s
        self.need(
            "decide_s",
            abs(ratio - round(ratio)) < 1e-6 and round(ratio) >= 1,
            f"must be a whole number of steps of clock.ctrl_dt_s = {ctrl_dt_s:g}; try "
            f"{max(1, round(ratio)) * ctrl_dt_s:g}",
        )


def _check_edges(key: str, named: Mapping[str, tuple[str, ...]]) -> None:
    """Raise a ConfigError for a name without edges, or an edge that is named twice."""
    seen: dict[str, str] = {}
    for name, edges in named.items():
        if not edges:
            raise ConfigError(f"limits.{key}.{name}: names no edge; give a list of ids of edges")
        for edge in edges:
            if edge in seen:
                raise ConfigError(
                    f"limits.{key}.{name}: edge {edge!r} is already in {seen[edge]!r}; name it once"
                )
            seen[edge] = name
