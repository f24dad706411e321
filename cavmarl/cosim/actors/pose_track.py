"""`PoseTrack`: poses of a body, received at any rate, and the extrapolated pose at any time.

Poses arrive at 10 to 100 Hz, and the world steps at another rate. For the end of a step, the track
extrapolates the newest pose with the motion of the last two poses: the velocity turns with the
heading, at a constant rate. It extrapolates for a limited time; then the body stops.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from math import remainder
from typing import NamedTuple

from cavmarl.core.errors import ActionError
from cavmarl.core.math.elementary import cos_sin
from cavmarl.core.math.geometry import TWO_PI
from cavmarl.driving.kernels.motion.motion import MAX_SPEED_MPS
from cavmarl.engine.external_component import LARGEST

MOST_RATE_HZ = 1000.0
MOST_EXTRAPOLATION_S = 10.0
_SAME_S = 1e-9  # stamps that differ by less are equal


class PoseSample(NamedTuple):
    """A measured pose of a body."""

    stamp_s: float  # simulated time since the reset
    x: float  # position of the body's centre, m
    y: float
    heading: float  # rad, counter-clockwise from east
    z: float | None = None  # height of the ground below the centre, m; None: the lane's height
    pitch: float | None = None  # rad, positive uphill; None: the slope of the lane
    speed: float | None = None  # m/s along the heading; None: computed from the motion


@dataclass
class PoseCounts:
    """Counts of the poses of a track."""

    received: int = 0
    # poses that arrived after a newer pose (these are dropped), and poses that were more than one
    # period (1 / `rate_hz`) plus one step old on arrival (these are used)
    late: int = 0
    lost: int = 0  # poses missing between two poses at the given rate
    extrapolated: int = 0  # steps without a pose for the end of the step
    stopped: int = 0  # steps in which the newest pose was older than `extrapolation_s`
    worst_age_s: float = 0.0  # largest age of the newest pose at the end of a step

    def to_dict(self) -> dict[str, float]:
        """Return the counts by name."""
        return asdict(self)


class PoseTrack:
    """The poses of one body, in the order of their stamps.

    Args:
        rate_hz: rate of the poses; 0: unknown, so that no lost poses are counted.
        extrapolation_s: largest time for which a pose is extrapolated.

    Attributes:
        counts: late, lost and extrapolated poses.

    Raises:
        ActionError: `rate_hz` or `extrapolation_s` is out of range.
    """

    def __init__(self, rate_hz: float, extrapolation_s: float) -> None:
        for name, value, most in (
            ("rate_hz", rate_hz, MOST_RATE_HZ),
            ("extrapolation_s", extrapolation_s, MOST_EXTRAPOLATION_S),
        ):
            if not 0.0 <= value <= most:
                raise ActionError(f"{name} = {value}: must be from 0 to {most:g}")
        self._rate_hz = rate_hz
        self._bound_s = extrapolation_s
        self._newest: PoseSample | None = None
        self._before: PoseSample | None = None
        self.counts = PoseCounts()

    @property
    def is_empty(self) -> bool:
        """Whether no pose has arrived yet."""
        return self._newest is None

    def clear(self) -> None:
        """Forget the poses at the start of an episode; the counts go on."""
        self._newest = self._before = None

    def add(self, sample: PoseSample, now_s: float, step_s: float) -> None:
        """Add a pose that has arrived.

        Args:
            sample: the pose.
            now_s: simulated time of the world.
            step_s: duration of a step.

        Raises:
            ActionError: a number is not finite or out of range, or the stamp is after the end of
                the next step.
        """
        _check(sample, now_s + step_s)
        counts, newest = self.counts, self._newest
        counts.received += 1
        if newest is not None and sample.stamp_s <= newest.stamp_s + _SAME_S:
            counts.late += 1
            is_of_gap = sample.stamp_s < newest.stamp_s - _SAME_S and counts.lost > 0
            counts.lost -= is_of_gap and self._rate_hz > 0.0
            return
        if self._rate_hz > 0.0:
            period_s = 1.0 / self._rate_hz
            counts.late += sample.stamp_s < now_s - period_s - step_s - _SAME_S
            if newest is not None:
                missing = round((sample.stamp_s - newest.stamp_s) * self._rate_hz) - 1
                counts.lost += max(0, missing)
        self._before, self._newest = newest, sample

    def at(self, time_s: float) -> PoseSample | None:
        """Return the pose at a time that is not before the newest stamp; None: there is no pose."""
        newest, counts = self._newest, self.counts
        if newest is None:
            return None
        age_s = time_s - newest.stamp_s
        counts.worst_age_s = max(counts.worst_age_s, age_s)
        if age_s <= _SAME_S:
            return newest
        counts.extrapolated += 1
        is_old = age_s > self._bound_s + _SAME_S
        counts.stopped += is_old
        found = self._moved(newest, min(age_s, self._bound_s))
        return found._replace(stamp_s=time_s, speed=0.0 if is_old else found.speed)

    def _moved(self, newest: PoseSample, ahead_s: float) -> PoseSample:
        """Return a pose moved for some seconds."""
        before = self._before
        east = north = spin = rise = 0.0
        span_s = math.inf if before is None else newest.stamp_s - before.stamp_s
        if before is not None and span_s <= max(self._bound_s, 2.0 / max(self._rate_hz, 1e-3)):
            east, north = (newest.x - before.x) / span_s, (newest.y - before.y) / span_s
            spin = remainder(newest.heading - before.heading, TWO_PI) / span_s
            if newest.z is not None and before.z is not None:
                rise = (newest.z - before.z) / span_s
        turn = spin * ahead_s
        if newest.speed is not None:
            cos, sin = cos_sin(newest.heading + 0.5 * turn)
            east, north = newest.speed * cos, newest.speed * sin
        else:  # the velocity belongs to the middle of the last two poses
            half = 0.5 * turn + (0.0 if not spin else 0.5 * spin * span_s)
            cos, sin = cos_sin(half)
            east, north = east * cos - north * sin, east * sin + north * cos
        return newest._replace(
            x=newest.x + east * ahead_s,
            y=newest.y + north * ahead_s,
            heading=remainder(newest.heading + turn, TWO_PI),
            z=None if newest.z is None else newest.z + rise * ahead_s,
        )


def _check(sample: PoseSample, latest_s: float) -> None:
    for name, value in sample._asdict().items():
        if value is not None and not abs(value) <= LARGEST:
            raise ActionError(
                f"{name} = {value:g}: must be a finite number from {-LARGEST:g} to {LARGEST:g}"
            )
    if sample.stamp_s < 0.0:
        raise ActionError(f"stamp_s = {sample.stamp_s:g}: must be a time since the reset, from 0")
    if sample.stamp_s > latest_s + _SAME_S:
        raise ActionError(
            f"stamp_s = {sample.stamp_s:g}: is in the future; must be at most {latest_s:g}, the "
            "end of the next step; use the time of the snapshots (time_s)"
        )
    if sample.speed is not None and abs(sample.speed) > MAX_SPEED_MPS:
        raise ActionError(
            f"speed = {sample.speed:g} m/s: must be from {-MAX_SPEED_MPS:g} to {MAX_SPEED_MPS:g}"
        )
