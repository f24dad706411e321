"""`PopulationConfig`: the vehicles of a world."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.checks import Section, Whole
from cavmarl.config.fleet import FleetPart, OwnType, check_fleet, parts_in_turn

MAX_IDS = 1_000_000  # agents per episode; each has a space and rows in every output


@dataclass(frozen=True)
class PopulationConfig(Section, key="population"):
    """The vehicles of a world.

    Attributes:
        mode: `closed`: all agents enter at the reset. `open`: agents also enter during the episode,
            each id once, `budget` agents in all. `respawn`: a fixed set of `agents` ids; if an
            agent's vehicle ends its trip, the agent gets a new one.
        agents: number of vehicles that policies drive at the same time.
        background: number of vehicles that the built-in driver drives. In `closed` worlds they are
            placed at the reset; otherwise each arrival is replaced by a departure.
        budget: number of agents that may enter in an episode of an `open` world (default: 4 ·
            agents); not used in the other modes.
        types: vehicle types of the agents, from `car`, `truck` and `bus`. Agent k has type
            k modulo the length of the list.
        own_types: further vehicle types, by name; see `config.fleet.OwnType`.
        fleet: parts of the agents, each with its vehicle type, its sensors and its driver; see
            `config.fleet.FleetPart`. It replaces `types`.
        insertions: number of vehicles that may be inserted into a world during an episode
            (`insert_vehicle`); memory is reserved for them.
        external: number of vehicles in a world at the same time whose position the caller may set,
            or which the caller drives (`ExternalCommands`); memory is reserved for them.
        external_agents: whether such vehicles can carry the sensors of `rig`; then they are agents
            of a PettingZoo environment while they are in the world: `external_0` and so on.
        reroute: which vehicles take another route if lanes change (`map.changed_lanes`). `never`:
            none; vehicles wait before a closed road. `blocked`: vehicles whose route leads over a
            closed lane. `always`: all vehicles for which another route is faster, also after a
            speed limit has changed.
    """

    mode: Literal["closed", "open", "respawn"] = "closed"
    agents: Annotated[int, Whole(0, 100_000, "; 0: without agents")] = 4
    background: Annotated[int, Whole(0, 1_000_000)] = 20
    budget: int | None = None
    types: tuple[Literal["car", "truck", "bus"], ...] = ("car",)
    own_types: dict[str, OwnType] = field(default_factory=dict)
    fleet: tuple[FleetPart, ...] = ()
    insertions: Annotated[int, Whole(0, 10_000)] = 0
    external: Annotated[int, Whole(0, 10_000)] = 0
    external_agents: bool = False
    reroute: Literal["never", "blocked", "always"] = "blocked"

    def __post_init__(self) -> None:
        super().__post_init__()
        self.need("types", bool(self.types), "must name at least one of car, truck, bus")
        check_fleet(self.own_types, self.fleet)
        self.need(
            "types",
            not self.fleet or self.types == ("car",),
            "population.fleet sets the types; leave this key out",
        )
        if self.budget is not None and self.mode == "open":
            self.need(
                "budget",
                self.agents <= self.budget <= MAX_IDS,
                f"must be at least population.agents = {self.agents}, and at most {MAX_IDS}",
            )

    @property
    def agent_types(self) -> tuple[str, ...]:
        """Type of each agent by its number, repeated in order."""
        if not self.fleet:
            return self.types
        return tuple(self.fleet[part].type for part in self.part_of_agents.tolist()) or ("car",)

    @cached_property
    def part_of_agents(self) -> NDArray[np.int64]:
        """(num_ids,) part of the fleet of each agent; 0 without a fleet."""
        return parts_in_turn(self.fleet or (FleetPart(),), self.num_ids)

    def carriers(self, sensor: str) -> NDArray[np.bool_]:
        """Return (num_ids,) the agents that carry a sensor of `rig`."""
        if not self.fleet:
            return np.ones(self.num_ids, dtype=np.bool_)
        has = np.array([part.rig is None or sensor in part.rig for part in self.fleet])
        carried: NDArray[np.bool_] = has[self.part_of_agents]
        return carried

    @property
    def num_ids(self) -> int:
        """Number of agent ids that an episode can use."""
        if self.mode == "open":
            return self.budget if self.budget is not None else 4 * self.agents
        return self.agents
