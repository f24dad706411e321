"""The log as JSON lines: its replay gives the table of owners, and a damaged log is refused."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from cavmarl.core.errors import JournalError, ProtocolError
from cavmarl.ownership.log_records import SCHEMA, LogChain, replay, sealed
from cavmarl.ownership.messages import Begin, Birth, Commit, Host, Removed, Reset
from tests.ownership.bench import Bench
from tests.ownership.recorded_trace import lines_of, records_from_lines
from tests.ownership.test_simulator import campaign


@pytest.fixture(scope="module")
def log() -> str:
    simulator = campaign(4, "corner")
    simulator.run(15)
    owners = simulator.directory.table.owners
    assert replay(records_from_lines(simulator.log)).owners == owners
    return simulator.log


def test_a_line_has_its_schema_sequence_and_kind(log: str) -> None:
    for sequence, line in enumerate(log.splitlines()):
        content = json.loads(line)
        assert (content["schema"], content["sequence"]) == (SCHEMA, sequence)
        assert {"kind", "episode", "tick", "checksum"} <= set(content)


def test_read_records_equal_written_records(log: str) -> None:
    records = records_from_lines(log)
    assert "".join(lines_of(records)) == log
    written, read = LogChain(), LogChain()
    assert [read.from_dict(written.to_dict(record)) for record in records] == list(records)


def test_every_beginning_of_a_log_can_be_replayed(log: str) -> None:
    records = records_from_lines(log)
    ticks = [replay(records[:length]).tick for length in range(1, len(records) + 1)]
    assert ticks == sorted(ticks)
    assert ticks[-1] == 15


def test_a_line_with_any_changed_character_is_refused(log: str) -> None:
    line = log.splitlines(keepends=True)[8]
    for at in range(len(line) - 1):
        for letter in ("0", "1", "f", '"', "x"):
            damaged = line[:at] + letter + line[at + 1 :]
            if damaged != line:
                with pytest.raises(JournalError):
                    records_from_lines("".join(log.splitlines(keepends=True)[:8]) + damaged)


def test_a_line_with_an_added_byte_is_refused_even_if_its_json_value_is_the_same(log: str) -> None:
    lines = log.splitlines(keepends=True)
    line, before = lines[8], lines[:8]
    for at in range(len(line)):
        for more in (" ", "\t", "\r", "\n"):
            with pytest.raises(JournalError):
                records_from_lines("".join(before) + line[:at] + more + line[at:])
    twice = line.replace('"kind":', '"kind":"RESET","kind":', 1)
    escaped = line.replace('"kind"', '"\\u006bind"', 1)
    for same in (twice, escaped):
        assert json.loads(same) == json.loads(line)
        with pytest.raises(JournalError, match=r"line 9 .* has been changed"):
            records_from_lines("".join(before) + same)


def test_a_log_with_a_missing_doubled_or_swapped_line_is_refused(log: str) -> None:
    lines = log.splitlines(keepends=True)
    for wrong in (lines[:5] + lines[6:], lines[:5] + lines[4:], [*lines[:5], lines[6], lines[5]]):
        with pytest.raises(JournalError, match="lines are missing"):
            records_from_lines("".join(wrong))


@pytest.mark.parametrize("at", [8, 20, 40])
def test_a_log_with_a_line_of_another_log_is_refused(log: str, at: int) -> None:
    """Insert a line with valid number, kind and checksum, which follows a different line."""
    other = campaign(5, "corner")
    other.run(15)
    lines, foreign = log.splitlines(keepends=True), other.log.splitlines(keepends=True)
    assert lines[at] != foreign[at]
    mixed = [*lines[:at], foreign[at], *lines[at + 1 :]]
    with pytest.raises(JournalError, match="another log"):
        records_from_lines("".join(mixed))


def host_record_with(**change: object) -> dict[str, object]:
    return sealed(LogChain().to_dict(Host(0, 0, 1, 1, 1)) | change)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"schema": "cavmarl.ownership/9"}, "schema"),
        ({"kind": "BLESS"}, "unknown kind 'BLESS'"),
        ({"zone": "one"}, "zone = .*one.*must be int"),
        ({"zone": True}, "zone = True: must be int"),
        ({"zone": 1 << 70}, "zone = .*: must be int, below"),
        ({"kind": ["HOST"]}, "unknown kind"),
    ],
)
def test_a_line_with_an_invalid_kind_or_field_is_refused(
    change: dict[str, object], why: str
) -> None:
    with pytest.raises(JournalError, match=why):
        LogChain().from_dict(host_record_with(**change))


def test_lines_that_are_not_json_objects_are_refused() -> None:
    for text in ("[1]\n", "nonsense\n", "\n"):
        with pytest.raises(JournalError, match="line 1"):
            records_from_lines(text)


def test_a_log_with_records_in_an_impossible_order_is_refused(log: str) -> None:
    records = records_from_lines(log)
    with pytest.raises(JournalError, match="must begin with a RESET"):
        replay(records[1:])
    with pytest.raises(JournalError, match="must begin with a RESET"):
        replay(())
    kinds = [type(record).__name__ for record in records]
    begin, commit = kinds.index("Begin"), kinds.index("Commit")
    with pytest.raises(JournalError, match="BEGIN of tick 1"):
        replay([*records[: begin + 1], records[begin]])
    second = kinds.index("Begin", begin + 1)
    with pytest.raises(JournalError, match="BEGIN of tick 2"):
        replay([*records[:begin], records[second]])
    with pytest.raises(JournalError, match="COMMIT of tick 1"):
        replay([*records[: second + 1], records[commit]])


def test_a_log_with_impossible_events_of_vehicles_is_refused() -> None:
    bench = Bench()
    bench.tick(births=[(7, 0), (8, 0)], offers=[(7, 1)])
    bench.tick(movers=[(7, 1)], removed=[8])
    kinds = [type(record).__name__ for record in bench.log]
    k = [at for at, kind in enumerate(kinds) if kind == "Begin"][1]
    begin, commit = bench.log[k], bench.log[k + 1]
    assert isinstance(begin, Begin)
    assert isinstance(commit, Commit)
    switch = begin.switches[0]
    for wrong in (
        replace(begin, switches=(switch._replace(source=1),)),
        replace(begin, switches=(switch._replace(epoch=5),)),
        replace(begin, switches=(switch._replace(vehicle=9),)),
        replace(begin, births=(Birth(7, 0, b""),)),
        replace(begin, births=(Birth(9, 5, b""),)),
    ):
        with pytest.raises(ProtocolError):
            replay([*bench.log[:k], wrong])
    with pytest.raises(JournalError, match="zones \\[0\\]"):
        replay([*bench.log[: k + 1], replace(commit, zones=commit.zones[:1])])
    with pytest.raises(JournalError, match="not 16"):
        replay([Reset(0, 0, b"short")])
    with pytest.raises(ProtocolError):
        replay([*bench.log[: k + 1], replace(commit, removed=(Removed(9, 0),))])
