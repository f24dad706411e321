"""Three distances at a border, and how wide the overlap has to be.

    approach      the owner begins to offer the vehicle                  PREPARE
    control       past the border by more than the hysteresis            SWITCH
    overlap       out of the strip that the old zone sees as ghosts      RELEASE

A depth is how far a vehicle is beyond the border of a zone: positive outside the owner's zone,
negative inside. The runtime compares whole arrays of depths with the same thresholds.
"""

from __future__ import annotations

from dataclasses import dataclass

from cavmarl.core.errors import ConfigError
from cavmarl.ownership.limits import Limits


@dataclass(frozen=True, slots=True)
class Distances:
    """The three distances of a world."""

    approach_m: float  # before the border; offers begin
    hysteresis_m: float  # beyond the border; up to there the owner stays
    overlap_m: float  # width of the strip around a zone that it sees and has roads for (B)

    def __post_init__(self) -> None:
        if min(self.approach_m, self.hysteresis_m) < 0:
            raise ConfigError(f"distances at a border are not below 0: {self}")
        if self.overlap_m <= max(self.approach_m, self.hysteresis_m):
            raise ConfigError(
                f"an overlap of {self.overlap_m:g} m has to be wider than the approach of "
                f"{self.approach_m:g} m and the hysteresis of {self.hysteresis_m:g} m: widen it or "
                "shorten them"
            )

    def offers(self, depth_m: float) -> bool:
        """Whether the owner offers the vehicle to the zone behind the border."""
        return depth_m > -self.approach_m

    def switches(self, depth_m: float) -> bool:
        """Whether the vehicle has crossed, and is a mover for `Directory.begin`."""
        return depth_m > self.hysteresis_m

    def releases(self, depth_m: float) -> bool:
        """Whether the vehicle is out of the sight of the zone that it left."""
        return depth_m > self.overlap_m


def needed_overlap_m(
    reach_m: float, hysteresis_m: float, limits: Limits, v_max_mps: float, dt_s: float
) -> float:
    """The least overlap: B = R + h + (D + 1) · v_max · dt.

    A zone that keeps a vehicle for D more ticks must see all that the vehicle can see, `reach_m`
    around it, however far it has come in that time.
    """
    return reach_m + hysteresis_m + (limits.deferral + 1) * v_max_mps * dt_s


def check_coverage(
    distances: Distances, limits: Limits, *, reach_m: float, v_max_mps: float, dt_s: float
) -> None:
    """Refuse a world in which "the source stays authoritative" would not be safe."""
    needed = needed_overlap_m(reach_m, distances.hysteresis_m, limits, v_max_mps, dt_s)
    if distances.overlap_m < needed:
        raise ConfigError(
            f"an overlap of {distances.overlap_m:g} m is too narrow: {needed:g} m = reach "
            f"{reach_m:g} m + hysteresis {distances.hysteresis_m:g} m + "
            f"({limits.deferral} + 1) ticks · {v_max_mps:g} m/s · {dt_s:g} s are needed"
        )
    if distances.approach_m < v_max_mps * dt_s:
        raise ConfigError(
            f"an approach of {distances.approach_m:g} m is shorter than the way of a tick, "
            f"{v_max_mps * dt_s:g} m: vehicles would cross before they are offered"
        )
