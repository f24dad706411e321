"""`PopulationConfig`: the vehicles of a world."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from cavmarl.config.checks import Section, Whole

MAX_IDS = 1_000_000  # of agents in one episode: each has its space and its rows in every output


@dataclass(frozen=True)
class PopulationConfig(Section, key="population"):
    """The vehicles of a world.

    Attributes:
        mode: `closed`: all agents enter at reset. `open`: agents also enter during the episode,
            each id once, `budget` in all. `respawn`: `agents` fixed ids; when the vehicle of one
            ends, the id gets a new vehicle.
        agents: vehicles driven by policies at any one time.
        background: vehicles driven by the built-in drivers. In `closed` worlds they are placed at
            reset; else each arrival orders a new departure, so that their number holds.
        budget: how many agents may enter in one episode of an `open` world (default 4 ·
            agents); the other modes do not read it.
        types: vehicles of the agents in turn, of `car`, `truck` and `bus`: agent k has the one
            at place k, counted round.
        insertions: how many vehicles may be put into a world in one episode while it runs
            (`insert_vehicle`, `close_road`); there is room for them.
    """

    mode: Literal["closed", "open", "respawn"] = "closed"
    agents: Annotated[int, Whole(0, 100_000, "; 0: a world to watch")] = 4
    background: Annotated[int, Whole(0, 1_000_000)] = 20
    budget: int | None = None
    types: tuple[Literal["car", "truck", "bus"], ...] = ("car",)
    insertions: Annotated[int, Whole(0, 10_000)] = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        self.need("types", bool(self.types), "must name at least one of car, truck, bus")
        if self.budget is not None and self.mode == "open":
            self.need(
                "budget",
                self.agents <= self.budget <= MAX_IDS,
                f"must be at least population.agents = {self.agents}, and at most {MAX_IDS}",
            )

    @property
    def num_ids(self) -> int:
        """How many agent ids an episode can use."""
        if self.mode == "open":
            return self.budget if self.budget is not None else 4 * self.agents
        return self.agents
