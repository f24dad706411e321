"""Readable traces of runs, and the checker of traces (acceptance test AT6).

`CAVMARL_REWRITE=1` rewrites the files; read the difference before you commit the files.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from cavmarl.core.errors import ProtocolError
from cavmarl.ownership.directory import Directory
from cavmarl.ownership.limits import Limits
from cavmarl.ownership.messages import (
    COORDINATOR,
    Ack,
    Begin,
    Commit,
    Done,
    Host,
    Prepare,
    Reset,
    Step,
    Switch,
)
from cavmarl.ownership.trace import LOG, TraceEntry
from tests.ownership.bench import Bench
from tests.ownership.recorded_trace import check_trace
from tests.ownership.simulator import Simulator
from tests.ownership.test_simulator import campaign, world

TRACES = Path(__file__).parent / "traces"


def target_dies_after_its_ack(bench: Bench) -> None:
    bench.tick(births=[(7, 0)], offers=[(7, 1)])
    bench.crash(1)
    bench.tick(movers=[(7, 1)], offers=[(7, 1)])
    bench.tick(movers=[(7, 1)])


def target_dies_after_begin(bench: Bench) -> None:
    bench.tick(births=[(7, 0)], offers=[(7, 1)])
    step = bench.begin(movers=[(7, 1)])[0]
    bench.pass_on(bench.give(step))
    bench.pass_on(bench.crash(1).messages)
    bench.commit()


def source_dies_in_its_step(bench: Bench) -> None:
    bench.tick(births=[(7, 0)], offers=[(7, 1)])
    source, target = bench.begin(movers=[(7, 1)])
    bench.give(source)
    bench.pass_on([target])
    bench.pass_on(bench.crash(0).messages)
    bench.commit()


def coordinator_restarts(bench: Bench) -> None:
    bench.tick(births=[(7, 0)], offers=[(7, 1)])
    first, _ = bench.begin(movers=[(7, 1)])
    bench.pass_on([first])
    bench.directory = Directory.restore(bench.log, range(2), bench, bench.limits)
    bench.pass_on(bench.directory.resend().messages)
    bench.commit()


def reset_in_a_switch(bench: Bench) -> None:
    bench.tick(births=[(7, 0)], offers=[(7, 1)])
    late = bench.begin(movers=[(7, 1)])
    bench.note(bench.directory.reset())
    bench.tick(births=[(7, 1)])
    for message in late:
        bench.give(message)


# Runs without faults: number of zones, and the arguments of `Bench.tick` for each tick. Vehicle 7
# is created in zone 0 in the first tick.
TICKS: dict[str, tuple[int, list[dict[str, Any]]]] = {
    "straight_crossing": (2, [{}, {"offers": [(7, 1)]}, {"movers": [(7, 1)]}, {}]),
    "lost_ack": (2, [
        {}, {"movers": [(7, 1)], "offers": []}, {"movers": [(7, 1)], "offers": [(7, 1)]},
        {"movers": [(7, 1)]},
    ]),
    "every_ack_lost": (2, [{}, *[{"movers": [(7, 1)]}] * 3]),
    "ping_pong": (2, [
        {"offers": [(7, 1)]},
        *[{"movers": [(7, zone)], "offers": [(7, 1 - zone)]} for zone in (1, 0, 1)],
    ]),
    "corner": (4, [
        {"offers": [(7, 1), (7, 2), (7, 3)]}, {"movers": [(7, 3)], "offers": [(7, 1)]}, {},
    ]),
    "chain": (3, [
        {"offers": [(7, 1)]}, {"movers": [(7, 1)], "offers": [(7, 2)]}, {"movers": [(7, 2)]},
    ]),
    "turn_back": (2, [{"offers": [(7, 1)]}, {"offers": [(7, 1)]}, {}]),
    "removed_in_its_switch": (2, [
        {"offers": [(7, 1)]}, {"movers": [(7, 1)], "removed": [7]}, {},
    ]),
}  # fmt: skip
SCRIPTS = {
    script.__name__: script
    for script in (
        target_dies_after_its_ack, target_dies_after_begin, source_dies_in_its_step,
        coordinator_restarts, reset_in_a_switch,
    )
}  # fmt: skip


@pytest.mark.parametrize("name", [*TICKS, *SCRIPTS])
def test_the_text_of_a_trace_equals_its_file(name: str) -> None:
    zones, ticks = TICKS.get(name, (2, []))
    bench = Bench(zones)
    for number, tick in enumerate(ticks):
        bench.tick(births=() if number else [(7, 0)], **tick)
    SCRIPTS.get(name, lambda _: None)(bench)
    bench.judge()
    path = TRACES / f"{name}.txt"
    if os.environ.get("CAVMARL_REWRITE"):
        path.write_text(bench.trace.text(), encoding="utf-8")
    assert bench.trace.text() == path.read_text(encoding="utf-8")


def test_every_trace_file_has_a_test() -> None:
    assert sorted(path.stem for path in TRACES.glob("*.txt")) == sorted([*TICKS, *SCRIPTS])


@pytest.fixture(scope="module")
def entries() -> tuple[TraceEntry, ...]:
    simulator = Simulator(world("corner"))
    simulator.run(10)
    return tuple(simulator.trace.entries)


def judge(entries: list[TraceEntry]) -> None:
    check_trace(entries, Limits().deferral, Limits().lifetime)


def positions_of(
    entries: tuple[TraceEntry, ...], kind: type, where: Callable[[TraceEntry], bool]
) -> list[int]:
    return [k for k, entry in enumerate(entries) if type(entry.item) is kind and where(entry)]


def has_switch(entry: TraceEntry) -> bool:
    return isinstance(entry.item, Begin) and bool(entry.item.switches)


def first_switch(entries: tuple[TraceEntry, ...]) -> tuple[int, Begin, Switch]:
    k = positions_of(entries, Begin, has_switch)[0]
    begin = entries[k].item
    assert isinstance(begin, Begin)
    return k, begin, begin.switches[0]


def change_first_switch(entries: tuple[TraceEntry, ...], **change: object) -> list[TraceEntry]:
    k, begin, switch = first_switch(entries)
    lie = replace(begin, switches=(switch._replace(**change), *begin.switches[1:]))  # type: ignore[arg-type]
    return [*entries[:k], TraceEntry(LOG, lie), *entries[k + 1 :]]


def without(
    entries: tuple[TraceEntry, ...], kind: type, where: Callable[[TraceEntry], bool]
) -> list[TraceEntry]:
    gone = set(positions_of(entries, kind, where))
    assert gone
    return [entry for k, entry in enumerate(entries) if k not in gone]


def test_the_checker_accepts_a_correct_run(entries: tuple[TraceEntry, ...]) -> None:
    judge(list(entries))


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"source": 9}, "is owned by"),
        ({"epoch": 9}, "is owned by"),
        ({"forced": True}, "is forced after 0 ticks"),
        ({"target": 9}, "without an ACK"),
    ],
)
def test_the_checker_refuses_another_switch(
    entries: tuple[TraceEntry, ...], change: dict[str, object], why: str
) -> None:
    with pytest.raises(ProtocolError, match=why):
        judge(change_first_switch(entries, **change))


@pytest.mark.parametrize(
    ("kind", "why"),
    [
        (Prepare, "acknowledges an unknown state"),
        (Ack, "without an ACK"),
        (Done, "has sent no DONE"),
        (Begin, "was sent before it was logged"),
        (Commit, "a tick is decided twice"),
        (Host, "has the zones"),
        (Reset, "has sent no DONE"),
    ],
)
def test_the_checker_detects_missing_entries(
    entries: tuple[TraceEntry, ...], kind: type, why: str
) -> None:
    with pytest.raises(ProtocolError, match=why):
        judge(without(entries, kind, lambda entry: True))


def test_the_checker_refuses_a_switch_without_its_ack(entries: tuple[TraceEntry, ...]) -> None:
    _, begin, switch = first_switch(entries)
    lost = without(
        entries,
        Ack,
        lambda entry: (
            entry.destination == COORDINATOR
            and isinstance(entry.item, Ack)
            and entry.item.tick == begin.tick - 1
            and switch.vehicle in [held.vehicle for held in entry.item.entries]
        ),
    )
    with pytest.raises(ProtocolError, match=f"v{switch.vehicle} switches"):
        judge(lost)


def test_the_checker_refuses_a_step_before_its_record(entries: tuple[TraceEntry, ...]) -> None:
    k, begin, _ = first_switch(entries)
    (after, *_) = positions_of(entries, Step, lambda entry: entry.item.tick == begin.tick)
    swapped = list(entries)
    swapped[k], swapped[after] = swapped[after], swapped[k]
    with pytest.raises(ProtocolError, match="before it was logged"):
        judge(swapped)


def test_the_checker_refuses_a_done_without_its_confirmation(
    entries: tuple[TraceEntry, ...],
) -> None:
    lied = [
        TraceEntry(to, replace(item, confirmed=()))
        if isinstance(item, Done)
        else TraceEntry(to, item)
        for to, item in entries
    ]
    with pytest.raises(ProtocolError, match="did not CONFIRM"):
        judge(lied)


def test_the_checker_refuses_a_wrong_ledger(entries: tuple[TraceEntry, ...]) -> None:
    k = positions_of(entries, Commit, lambda entry: True)[3]
    commit = entries[k].item
    assert isinstance(commit, Commit)
    zone = commit.zones[0]
    lie = replace(
        commit, zones=(zone._replace(owned=zone.owned._replace(digest=1)), *commit.zones[1:])
    )
    with pytest.raises(ProtocolError, match="does not own the expected vehicles"):
        judge([*entries[:k], TraceEntry(LOG, lie), *entries[k + 1 :]])


def test_the_checker_refuses_a_stale_acknowledgement() -> None:
    bench = Bench()
    bench.tick(births=[(7, 0)], offers=[(7, 1)])
    acks = [entry for entry in bench.trace.entries if isinstance(entry.item, Ack)]
    ack = acks[0].item
    assert isinstance(ack, Ack)
    bench.trace.delivered(COORDINATOR, replace(ack, tick=2))
    with pytest.raises(ProtocolError, match="acknowledges an unknown state"):
        bench.judge()


@pytest.mark.parametrize("seed", [1, 3, 4])
def test_the_checker_refuses_runs_in_which_a_record_is_missing(seed: int) -> None:
    simulator = campaign(seed, "corner")
    simulator.run(15)
    entries = tuple(simulator.trace.entries)
    for k in positions_of(entries, Begin, lambda entry: True):
        with pytest.raises(ProtocolError):
            judge([*entries[:k], *entries[k + 1 :]])
