"""How long a lease of nodes is: the ticks of a step, for what agents do in them is known.

A vehicle that crosses a border meanwhile stays with its owner until the next lease. Where it cannot
be offered before that, since it is on no record yet, a lease of no ticks comes first.
"""

from __future__ import annotations

MOST = 4  # ticks: the longer, the further zones have to see over their borders


def lease_ticks(ticks_per_step: int) -> int:
    """The ticks of a lease; the last one of a step may have fewer."""
    return min(ticks_per_step, MOST)


def leases_of(ticks: int, ticks_per_step: int) -> int:
    """How many leases so many ticks take."""
    return -(-ticks // lease_ticks(ticks_per_step))


def late_ticks(ticks_per_step: int) -> int:
    """For how many ticks more than one a vehicle that has crossed may stay with its zone."""
    return lease_ticks(ticks_per_step) - 1
