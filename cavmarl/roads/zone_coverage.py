"""How far zones must see over their borders for a divided world to be the undivided one.

Ghosts go by reach and not by contact (decision 012): the halo is a distance, and a zone gets every
vehicle within it, from neighbours or from far behind them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from cavmarl.errors import ZoneError
from cavmarl.kernels.zones import Halo
from cavmarl.roads.zones import ZonePartition

__all__ = ["Coverage", "zone_halo"]

# Added to the halo, so that no rounding of the sum below can make it too narrow.
_ROUNDING_M = 1e-6


@dataclass(frozen=True)
class Coverage:
    """The coverage inequality: halo ≥ R + h + (D + 1) · v_max · dt.

    A vehicle is still driven by its old zone when it is h behind the border and its transfer has
    failed in D ticks; in the tick of the hand-over it moves once more. From there it looks R far.

    Attributes:
        reach_m: R, the farthest that a sensor or a model of behaviour looks.
        hysteresis_m: h, how far behind a border a vehicle changes its zone.
        max_deferred_ticks: D, ticks after which a hand-over is forced.
        max_speed_mps: v_max, that no vehicle can exceed.
        sim_dt_s: dt, seconds a tick.

    Raises:
        ZoneError: a negative or infinite number.
    """

    reach_m: float
    hysteresis_m: float
    max_deferred_ticks: int
    max_speed_mps: float
    sim_dt_s: float

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (math.isfinite(value) and value >= 0.0):
                raise ZoneError(f"{name} = {value!r}: must be a finite number from 0")

    @classmethod
    def of(
        cls,
        reaches_m: Iterable[float],
        *,
        hysteresis_m: float,
        max_deferred_ticks: int,
        max_speed_mps: float,
        sim_dt_s: float,
    ) -> Coverage:
        """With the farthest of all declared reaches."""
        farthest = max(reaches_m, default=0.0)
        return cls(farthest, hysteresis_m, max_deferred_ticks, max_speed_mps, sim_dt_s)

    @property
    def halo_m(self) -> float:
        """The narrowest halo that is exact."""
        late_m = (self.max_deferred_ticks + 1) * self.max_speed_mps * self.sim_dt_s
        return self.reach_m + self.hysteresis_m + late_m + _ROUNDING_M

    def check(self, halo_m: float) -> None:
        """Refuse a halo that is too narrow.

        Raises:
            ZoneError: with all numbers of the inequality.
        """
        if not halo_m >= self.halo_m:
            raise ZoneError(
                f"a halo of {halo_m:g} m is too narrow to be exact: reach {self.reach_m:g} m + "
                f"hysteresis {self.hysteresis_m:g} m + ({self.max_deferred_ticks} + 1) ticks · "
                f"{self.max_speed_mps:g} m/s · {self.sim_dt_s:g} s need {self.halo_m:.6f} m; widen "
                "it, or shorten the farthest reach"
            )


def zone_halo(partition: ZonePartition, halo_m: float) -> Halo:
    """What `kernels.exchange.exchange` takes.

    Raises:
        ZoneError: `halo_m` is negative or not finite.
    """
    if not (math.isfinite(halo_m) and halo_m >= 0.0):
        raise ZoneError(f"halo_m = {halo_m!r}: must be a finite number from 0")
    rects = partition.reaching
    # A little further in: whoever lies inside is out of every other zone's halo by any rounding.
    margin = halo_m + _ROUNDING_M
    inner = rects + np.array([margin, margin, -margin, -margin])
    gaps = np.maximum(rects[:, None, :2] - rects[None, :, 2:], 0.0)
    gaps = np.maximum(gaps, gaps.swapaxes(0, 1))
    near = (gaps * gaps).sum(axis=2) <= halo_m * halo_m
    start = np.concatenate([[0], np.cumsum(near.sum(axis=1))]).astype(np.int32)
    return Halo(float(halo_m), inner, start, np.nonzero(near)[1].astype(np.int32))
