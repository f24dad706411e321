"""No vehicle is lost or doubled in many hand-offs under random faults (acceptance test AT10)."""

from __future__ import annotations

from typing import Any

import pytest

from cavmarl.ownership.messages import COORDINATOR, Message
from tests.ownership.bench import Bench
from tests.ownership.toy import number
from tests.support.held_entries import held_entries
from tests.support.lossy_network import FaultPlan, Network, Rates

ZONES = 4
VEHICLES = 400
FAULTS = Rates(drop=0.1, delay=0.1, duplicate=0.1, reorder=0.2, corrupt=0.02, longest_delay=10)


class Traffic:
    """Vehicles that change their zones in each tick, over a network with random faults."""

    def __init__(self) -> None:
        self.bench = Bench(ZONES)
        self.network = Network(FaultPlan(seed=3, otherwise=FAULTS))
        self.handoffs = 0

    def zone(self, vehicle: int, tick: int) -> int:
        return (number("path", vehicle % 40, tick) + vehicle) % ZONES

    def tick(self) -> None:
        bench, now = self.bench, self.bench.directory.table.tick
        owners = bench.directory.table.owners
        movers = [(v, zone) for v, (owner, _) in owners.items()
                  if (zone := self.zone(v, now)) != owner]  # fmt: skip
        births = () if now else [(v, self.zone(v, 0)) for v in range(VEHICLES)]
        self.network.send(bench.begin(movers, births))
        self.handoffs += len(bench.directory.table.planned.switches)
        offered: set[int] = set()
        for phase in range(300):
            for destination, message, _ in self.network.deliver():
                self.network.send(self.react(destination, message))
            for zone, endpoint in bench.endpoints.items():
                if endpoint.tick == now + 1 and zone not in offered:
                    offered.add(zone)
                    self.network.send(bench.offer(zone, *self.targets(zone, now + 1)))
            if phase % 3 == 2:
                self.network.send(bench.directory.resend().messages)
                for endpoint in bench.endpoints.values():
                    self.network.send(endpoint.offer_again())
            if not bench.directory.waiting_for() and phase >= 6:
                break
        bench.commit()
        bench.trace.entries.clear()
        bench.log.clear()

    def targets(self, zone: int, tick: int) -> list[tuple[int, int]]:
        places = ((v, self.zone(v, tick)) for v in self.bench.endpoints[zone].owned)
        return [(vehicle, to) for vehicle, to in places if to != zone]

    def react(self, destination: int, message: Message) -> tuple[Message, ...]:
        if destination == COORDINATOR:
            return self.bench.directory.on_message(message).messages
        endpoint = self.bench.endpoints[destination]
        reaction = endpoint.on_message(message)
        return reaction.messages if reaction.advance is None else (endpoint.complete(0),)


def drive(handoffs: int) -> None:
    traffic = Traffic()
    while traffic.handoffs < handoffs:
        traffic.tick()
        owners = traffic.bench.directory.table.owners
        assert len(owners) == VEHICLES
        kept = [vehicle for end in traffic.bench.endpoints.values() for vehicle in end.owned]
        assert sorted(kept) == sorted(owners)
    assert sum(traffic.network.faults.values()) > handoffs / 200


def test_a_hundred_thousand_hand_offs_lose_no_vehicle() -> None:
    drive(100_000)


@pytest.mark.slow
def test_a_million_hand_offs_lose_no_vehicle() -> None:
    drive(1_000_000)


def test_memory_does_not_grow_with_the_number_of_ticks() -> None:
    traffic = Traffic()
    sizes = []
    for tick in range(90):
        traffic.tick()
        directory, endpoints = traffic.bench.directory, traffic.bench.endpoints.values()
        assert set(directory.readiness.held) <= {tick + 1}
        kept: list[Any] = [directory.table.deferred, directory.table.seen.above, directory.dones]
        for end in endpoints:
            kept += [end.replicas, end.retained, end.offers]
        sizes.append(held_entries(kept))
    assert max(sizes[60:]) <= 1.1 * max(sizes[20:50])
