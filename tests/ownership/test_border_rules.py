"""One test for each rule on borders, deadlines and neighbors in docs/explanation/ownership.md."""

from __future__ import annotations

from dataclasses import replace

import pytest

from cavmarl.core.errors import (
    ConfigError,
    ProtocolError,
)
from cavmarl.ownership.decisions import Neighbours
from cavmarl.ownership.distances import Distances, check_coverage, needed_overlap_m
from cavmarl.ownership.limits import Limits
from cavmarl.ownership.messages import (
    Begin,
    Switch,
)
from cavmarl.ownership.offers import Approach
from cavmarl.ownership.trace import LOG, TraceEntry
from cavmarl.ownership.trace_check import TraceChecker
from tests.ownership.bench import Bench, version
from tests.ownership.scenarios import HALVES, near_border, prepared
from tests.support.builders import vehicles
from tests.support.zoned import exchanged, ghosts_of


def test_r06_the_target_is_the_zone_that_contains_the_vehicle() -> None:
    bench = Bench(4)
    bench.tick(births=[(7, 0)], offers=[(7, 1), (7, 2), (7, 3)])
    bench.tick(movers=[(7, 3)])
    assert bench.owner(7) == 3


def test_r08_a_hand_off_is_forced_after_d_ticks_without_an_ack() -> None:
    bench = Bench(limits=Limits(deferral=2))
    bench.tick(births=[(7, 0)])
    for ticks in (1, 2):
        bench.tick(movers=[(7, 1)])
        assert bench.directory.table.deferred == {7: ticks}
        assert bench.owner(7) == 0
    (_, step) = bench.begin(movers=[(7, 1)])
    assert step.enter[0].forced
    assert step.enter[0].state == version(7, 3)


def test_r28_the_count_of_deferred_ticks_restarts_if_the_vehicle_returns() -> None:
    bench = Bench()
    bench.tick(births=[(7, 0)])
    bench.tick(movers=[(7, 1)])
    bench.tick()
    assert not bench.directory.table.deferred
    bench.tick(movers=[(7, 1)])
    assert bench.directory.table.deferred == {7: 1}


def test_r30_an_overlap_that_is_too_narrow_is_refused_with_the_needed_width() -> None:
    limits = Limits(deferral=2)
    assert needed_overlap_m(100.0, 2.0, limits, 40.0, 0.05) == 108.0
    fits = Distances(approach_m=10.0, hysteresis_m=2.0, overlap_m=108.0)
    check_coverage(fits, limits, reach_m=100.0, v_max_mps=40.0, dt_s=0.05)
    with pytest.raises(ConfigError, match=r"107\.9 m is too narrow; .* 108 m = reach 100 m"):
        check_coverage(
            replace(fits, overlap_m=107.9), limits, reach_m=100.0, v_max_mps=40.0, dt_s=0.05
        )
    with pytest.raises(ConfigError, match="approach of 1 m is too short"):
        check_coverage(
            replace(fits, approach_m=1.0), limits, reach_m=100.0, v_max_mps=40.0, dt_s=0.05
        )


def test_r31_offer_switch_and_release_each_have_their_own_distance() -> None:
    steps = []
    for x_m in (-9.0, -7.0, 1.0, 3.0, 19.0, 21.0):
        entries = near_border(x_m, speed_mps=10.0)
        row = vehicles([(x_m, 0.0, 0.0)])
        zoned = exchanged(HALVES, 20.0, [row[:0], row])  # zone 1 owns the vehicle
        steps.append((bool(entries), True in entries, not len(ghosts_of(zoned, 0))))
    offered, switches, released = zip(*steps, strict=True)
    assert offered == (False, True, True, True, True, True)
    assert switches == (False, False, False, True, True, True)
    assert released == (False, False, False, False, False, True)


def test_r35_a_zone_cannot_offer_a_vehicle_that_it_does_not_own() -> None:
    bench, _ = prepared()
    with pytest.raises(ProtocolError, match="offers vehicle 8"):
        bench.endpoints[0].offer([Approach(8, 1, b"")])


def test_r36_a_change_to_a_zone_that_is_not_a_neighbour_is_refused() -> None:
    in_a_row = tuple(map(frozenset, ({0, 1}, {0, 1, 2}, {1, 2})))
    for may_teleport in (False, True):
        bench = Bench(zones=3)
        bench.directory.set_neighbours(Neighbours(in_a_row, may_teleport))
        bench.tick(births=[(7, 0), (8, 1)], offers=[(7, 2), (8, 2)])
        if may_teleport:
            bench.begin([(7, 2), (8, 2)])
            begun = bench.log[-1]
            assert isinstance(begun, Begin)
            assert [switch.vehicle for switch in begun.switches] == [7, 8]
            assert begun.teleports == (7,)
            continue
        with pytest.raises(ProtocolError, match=r"vehicle 7 of zone 0 .* zone 2, .* only zones 1;"):
            bench.begin([(7, 2)])
        bench.begin([(8, 2)])
        checker = TraceChecker(2, 16, near=in_a_row)
        *before, begun = bench.trace.entries
        assert isinstance(begun.item, Begin)
        for entry in before:
            checker.take(entry)
        wrong = Begin(0, begun.item.tick, (Switch(7, 0, 2, 1, False),))
        with pytest.raises(ProtocolError, match="2 is no neighbour of 0"):
            checker.take(TraceEntry(LOG, wrong))
