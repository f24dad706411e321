"""One test for each numbered rule of docs/explanation/ownership.md."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest

from cavmarl.core.errors import (
    JournalError,
    LostTickError,
    ProtocolError,
)
from cavmarl.ownership.directory import Directory, StoreError
from cavmarl.ownership.ledger import row_hash, world_digest
from cavmarl.ownership.limits import Limits
from cavmarl.ownership.messages import (
    COORDINATOR,
    Abort,
    Ack,
    Begin,
    Done,
    Held,
    Nack,
    Need,
    Prepare,
    Refusal,
    Removed,
    Step,
)
from cavmarl.ownership.transitions import State
from tests.ownership.bench import Bench, version
from tests.ownership.scenarios import approached, prepared
from tests.support.lossy_network import FaultPlan, Network, Rates
from tests.support.memory_store import MemoryStore


def test_r01_a_host_advances_only_with_its_step_and_once() -> None:
    bench = Bench()
    step = bench.begin(births=[(7, 0)])[0]
    endpoint = bench.endpoints[0]
    with pytest.raises(ProtocolError, match="no lease"):
        endpoint.complete(0)
    assert endpoint.on_message(replace(step, tick=2)).advance is None
    assert endpoint.lease is None
    assert endpoint.on_message(step).advance is not None
    assert endpoint.lease == 1
    assert endpoint.on_message(step).advance is None
    for other in (replace(step, tick=3), replace(step, incarnation=2), replace(step, zone=1)):
        assert endpoint.on_message(other).advance is None


def test_r02_done_ends_the_lease() -> None:
    bench = Bench()
    step = bench.begin(births=[(7, 0)])[0]
    bench.give(step)
    assert bench.endpoints[0].lease is None
    with pytest.raises(ProtocolError, match="no lease"):
        bench.endpoints[0].complete(0)


def test_r03_records_come_before_messages() -> None:
    bench = approached(Bench())
    output = bench.directory.begin([(7, 1)])
    assert [type(record) for record in output.records] == [Begin]
    assert [type(message) for message in output.messages] == [Step, Step]
    assert not bench.directory.resend().records


def test_r03_the_payload_of_a_step_is_sent_again_with_it() -> None:
    bench = Bench()
    bench.directory.begin([], payloads={1: b"ghosts"})
    for output in (bench.directory.resend(), bench.crash(0), bench.crash(1)):
        for step in output.messages:
            assert isinstance(step, Step)
            assert step.payload == (b"ghosts" if step.zone == 1 else b"")
    bench.pass_on(bench.directory.resend().messages)
    bench.commit()
    assert [step.payload for step in bench.begin()] == [b"", b""]


def test_r04_a_restarted_coordinator_keeps_a_logged_decision() -> None:
    bench = approached(Bench())
    sent = bench.begin([(7, 1)])
    again = Directory.restore(bench.log, range(2), bench)
    assert again.resend().messages == sent
    with pytest.raises(ProtocolError, match="not committed"):
        again.begin([])
    for log in ([], bench.log[1:]):
        with pytest.raises(JournalError, match="must begin with a RESET"):
            Directory.restore(log, range(2), bench)


def test_r05_a_tick_begins_only_after_the_previous_one_is_committed() -> None:
    bench = Bench()
    bench.begin()
    with pytest.raises(ProtocolError, match="tick 1 is not committed"):
        bench.begin()
    with pytest.raises(ProtocolError, match="zones \\[0, 1\\] have not answered"):
        bench.directory.commit({})


@pytest.mark.parametrize("change", ["epoch", "tick", "incarnation", "digest"])
def test_r07_only_an_exact_ack_makes_a_target_ready(change: str) -> None:
    bench = Bench()
    for step in bench.begin(births=[(7, 0)]):
        bench.give(bench.give(step)[0])
    (prepare,) = bench.offer(0, (7, 1))
    (ack,) = bench.give(prepare)
    assert isinstance(ack, Ack)
    entry = ack.entries[0]
    wrong = {
        "epoch": replace(ack, entries=(entry._replace(epoch=1),)),
        "tick": replace(ack, tick=0),
        "incarnation": replace(ack, incarnation=2),
        "digest": replace(ack, entries=(entry._replace(digest=bytes(16)),)),
    }
    bench.directory.on_message(wrong[change])
    bench.commit()
    bench.begin(movers=[(7, 1)])
    assert [entry.vehicle for entry in bench.directory.table.planned.record.deferred] == [7]


def test_r09_a_target_promotes_the_exact_state_or_asks_for_it() -> None:
    bench = approached(Bench())
    bench.endpoints[1].replicas.held.clear()
    step = bench.begin(movers=[(7, 1)])[1]
    (need,) = bench.give(step)
    assert isinstance(need, Need)
    assert bench.endpoints[1].lease is None
    bench.give(replace(need, vehicles=(99,)))
    bench.give(replace(need, zone=0))
    assert bench.directory.dropped["Need", "unknown"] == 2
    (again,) = bench.give(need)
    bench.pass_on([again])
    assert bench.entered[7] == version(7, 1)


def test_r10_the_source_keeps_a_row_until_its_switch_is_committed() -> None:
    bench = approached(Bench())
    bench.tick(movers=[(7, 1)])
    assert bench.endpoints[0].row_state(7) is State.RETAINED
    step = bench.begin()[0]
    advance = bench.endpoints[0].on_message(step).advance
    assert advance is not None
    assert advance.release == (7,)
    assert bench.endpoints[0].row_state(7) is State.NONE


def test_r11_a_commit_needs_the_done_of_every_living_host() -> None:
    bench = Bench()
    first, second = bench.begin()
    (done,) = bench.give(first)
    bench.give(done)
    assert bench.directory.waiting_for() == (1,)
    (late,) = bench.give(second)
    bench.note(bench.directory.fence(1))
    bench.directory.on_message(late)
    bench.directory.on_message(replace(late, incarnation=2))
    assert bench.directory.waiting_for() == (1,)
    bench.directory = Directory.restore(bench.log, range(2), bench)
    assert bench.directory.table.states[1] is State.FENCED
    assert not bench.directory.fence(1).records


def test_r12_a_tick_with_a_wrong_ledger_is_not_committed() -> None:
    bench = Bench()
    bench.tick(births=[(7, 0), (8, 1)])
    first, second = bench.begin()
    bench.give(bench.give(first)[0])
    (done,) = bench.give(second)
    assert isinstance(done, Done)
    bench.give(replace(done, removed=(Removed(7, 0),)))
    with pytest.raises(
        ProtocolError, match="zone 1 at tick 2 removed vehicle 7, but zone 0 owns it"
    ):
        bench.commit()


def test_r13_a_zone_whose_stored_rows_differ_from_its_report_gets_a_new_host() -> None:
    bench = Bench()
    for step in bench.begin(births=[(7, 0)]):
        bench.give(bench.give(step)[0])
    with pytest.raises(StoreError) as error:
        bench.directory.commit({0: 1, 1: 0})
    assert error.value.zones == (0,)
    bench.pass_on(bench.crash(0).messages)
    bench.commit()


def test_r14_the_epoch_rises_by_one_with_each_switch() -> None:
    bench = Bench()
    bench.tick(births=[(7, 0)], offers=[(7, 1)])
    for epoch, zone in enumerate((1, 0, 1), start=1):
        bench.tick(movers=[(7, zone)], offers=[(7, 1 - zone)])
        assert bench.directory.table.owners[7] == (zone, epoch)


def test_r15_a_prepare_or_abort_that_is_not_newer_than_the_fence_is_dropped() -> None:
    bench, prepare = prepared()
    assert bench.give(replace(prepare, tick=2))
    assert not bench.give(prepare)
    endpoint = bench.endpoints[1]
    assert endpoint.replicas.held[7].tick == 2
    abort = Abort(prepare.run, 0, 2, 0, 1, 1, ((7, 0),))  # type: ignore[arg-type]
    bench.give(abort)
    assert 7 in endpoint.replicas.held
    assert endpoint.dropped["Abort", "fence"] == 1


def test_r16_replicas_and_messages_older_than_the_lifetime_are_dropped() -> None:
    bench, prepare = prepared()
    bench.commit()
    for _ in range(bench.limits.lifetime):
        bench.tick()
    assert not bench.give(prepare)
    assert bench.endpoints[1].dropped["Prepare", "tick"] == 1
    for _ in range(2):
        bench.tick()
    assert not bench.endpoints[1].replicas.fences


def test_r17_a_prepare_never_changes_a_row_that_the_zone_owns() -> None:
    bench, prepare = prepared()
    owner = bench.endpoints[0]
    owner.on_message(replace(prepare, target=0))
    assert owner.dropped["Prepare", "owned"] == 1
    assert 7 not in owner.replicas.held


def test_r18_a_target_gets_one_prepare_or_abort_per_tick_with_limited_repeats() -> None:
    bench, _ = prepared()
    endpoint = bench.endpoints[0]
    tries = [endpoint.offer_again() for _ in range(4)]
    assert [len(messages) for messages in tries] == [1, 1, 0, 0]
    sent = bench.offer(0)
    assert [type(message) for message in sent] == [Abort]
    assert not bench.offer(0)
    (prepare,) = bench.offer(0, (7, 1))
    bench.pass_on(bench.give(prepare))
    assert not endpoint.offer_again(), "an answered offer is sent again"
    bench.offer(0, (7, 1))
    bench.commit()
    bench.give(bench.begin()[0])
    assert not endpoint.offer_again(), "an offer of the previous tick is sent again"


def test_r19_a_refusal_has_a_reason_and_stops_offers_for_some_ticks() -> None:
    bench = Bench(limits=Limits(capacity=0, backoff=3))
    offered = []
    for tick in range(8):
        births = [(7, 0)] if tick == 0 else []
        sent = bench.tick(births=births, offers=[(7, 1)])
        offered.append(sum(isinstance(message, Prepare) for message in sent))
    assert offered == [1, 0, 0, 0, 1, 0, 0, 0]
    assert bench.directory.refusals == {Refusal.LOAD: 2}
    other, prepare = prepared()
    target = other.endpoints[1]
    (nack,) = target.refuse(prepare).messages
    assert isinstance(nack, Nack)
    assert [entry.reason for entry in nack.entries] == [Refusal.LOAD]
    assert not target.refuse(replace(prepare, target=0)).messages
    assert target.dropped["Prepare", "zone"] == 1


def test_r20_a_repeated_step_is_answered_from_memory() -> None:
    bench = Bench()
    step = bench.begin(births=[(7, 0)])[0]
    (done,) = bench.give(step)
    assert bench.give(step) == (done,)
    assert bench.endpoints[0].tick == 1


def test_r21_messages_of_a_fenced_process_are_dropped() -> None:
    bench = approached(Bench())
    step = bench.begin(movers=[(7, 1)])[1]
    (late,) = bench.give(step)
    bench.crash(1)
    bench.directory.on_message(late)
    assert bench.directory.dropped["Done", "incarnation"] == 1
    assert bench.directory.table.hosts[1] == (1, 2)


def test_r22_a_new_host_gets_the_committed_tick_and_the_states_of_arriving_vehicles() -> None:
    bench = approached(Bench())
    bench.begin(movers=[(7, 1)])
    source, target = bench.crash(0), bench.crash(1)
    assert bench.endpoints[0].owned == {7: 0}
    assert bench.endpoints[0].tick == 1
    (step,) = target.messages
    assert isinstance(step, Step)
    assert step.enter[0].state == version(7, 1)
    bench.pass_on(source.messages + target.messages)
    bench.commit()
    assert bench.owner(7) == 1


def test_r23_a_tick_in_which_every_host_dies_is_an_error() -> None:
    bench = Bench(limits=Limits(repeats=2))
    bench.begin()
    bench.crash(0)
    bench.crash(0)
    with pytest.raises(LostTickError) as error:
        bench.crash(0)
    assert (error.value.zone, error.value.tick) == (0, 1)
    bench.note(bench.directory.reset())
    bench.begin()
    bench.crash(0)


def test_r24_a_zone_with_a_living_host_moves_only_between_ticks() -> None:
    bench = approached(Bench())
    bench.host(1)
    bench.tick(movers=[(7, 1)])
    assert bench.directory.table.deferred == {7: 1}, (
        "the vehicle is handed over with the ACK of another process"
    )
    bench.begin()
    with pytest.raises(ProtocolError, match="fence it first"):
        bench.host(1)


def test_r25_the_id_of_a_removed_vehicle_is_not_used_again_in_the_episode() -> None:
    bench, prepare = prepared()
    bench.commit()
    bench.tick(removed=[7])
    assert not bench.give(prepare), "the target acknowledges an offer that was withdrawn"
    held = Held(7, 0, prepare.entries[0].digest)
    bench.directory.on_message(Ack(prepare.run, 0, 2, 1, 1, 0, (held,)))
    assert bench.directory.dropped["Ack", "unknown"] == 1
    for births in ([(7, 0)], [(-1, 0)], [(8, 9)], [(9, 0), (9, 1)]):
        with pytest.raises(ProtocolError):
            bench.begin(births=births)
    with pytest.raises(ProtocolError, match="does not exist"):
        bench.begin(movers=[(7, 1)])
    assert [bench.directory.table.state(vehicle) for vehicle in (7, 8)] == ["REMOVED", "UNKNOWN"]


def test_r26_a_reset_begins_an_empty_episode_and_the_tick_number_continues() -> None:
    bench = approached(Bench())
    late = bench.begin(movers=[(7, 1)])
    bench.note(bench.directory.reset())
    table = bench.directory.table
    assert (table.episode, table.tick, table.owners, table.deferred) == (1, 2, {}, {})
    bench.tick(births=[(7, 1)])
    assert bench.owner(7) == 1
    assert [(end.episode, end.tick) for end in bench.endpoints.values()] == [(1, 3), (1, 3)]
    for message in late:
        assert not bench.give(message)


def test_r27_foreign_messages_are_dropped_and_counted_by_reason() -> None:
    bench = Bench()
    step = bench.begin()[0]
    (done,) = bench.give(step)
    directory, endpoint = bench.directory, bench.endpoints[0]
    assert isinstance(done, Done)
    for wrong in (
        replace(done, run=bytes(16)), replace(done, episode=5), replace(done, zone=9), step,
        replace(done, tick=7),
    ):  # fmt: skip
        directory.on_message(wrong)
    reasons = {reason for _, reason in directory.dropped}
    assert reasons == {"run", "episode", "zone", "kind", "tick"}
    header = (bench.directory.run, 0, 1)
    for message in (
        replace(step, run=bytes(16)), replace(step, zone=1), replace(step, incarnation=3),
        done, Nack(*header, 1, 1, 5, ()), Prepare(run=header[0], episode=3, tick=1, source=1,
        incarnation=1, target=0, schema=1, entries=()),
    ):  # fmt: skip
        assert not endpoint.on_message(message).messages
    reasons = {reason for _, reason in endpoint.dropped}
    assert reasons == {"run", "zone", "incarnation", "kind", "episode"}


def test_r32_the_digest_of_a_world_does_not_depend_on_its_zones() -> None:
    rows = {vehicle: version(vehicle, 3) for vehicle in range(20)}
    whole = world_digest(row_hash(vehicle, row) for vehicle, row in rows.items())
    for zones in (1, 2, 7):
        store = MemoryStore()
        for vehicle, row in reversed(rows.items()):
            store.write(vehicle % zones, 1, vehicle, row)
        parts = [store.digest(zone, 1) for zone in range(zones)]
        store.commit(1, dict.fromkeys(range(zones), 1))
        assert world_digest(parts) == store.world() == whole


def test_r33_the_faults_of_the_network_depend_only_on_its_seed() -> None:
    def arrivals(seed: int) -> list[tuple[int, int]]:
        network = Network(FaultPlan(seed=seed, otherwise=Rates(0.2, 0.3, 0.3, 0.3)))
        seen = []
        for tick in range(30):
            network.send([Need(bytes(16), 0, tick, zone, 1, ()) for zone in range(3)])
            seen += [(network.phase, d.message.tick) for d in network.deliver()]
        return seen

    assert arrivals(1) == arrivals(1) != arrivals(2)
    plain = Network()
    plain.send([Need(bytes(16), 0, 5, 0, 1, ())])
    assert [delivery.destination for delivery in plain.deliver()] == [COORDINATOR]
    assert not plain.in_flight()


class NotIterable(dict[int, tuple[int, int]]):
    """A table of owners that allows look-ups, but no iteration."""

    def __iter__(self) -> Iterator[int]:
        raise AssertionError("every vehicle was looked at")

    keys = values = items = __iter__  # type: ignore[assignment]


def test_r34_a_tick_visits_only_the_vehicles_that_change() -> None:
    bench = Bench()
    bench.tick(births=[(vehicle, vehicle % 2) for vehicle in range(50)], offers=[(0, 1)])
    owners = NotIterable(bench.directory.table.owners)
    bench.directory.table.owners = owners
    bench.tick(movers=[(0, 1)], births=[(99, 0)], offers=[(99, 1)])
    assert (owners[0], owners[99], len(owners)) == ((1, 1), (0, 0), 51)
