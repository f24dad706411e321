"""Poses that arrive at their own rate: limited extrapolation, late and lost poses."""

from __future__ import annotations

import math
from typing import Any

import pytest

from cavmarl.core.errors import ActionError
from cavmarl.cosim.actors.pose_track import PoseSample, PoseTrack

STEP_S = 0.05


def straight(stamp_s: float, speed_mps: float = 10.0, **more: Any) -> PoseSample:
    """Return a pose on the x axis."""
    return PoseSample(stamp_s, speed_mps * stamp_s, 2.0, 0.0, **more)


def test_a_pose_at_the_requested_time_is_returned_unchanged() -> None:
    track = PoseTrack(20.0, 0.5)
    sample = PoseSample(0.05, 1.0, 2.0, 0.3, 0.1, 0.02, 4.0)
    track.add(sample, 0.0, STEP_S)
    assert track.at(0.05) == sample
    assert track.counts.extrapolated == 0


def test_straight_motion_is_extrapolated_from_two_poses_or_from_a_speed() -> None:
    without = PoseTrack(100.0, 0.5)
    stated = PoseTrack(100.0, 0.5)
    for stamp_s in (0.01, 0.02):
        without.add(straight(stamp_s), 0.02, STEP_S)
        stated.add(straight(stamp_s, speed=10.0), 0.02, STEP_S)
    for track in (without, stated):
        found = track.at(0.05)
        assert found is not None
        assert (found.x, found.y, found.heading) == pytest.approx((0.5, 2.0, 0.0))
        assert track.counts.extrapolated == 1
        assert track.counts.worst_age_s == pytest.approx(0.03)


@pytest.mark.parametrize("is_stated", [False, True])
def test_a_turn_is_extrapolated_along_its_circle(is_stated: bool) -> None:
    radius_m, speed_mps = 20.0, 8.0
    rate = speed_mps / radius_m

    def on_circle(stamp_s: float) -> PoseSample:
        angle = rate * stamp_s
        place = radius_m * math.sin(angle), radius_m * (1.0 - math.cos(angle))
        return PoseSample(stamp_s, *place, angle, speed=speed_mps if is_stated else None)

    track = PoseTrack(10.0, 0.5)
    for stamp_s in (0.3, 0.4):
        track.add(on_circle(stamp_s), stamp_s, STEP_S)
    found, expected = track.at(0.7), on_circle(0.7)
    assert found is not None
    assert math.hypot(found.x - expected.x, found.y - expected.y) < 0.01
    assert found.heading == pytest.approx(expected.heading)


def test_the_body_stops_when_extrapolation_reaches_its_limit() -> None:
    track = PoseTrack(20.0, 0.2)
    for stamp_s in (0.05, 0.1):
        track.add(straight(stamp_s), stamp_s, STEP_S)
    at_bound, after, later = track.at(0.3), track.at(0.35), track.at(9.0)
    assert at_bound is not None
    assert after is not None
    assert later is not None
    assert at_bound.x == pytest.approx(3.0)
    assert at_bound.speed is None
    assert (after.x, after.speed) == (at_bound.x, 0.0)
    assert (later.x, later.speed) == (at_bound.x, 0.0)
    assert (track.counts.extrapolated, track.counts.stopped) == (3, 2)
    assert track.counts.worst_age_s == pytest.approx(8.9)


def test_missing_poses_count_as_lost_and_late_poses_count_as_late() -> None:
    track = PoseTrack(100.0, 0.5)
    for number in (1, 2, 5, 6):
        track.add(straight(number / 100.0), number / 100.0, STEP_S)
    assert (track.counts.lost, track.counts.late) == (2, 0)
    track.add(straight(0.03), 0.06, STEP_S)  # arrives after newer poses
    assert (track.counts.lost, track.counts.late, track.counts.received) == (1, 1, 5)
    found = track.at(0.06)
    assert found is not None
    assert found.x == pytest.approx(0.6)
    track.add(straight(0.07), 0.5, STEP_S)  # the newest pose, but it arrives 0.43 s after its time
    assert track.counts.late == 2
    track.add(straight(0.07), 0.5, STEP_S)  # the same pose a second time
    assert (track.counts.late, track.counts.lost) == (3, 1)


def test_without_a_rate_no_pose_counts_as_lost() -> None:
    track = PoseTrack(0.0, 0.5)
    for stamp_s in (0.0, 1.0, 3.0):
        track.add(straight(stamp_s), stamp_s, STEP_S)
    assert (track.counts.lost, track.counts.late) == (0, 0)


def test_a_new_episode_deletes_the_poses_and_keeps_the_counts() -> None:
    track = PoseTrack(20.0, 0.5)
    track.add(straight(0.05), 0.05, STEP_S)
    track.clear()
    assert track.is_empty
    assert track.at(0.1) is None
    assert track.counts.received == 1


@pytest.mark.parametrize(
    ("sample", "match"),
    [
        (PoseSample(0.0, math.nan, 0.0, 0.0), "x = nan: must be a finite number"),
        (PoseSample(0.0, 0.0, 0.0, math.inf), "heading = inf: must be a finite number"),
        (
            PoseSample(0.0, 0.0, 0.0, -1.7e308),
            r"heading = -1.7e\+308: must be a finite number from",
        ),
        (PoseSample(0.0, 0.0, 0.0, 0.0, z=math.nan), "z = nan"),
        (PoseSample(-0.1, 0.0, 0.0, 0.0), "since the reset, from 0"),
        (PoseSample(1.06, 0.0, 0.0, 0.0), "is in the future; must be at most 1.05"),
        (PoseSample(0.0, 0.0, 0.0, 0.0, speed=61.0), "must be from -60 to 60"),
    ],
)
def test_invalid_poses_are_refused(sample: PoseSample, match: str) -> None:
    track = PoseTrack(20.0, 0.5)
    with pytest.raises(ActionError, match=match):
        track.add(sample, 1.0, STEP_S)
    assert track.is_empty
    assert track.counts.received == 0


@pytest.mark.parametrize(
    ("rate_hz", "bound_s", "match"),
    [(2000.0, 0.5, "rate_hz = 2000"), (20.0, 60.0, "extrapolation_s = 60"), (math.nan, 1.0, "nan")],
)
def test_rates_and_bounds_are_checked(rate_hz: float, bound_s: float, match: str) -> None:
    with pytest.raises(ActionError, match=match):
        PoseTrack(rate_hz, bound_s)
