"""Vehicles that an agent cannot see are known from messages."""

from __future__ import annotations

from typing import Any

import numpy as np

from cavmarl.sensors.observed import layout
from cavmarl.v2x.kernels.v2x_records import FIRST_ROADSIDE_ID, KIND_CAM, KIND_CPM
from tests.support.world import tick_of
from tests.v2x.station_worlds import StationWorld

# The agent, a truck ahead, a car that the truck hides, and a car that sees all vehicles.
PLACES = np.array([[100.0, 120.0], [112.0, 120.0], [135.0, 120.0], [118.0, 140.0]])
HIDDEN = 2


def known(world: StationWorld, receiver: int = 0) -> dict[int, tuple[int, int]]:
    """Return (sender, kind of message) for each vehicle that a receiver knows."""
    box = world.bus.mail.objects[0, receiver]
    return {
        int(report["subject"]): (int(report["sender"]), int(report["kind"]))
        for report in box
        if report["sender"] >= 0
    }


def behind_a_truck(**settings: Any) -> StationWorld:
    world = StationWorld(1, **settings)
    rows = world.put(PLACES)
    rows["length"][1], rows["width"][1], rows["height"][1] = 16.0, 2.6, 4.0
    world.write(rows)
    return world


def test_a_car_behind_a_truck_is_known_only_from_messages() -> None:
    world = behind_a_truck(perception__rate_hz=10.0)
    # The agent's own CPM has the vehicles that the agent sees.
    world.tick()
    mail = world.bus.mail
    reports = mail.reports[0, 0, : mail.num_reports[0, 0]]
    own = reports[(reports["sender"] == 0) & (reports["kind"] == KIND_CPM)]
    assert sorted(own["subject"].tolist()) == [1, 3]
    assert known(world)[HIDDEN] == (HIDDEN, KIND_CAM)
    silent = behind_a_truck(equipped=0.0)
    silent.tick()
    assert known(silent) == {}


def test_a_vehicle_hidden_from_lidar_is_known_from_messages() -> None:
    world = StationWorld(1, rays=64)
    simulation = world.simulation
    rows = world.worlds.rows[0, : world.worlds.num_owned[0]]
    agent = rows[rows["agent"] == 0][0]
    ahead = np.array([np.cos(agent["heading"]), np.sin(agent["heading"])])
    places = np.array([[agent["x"], agent["y"]]] + [
        [agent["x"], agent["y"]] + ahead * far for far in (14.0, 40.0)
    ])  # fmt: skip
    seated = rows[rows["agent"] == 0].copy()
    placed = np.repeat(seated, 3)
    placed["id"], placed["agent"][1:], placed["driver"][1:] = np.arange(3), -1, 0
    placed["x"], placed["y"] = places.T
    placed["length"][1], placed["width"][1] = 16.0, 2.6

    def lidar(vehicles: Any) -> Any:
        world.write(vehicles)
        tick_of(simulation).sense(simulation.everywhere)
        place = layout(simulation.config.sensors)["lidar"]
        return simulation.outputs.observations[0, 0, place].copy()

    with_hidden, without = lidar(placed), lidar(placed[:2])
    assert (with_hidden == without).all()  # the car is hidden from all rays
    world.write(placed)
    world.tick()
    assert known(world)[2] == (2, KIND_CAM)


def test_a_car_without_radio_is_reported_by_a_roadside_unit_that_sees_it() -> None:
    # Only the agent and the roadside unit are equipped; a wall hides the car from the agent.
    settings: dict[str, Any] = {
        "equipped": 0.0, "perception__rate_hz": 10.0, "roadside__signals": ["all"],
        "roadside__perception_hz": 10.0, "roadside__range_m": 60.0,
    }  # fmt: skip
    unit = StationWorld(1, **settings).bus.units[5]
    x, y = float(unit["x"]), float(unit["y"])
    world = StationWorld(1, walls=[(x - 15.0, y + 5.0, x - 15.0, y + 200.0)], **settings)
    world.put(np.array([[x - 40.0, y], [x + 3.0, y + 30.0]]))
    world.tick()
    world.tick()
    assert known(world) == {1: (FIRST_ROADSIDE_ID + 5, KIND_CPM)}


def test_packets_through_buildings_are_weaker() -> None:
    ratios = []
    for building_db in (0.0, 12.0, 60.0):
        world = StationWorld(
            1, walls=[(150.0, -500.0, 150.0, 500.0)], channel__path_loss_exponent=2.75,
            channel__building_db=building_db, inbox__objects=1,
        )  # fmt: skip
        # 20 cars are 60 m away behind the wall. Without the wall, nearly all packets are received.
        ring = np.linspace(-0.5, 0.5, 20)
        behind = 100.0 + 60.0 * np.stack([np.cos(ring), np.sin(ring)], 1)
        world.put(np.concatenate([[[100.0, 100.0]], behind]))
        for _ in range(30):
            world.tick()
        ratios.append(world.bus.statistics().reception_ratio)
    assert ratios[0] > 0.85
    assert 0.15 < ratios[1] < ratios[0] - 0.2
    assert ratios[2] == 0.0
