"""Length of the leases of nodes: at most one step, since a step's commands are known in advance.

A vehicle that crosses a border during a lease stays with its owner until the next lease. Only a
vehicle that is on record at the coordinator can be offered. If a new vehicle has crossed a border,
a lease of 0 ticks first puts it on record.
"""

from __future__ import annotations

from cavmarl.config.env import EnvConfig

MOST = 4  # limit in ticks; with longer leases, zones need more ghosts beyond their borders


def lease_ticks(config: EnvConfig) -> int:
    """Return the ticks of a lease; the last lease of a step may have fewer."""
    return min(config.clock.ticks_per_step, MOST)


def leases_of(ticks: int, lease: int) -> int:
    """Return how many leases of `lease` ticks cover `ticks`."""
    return -(-ticks // lease)


def late_ticks(config: EnvConfig) -> int:
    """Return for how many ticks a zone may keep a vehicle after the tick in which it left the zone.

    Simulators of zones may refuse the vehicle for `zones.max_deferred_ticks` leases.
    """
    deferred = config.zones.max_deferred_ticks if config.zones.simulators else 0
    return lease_ticks(config) * (1 + deferred) - 1
