"""One scenario per remedy, a rule that closes a hole of docs/explanation/ownership.md.

H1 to H28 number the holes of that page, and I1 to I10 its invariants. The first lines of the
docstrings are a table on the page. The fence of a vehicle is the newest (epoch, tick) that a host
has received about it; a fenced process is one whose messages no longer count. A segment is the part
of the committed store that one process writes. "Every host" means all hosts that a zone gets in
turn.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from cavmarl.core.errors import LostTickError, ProtocolError
from cavmarl.ownership.directory import StoreError
from cavmarl.ownership.limits import Limits
from cavmarl.ownership.messages import Ack, Confirmed, Done, Held, Nack, Need, Prepare, Removed
from cavmarl.zones.kernels.borders import NEAR, Borders, find_near
from cavmarl.zones.partition.zone_partition import ZonePartition
from tests.ownership.bench import Bench
from tests.ownership.explorer import Explorer, Small, version
from tests.ownership.simulator import Simulator
from tests.ownership.toy import ToyWorld
from tests.support.builders import vehicles
from tests.support.lossy_network import FaultPlan, Rates
from tests.support.memory_store import MemoryStore
from tests.support.zoned import SIDE, zoned_of

OTHER_RUN = bytes(reversed(range(16)))


def explore(**small: object) -> None:
    """Check that in each state of a small world, the invariants hold and the end can be reached."""
    states, reached = Explorer(Small(**small)).run()  # type: ignore[arg-type]
    assert states == reached


# The lease and the switch


def one_step_lease() -> None:
    """H1: OUT ends the authority of the source before IN gives authority to the target."""
    explore(ticks=2)


def copy_until_commit() -> None:
    """H2: the source keeps its frozen row until the switch commits."""
    explore(ticks=2)


def exact_promotion() -> None:
    """H3: a host promotes the exact replica, or asks for the state."""
    bench = approached(Bench())
    step = bench.begin(movers=[(7, 1)])[1]
    stale = replace(step, enter=(step.enter[0]._replace(digest=b"of another state"),))
    (answer,) = bench.give(stale)
    assert answer == Need(bench.directory.run, 0, 2, 1, 1, (7,))


def reattach() -> None:
    """H9: the coordinator sends the state again to a target that has lost its replica."""
    bench = approached(Bench())
    bench.begin(movers=[(7, 1)])
    bench.pass_on(bench.crash(1).messages)
    assert bench.entered.get(7) == version(7, 1)


def deadline() -> None:
    """H14: after D ticks the hand-off is forced."""
    explore(ticks=3, limits=Limits(deferral=0))


def target_by_position() -> None:
    """H17, H18: the target is the zone that contains the vehicle now."""
    bench = Bench(3)
    bench.tick(births=[(7, 0)], offers=[(7, 1)])
    bench.begin(movers=[(7, 2)])
    assert not bench.directory.table.planned.switches, (
        "the vehicle is handed over although its present zone is not prepared"
    )


# Acknowledgements


def ack_freshness() -> None:
    """H3, H4: an ACK counts for its own tick and epoch only."""
    bench = approached(Bench())
    bench.tick()
    bench.begin(movers=[(7, 1)])
    bench.judge()
    assert not bench.directory.table.planned.switches


def ack_incarnation() -> None:
    """H8, H26: an ACK of a dead process is ignored."""
    bench = approached(Bench())
    bench.crash(1)
    bench.begin(movers=[(7, 1)])
    bench.judge()
    assert not bench.directory.table.planned.switches


def ack_digest() -> None:
    """H25: an ACK counts only with the digest of the state that was offered."""
    bench = Bench()
    bench.tick(births=[(7, 0)])
    held = Held(7, 0, b"of another state")
    bench.directory.on_message(Ack(bench.directory.run, 0, 1, 1, 1, 0, (held,)))
    bench.begin(movers=[(7, 1)])
    assert not bench.directory.table.planned.switches


def state_digest() -> None:
    """H25: a state that does not match its digest is refused."""
    bench, prepare = prepared()
    entry = prepare.entries[0]._replace(state=b"damaged on its way")
    (answer,) = bench.give(replace(prepare, entries=(entry,)))
    assert isinstance(answer, Nack)


def state_schema() -> None:
    """H25: a state of another schema is refused."""
    bench, prepare = prepared()
    (answer,) = bench.give(replace(prepare, schema=2))
    assert isinstance(answer, Nack)


# Replicas


def abort_fence() -> None:
    """H5: an older ABORT does not drop a newer replica."""
    bench, prepare = prepared()
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


def fence_stays() -> None:
    """H6: the fence stays after the replica is dropped."""
    bench, prepare = prepared()
    bench.commit()
    (step, _) = bench.begin()
    bench.give(bench.give(step)[0])
    (abort,) = bench.offer(0)
    bench.give(abort)
    assert not bench.give(prepare), "the target acknowledges an offer that was withdrawn"
    assert 7 not in bench.endpoints[1].replicas.held


def replica_slot() -> None:
    """H7: a PREPARE never changes a row that the zone owns."""
    bench, prepare = prepared()
    bench.pass_on([prepare])
    bench.commit()
    bench.tick(movers=[(7, 1)])
    bench.entered.clear()
    bench.give(prepare)
    bench.tick()
    assert not bench.entered, "a late PREPARE has changed a row that the zone owns"


def replica_lifetime() -> None:
    """I8: a replica that is not refreshed expires."""
    bench = approached(Bench(limits=Limits(lifetime=3)))
    bench.endpoints[
        0
    ].offers.open.clear()  # no host refreshes the replica, as if its source were dead
    for _ in range(5):
        bench.tick()
    assert not bench.endpoints[1].replicas.held
    assert not bench.endpoints[1].replicas.fences


# Ticks, runs, episodes, processes


def log_before_send() -> None:
    """H11, H23: a decision is logged before it is sent."""
    explore(ticks=2, coordinator_crashes=1)


def done_incarnation() -> None:
    """H12: a DONE of a fenced process is ignored."""
    explore(ticks=2, false_alarms=1)


def step_tick() -> None:
    """H13: a STEP is executed once."""
    explore(ticks=2)


def done_tick() -> None:
    """H13: a DONE counts for its own tick only."""
    explore(ticks=2)


def answer_again() -> None:
    """H13: a host answers a repeated STEP from memory."""
    plan = FaultPlan(rates={"Done": Rates(drop=0.5)})
    Simulator(ToyWorld(), plan=plan, patience=60).run(5)


def tick_never_resets() -> None:
    """H15: a reset begins an episode, and the tick number continues."""
    bench = Bench()
    late = [bench.give(step)[0] for step in bench.begin()]
    for done in late:
        bench.give(done)
    bench.commit()
    bench.note(bench.directory.reset())
    bench.begin()
    for done in late:
        bench.directory.on_message(done)
    assert bench.directory.waiting_for() == (0, 1)


def run_fence() -> None:
    """H15: messages of another run are dropped."""
    bench = Bench()
    step = bench.begin()[0]
    (done,) = bench.give(step)
    bench.directory.on_message(replace(done, run=OTHER_RUN))
    assert bench.directory.waiting_for() == (0, 1)
    assert not bench.endpoints[1].on_message(replace(step, run=OTHER_RUN, zone=1)).messages


def repeat_limit() -> None:
    """H22: a tick in which every host dies ends in an error."""
    bench = Bench()
    bench.begin()
    for _ in range(bench.limits.repeats):
        bench.crash(1)
    with pytest.raises(LostTickError, match="zone 1 could not reach tick 1: 4 hosts"):
        bench.crash(1)


# The ledger and the committed store


def removed_is_final() -> None:
    """H19: an id is used only once in an episode."""
    bench = Bench()
    bench.tick(births=[(7, 0)])
    bench.tick(removed=[7])
    with pytest.raises(ProtocolError, match="vehicle 7"):
        bench.begin(births=[(7, 1)])


def ledger() -> None:
    """I6: a tick is committed only if no vehicle is lost or doubled."""
    for forge in (
        lambda done: replace(done, removed=(Removed(8, 0),)),
        lambda done: replace(done, confirmed=(Confirmed(7, 1),)),
        lambda done: replace(done, owned=done.owned._replace(vehicles=0)),
        lambda done: replace(done, owned=done.owned._replace(digest=1)),
    ):
        bench = Bench()
        bench.tick(births=[(7, 0), (8, 1)])
        dones = [bench.give(step)[0] for step in bench.begin()]
        assert isinstance(dones[0], Done)
        bench.give(forge(dones[0]))
        bench.give(dones[1])
        with pytest.raises(ProtocolError, match="zone 0"):
            bench.commit()


def double_buffer() -> None:
    """H10: the states of tick t stay complete until tick t + 1 is committed."""
    world = ToyWorld()
    simulator = Simulator(world, crashes=lambda tick, point, zone: point == "half written")
    simulator.run(5)
    assert simulator.digests == world.undivided(5)


def segment_per_incarnation() -> None:
    """H28: each process writes to its own segment."""
    store = MemoryStore()
    store.write(0, 2, 7, b"of the living host")
    store.write(0, 1, 7, b"of the zombie")
    store.commit(1, {0: 2})
    assert store.state(7) == b"of the living host"


def digest_before_commit() -> None:
    """H28: a tick is committed only if the stored rows equal the rows that DONE reported."""
    bench = Bench()
    for step in bench.begin():
        bench.give(bench.give(step)[0])
    with pytest.raises(StoreError, match="zones \\[1\\]"):
        bench.directory.commit({0: bench.directory.dones[0].rows, 1: 12345})
    assert bench.directory.waiting_for() == (1,)


# Distances


HALVES = ZonePartition(
    (-100.0, -50.0, 100.0, 50.0), np.array([[-100.0, -50.0, 0.0, 50.0], [0.0, -50.0, 100.0, 50.0]])
)
"""Zone 0 in the west, zone 1 in the east; the border is at x = 0."""

BORDERS = Borders(hysteresis_m=2.0, ahead_s=1.0, max_speed_mps=20.0)


def near_border(x_m: float, owner: int = 0, speed_mps: float = 0.0) -> list[bool]:
    """Return for each zone near a vehicle whether the vehicle has crossed; it drives east."""
    row = vehicles([(x_m, 0.0, 0.0)], speed=speed_mps)
    zoned = zoned_of([row if zone == owner else row[:0] for zone in (0, 1)])
    out = np.zeros(2, dtype=NEAR)
    found = find_near(HALVES.arrays, BORDERS, zoned, SIDE, 0, True, out)
    crossed: list[bool] = out["crossed"][:found].tolist()
    return crossed


def hysteresis() -> None:
    """H16: a vehicle that weaves on a border does not change owner."""
    for owner in (0, 1):
        assert near_border(-1.0, owner) == near_border(1.0, owner) == []
    assert near_border(3.0, 0) == near_border(-3.0, 1) == [True]


def early_offer() -> None:
    """H20: a vehicle is offered before it crosses."""
    assert near_border(-9.0, speed_mps=10.0) == []
    assert near_border(-7.0, speed_mps=10.0) == [False]


def approached(bench: Bench) -> Bench:
    """Run tick 1: zone 0 gets vehicle 7 and offers it to zone 1, which acknowledges the offer."""
    bench.tick(births=[(7, 0)], offers=[(7, 1)])
    return bench


def prepared() -> tuple[Bench, Prepare]:
    """Return a run in tick 1 in which zone 0 has sent a PREPARE that is not delivered yet."""
    bench = Bench()
    for step in bench.begin(births=[(7, 0)]):
        bench.give(bench.give(step)[0])
    (prepare,) = bench.offer(0, (7, 1))
    assert isinstance(prepare, Prepare)
    return bench, prepare


SCENARIOS: dict[str, Callable[[], None]] = {
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
