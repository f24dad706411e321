"""The key `scenario`: what happens to the agents, and where."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from cavmarl.config.checks import Section


@dataclass(frozen=True)
class ScenarioConfig(Section, key="scenario"):
    """One scripted conflict for the agents of each world; docs/guides/scenarios.md.

    Attributes:
        name: of a scenario, or the path of a `.py` file with one; empty: none.
        place: where, by a name of the map as `cavmarl scenario run` prints it; empty: one of the
            places that the map has, drawn by `seed`.
        seed: draws the place.
        params: values of the scenario's parameters; the others have their defaults.
    """

    name: str = ""
    place: str = ""
    seed: int = 0
    params: dict[str, bool | float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.need("seed", self.seed >= 0, "must be 0 or more")
        self.need(
            "name",
            bool(self.name) or not (self.place or self.params),
            "must name a scenario where scenario.place or scenario.params is given",
        )


def path_of_code(name: str) -> Path | None:
    """The `.py` file that a scenario's name means, however its path is written; None: no path."""
    path = Path(name)
    return path if path.suffix == ".py" else None
