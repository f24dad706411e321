"""The holes of the paper's protocol, H1 to H28: none of the faults can occur.

H21 (pairs across a border), H24 (content of a state) and H27 (load readings) lie outside the core,
which transfers states as bytes; these tests check that the bytes do not change.
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


def test_h01_no_two_owners() -> None:
    bench = approached(Bench())
    for step in bench.begin(movers=[(7, 1)]):
        bench.give(step)
        assert sum(7 in endpoint.owned for endpoint in bench.endpoints.values()) <= 1
    scenarios.one_step_lease()


def test_h02_no_vehicle_without_an_owner_or_a_copy() -> None:
    bench = approached(Bench())
    first, second = bench.begin(movers=[(7, 1)])
    bench.give(first)
    assert bench.endpoints[0].row_state(7) is State.RETAINED
    assert bench.endpoints[1].replicas.state(7) is State.PREPARED
    bench.give(second)
    assert bench.endpoints[0].row_state(7) is State.RETAINED
    assert bench.endpoints[1].row_state(7) is State.AUTHORITATIVE
    scenarios.copy_until_commit()


def test_h03_no_jump_back_in_time() -> None:
    bench = approached(Bench())
    bench.tick()
    bench.tick(movers=[(7, 1)])
    assert bench.owner(7) == 0, "the state at the target is that of an older tick"


def test_h04_a_late_ack_after_a_turn_back() -> None:
    bench, prepare = prepared()
    (ack,) = bench.give(prepare)
    bench.commit()
    bench.tick()  # it turns back: an ABORT goes to the target
    bench.directory.on_message(ack)
    bench.tick(movers=[(7, 1)])
    assert bench.owner(7) == 0


def test_h05_a_late_abort() -> None:
    scenarios.abort_fence()


def test_h06_a_late_prepare_after_an_abort() -> None:
    scenarios.fence_stays()


def test_h07_a_doubled_prepare_after_a_return_trip() -> None:
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


def test_h08_a_target_that_died_after_its_ack() -> None:
    scenarios.ack_incarnation()


def test_h09_a_target_that_dies_after_the_switch() -> None:
    bench = approached(Bench())
    bench.tick(movers=[(7, 1)])
    bench.crash(1)
    bench.tick()
    assert bench.endpoints[1].owned == {7: 1}
    scenarios.reattach()


def test_h10_a_source_that_dies_in_its_step() -> None:
    scenarios.double_buffer()


def test_h11_a_coordinator_that_dies_between_decision_and_cleanup() -> None:
    bench = approached(Bench())
    steps = bench.begin(movers=[(7, 1)])
    bench.directory = Directory.restore(bench.log, range(2), bench)
    assert bench.directory.resend().messages == steps
    scenarios.log_before_send()


def test_h12_a_worker_that_was_wrongly_suspected() -> None:
    scenarios.done_incarnation()


def test_h13_a_repeated_step_and_an_old_done() -> None:
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


def test_h14_the_source_does_not_stay_for_ever() -> None:
    bench = Bench(limits=Limits(deferral=2))
    bench.tick(births=[(7, 0)])
    for _ in range(3):
        bench.tick(movers=[(7, 1)])
    assert bench.owner(7) == 1
    scenarios.deadline()


def test_h15_a_reset_does_not_bring_old_messages_back() -> None:
    scenarios.tick_never_resets()
    scenarios.run_fence()


def test_h16_a_car_that_weaves_on_a_border() -> None:
    scenarios.hysteresis()


def test_h17_a_corner_of_four_zones() -> None:
    bench = Bench(4)
    bench.tick(births=[(7, 0)], offers=[(7, 1), (7, 2), (7, 3)])
    for zone in (3, 1, 2, 0):
        others = [(7, other) for other in range(4) if other != zone]
        bench.tick(movers=[(7, zone)], offers=others)
        assert bench.owner(7) == zone


def test_h18_a_zone_that_is_skipped_while_waiting() -> None:
    bench = Bench(3, limits=Limits(deferral=2))
    bench.tick(births=[(7, 0)])
    bench.tick(movers=[(7, 1)])
    bench.tick(movers=[(7, 1)])
    bench.tick(movers=[(7, 2)])
    assert bench.owner(7) == 2


def test_h19_removed_and_born_in_the_middle_of_a_transfer() -> None:
    bench = approached(Bench())
    bench.tick(movers=[(7, 1)], births=[(8, 0)], removed=[7])
    assert bench.directory.table.owners == {8: (0, 0)}
    bench.tick()
    assert bench.endpoints[0].owned == {8: 0}
    assert not bench.endpoints[1].owned
    scenarios.removed_is_final()


def test_h20_the_approach_prepares_and_the_position_decides() -> None:
    bench = approached(Bench())
    bench.tick(offers=[(7, 1)])
    assert bench.owner(7) == 0, "an ACK alone moves no vehicle"
    scenarios.early_offer()


def test_h22_a_dead_node_does_not_stop_the_clock() -> None:
    bench = Bench()
    bench.tick(births=[(7, 0)])
    first, _ = bench.begin()
    bench.pass_on([first])
    bench.pass_on(bench.crash(1).messages)
    bench.commit()
    assert bench.directory.table.tick == 2


def test_h23_the_owners_outlive_the_coordinator() -> None:
    bench = approached(Bench())
    bench.tick(movers=[(7, 1)])
    again = Directory.restore(bench.log, range(2), bench)
    assert again.table.owners == {7: (1, 1)}
    assert again.table.tallies == bench.directory.table.tallies


def test_h24_a_state_is_carried_byte_for_byte() -> None:
    simulator = Simulator(ToyWorld(cuts_x=(6, 12, 18)))
    simulator.run(20)
    assert simulator.digests == simulator.world.undivided(20)
    assert simulator.switches > 30


def test_h25_states_of_other_content_or_schema_are_refused_with_the_reason() -> None:
    bench, prepare = prepared()
    damaged = replace(prepare, entries=(prepare.entries[0]._replace(state=b""),))
    for message, reason in (
        (damaged, Refusal.DIGEST),
        (replace(prepare, schema=9), Refusal.SCHEMA),
    ):
        (answer,) = bench.give(message)
        assert isinstance(answer, Nack)
        assert [entry.reason for entry in answer.entries] == [reason]


def test_h26_a_zone_that_moves_in_the_middle_of_a_transfer() -> None:
    bench, prepare = prepared()
    (ack,) = bench.give(prepare)
    bench.commit()
    bench.host(1)
    bench.directory.on_message(ack)
    assert bench.directory.dropped["Ack", "incarnation"] == 1
    bench.tick(movers=[(7, 1)], offers=[(7, 1)])
    bench.tick(movers=[(7, 1)])
    assert bench.owner(7) == 1


def test_h28_a_wild_write_does_not_become_the_truth() -> None:
    scenarios.segment_per_incarnation()
    scenarios.digest_before_commit()


def test_a_swap_of_two_and_a_hundred_crossings_in_one_tick() -> None:
    bench = Bench()
    births = [(vehicle, vehicle % 2) for vehicle in range(100)]
    offers = [(vehicle, 1 - zone) for vehicle, zone in births]
    bench.tick(births=births, offers=offers)
    bench.tick(movers=offers)
    assert [bench.owner(vehicle) for vehicle, _ in births] == [zone for _, zone in offers]
    bench.judge()


def test_a_birth_in_the_overlap_can_be_handed_over_at_once() -> None:
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
