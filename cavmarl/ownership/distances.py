"""The three distances at a border, and the minimum width of the overlap.

    distance      side of the border    what happens there                   step of a transfer
    approach_m    before                the owner begins to offer a vehicle  PREPARE
    hysteresis_m  beyond                the vehicle changes its owner        SWITCH
    overlap_m     beyond                the old zone drops its ghost         RELEASE

`docs/explanation/ownership.md` explains the steps. `zones/kernels/borders.py` finds the vehicles
that are offered and that switch.
"""

from __future__ import annotations

from dataclasses import dataclass

from cavmarl.core.errors import ConfigError
from cavmarl.ownership.limits import Limits


@dataclass(frozen=True, slots=True)
class Distances:
    """The three distances of a world."""

    approach_m: float  # distance before the border from which a vehicle is offered
    hysteresis_m: float  # distance beyond the border up to which the owner does not change
    overlap_m: float  # width of the strip around a zone that the zone sees (B)

    def __post_init__(self) -> None:
        if min(self.approach_m, self.hysteresis_m) < 0:
            raise ConfigError(f"{self} has a distance below 0; use distances from 0 up")
        if self.overlap_m <= max(self.approach_m, self.hysteresis_m):
            raise ConfigError(
                f"an overlap of {self.overlap_m:g} m must be wider than the approach of "
                f"{self.approach_m:g} m and the hysteresis of {self.hysteresis_m:g} m; increase "
                "the overlap, or decrease the other distances"
            )


def needed_overlap_m(
    reach_m: float, hysteresis_m: float, limits: Limits, v_max_mps: float, dt_s: float
) -> float:
    """Return the minimum overlap, B = R + h + (D + 1) · v_max · dt.

    A zone may keep a vehicle for D = `limits.deferral` ticks after the vehicle has crossed the
    border and the hysteresis h. It must see everything within R = `reach_m` of the vehicle, however
    far the vehicle has moved in that time.
    """
    return reach_m + hysteresis_m + (limits.deferral + 1) * v_max_mps * dt_s


def check_coverage(
    distances: Distances, limits: Limits, *, reach_m: float, v_max_mps: float, dt_s: float
) -> None:
    """Raise ConfigError if the source of a vehicle could not safely keep it during a transfer."""
    needed = needed_overlap_m(reach_m, distances.hysteresis_m, limits, v_max_mps, dt_s)
    if distances.overlap_m < needed:
        raise ConfigError(
            f"an overlap of {distances.overlap_m:g} m is too narrow; use at least {needed:g} m = "
            f"reach {reach_m:g} m + hysteresis {distances.hysteresis_m:g} m + "
            f"({limits.deferral} + 1) ticks · {v_max_mps:g} m/s · {dt_s:g} s"
        )
    if distances.approach_m < v_max_mps * dt_s:
        raise ConfigError(
            f"an approach of {distances.approach_m:g} m is too short, because vehicles would cross "
            f"before they are offered; use at least the longest move in a tick, "
            f"{v_max_mps * dt_s:g} m"
        )
