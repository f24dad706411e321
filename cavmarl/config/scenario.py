"""`ScenarioConfig`: a scripted conflict for the agents of a world, or a logged scene."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from cavmarl.config.checks import Section
from cavmarl.core.scene_names import is_scene_file


@dataclass(frozen=True)
class ScenarioConfig(Section, key="scenario"):
    """A scripted conflict for the agents of each world; see docs/guides/scenarios.md.

    Attributes:
        name: a scenario, or the path of a `.py` file with one, or of a logged scene
            (docs/guides/logged_scenes.md); empty: none.
        place: name of a place on the map, from `cavmarl scenario run`; empty: a place that is drawn
            with `seed`.
        seed: seed that draws the place.
        params: values of the scenario's parameters; the other parameters keep their defaults.
        seats: the tracks of a logged scene that the agents drive, one per agent; empty: first the
            vehicle that logged the scene, then other vehicles in the order of the file.
    """

    name: str = ""
    place: str = ""
    seed: int = 0
    params: dict[str, bool | float] = field(default_factory=dict)
    seats: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        self.need("seed", self.seed >= 0, "must be 0 or more")
        self.need(
            "name",
            bool(self.name) or not (self.place or self.params),
            "must name a scenario if scenario.place or scenario.params is given",
        )
        self.need(
            "seats",
            not self.seats or is_scene_file(self.name),
            "needs a logged scene in scenario.name; leave this key out",
        )
        self.need(
            "seats", len(set(self.seats)) == len(self.seats), "must name each track at most once"
        )


def path_of_code(name: str) -> Path | None:
    """Return the path of the `.py` file in a scenario's name; None if the name is not a path."""
    path = Path(name)
    return path if path.suffix == ".py" else None
