"""The phases of a tick: which there are, and how each may be run. What runs them goes by this."""

from __future__ import annotations

from typing import NamedTuple


class PhaseRule(NamedTuple):
    """How a phase may be run."""

    together: str = ""  # what the workers of one world run of it side by side; "": one runs it all
    is_late: bool = False  # the next one asks only that it ran on the same zone: nothing waits
    is_early: bool = False  # asks for nothing that other zones write in the phase before
    is_beside: bool = False  # asked beside the tick: no part of what a zone costs


# A name, and its arguments, can be sent anywhere: a method of `ShardGroup` or `Shard`.
PHASES = {
    "begin_step": PhaseRule(together="begin_step", is_late=True),
    "advance": PhaseRule(together="move"),
    "choose_goals": PhaseRule(),
    "leave": PhaseRule(),
    "gather": PhaseRule(together="gather"),
    "resolve": PhaseRule(together="resolve", is_late=True),
    "rank_lanes": PhaseRule(),
    "propose": PhaseRule(),
    "admit": PhaseRule(),
    "commit": PhaseRule(is_early=True),
    "detect": PhaseRule(is_early=True),
    "sense": PhaseRule(together="sense"),
    "credit": PhaseRule(together="credit"),
    "suggest": PhaseRule(together="suggest", is_beside=True),
    "retire": PhaseRule(),
    "forget": PhaseRule(),
}
