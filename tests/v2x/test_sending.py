"""Times and contents of the messages that stations send."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from cavmarl.v2x.kernels.v2x_records import (
    FIRST_ROADSIDE_ID,
    KIND_CAM,
    KIND_CPM,
    KIND_DENM,
    KIND_SPAT,
    LAST_CAM,
    PACKET,
    REPORT,
)
from cavmarl.v2x.v2x_messages import messages_of
from tests.naive import v2x as naive
from tests.v2x.station_worlds import StationWorld

SPREAD = np.stack([np.linspace(0.0, 390.0, 40), np.full(40, 100.0)], 1)


def sent(world: StationWorld, kind: int) -> Any:
    """Return the messages of a kind that were sent in this tick."""
    mail, slot = world.bus.mail, 0
    return messages_of(kind, mail.reports[0, slot, : mail.num_reports[0, slot]])


@pytest.mark.parametrize("dtype", [REPORT, PACKET, LAST_CAM])
def test_records_have_no_padding(dtype: np.dtype[Any]) -> None:
    assert dtype.itemsize == sum(dtype[name].itemsize for name in dtype.names or ())


def test_each_station_sends_in_a_tick_that_depends_on_its_id() -> None:
    world = StationWorld(1, cam__rate_hz=2.5)
    world.put(SPREAD)
    for _ in range(8):
        tick = world.tick()
        senders = sent(world, KIND_CAM)["sender"].tolist()
        assert senders == [k for k in range(40) if (tick + k) % 4 == 0]
        assert (sent(world, KIND_CAM)["tick"] == tick).all()


def test_a_cam_has_the_state_of_its_vehicle() -> None:
    world = StationWorld(1)
    rows = world.put(SPREAD, speed=7.0, accel=-1.5, yaw_rate=0.1, heading=0.3, length=4.2)
    world.tick()
    cams = sent(world, KIND_CAM)
    for name in ("x", "y", "z", "heading", "speed", "accel", "yaw_rate", "length", "width"):
        assert (cams[name] == rows[name]).all(), name
    assert (cams["vclass"] == 0).all()


def test_triggered_cams_are_sent_after_a_change_and_once_a_second() -> None:
    world = StationWorld(1, cam__triggered=True)
    rows = world.put(SPREAD)
    world.tick()
    assert len(sent(world, KIND_CAM)) == 40  # each vehicle's first CAM
    rows["x"][3] += 4.1
    rows["heading"][4] += math.radians(4.1)
    rows["speed"][5] += 0.6
    rows["x"][6] += 3.9
    rows["heading"][7] -= math.radians(3.9)
    rows["speed"][8] += 0.4
    world.write(np.random.default_rng(0).permutation(rows))
    world.tick()
    assert sent(world, KIND_CAM)["sender"].tolist() == [3, 4, 5]
    for tick in range(3, 12):
        world.tick()
        expected = {11: [k for k in range(40) if k not in (3, 4, 5)]}.get(tick, [])
        assert sent(world, KIND_CAM)["sender"].tolist() == expected


def test_only_equipped_vehicles_and_agents_send() -> None:
    world = StationWorld(4, equipped=0.5)
    world.put(SPREAD)
    world.tick()
    senders = set(sent(world, KIND_CAM)["sender"].tolist())
    assert {0, 1, 2, 3} <= senders
    assert 10 <= len(senders) <= 30
    world.tick()
    assert set(sent(world, KIND_CAM)["sender"].tolist()) == senders
    silent = StationWorld(4, equipped=0.0)
    silent.put(SPREAD)
    silent.tick()
    assert sent(silent, KIND_CAM)["sender"].tolist() == [0, 1, 2, 3]


def test_a_vehicle_with_several_events_sends_the_worst_cause() -> None:
    world = StationWorld(1)
    rows = world.put(SPREAD, hit=-1)
    rows["accel"][3] = -4.5
    rows["wait_s"][4] = 31.0
    rows["hit"][5], rows["accel"][5] = 6, -9.0
    rows["accel"][6] = -3.9
    rows["wait_s"][7], rows["speed"][7] = 31.0, 2.0
    world.write(rows)
    tick = world.tick()
    events = sent(world, KIND_DENM)
    assert dict(zip(events["sender"].tolist(), events["cause"].tolist(), strict=True)) == {
        3: 99,
        4: 94,
        5: 2,
    }
    assert (events["expires"] == tick + 20).all()


@pytest.mark.parametrize("units", [False, True], ids=["vehicles", "roadside"])
def test_stations_report_the_vehicles_that_they_see(units: bool) -> None:
    settings: dict[str, Any] = {"perception__rate_hz": 10.0, "perception__objects": 5}
    if units:
        settings = {
            "roadside__signals": ["all"],
            "roadside__perception_hz": 10.0,
            "perception__objects": 5,
            "roadside__range_m": 60.0,
        }
    world = StationWorld(1, cam__rate_hz=0.0, denm__rate_hz=0.0, **settings)
    random = np.random.default_rng(8)
    cells = np.stack(np.meshgrid(np.arange(9), np.arange(8)), -1).reshape(-1, 2)
    places = 210.0 + 14.0 * cells + random.uniform(-3.0, 3.0, (72, 2))
    rows = world.put(places, heading=random.uniform(-3.0, 3.0, 72))
    world.tick()
    told: dict[int, list[int]] = {}
    for report in sent(world, KIND_CPM):
        told.setdefault(int(report["sender"]), []).append(int(report["object"]))
        assert report["x"] == rows["x"][report["object"]]
    if units:
        for k, unit in enumerate(world.bus.units):
            found = naive.seen(rows, -1, unit["x"], unit["y"], 60.0, 5, bodies=False)
            assert told.get(FIRST_ROADSIDE_ID + k, []) == found
    else:
        for k, (x, y) in enumerate(places):
            assert told.get(k, []) == naive.seen(rows, k, x, y, 60.0, 5, bodies=True), k
    assert sum(map(len, told.values())) > 10


def test_roadside_units_send_the_active_phase_and_its_remaining_time() -> None:
    world = StationWorld(1, cam__rate_hz=0.0, roadside__signals=["all"], roadside__rate_hz=10.0)
    network = world.simulation.network
    world.put(SPREAD)
    world.tick()
    told = sent(world, KIND_SPAT)
    assert told["signal"].tolist() == list(range(len(network.signals)))
    assert (told["phase"] == world.worlds.signal_phase[0]).all()
    for signal, left_s in zip(told["signal"], told["left_s"], strict=True):
        program = network.programs[network.signals[signal]["program"]]
        first, num = int(program["first_phase"]), int(program["num_phases"])
        ends = np.cumsum(network.phases["duration_s"][first : first + num])
        now = (0.1 - program["offset_s"]) % program["cycle_s"]
        assert left_s == pytest.approx(float(ends[ends > now][0] - now))
