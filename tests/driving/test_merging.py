"""Vehicles before a junction brake in time for a vehicle that turns into their lane."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cavmarl.driving.kernels.junctions.junctions import behind_merging
from cavmarl.driving.kernels.models.following import no_constraint
from cavmarl.driving.vehicle_types import generated_types
from tests.support.junction_scenes import Scene, build_crossing
from tests.support.traffic import network, on_lane, scratch


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Scene]:
    folder: Path = tmp_path_factory.mktemp("merging")
    return lambda kind: Scene(build_crossing(folder, kind))


@pytest.mark.parametrize(("merging", "front_m"), [(True, 3.0), (False, 3.0), (True, -3.0)])
def test_a_fast_vehicle_brakes_early_for_a_vehicle_that_turns_into_its_lane(
    merging: bool, front_m: float
) -> None:
    # If the vehicle looked only at the shared area, it would brake too late.
    roads, kind = network("intersection"), generated_types()[0]
    own = np.repeat(np.arange(len(roads.links)), roads.links["num_conflicts"])
    picked = int(np.flatnonzero(roads.conflicts["merging"] == merging)[0])
    link, foe = int(own[picked]), int(roads.conflicts["foe"][picked])
    lane = int(roads.links["from_lane"][link])
    row = on_lane(roads, lane, float(roads.lanes["length_m"][lane]) - 40.0, speed=28.0)
    room = scratch(roads, 2)
    entry = room.approach[0]
    entry["link"], entry["row"], entry["id"], entry["half"] = foe, 1, 1, 2.5
    entry["dist"], entry["speed"] = 2.5 - front_m, 4.0
    room.link_end[foe] = 1
    found = behind_merging(roads.arrays, kind, row[0], link, 40.0, room)
    if merging and front_m > 0.0:
        assert found > 5.0
    else:
        assert found == no_constraint(kind)


@pytest.mark.parametrize(("speed", "minds"), [(13.9, True), (4.9, False)])
def test_a_fast_background_driver_slows_down_for_a_merging_vehicle(
    scene: Callable[[str], Scene], speed: float, minds: bool
) -> None:
    """The merging vehicle leaves the shared area in time, but is much slower."""
    accels = []
    for others in (False, True):
        here = scene("priority")
        here.clear()
        here.put("main", "W_in_0", 40.0, "E_out", speed=speed)
        if others:
            here.put("side", "N_in_0", -6.0, "E_out", speed=5.0)
        next(here.run(0.05))
        accels.append(float(here["main"]["accel"]))
    assert (accels[1] < accels[0] - 0.5) == minds
