"""The lanes that may reach into each cell of a map."""

from __future__ import annotations

from itertools import pairwise

import pytest

from cavmarl.config.registry import load_config
from cavmarl.engine.world_setup import load_roads
from cavmarl.roads.routing import lane_grid
from tests.naive.lane_grid import cells_of_lanes


@pytest.mark.parametrize("cell_m", [25.0, 6.0])
@pytest.mark.parametrize("env", ["grid4x4", "highway", "roundabout"])
def test_lanes_of_cells_equal_twin(env: str, cell_m: float) -> None:
    network = load_roads(*load_config(env))
    grid = lane_grid(network, cell_m)
    naive = cells_of_lanes(network, (grid.min_x, grid.min_y), (grid.num_x, grid.num_y), cell_m)
    starts = grid.cell_start.tolist()
    found = [grid.cell_lanes[start:end].tolist() for start, end in pairwise(starts)]
    assert found == naive
    assert {lane for cell in found for lane in cell} == set(range(len(network.lanes)))
