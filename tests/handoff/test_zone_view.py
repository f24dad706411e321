from __future__ import annotations

import numpy as np
import pytest

from cavmarl.engine.simulation import Simulation
from cavmarl.handoff import shard_setup as dividing
from cavmarl.handoff.zone_view import TransferInFlight, view_zones
from cavmarl.zones.kernels.zone_lookup import squared_distance
from tests.support.driving import drive, make_simulation, start

HALO_M = 60.0


@pytest.fixture
def divided(monkeypatch: pytest.MonkeyPatch) -> Simulation:
    """Create nine zones that see less than the whole map."""
    monkeypatch.setattr(dividing, "halo_m", lambda *_: HALO_M)
    simulation = make_simulation(
        "grid4x4",
        mode="respawn",
        agents=4,
        background=60,
        num_worlds=2,
        overrides={"zones.count": 9, "zones.hysteresis_m": 0.0},
    )
    start(simulation, seed=1)
    return simulation


def test_a_view_has_the_owner_of_each_vehicle_and_the_ghosts_near_zones(
    divided: Simulation,
) -> None:
    rects = divided.partition.reaching
    for _ in range(10):
        drive(divided)
        for world in range(2):
            view, rows = divided.zones.view(world), divided.vehicles(world)
            for row, owner in zip(rows, view.owners.tolist(), strict=True):
                away = [squared_distance(rects, k, row["x"], row["y"]) for k in range(len(rects))]
                # Vehicles that cross a border are handed over at the start of the next tick.
                assert away[owner] ** 0.5 <= divided.config.clock.sim_dt_s * row["speed"] + 1e-9
                seen_by = {k for k, ghosts in enumerate(view.ghosts) if row["id"] in ghosts}
                assert seen_by == {k for k in range(len(rects)) if away[k] <= HALO_M**2} - {owner}
            owner_of = dict(zip(rows["id"].tolist(), view.owners.tolist(), strict=True))
            assert all(owner_of[t.vehicle] == t.source != t.target for t in view.transfers)
            np.testing.assert_array_equal(rows["owner"], view.owners)
    assert view.halo_m == HALO_M


def test_a_view_does_not_change_when_the_world_steps(divided: Simulation) -> None:
    view = divided.zones.view()
    before = [ghosts.copy() for ghosts in view.ghosts]
    for _ in range(20):
        drive(divided)
    for ghosts, then in zip(view.ghosts, before, strict=True):
        np.testing.assert_array_equal(ghosts, then)


def test_a_view_contains_the_given_transfers(divided: Simulation) -> None:
    one = TransferInFlight(vehicle=7, source=0, target=1, state="offered")
    view = view_zones(divided.shards, divided.partition, HALO_M, transfers=[one])
    assert view.transfers == (one,)
