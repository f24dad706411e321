"""`ZonesConfig`: the division of a map into zones."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from cavmarl.config.checks import Section, Whole, Within

MAX_ZONES = 256  # per map
ZONE_LAYOUTS = ("grid", "strips", "bisection")
ZONE_FILE_SUFFIXES = (".json", ".yaml", ".yml")


@dataclass(frozen=True)
class ZonesConfig(Section, key="zones"):
    """The division of the map into zones; see docs/reference/zones.md.

    Attributes:
        layout: division method `grid`, `strips` or `bisection`; or a zone file, with a path as in
            `map.source`.
        count: number of zones; with a zone file, the number in the file.
        avoid_junctions: move borders if that keeps junctions in one zone.
        weight: quantity that `bisection` distributes evenly: length of lanes, or area.
        hysteresis_m: distance past a border at which a vehicle changes its zone.
        max_deferred_ticks: ticks for which a vehicle that has crossed a border may stay with its
            old zone, if the new one does not acknowledge it; then the change is forced.
        backoff_ticks: ticks for which a zone that has refused a vehicle is not asked again.
        halo_m: how far zones see over their borders; default: the minimum for exact results. A
            smaller value is an error.
        approach_ticks: a vehicle is announced to the next zone if it would be there after this
            number of ticks at its present velocity.
        journal: file for the coordinator's log, which must not exist yet; empty: no log.
        check_invariants: check the invariants of ownership at run time.
        repartition_steps: steps between two checks whether bisection by vehicle positions would
            balance the zones better. Results do not depend on it. 0: never.
        repartition_tolerance: zones change only if that reduces the number of vehicles in the
            fullest zone by more than this share of the mean number of vehicles per zone.
        simulators: zones that other simulators run, by number: `carla://HOST:PORT`, or the name of
            a registered simulator (docs/guides/zone_simulators.md).
        simulator_failure: if a simulator fails or refuses a vehicle for too long: `error`, or
            `return`: cavmarl runs the zone until the episode ends.
    """

    layout: str = "bisection"
    count: Annotated[int, Whole(1, MAX_ZONES)] = 1
    avoid_junctions: bool = False
    weight: Literal["lane_length", "uniform"] = "lane_length"
    hysteresis_m: Annotated[float, Within(0.0, 100.0)] = 2.0
    max_deferred_ticks: Annotated[int, Whole(0, 1000)] = 2
    backoff_ticks: Annotated[int, Whole(0, 1000)] = 4
    halo_m: Annotated[float | None, Within(0.0, 1e6)] = None
    approach_ticks: Annotated[int, Whole(1, 1000)] = 2
    journal: str = ""
    check_invariants: bool = False
    repartition_steps: Annotated[int, Whole(0, 1_000_000)] = 0
    repartition_tolerance: Annotated[float, Within(0.0, 100.0)] = 0.1
    simulators: dict[int, str] = field(default_factory=dict)
    simulator_failure: Literal["error", "return"] = "error"

    def __post_init__(self) -> None:
        super().__post_init__()
        self.need(
            "simulators",
            not (self.simulators and self.repartition_steps),
            "other simulators cannot change their zones: set zones.repartition_steps to 0",
        )
        self.need(
            "layout",
            self.layout in ZONE_LAYOUTS or self.layout.endswith(ZONE_FILE_SUFFIXES),
            f"must be {', '.join(ZONE_LAYOUTS)}, or a zone file ({', '.join(ZONE_FILE_SUFFIXES)})",
        )
