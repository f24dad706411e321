"""Digests states of worlds for comparison, independent of the order of rows."""

from __future__ import annotations

import hashlib

import numpy as np

from cavmarl.driving.vehicles import STATE_FIELDS
from cavmarl.engine.world_snapshot import Parts


def digest_world(parts: Parts, world: int) -> str:
    """Hex digest of one world; see `Simulation.state_hash`."""
    worlds, gate, rerouting = parts.worlds, parts.gate, parts.traffic.rerouting
    sumo = parts.sumo
    rows = parts.division.vehicles(world)
    rows = rows[np.argsort(rows["id"])]
    if rerouting is not None:
        rows["way"] = rerouting.ways_of_first_world(rows["way"], world)
    if sumo is not None:
        sumo.shift(rows, -world)
    digest = hashlib.blake2b(digest_size=16)
    for name in STATE_FIELDS:
        digest.update(np.ascontiguousarray(rows[name]).tobytes())
    agents = rows["agent"][rows["agent"] >= 0]
    digest.update(worlds.pending[world, agents].tobytes())
    queue = gate.queue[world, : gate.num_queue[world]]
    if sumo is not None:
        queue = queue.copy()
        sumo.shift(queue, -world)
    for name in queue.dtype.names or ():
        digest.update(np.ascontiguousarray(queue[name]).tobytes())
    for array in (
        worlds.signal_phase[world],
        worlds.controllers[world],
        worlds.detected_s[world],
        worlds.ticks[world],
        worlds.keys[world],
        worlds.cues[world],
        gate.next_id[world],
        gate.next_order[world],
        gate.num_entered[world],
    ):
        digest.update(array.tobytes())
    if rerouting is not None:
        for array in rerouting.state(world, parts.division.vehicles(world)):
            digest.update(array.tobytes())
    for part in parts.attached:
        for array in part.arrays():
            digest.update(array[world].tobytes())
    return digest.hexdigest()
