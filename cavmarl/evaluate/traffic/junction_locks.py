"""Gridlocks of junctions: vehicles wait although no red signal stops them, and none moves."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.records.codes import SIGNAL_RED, SIGNAL_RED_YELLOW
from cavmarl.roads.network import RoadNetwork

STOP_LINE_M = 10.0  # a front this close to the end of its lane is at the stop line


class JunctionLocks:
    """The duration of locks of each junction, from samples once per second.

    A vehicle *waits* at a junction if it is stopped inside it, or at the stop line of a lane with a
    link into the junction that has no red signal. A lock counts the seconds with a waiting vehicle
    since a vehicle last entered or left the junction. A lock also ends when no vehicle is stopped
    there. Seconds in which all stopped vehicles have a red signal neither count nor end a lock.
    """

    def __init__(self, network: RoadNetwork) -> None:
        self._network = network
        lanes, edges, links = network.lanes, network.edges, network.links
        num = len(network.junctions)
        self._inside = np.where(lanes["internal"], edges["from_junction"][lanes["edge"]], -1)
        leads_in = ~lanes["internal"] & (lanes["num_links"] > 0)
        self._into = np.where(leads_in, edges["to_junction"][lanes["edge"]], -1)
        self._links_from = links["from_lane"]
        self._ids = np.zeros(0, dtype=np.int64)
        self._lanes = np.zeros(0, dtype=np.int64)
        self._lock_s = np.zeros(num, dtype=np.int64)
        self._longest_s = np.zeros(num, dtype=np.int64)

    def sample(
        self, rows: NDArray[np.void], standing: NDArray[np.bool_], codes: NDArray[np.uint8]
    ) -> None:
        """Add the sample of a second.

        Args:
            rows: VEHICLE (num_vehicles,), all on lanes of the map.
            standing: (num_vehicles,) whether a vehicle is stopped.
            codes: (num_links,) signal states of the links.
        """
        lanes = rows["lane"]
        front_to_end = self._network.lanes["length_m"][lanes] - rows["s"] - 0.5 * rows["length"]
        at_line = standing & (self._into[lanes] >= 0) & (front_to_end < STOP_LINE_M)
        may_go = np.zeros(len(self._network.lanes), dtype=np.bool_)
        may_go[self._links_from[(codes != SIGNAL_RED) & (codes != SIGNAL_RED_YELLOW)]] = True
        held = self._marks(self._into[lanes[at_line]])
        waits = self._marks(self._into[lanes[at_line & may_go[lanes]]])
        inside = standing & (self._inside[lanes] >= 0)
        waits |= self._marks(self._inside[lanes[inside]])
        self._lock_s[waits] += 1
        self._lock_s[self._passed(rows) | ~(waits | held)] = 0
        np.maximum(self._longest_s, self._lock_s, out=self._longest_s)

    def longest_s(self) -> dict[str, float]:
        """The longest lock in s of each junction that had one."""
        return {
            self._network.junction_ids[row]: float(self._longest_s[row])
            for row in np.flatnonzero(self._longest_s)
        }

    def _passed(self, rows: NDArray[np.void]) -> NDArray[np.bool_]:
        """Return (num_junctions,) whether a vehicle entered or left since the last sample."""
        order = np.argsort(rows["id"])
        ids, lanes = rows["id"][order], rows["lane"][order].astype(np.int64)
        _, now, before = np.intersect1d(ids, self._ids, assume_unique=True, return_indices=True)
        new, old = lanes[now], self._lanes[before]
        edges = self._network.lanes["edge"]
        moved = edges[new] != edges[old]
        gone = np.setdiff1d(np.arange(len(self._ids)), before, assume_unique=True)
        passed = self._marks(self._into[old[moved]])
        passed |= self._marks(self._inside[old[moved]])
        passed |= self._marks(self._inside[new[moved]])
        passed |= self._marks(self._inside[self._lanes[gone]])
        self._ids, self._lanes = ids, lanes
        return passed

    def _marks(self, junctions: NDArray[np.int32]) -> NDArray[np.bool_]:
        """Return (num_junctions,) true at the given rows; -1 marks none."""
        found = np.zeros(len(self._lock_s), dtype=np.bool_)
        found[junctions[junctions >= 0]] = True
        return found
