"""How SUMO is run where it is global traffic: the keys under `sumo` of `env.yaml`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from cavmarl.config.checks import check as _check

__all__ = ["SumoConfig"]


@dataclass(frozen=True)
class SumoConfig:
    """Read where `traffic.source` is `sumo-demand` or `sumo-traffic`; see docs/sumo.md.

    Attributes:
        interface: `libsumo`, `traci` (slower, the same results), or `auto`: the first of them that
            is installed.
        max_vehicles: of SUMO's that one world can hold; SUMO keeps others waiting.
        replay_mib: MiB, by world, for what SUMO was told of our vehicles in an episode, 40 bytes a
            vehicle and tick: `sumo-traffic` with worker processes keeps it thrice, and where one
            dies its successor runs SUMO again with it. 0: nothing is kept, a death is an error.
    """

    interface: Literal["auto", "libsumo", "traci"] = "auto"
    max_vehicles: int = 5000
    replay_mib: int = 256

    def __post_init__(self) -> None:
        _check(
            1 <= self.max_vehicles <= 1_000_000,
            "sumo.max_vehicles",
            self.max_vehicles,
            "must be a whole number from 1 to 1000000",
        )
        _check(
            0 <= self.replay_mib <= 1_000_000,
            "sumo.replay_mib",
            self.replay_mib,
            "must be a whole number of MiB from 0 to 1000000",
        )
