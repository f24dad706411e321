"""The lane-change model MOBIL as two criteria of the paper: safety, then incentive."""

from __future__ import annotations


def mobil_accepts(
    own: tuple[float, float],
    new_follower: tuple[float, float],
    old_follower: tuple[float, float],
    mandatory: bool,
) -> bool:
    """Decide from pairs of accelerations before and after the change, with politeness 0."""
    safe_for_follower = new_follower[1] >= -2.0
    safe_for_me = own[1] >= -2.0
    politeness = 0.0
    others = sum(after - before for before, after in (new_follower, old_follower))
    worthwhile = own[1] - own[0] + politeness * others >= 0.2
    return safe_for_follower and (safe_for_me if mandatory else worthwhile)
