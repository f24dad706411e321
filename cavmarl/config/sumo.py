"""How SUMO is run where it is global traffic: the keys under `sumo` of `env.yaml`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from cavmarl.config.checks import Section, Whole


@dataclass(frozen=True)
class SumoConfig(Section, key="sumo"):
    """Read where `traffic.source` is `sumo-demand` or `sumo-traffic`; see docs/guides/sumo.md.

    Attributes:
        interface: `libsumo`, `traci` (slower, the same results), or `auto`: the first of them that
            is installed.
        max_vehicles: of SUMO's that one world can hold; SUMO keeps others waiting.
        replay_mib: MiB, by world, for what SUMO was told of our vehicles in an episode, 40 bytes a
            vehicle and tick: `sumo-traffic` with worker processes keeps it thrice, and where one
            dies its successor runs SUMO again with it. 0: nothing is kept, a death is an error.
    """

    interface: Literal["auto", "libsumo", "traci"] = "auto"
    max_vehicles: Annotated[int, Whole(1, 1_000_000)] = 5000
    replay_mib: Annotated[int, Whole(0, 1_000_000)] = 256
