"""`TrafficConfig`: the departures of vehicles."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from cavmarl.config.checks import Section, Whole, Within

ZOO = "zoo:"  # prefix of the name of a trained driver that drives background vehicles


@dataclass(frozen=True)
class TrafficConfig(Section, key="traffic"):
    """The departures of vehicles.

    Attributes:
        source: `native`: cavmarl reads the demand files. `sumo-demand`: SUMO determines departures,
            routes and signals; cavmarl's drivers drive. `sumo-traffic`: SUMO also moves its
            vehicles. Generated vehicles are added in all three cases.
        demand: SUMO files with vehicles, flows, routes and types (`.rou.xml`, `.add.xml`,
            `.sumocfg`), with paths as in `map.source`. Their vehicles are added to the generated
            ones.
        on_bad_route: handling of vehicles of the demand that cannot drive their route, and of stops
            off the route: `error`, or `skip` them (counted).
        goals: number of destination edges of the generator. For each, the world needs memory for a
            table of routes from all lanes.
        origins: ids of edges that agents start on; empty: all edges from which a goal is reachable.
        destinations: ids of edges that agents drive to; empty: the generator's goals.
        min_trip_m: shortest route of an agent between origin and destination.
        max_trip_m: longest route of an agent; 0: no limit.
        endless: 150 m before their goal, agents get another goal, farther than 150 m away, like the
            background vehicles of a `closed` world.
        speed_factor_spread: half width of the uniform distribution of desired speed / speed limit.
        model: driver of the generator's vehicles: a car-following model (`IDM`, `Krauss`, `ACC`, or
            a registered model, docs/guides/extending.md), or `zoo:` and the name of a trained
            driver (docs/guides/learned_traffic.md). Several drivers: a mapping from each driver to
            its share, relative to the others. Vehicles of `demand` follow their type.
        trip_horizon: limit of an agent's trip: this multiple of the time that its route takes at
            the speed limits, plus one cycle of each signal on it. Then the vehicle leaves, and the
            trip is truncated. 0: only the episode's horizon limits it.
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
    model: str | dict[str, float] = "IDM"
    trip_horizon: Annotated[float, Within(0.0, 1000.0)] = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self.need(
            "trip_horizon",
            self.trip_horizon == 0.0 or self.trip_horizon >= 1.0,
            "must be 0 (no limit), or at least 1: no vehicle is faster than the limits allow",
        )
        self.need(
            "source",
            self.source == "native" or bool(self.demand),
            "needs traffic.demand: a .sumocfg, or route files",
        )
        self.need(
            "max_trip_m",
            self.max_trip_m == 0.0 or self.max_trip_m > self.min_trip_m,
            f"must be 0 (no limit), or above traffic.min_trip_m = {self.min_trip_m:g}",
        )
        self._check_models()

    def _check_models(self) -> None:
        """Check the drivers and their shares."""
        shares = list(self.models.values())
        self.need("model", bool(shares), "must name a driver, or map drivers to their shares")
        self.need(
            "model",
            all(math.isfinite(share) and share >= 0.0 for share in shares)
            and 0.0 < sum(shares) < math.inf,
            "shares must be finite numbers of at least 0, and at least one must be above 0",
        )
        self.need(
            "model",
            self.source == "native" or (isinstance(self.model, str) and not self.networks),
            f"traffic.source = {self.source} needs one car-following model, such as IDM; trained "
            "drivers and shares need traffic.source = native",
        )

    @property
    def models(self) -> dict[str, float]:
        """The drivers of the generator's vehicles, with their shares.

        Trained drivers come first, then larger shares, then names in alphabetical order. The order
        of `model` does not matter, since digests of configurations leave it out.
        """
        if isinstance(self.model, str):
            return {self.model: 1.0}
        ranked = sorted(
            self.model.items(), key=lambda item: (not item[0].startswith(ZOO), -item[1], item[0])
        )
        return dict(ranked)

    @property
    def networks(self) -> tuple[str, ...]:
        """The trained drivers of background vehicles, by name or path."""
        return tuple(name.removeprefix(ZOO) for name in self.models if name.startswith(ZOO))
