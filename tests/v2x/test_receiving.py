"""Receptions and inboxes equal a direct computation from the definitions."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.v2x.channel import airtime_s
from cavmarl.v2x.kernels.v2x_records import (
    BAND_M,
    COUNT_NO_ACCESS,
    COUNT_OVERFLOW,
    COUNT_REACHABLE,
    COUNT_RECEIVED,
    KIND_CAM,
    KIND_CPM,
)
from tests.naive import v2x as naive
from tests.v2x.station_worlds import StationWorld

AGENTS, VEHICLES = 6, 40
CHANNELS: dict[str, dict[str, Any]] = {
    "ideal": {},
    "range": {"channel__range_m": 120.0},
    "loss": {"channel__loss": 0.3},
    "path loss": {"channel__path_loss_exponent": 2.75, "channel__range_m": 300.0},
    "all": {
        "channel__path_loss_exponent": 2.3, "channel__range_m": 400.0, "channel__loss": 0.1,
        "channel__data_rate_mbps": 1.0, "channel__latency_ticks": 2,
    },
}  # fmt: skip


def expected_receptions(
    world: StationWorld, tick: int, receiver: int, x: float, y: float
) -> tuple[list[naive.Said], int, int]:
    """Return the received reports of a tick, and the numbers of reachable and received packets."""
    config = world.config.v2x.channel
    slots = config.latency_ticks + 1
    slot = (tick - config.latency_ticks) % slots
    mail = world.bus.mail
    packets = mail.packets[0, slot, : mail.num_packets[0, slot]]
    near = np.hypot(packets["x"] - x, packets["y"] - y)
    busy = naive.airtime_s(config) / 0.1 * float((near <= naive.sensing_m(config)).sum())
    busy = math.floor(64.0 * min(busy, 1.0) + 0.5) / 64.0  # the table has 64 steps
    said: list[naive.Said] = []
    reachable = received = 0
    for packet, distance in zip(packets, near.tolist(), strict=True):
        if packet["sender"] == receiver or distance > (config.range_m or math.inf):
            continue
        reachable += 1
        metre = int(distance)
        low, high = (naive.chance(config, metre + k, False, busy) for k in (0, 1))
        chance = low + (high - low) * (distance - metre)
        kind, sender = int(packet["kind"]), int(packet["sender"])
        if naive.number(world.key(), receiver, sender, int(packet["tick"]), kind) >= chance:
            continue
        received += 1
        for k in range(packet["first"], packet["first"] + packet["count"]):
            report = mail.reports[0, slot, k]
            if kind in (KIND_CAM, KIND_CPM):
                said.append(_said(report))
    return said, reachable, received


def _said(report: Any) -> naive.Said:
    return naive.Said(
        int(report["subject"]),
        int(report["sender"]),
        int(report["tick"]),
        float(report["x"]),
        float(report["y"]),
        int(report["kind"]) == KIND_CAM,
    )


def drift(random: np.random.Generator, places: NDArray[np.float64]) -> NDArray[np.float64]:
    return places + random.normal(0.0, 8.0, places.shape)


@pytest.mark.parametrize("seen", [False, True], ids=["cams", "cpms"])
@pytest.mark.parametrize("name", CHANNELS)
def test_inboxes_equal_the_definitions(name: str, seen: bool) -> None:
    settings = CHANNELS[name] | {"inbox__objects": 5, "inbox__memory_s": 0.4, "cam__rate_hz": 5.0}
    world = StationWorld(AGENTS, perception__rate_hz=2.5 if seen else 0.0, **settings)
    random = np.random.default_rng(1)
    places = random.uniform(0.0, 420.0, (VEHICLES, 2))
    known: list[list[naive.Said]] = [[] for _ in range(AGENTS)]
    total = [0, 0]
    for _ in range(14):
        places = drift(random, places)
        rows = world.put(places)
        world.write(random.permutation(rows))
        tick = world.tick()
        for agent in range(AGENTS):
            x, y = places[agent]
            said, reachable, received = expected_receptions(world, tick, agent, x, y)
            total[0] += reachable
            total[1] += received
            old = [report for report in known[agent] if report.tick + 4 >= tick]
            known[agent] = naive.inbox(old, said, agent, x, y, 5)
            box = world.bus.mail.objects[0, agent]
            assert [_said(report) for report in box if report["sender"] >= 0] == known[agent]
    counts = world.bus.mail.counts[0]
    assert [counts[COUNT_REACHABLE], counts[COUNT_RECEIVED]] == total
    assert total[1] > 100
    statistics = world.bus.statistics()
    assert statistics.reception_ratio == total[1] / total[0]
    assert statistics.mean_latency_s == pytest.approx(0.1 * world.config.v2x.channel.latency_ticks)


def test_receptions_have_the_configured_probability() -> None:
    # The ratio of 300 receptions at each distance may differ by four standard deviations.
    world = StationWorld(1, channel__path_loss_exponent=2.75, channel__loss=0.1, equipped=1.0)
    distances = np.array([20.0, 90.0, 120.0, 140.0, 220.0])
    ring = np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False)
    config = world.config.v2x.channel
    for distance in distances:
        places = np.stack([200.0 + distance * np.cos(ring), 200.0 + distance * np.sin(ring)], 1)
        world.bus.reset(np.ones(1, dtype=np.bool_))
        world.put(np.concatenate([[[200.0, 200.0]], places]))
        for _ in range(5):
            world.tick()
        chance = naive.chance(config, distance, False, 0.0)
        spread = 4.0 * math.sqrt(chance * (1.0 - chance) / 300.0) + 1e-3
        assert abs(world.bus.statistics().reception_ratio - chance) < spread
        (band,) = np.flatnonzero(world.bus.statistics().bands[:, 0])
        assert band * BAND_M <= distance <= (band + 1) * BAND_M


def test_packets_of_the_largest_ids_are_dropped_beyond_the_capacity() -> None:
    world = StationWorld(1, capacity=10)
    world.put(np.random.default_rng(2).uniform(0.0, 300.0, (30, 2)))
    world.tick()
    mail = world.bus.mail
    assert mail.counts[0, COUNT_OVERFLOW] == 20
    assert mail.packets[0, 0, :10]["sender"].tolist() == list(range(10))


def test_packets_beyond_the_capacity_of_the_channel_are_dropped() -> None:
    # 60 packets of 300 bytes at 0.5 Mbit/s take 4.84 ms each: 290 ms, but 100 ms are available.
    world = StationWorld(1, channel__data_rate_mbps=0.5)
    world.put(np.random.default_rng(2).uniform(0.0, 300.0, (60, 2)))
    world.tick()
    dropped = world.bus.mail.counts[0, COUNT_NO_ACCESS]
    load = 2.904
    assert abs((60 - dropped) - 60 / load) < 4.0 * math.sqrt(60 / load)
    statistics = world.bus.statistics()
    assert 0.5 < statistics.busy_mean <= 1.0
    assert statistics.to_dict()["v2x_dropped"] == dropped


@pytest.mark.parametrize(
    ("bytes_", "rate_mbps", "airtime_us"),
    # At 6 Mbit/s, a symbol of 8 µs has 48 bits.
    [(300, 6.0, 440.0), (300, 3.0, 840.0), (1500, 12.0, 1040.0), (300, 0.0, 0.0)],
)
def test_airtime_depends_on_preamble_size_and_data_rate(
    bytes_: int, rate_mbps: float, airtime_us: float
) -> None:
    world = StationWorld(1, channel__data_rate_mbps=rate_mbps, channel__packet_bytes=bytes_)
    assert airtime_s(world.config.v2x.channel) == pytest.approx(1e-6 * airtime_us)
    world.put(np.array([[0.0, 0.0], [10.0, 0.0], [20.0, 0.0]]))
    world.tick()
    busy = world.bus.statistics().busy_mean
    assert busy == pytest.approx(3 * 1e-6 * airtime_us / 0.1, rel=1e-6)


def test_the_reception_ratio_falls_with_the_number_of_vehicles() -> None:
    ratios = []
    for vehicles in (10, 40, 75):
        world = StationWorld(
            1, channel__path_loss_exponent=2.0, channel__sensitivity_dbm=-66.0,
            channel__data_rate_mbps=3.0,
        )  # fmt: skip
        ring = np.linspace(0.0, 2.0 * np.pi, vehicles, endpoint=False)
        around = 200.0 + 100.0 * np.stack([np.cos(ring), np.sin(ring)], 1)
        world.put(np.concatenate([[[200.0, 200.0]], around]))
        for _ in range(40):
            world.tick()
        ratios.append(world.bus.statistics().reception_ratio)
    assert ratios[0] > ratios[1] > ratios[2]


def test_the_inbox_of_an_agent_is_empty_for_a_new_vehicle() -> None:
    world = StationWorld(1, cam__rate_hz=1.0)
    places = np.random.default_rng(3).uniform(0.0, 300.0, (20, 2))
    rows = world.put(places)
    for _ in range(9):
        world.tick()
    assert (world.bus.mail.objects[0, 0]["sender"] >= 0).all()
    rows["id"][0] = 1000
    world.write(rows)
    world.tick()
    there = world.bus.mail.objects[0, 0]["sender"]
    assert there[there >= 0].tolist() == [10]  # only vehicle 10 sends in this tick
    world.write(rows[1:])
    world.tick()
    assert (world.bus.mail.objects[0, 0]["sender"] < 0).all()
