"""Tests of the holes H1 to H28: none of these faults can occur.

A hole is a case that the protocol of paper A leaves open; see "Departures from the paper" in
docs/explanation/ownership.md. H21 (pairs across a border), H24 (content of a state) and H27 (load
readings) are outside of `cavmarl/ownership`, which transfers states as bytes. The test of H24
checks that the bytes do not change.
"""

from __future__ import annotations

from dataclasses import replace

from cavmarl.ownership.directory import Directory
from cavmarl.ownership.limits import Limits
from cavmarl.ownership.messages import Birth, Done, Nack, Refusal, Step
from cavmarl.ownership.transitions import State
from tests.ownership import scenarios
from tests.ownership.bench import Bench, version
from tests.ownership.scenarios import approached, prepared
from tests.ownership.simulator import Simulator
from tests.ownership.toy import ToyWorld


def test_h01_a_vehicle_never_has_two_owners() -> None:
    bench = approached(Bench())
    for step in bench.begin(movers=[(7, 1)]):
        bench.give(step)
        assert sum(7 in endpoint.owned for endpoint in bench.endpoints.values()) <= 1
    scenarios.one_step_lease()


def test_h02_a_vehicle_always_has_an_owner_or_a_copy() -> None:
    bench = approached(Bench())
    first, second = bench.begin(movers=[(7, 1)])
    bench.give(first)
    assert bench.endpoints[0].row_state(7) is State.RETAINED
    assert bench.endpoints[1].replicas.state(7) is State.PREPARED
    bench.give(second)
    assert bench.endpoints[0].row_state(7) is State.RETAINED
    assert bench.endpoints[1].row_state(7) is State.AUTHORITATIVE
    scenarios.copy_until_commit()


def test_h03_a_vehicle_is_not_handed_over_with_an_older_state() -> None:
    bench = approached(Bench())
    bench.tick()
    bench.tick(movers=[(7, 1)])
    assert bench.owner(7) == 0, "the target owns the vehicle with the state of an older tick"


def test_h04_a_late_ack_after_a_withdrawn_offer_does_not_count() -> None:
    bench, prepare = prepared()
    (ack,) = bench.give(prepare)
    bench.commit()
    bench.tick()  # the vehicle turns back, so the source sends an ABORT to the target
    bench.directory.on_message(ack)
    bench.tick(movers=[(7, 1)])
    assert bench.owner(7) == 0


def test_h05_a_late_abort_does_not_drop_a_newer_replica() -> None:
    scenarios.abort_fence()


def test_h06_a_late_prepare_after_an_abort_makes_no_replica() -> None:
    scenarios.fence_stays()


def test_h07_a_doubled_prepare_after_a_return_does_not_change_the_owned_row() -> None:
    bench, prepare = prepared()
    bench.give(prepare)
    bench.commit()
    bench.directory.on_message(bench.give(prepare)[0])
    bench.tick(movers=[(7, 1)], offers=[(7, 0)])
    bench.tick(movers=[(7, 0)], offers=[(7, 1)])
    assert not bench.give(prepare)
    bench.tick(movers=[(7, 1)])
    assert bench.entered[7] == version(7, 3)
    scenarios.replica_slot()


def test_h08_the_ack_of_a_dead_target_does_not_count() -> None:
    scenarios.ack_incarnation()


def test_h09_a_target_that_dies_after_the_switch_still_owns_the_vehicle() -> None:
    bench = approached(Bench())
    bench.tick(movers=[(7, 1)])
    bench.crash(1)
    bench.tick()
    assert bench.endpoints[1].owned == {7: 1}
    scenarios.reattach()


def test_h10_a_source_that_dies_in_its_step_loses_no_committed_state() -> None:
    scenarios.double_buffer()


def test_h11_a_restarted_coordinator_sends_the_same_decisions() -> None:
    bench = approached(Bench())
    steps = bench.begin(movers=[(7, 1)])
    bench.directory = Directory.restore(bench.log, range(2), bench)
    assert bench.directory.resend().messages == steps
    scenarios.log_before_send()


def test_h12_a_living_process_that_was_replaced_does_not_count() -> None:
    scenarios.done_incarnation()


def test_h13_a_repeated_step_is_not_executed_and_an_old_done_does_not_count() -> None:
    bench = Bench()
    bench.tick(births=[(7, 0)])
    old = bench.begin()
    answers = [bench.give(step)[0] for step in old]
    for done in answers:
        bench.give(done)
    bench.commit()
    bench.begin()
    assert bench.give(old[0]) == (answers[0],)
    bench.give(answers[0])
    assert bench.directory.waiting_for() == (0, 1)


def test_h14_the_source_does_not_remain_the_owner_forever() -> None:
    bench = Bench(limits=Limits(deferral=2))
    bench.tick(births=[(7, 0)])
    for _ in range(3):
        bench.tick(movers=[(7, 1)])
    assert bench.owner(7) == 1
    scenarios.deadline()


def test_h15_messages_from_before_a_reset_do_not_count() -> None:
    scenarios.tick_never_resets()
    scenarios.run_fence()


def test_h16_a_vehicle_that_weaves_on_a_border_keeps_its_owner() -> None:
    scenarios.hysteresis()


def test_h17_at_a_corner_of_four_zones_the_owner_is_the_zone_of_the_vehicle() -> None:
    bench = Bench(4)
    bench.tick(births=[(7, 0)], offers=[(7, 1), (7, 2), (7, 3)])
    for zone in (3, 1, 2, 0):
        others = [(7, other) for other in range(4) if other != zone]
        bench.tick(movers=[(7, zone)], offers=others)
        assert bench.owner(7) == zone


def test_h18_a_vehicle_that_waits_for_its_transfer_may_skip_a_zone() -> None:
    bench = Bench(3, limits=Limits(deferral=2))
    bench.tick(births=[(7, 0)])
    bench.tick(movers=[(7, 1)])
    bench.tick(movers=[(7, 1)])
    bench.tick(movers=[(7, 2)])
    assert bench.owner(7) == 2


def test_h19_vehicles_may_be_removed_and_created_during_a_transfer() -> None:
    bench = approached(Bench())
    bench.tick(movers=[(7, 1)], births=[(8, 0)], removed=[7])
    assert bench.directory.table.owners == {8: (0, 0)}
    bench.tick()
    assert bench.endpoints[0].owned == {8: 0}
    assert not bench.endpoints[1].owned
    scenarios.removed_is_final()


def test_h20_an_ack_alone_does_not_change_the_owner() -> None:
    bench = approached(Bench())
    bench.tick(offers=[(7, 1)])
    assert bench.owner(7) == 0, "an ACK has changed the owner"
    scenarios.early_offer()


def test_h22_a_tick_is_committed_although_a_host_dies() -> None:
    bench = Bench()
    bench.tick(births=[(7, 0)])
    first, _ = bench.begin()
    bench.pass_on([first])
    bench.pass_on(bench.crash(1).messages)
    bench.commit()
    assert bench.directory.table.tick == 2


def test_h23_a_restarted_coordinator_knows_the_owners() -> None:
    bench = approached(Bench())
    bench.tick(movers=[(7, 1)])
    again = Directory.restore(bench.log, range(2), bench)
    assert again.table.owners == {7: (1, 1)}
    assert again.table.tallies == bench.directory.table.tallies


def test_h24_states_are_transferred_byte_for_byte() -> None:
    simulator = Simulator(ToyWorld(cuts_x=(6, 12, 18)))
    simulator.run(20)
    assert simulator.digests == simulator.world.undivided(20)
    assert simulator.switches > 30


def test_h25_a_state_with_another_digest_or_schema_is_refused_with_the_reason() -> None:
    bench, prepare = prepared()
    damaged = replace(prepare, entries=(prepare.entries[0]._replace(state=b""),))
    for message, reason in (
        (damaged, Refusal.DIGEST),
        (replace(prepare, schema=9), Refusal.SCHEMA),
    ):
        (answer,) = bench.give(message)
        assert isinstance(answer, Nack)
        assert [entry.reason for entry in answer.entries] == [reason]


def test_h26_a_transfer_to_a_zone_that_gets_another_host_is_repeated() -> None:
    bench, prepare = prepared()
    (ack,) = bench.give(prepare)
    bench.commit()
    bench.host(1)
    bench.directory.on_message(ack)
    assert bench.directory.dropped["Ack", "incarnation"] == 1
    bench.tick(movers=[(7, 1)], offers=[(7, 1)])
    bench.tick(movers=[(7, 1)])
    assert bench.owner(7) == 1


def test_h28_rows_of_other_processes_are_not_committed() -> None:
    scenarios.segment_per_incarnation()
    scenarios.digest_before_commit()


def test_a_hundred_vehicles_change_their_owners_in_one_tick() -> None:
    bench = Bench()
    births = [(vehicle, vehicle % 2) for vehicle in range(100)]
    offers = [(vehicle, 1 - zone) for vehicle, zone in births]
    bench.tick(births=births, offers=offers)
    bench.tick(movers=offers)
    assert [bench.owner(vehicle) for vehicle, _ in births] == [zone for _, zone in offers]
    bench.judge()


def test_a_vehicle_that_is_created_in_the_overlap_can_be_handed_over_in_the_next_tick() -> None:
    bench = Bench()
    output = bench.note(bench.directory.begin([], [Birth(7, 0, version(7, 0))]))
    for step in output.messages:
        assert isinstance(step, Step)
        (done,) = bench.give(step)
        assert isinstance(done, Done)
        bench.give(done)
    bench.pass_on(bench.offer(0, (7, 1)))
    bench.commit()
    bench.tick(movers=[(7, 1)])
    assert bench.owner(7) == 1
