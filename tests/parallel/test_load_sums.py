"""Compute loads of nodes from given totals."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from cavmarl.parallel.nodes.node_loads import NodeLoad, since, totals


def test_a_load_is_the_difference_to_the_previous_report() -> None:
    # Processor time, waiting time, bytes and frames are totals since the start, so a load has
    # their differences. Memory, vehicles and ghosts are present values.
    before = [10.0, 4.0, 1000, 20, 5000, 7, 3]
    now = [12.5, 4.5, 1600, 26, 4000, 6, 2]
    assert since(1, 40, now, before) == NodeLoad(1, 40, 2.5, 0.5, 600, 6, 4000, 6, 2)
    assert since(1, 40, now, None) == NodeLoad(1, 40, 12.5, 4.5, 1600, 26, 4000, 6, 2)


def test_totals_cover_only_the_zones_that_the_node_hosts() -> None:
    links: Any = SimpleNamespace(waited_s=1.5, sent_bytes=300, sent_frames=4)
    # The zones own 5, 2 and 4 vehicles and hold 3, 1 and 6 ghosts.
    zoned = SimpleNamespace(num_owned=np.array([5, 2, 4]), num_rows=np.array([8, 3, 10]))
    simulation: Any = SimpleNamespace(division=SimpleNamespace(zoned=zoned))
    cpu_s, *rest, vehicles, ghosts = totals(links, simulation, [0, 2])
    assert cpu_s > 0.0
    assert rest[:3] == [1.5, 300, 4]
    assert (vehicles, ghosts) == (9, 9)
