"""Every change of owner leaves a row that tells how it came about."""

from __future__ import annotations

from cavmarl.ownership.limits import Limits
from cavmarl.ownership.messages import Record
from cavmarl.ownership.trace import LOG, Trace
from cavmarl.ownership.transfers import Transfer, TransferLog
from tests.ownership.bench import Bench
from tests.ownership.test_simulator import campaign


def followed(trace: Trace) -> TransferLog:
    log = TransferLog(Limits().lifetime)
    for destination, item in trace.entries:
        if isinstance(item, Record):
            assert destination == LOG
            log.logged([item])
        else:
            log.delivered(destination, item)
    return log


def test_a_prepared_transfer_has_its_row() -> None:
    bench = Bench()
    bench.tick(births=[(7, 0)], offers=[(7, 1)])
    bench.tick(offers=[(7, 1)])
    bench.tick(movers=[(7, 1)])
    log = followed(bench.trace)
    assert list(log.rows) == [Transfer(0, 3, 7, 0, 1, 1, False, False, 1, 0, 2, 16)]
    assert log.counts == {"switched": 1, "acknowledged": 2, "deferred": 0}


def test_a_forced_transfer_tells_how_long_it_waited() -> None:
    bench = Bench()
    bench.tick(births=[(7, 0)])
    for _ in range(2):
        bench.tick(movers=[(7, 1)])
    bench.tick(movers=[(7, 1)], removed=[7])
    log = followed(bench.trace)
    assert list(log.rows) == [Transfer(0, 4, 7, 0, 1, 1, True, True, -1, 2, 0, 0)]
    assert log.counts == {"forced": 1, "deferred": 2}


def test_an_approach_that_ends_is_counted_and_one_that_is_forgotten_takes_no_room() -> None:
    bench = Bench(3)
    bench.tick(births=[(7, 0), (8, 0)], offers=[(7, 1), (8, 2)])
    bench.tick(offers=[(8, 2)])
    bench.endpoints[0].offers.open.clear()
    for _ in range(bench.limits.lifetime + 3):
        bench.tick()
    log = followed(bench.trace)
    assert log.counts["aborted"] == 1
    assert not log.rows
    assert not log._approaches


def test_the_rows_of_a_campaign_are_the_switches_of_its_log() -> None:
    simulator = campaign(3, "corner")
    simulator.run(25)
    log = followed(simulator.trace)
    assert len(log.rows) == simulator.switches == log.counts["switched"] + log.counts["forced"]
    assert log.counts["deferred"] == simulator.deferred
    assert all(row.waited <= Limits().longest_deferral for row in log.rows)
    assert all(row.forced or row.offers for row in log.rows)
