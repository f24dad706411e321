"""One scenario for each safeguard: it passes with all of them on, and fails without that one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from cavmarl.core.errors import LostTickError, ProtocolError
from cavmarl.ownership.directory import StoreError
from cavmarl.ownership.distances import Distances
from cavmarl.ownership.limits import Limits
from cavmarl.ownership.messages import Ack, Confirmed, Done, Held, Nack, Need, Prepare, Removed
from cavmarl.ownership.safeguards import Safeguards
from cavmarl.ownership.store import MemoryStore
from cavmarl.ownership.transport import FaultPlan, Rates
from tests.ownership.bench import Bench
from tests.ownership.explorer import Explorer, Small, version
from tests.ownership.simulator import Simulator
from tests.ownership.toy import ToyWorld

OTHER_RUN = bytes(reversed(range(16)))


def explored(safeguards: Safeguards, **small: object) -> None:
    """In every state all invariants hold, and the end can be reached."""
    states, reached = Explorer(Small(safeguards=safeguards, **small)).run()  # type: ignore[arg-type]
    assert states == reached


# The lease and the switch


def one_step_lease(safeguards: Safeguards) -> None:
    explored(replace(safeguards, ledger=False), ticks=2)


def copy_until_commit(safeguards: Safeguards) -> None:
    explored(safeguards, ticks=2)


def exact_promotion(safeguards: Safeguards) -> None:
    bench = approached(Bench(safeguards=safeguards))
    step = bench.begin(movers=[(7, 1)])[1]
    stale = replace(step, enter=(step.enter[0]._replace(digest=b"of another state"),))
    (answer,) = bench.give(stale)
    assert answer == Need(bench.directory.run, 0, 2, 1, 1, (7,))


def reattach(safeguards: Safeguards) -> None:
    bench = approached(Bench(safeguards=safeguards))
    bench.begin(movers=[(7, 1)])
    bench.pass_on(bench.crash(1).messages)
    assert bench.entered.get(7) == version(7, 1)


def deadline(safeguards: Safeguards) -> None:
    explored(safeguards, ticks=3, limits=Limits(deferral=0))


def target_by_position(safeguards: Safeguards) -> None:
    bench = Bench(3, safeguards=safeguards)
    bench.tick(births=[(7, 0)], offers=[(7, 1)])
    bench.begin(movers=[(7, 2)])
    assert not bench.directory.table.planned.switches, "it is not where it was prepared"


# Acknowledgements


def ack_freshness(safeguards: Safeguards) -> None:
    bench = approached(Bench(safeguards=replace(safeguards, ack_digest=False)))
    bench.tick()
    bench.begin(movers=[(7, 1)])
    bench.judge()
    assert not bench.directory.table.planned.switches


def ack_incarnation(safeguards: Safeguards) -> None:
    bench = approached(Bench(safeguards=safeguards))
    bench.crash(1)
    bench.begin(movers=[(7, 1)])
    bench.judge()
    assert not bench.directory.table.planned.switches


def ack_digest(safeguards: Safeguards) -> None:
    bench = Bench(safeguards=safeguards)
    bench.tick(births=[(7, 0)])
    held = Held(7, 0, b"of another state")
    bench.directory.on_message(Ack(bench.directory.run, 0, 1, 1, 1, 0, (held,)))
    bench.begin(movers=[(7, 1)])
    assert not bench.directory.table.planned.switches


def state_digest(safeguards: Safeguards) -> None:
    bench, prepare = prepared(safeguards)
    entry = prepare.entries[0]._replace(state=b"damaged on its way")
    (answer,) = bench.give(replace(prepare, entries=(entry,)))
    assert isinstance(answer, Nack)


def state_schema(safeguards: Safeguards) -> None:
    bench, prepare = prepared(safeguards)
    (answer,) = bench.give(replace(prepare, schema=2))
    assert isinstance(answer, Nack)


# Replicas


def abort_fence(safeguards: Safeguards) -> None:
    bench, prepare = prepared(safeguards)
    (abort,) = bench.offer(0)
    bench.commit()
    (step, other) = bench.begin()
    bench.give(bench.give(step)[0])
    (newer,) = bench.offer(0, (7, 1))
    bench.give(newer)
    bench.give(replace(abort, tick=1))
    assert 7 in bench.endpoints[1].replicas.held
    assert other.zone == 1
    assert prepare.tick == 1


def fence_stays(safeguards: Safeguards) -> None:
    bench, prepare = prepared(safeguards)
    bench.commit()
    (step, _) = bench.begin()
    bench.give(bench.give(step)[0])
    (abort,) = bench.offer(0)
    bench.give(abort)
    assert not bench.give(prepare), "an approach that is over is not acknowledged"
    assert 7 not in bench.endpoints[1].replicas.held


def replica_slot(safeguards: Safeguards) -> None:
    bench, prepare = prepared(safeguards)
    bench.pass_on([prepare])
    bench.commit()
    bench.tick(movers=[(7, 1)])
    bench.entered.clear()
    bench.give(prepare)
    bench.tick()
    assert not bench.entered, "a late state has reached the row that is owned"


def replica_lifetime(safeguards: Safeguards) -> None:
    bench = approached(Bench(safeguards=safeguards, limits=Limits(lifetime=3)))
    bench.endpoints[0].offers.open.clear()  # as in a source that died and knows of nothing
    for _ in range(5):
        bench.tick()
    assert not bench.endpoints[1].replicas.held
    assert not bench.endpoints[1].replicas.fences


# Ticks, runs, episodes, processes


def log_before_send(safeguards: Safeguards) -> None:
    explored(safeguards, ticks=2, coordinator_crashes=1)


def done_incarnation(safeguards: Safeguards) -> None:
    explored(safeguards, ticks=2, false_alarms=1)


def step_tick(safeguards: Safeguards) -> None:
    explored(replace(safeguards, answer_again=False), ticks=2)


def done_tick(safeguards: Safeguards) -> None:
    explored(safeguards, ticks=2)


def answer_again(safeguards: Safeguards) -> None:
    plan = FaultPlan(rates={"Done": Rates(drop=0.5)})
    Simulator(ToyWorld(), plan=plan, safeguards=safeguards, patience=60).run(5)


def tick_never_resets(safeguards: Safeguards) -> None:
    bench = Bench(safeguards=safeguards)
    late = [bench.give(step)[0] for step in bench.begin()]
    for done in late:
        bench.give(done)
    bench.commit()
    bench.note(bench.directory.reset())
    bench.begin()
    for done in late:
        bench.directory.on_message(done)
    assert bench.directory.waiting_for() == (0, 1)


def run_fence(safeguards: Safeguards) -> None:
    bench = Bench(safeguards=safeguards)
    step = bench.begin()[0]
    (done,) = bench.give(step)
    bench.directory.on_message(replace(done, run=OTHER_RUN))
    assert bench.directory.waiting_for() == (0, 1)
    assert not bench.endpoints[1].on_message(replace(step, run=OTHER_RUN, zone=1)).messages


def repeat_limit(safeguards: Safeguards) -> None:
    bench = Bench(safeguards=safeguards)
    bench.begin()
    for _ in range(bench.limits.repeats):
        bench.crash(1)
    with pytest.raises(LostTickError, match="zone 1 could not reach tick 1: 4 hosts"):
        bench.crash(1)


# The ledger and the committed store


def removed_is_final(safeguards: Safeguards) -> None:
    bench = Bench(safeguards=safeguards)
    bench.tick(births=[(7, 0)])
    bench.tick(removed=[7])
    with pytest.raises(ProtocolError, match="vehicle 7"):
        bench.begin(births=[(7, 1)])


def ledger(safeguards: Safeguards) -> None:
    for lie in (
        lambda done: replace(done, removed=(Removed(8, 0),)),
        lambda done: replace(done, confirmed=(Confirmed(7, 1),)),
        lambda done: replace(done, owned=done.owned._replace(vehicles=0)),
        lambda done: replace(done, owned=done.owned._replace(digest=1)),
    ):
        bench = Bench(safeguards=safeguards)
        bench.tick(births=[(7, 0), (8, 1)])
        dones = [bench.give(step)[0] for step in bench.begin()]
        assert isinstance(dones[0], Done)
        bench.give(lie(dones[0]))
        bench.give(dones[1])
        with pytest.raises(ProtocolError, match="zone 0"):
            bench.commit()


def double_buffer(safeguards: Safeguards) -> None:
    world = ToyWorld()
    simulator = Simulator(
        world, safeguards=safeguards, crashes=lambda tick, point, zone: point == "half written"
    )
    simulator.run(5)
    assert simulator.digests == world.undivided(5)


def segment_per_incarnation(safeguards: Safeguards) -> None:
    store = MemoryStore(safeguards)
    store.write(0, 2, 7, b"of the living host")
    store.write(0, 1, 7, b"of the zombie")
    store.commit(1, {0: 2})
    assert store.state(7) == b"of the living host"


def digest_before_commit(safeguards: Safeguards) -> None:
    bench = Bench(safeguards=safeguards)
    for step in bench.begin():
        bench.give(bench.give(step)[0])
    with pytest.raises(StoreError, match="zones \\[1\\]"):
        bench.directory.commit({0: bench.directory.dones[0].rows, 1: 12345})
    assert bench.directory.waiting_for() == (1,)


# Distances


def hysteresis(safeguards: Safeguards) -> None:
    distances = Distances(approach_m=20.0, hysteresis_m=2.0, overlap_m=100.0)
    side, changes = 0, 0
    for tick in range(40):
        x = 1.0 if tick % 2 else -1.0  # the border is at 0
        depth = x if side == 0 else -x
        if distances.switches(depth, safeguards):
            side, changes = 1 - side, changes + 1
    assert changes <= 1


def early_offer(safeguards: Safeguards) -> None:
    distances = Distances(approach_m=5.0, hysteresis_m=1.0, overlap_m=100.0)
    depths = [-9.0 + 2.0 * tick for tick in range(10)]
    offered = next(tick for tick, depth in enumerate(depths) if distances.offers(depth, safeguards))
    crossed = next(tick for tick, depth in enumerate(depths) if depth > 0.0)
    assert offered < crossed


def approached(bench: Bench) -> Bench:
    """Vehicle 7 of zone 0 has been offered to zone 1, which has acknowledged it, in tick 1."""
    bench.tick(births=[(7, 0)], offers=[(7, 1)])
    return bench


def prepared(safeguards: Safeguards) -> tuple[Bench, Prepare]:
    """Tick 1 is computed, not committed; zone 0 has sent a PREPARE that has not arrived."""
    bench = Bench(safeguards=safeguards)
    for step in bench.begin(births=[(7, 0)]):
        bench.give(bench.give(step)[0])
    (prepare,) = bench.offer(0, (7, 1))
    assert isinstance(prepare, Prepare)
    return bench, prepare


SCENARIOS: dict[str, Callable[[Safeguards], None]] = {
    scenario.__name__: scenario
    for scenario in (
        one_step_lease, copy_until_commit, exact_promotion, reattach, deadline,
        target_by_position, ack_freshness, ack_incarnation, ack_digest, state_digest,
        state_schema, abort_fence, fence_stays, replica_slot, replica_lifetime, log_before_send,
        done_incarnation, step_tick, done_tick, answer_again, tick_never_resets, run_fence,
        repeat_limit, removed_is_final, ledger, double_buffer, segment_per_incarnation,
        digest_before_commit, hysteresis, early_offer,
    )
}  # fmt: skip
