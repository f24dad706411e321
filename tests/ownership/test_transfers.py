"""Each change of owner adds a row to the table of transfers."""

from __future__ import annotations

from cavmarl.ownership.limits import Limits
from cavmarl.ownership.messages import Record
from cavmarl.ownership.trace import LOG
from cavmarl.ownership.transfer_summary import TransferSummary
from cavmarl.ownership.transfers import KEPT_ROWS, Transfer, TransferLog
from tests.ownership.bench import Bench
from tests.ownership.recorded_trace import Trace
from tests.ownership.test_simulator import campaign
from tests.support.held_entries import held_entries


def transfers_of(trace: Trace) -> TransferLog:
    log = TransferLog(Limits().lifetime)
    for destination, item in trace.entries:
        if isinstance(item, Record):
            assert destination == LOG
            log.logged([item])
        else:
            log.delivered(destination, item)
    return log


def test_a_prepared_transfer_has_a_row() -> None:
    bench = Bench()
    bench.tick(births=[(7, 0)], offers=[(7, 1)])
    bench.tick(offers=[(7, 1)])
    bench.tick(movers=[(7, 1)])
    log = transfers_of(bench.trace)
    assert list(log.rows) == [Transfer(0, 3, 7, 0, 1, 1, False, False, 1, 0, 2, 16)]
    assert log.counts == {"switched": 1, "acknowledged": 2, "deferred": 0}


def test_the_row_of_a_forced_transfer_has_its_deferred_ticks() -> None:
    bench = Bench()
    bench.tick(births=[(7, 0)])
    for _ in range(2):
        bench.tick(movers=[(7, 1)])
    bench.tick(movers=[(7, 1)], removed=[7])
    log = transfers_of(bench.trace)
    assert list(log.rows) == [Transfer(0, 4, 7, 0, 1, 1, True, True, -1, 2, 0, 0)]
    assert log.counts == {"forced": 1, "deferred": 2, "removed": 1}


def test_withdrawn_offers_are_counted_and_take_no_memory() -> None:
    bench = Bench(3)
    bench.tick(births=[(7, 0), (8, 0)], offers=[(7, 1), (8, 2)])
    bench.tick(offers=[(8, 2)])
    bench.endpoints[0].offers.open.clear()
    for _ in range(bench.limits.lifetime + 3):
        bench.tick()
    log = transfers_of(bench.trace)
    assert log.counts["aborted"] == 1
    assert not log.rows
    quiet = Bench(3)
    quiet.tick(births=[(7, 0), (8, 0)])
    for _ in range(bench.limits.lifetime + 4):
        quiet.tick()
    without = transfers_of(quiet.trace)
    assert held_entries(log) - len(log.counts) == held_entries(without) - len(without.counts)


def test_a_run_with_all_faults_has_one_row_per_switch_in_its_log() -> None:
    simulator = campaign(3, "corner")
    simulator.run(25)
    log = transfers_of(simulator.trace)
    assert len(log.rows) == simulator.switches == log.counts["switched"] + log.counts["forced"]
    assert log.counts["deferred"] == simulator.deferred
    assert all(row.waited <= Limits().deferral for row in log.rows)
    assert all(row.forced or row.offers for row in log.rows)


def test_the_number_of_rows_is_limited_and_take_removes_the_rows() -> None:
    simulator = campaign(3, "corner")
    simulator.run(25)
    log = transfers_of(simulator.trace)
    rows = list(log.rows)
    assert log.rows.maxlen == KEPT_ROWS
    assert log.take() == rows
    assert log.take() == []
    assert log.counts["switched"] + log.counts["forced"] == len(rows)


def test_only_the_rows_of_the_newest_transfers_are_computed() -> None:
    log = TransferLog(Limits().lifetime)
    made = []

    def later(first: int, number: int) -> None:
        def make() -> list[Transfer]:
            made.append(first)
            return [
                Transfer(0, tick, 1, 0, 1, tick, False, False, tick, 0, 0, 0)
                for tick in range(first, first + number)
            ]

        log.add_later(number, 1, make)

    batch = KEPT_ROWS // 4
    for first in range(0, 6 * batch, batch):
        later(first, batch)
    assert log.counts == {"switched": 6 * batch, "removed": 6}
    assert made == [], "rows were computed although nothing has read them yet"
    assert [row.tick for row in log.rows] == list(range(2 * batch, 6 * batch))
    assert made == [2 * batch, 3 * batch, 4 * batch, 5 * batch]
    later(6 * batch, 3)
    assert [row.tick for row in log.take()] == list(range(2 * batch + 3, 6 * batch + 3))
    assert not log.rows


def test_the_summary_has_counts_and_percentiles() -> None:
    rows = [
        Transfer(
            0, 20, n, 0, 1, 1, n == 5, False, 20 - n, 0, 1, 100 + n, -1.0 * n, 2.0, 2.0 + n, 0.5 * n
        )
        for n in range(1, 101)
    ]
    counts = {"switched": 199, "forced": 1, "deferred": 3, "refused": 2, "aborted": 4, "expired": 6}
    found = TransferSummary.of(rows, counts)
    assert (found.transfers, found.forced, found.deferred) == (200, 1, 3)
    assert (found.refused, found.aborted, found.failure_rate) == (2, 4, 0.005)
    assert found.timeouts == {"acknowledge": 3, "switch": 1, "replica": 6}
    assert found.latency_ms == (25.0, 47.5, 50.0)
    assert found.state_bytes == (150, 195, 200)
    assert found.prepare_depth_m == (-51.0, -6.0, -1.0)
    assert found.release_depth_m == (52.0, 97.0, 102.0)


def test_the_summary_without_transfers_has_no_percentiles() -> None:
    found = TransferSummary.of([], {})
    assert (found.transfers, found.failure_rate) == (0, None)
    assert found.latency_ticks == (None, None, None)
