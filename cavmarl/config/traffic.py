"""`TrafficConfig`: where departures come from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from cavmarl.config.checks import Section, Whole, Within


@dataclass(frozen=True)
class TrafficConfig(Section, key="traffic"):
    """Where departures come from.

    Attributes:
        source: what reads the demand files. `native`: cavmarl. `sumo-demand`: SUMO says which
            vehicle departs when and on which route, and what signals show; our drivers drive.
            `sumo-traffic`: SUMO moves its vehicles, too. The generator's drive beside them.
        demand: SUMO files of vehicles, flows, routes and types (`.rou.xml`, `.add.xml`,
            `.sumocfg`): named as `map.source`; their vehicles drive beside the generator's.
        on_bad_route: what to do with vehicles of the demand that cannot drive their route, and with
            stops off it: `error`, or `skip` them (counted).
        goals: how many destination edges the generator uses; lane-level plans are made for each.
        origins: edges that agents start on, by id; empty: all that lead somewhere.
        destinations: edges that agents drive to, by id; empty: the generator's goals.
        min_trip_m: shortest way of an agent between origin and destination.
        max_trip_m: longest way of an agent; 0: no limit.
        endless: agents drive on to another goal before they reach theirs, as the background of a
            `closed` world does: 150 m before it, to one that is farther than that.
        speed_factor_spread: half width of the drivers' uniform spread of desired speed over limit.
        model: how the generator's vehicles follow their leader: `IDM`, `Krauss`, `ACC`, or a model
            that is registered (docs/guides/extending.md). Those of `demand` drive as their type
            says.
        trip_horizon: so many times what its way takes at the limits, and one cycle of each signal
            on it, an agent's trip may take; then the vehicle leaves, and the trip is truncated.
            0: only the episode's horizon cuts it.
    """

    source: Literal["native", "sumo-demand", "sumo-traffic"] = "native"
    demand: tuple[str, ...] = ()
    on_bad_route: Literal["error", "skip"] = "error"
    goals: Annotated[int, Whole(1, 1024)] = 32
    origins: tuple[str, ...] = ()
    destinations: tuple[str, ...] = ()
    min_trip_m: Annotated[float, Within(0.0, 1e6)] = 100.0
    max_trip_m: Annotated[float, Within(0.0, 1e6)] = 0.0
    endless: bool = False
    speed_factor_spread: Annotated[float, Within(0.0, 0.5)] = 0.1
    model: str = "IDM"
    trip_horizon: Annotated[float, Within(0.0, 1000.0)] = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self.need(
            "trip_horizon",
            self.trip_horizon == 0.0 or self.trip_horizon >= 1.0,
            "must be 0 (none), or 1 or more: no vehicle is faster than the limits allow",
        )
        self.need(
            "source",
            self.source == "native" or bool(self.demand),
            "needs traffic.demand: a .sumocfg, or files of routes",
        )
        self.need(
            "max_trip_m",
            self.max_trip_m == 0.0 or self.max_trip_m > self.min_trip_m,
            f"must be 0 (no limit) or above traffic.min_trip_m = {self.min_trip_m:g}",
        )
