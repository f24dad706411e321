"""How long a lease of nodes is: the ticks of a step, for what agents do in them is known.

A vehicle that crosses a border meanwhile stays with its owner until the next lease. Where it cannot
be offered before that, since it is on no record yet, a lease of no ticks comes first.
"""

from __future__ import annotations

from cavmarl.config.env import EnvConfig

MOST = 4  # ticks: the longer, the further zones have to see over their borders


def lease_ticks(config: EnvConfig) -> int:
    """The ticks of a lease; the last one of a step may have fewer."""
    return min(config.clock.ticks_per_step, MOST)


def leases_of(ticks: int, lease: int) -> int:
    """How many leases of so many ticks, `lease`, they take."""
    return -(-ticks // lease)


def late_ticks(config: EnvConfig) -> int:
    """For how many ticks more than one a vehicle that has crossed may stay with its zone."""
    return lease_ticks(config) - 1
