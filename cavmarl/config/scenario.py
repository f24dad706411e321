"""`ScenarioConfig`: a scripted conflict for the agents of a world."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from cavmarl.config.checks import Section


@dataclass(frozen=True)
class ScenarioConfig(Section, key="scenario"):
    """A scripted conflict for the agents of each world; see docs/guides/scenarios.md.

    Attributes:
        name: a scenario, or the path of a `.py` file with one; empty: none.
        place: name of a place on the map, from `cavmarl scenario run`; empty: a place that is drawn
            with `seed`.
        seed: seed that draws the place.
        params: values of the scenario's parameters; the other parameters keep their defaults.
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
            "must name a scenario if scenario.place or scenario.params is given",
        )


def path_of_code(name: str) -> Path | None:
    """Return the path of the `.py` file in a scenario's name; None if the name is not a path."""
    path = Path(name)
    return path if path.suffix == ".py" else None
