"""`SumoConfig`: the keys under `sumo` of `env.yaml`, used if SUMO provides the traffic."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from cavmarl.config.checks import Section, Whole


@dataclass(frozen=True)
class SumoConfig(Section, key="sumo"):
    """Settings of SUMO for `traffic.source` `sumo-demand` or `sumo-traffic`; docs/guides/sumo.md.

    Attributes:
        interface: `libsumo`, `traci` (slower, same results), or `auto`: the first of these that is
            installed.
        max_vehicles: number of SUMO's vehicles that a world can hold; SUMO delays the others.
        max_persons: number of SUMO's persons that a world mirrors at the same time with
            `sumo-traffic`; memory is reserved for them if the demand has persons.
        replay_mib: MiB per world for the inputs of SUMO during an episode, 48 bytes per vehicle and
            tick. With `sumo-traffic` and worker processes, three copies are kept. If a worker dies,
            its successor uses them to run SUMO again. 0: nothing is kept, and a death is an error.
    """

    interface: Literal["auto", "libsumo", "traci"] = "auto"
    max_vehicles: Annotated[int, Whole(1, 1_000_000)] = 5000
    max_persons: Annotated[int, Whole(0, 100_000)] = 200
    replay_mib: Annotated[int, Whole(0, 1_000_000)] = 256
