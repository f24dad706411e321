"""The journal on disk: appended records can be read, and damage is refused with file and line."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

import pytest

from cavmarl.core.errors import ConfigError, JournalError
from cavmarl.handoff.coordinator.journal import (
    Journal,
    JournalReader,
    Sync,
)
from cavmarl.handoff.coordinator.journal_summary import owners_at, summarize
from cavmarl.ownership.directory import Directory
from cavmarl.ownership.log_records import KINDS, replay
from cavmarl.ownership.messages import Begin, Record
from tests.ownership.bench import Bench
from tests.ownership.recorded_trace import lines_of
from tests.ownership.test_simulator import campaign
from tests.support.forks import said_in_fork
from tests.support.generated import check_block, table

PAGE = Path(__file__).resolve().parents[2] / "docs/explanation/ownership.md"


def run_events() -> Bench:
    """Run two zones with births, a hand-off, a forced hand-off, a crash and a removal."""
    bench = Bench()
    bench.tick(births=[(7, 0)], offers=[(7, 1)])
    bench.tick(movers=[(7, 1)], births=[(8, 1)])
    for _ in range(3):
        bench.tick(movers=[(8, 0)])
    bench.crash(1)
    bench.tick(removed=[8])
    return bench


@pytest.fixture
def journal_file(tmp_path: Path) -> Path:
    """Write the journal of `run_events`."""
    path = tmp_path / "run.journal"
    with Journal(path) as journal:
        journal.append(run_events().log)
    return path


def test_read_records_equal_appended_records(tmp_path: Path) -> None:
    log = run_events().log
    with Journal(tmp_path / "run.journal") as journal:
        journal.append(log[:1])
        journal.append([])
        journal.append(log[1:])
        assert journal.sequence == len(log)
    with pytest.raises(JournalError, match="is closed"):
        journal.append(log[:1])
    journal.close()
    assert list(JournalReader(journal.path)) == log


@pytest.mark.parametrize("sync", ["flush", "fsync"])
def test_an_appended_record_is_in_the_file_when_append_returns(tmp_path: Path, sync: Sync) -> None:
    path = tmp_path / "run.journal"
    with Journal(path, sync=sync) as journal:
        for number, record in enumerate(run_events().log):
            journal.append([record])
            assert path.read_text().count("\n") == number + 1


@pytest.mark.parametrize("sync", ["flush", "fsync"])
def test_appended_records_are_synced_to_disk_only_with_fsync(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sync: Sync
) -> None:
    path, there = tmp_path / "run.journal", list[int]()
    monkeypatch.setattr(os, "fsync", lambda _: there.append(path.read_text().count("\n")))
    log = run_events().log
    with Journal(path, sync=sync) as journal:
        journal.append(log[:2])
        journal.append(log[2:3])
    with Journal(path, resume=True, sync=sync) as journal:
        journal.append(log[3:4])
    assert there == ([2, 3, 4] if sync == "fsync" else [])


def test_an_existing_file_is_not_overwritten(journal_file: Path) -> None:
    before = journal_file.read_bytes()
    with pytest.raises(
        JournalError, match=re.escape(f"{journal_file}: the journal exists already")
    ):
        Journal(journal_file)
    assert journal_file.read_bytes() == before


def test_a_resumed_journal_appends_to_its_file(tmp_path: Path) -> None:
    log, path = run_events().log, tmp_path / "run.journal"
    for at in range(0, len(log), 3):
        with Journal(path, resume=at > 0) as journal:
            assert (journal.sequence, journal.dropped) == (at, "")
            journal.append(log[at : at + 3])
    assert list(JournalReader(path)) == log


def test_a_fork_does_not_write_to_the_journal_of_its_parent(tmp_path: Path) -> None:
    log, path = run_events().log, tmp_path / "run.journal"
    with Journal(path) as journal:
        journal.append(log[:3])
        said = said_in_fork(lambda: journal.append(log[3:]), journal.close)
        assert f"the lines of {path} belong to process" in said
        journal.append(log[3:])
    assert list(JournalReader(path)) == log


HOLD = """
import sys, time
from pathlib import Path
from cavmarl.core.errors import JournalError
from cavmarl.handoff.coordinator.journal import Journal
try:
    journal = Journal(Path(sys.argv[1]), resume=True)
except JournalError as error:
    sys.exit(str(error))
print("held", flush=True)
time.sleep(float(sys.argv[2]))
"""


def other_process(path: Path, seconds: float) -> subprocess.Popen[str]:
    """Start a process that opens a journal and keeps it open for some seconds."""
    words = [sys.executable, "-c", HOLD, str(path), str(seconds)]
    return subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.skipif(sys.platform == "win32", reason="files are not locked there")
def test_two_runs_cannot_write_the_same_journal(tmp_path: Path) -> None:
    path = tmp_path / "run.journal"
    words = f"{re.escape(str(path))}: another run is writing this journal; choose another"
    with Journal(path) as journal:
        journal.append(run_events().log[:2])
        with other_process(path, 0.0) as late:
            _, said = late.communicate(timeout=60.0)
        assert late.returncode == 1
        assert re.match(words, said)
        assert len(list(journal.read())) == 2
    with other_process(path, 600.0) as writer:
        assert writer.stdout is not None
        assert writer.stdout.readline() == "held\n"
        with pytest.raises(JournalError, match=words):
            Journal(path, resume=True)
        writer.kill()
    with Journal(path, resume=True) as journal:  # the lock ends with the process
        assert journal.sequence == 2


def test_an_incomplete_last_line_is_reported_and_dropped(tmp_path: Path) -> None:
    log, path = run_events().log, tmp_path / "run.journal"
    *before, last = [line.encode() for line in lines_of(log[:5])]
    whole = b"".join(before)
    for length in range(1, len(last)):
        path.write_bytes(whole + last[:length])
        with pytest.raises(JournalError, match=re.escape(f"{path}: line 5 is cut short")):
            list(JournalReader(path))
        with Journal(path, resume=True) as journal:
            assert journal.dropped.startswith("line 5 is cut short: b'{")
            assert path.read_bytes() == whole
            journal.append(log[4:])
        assert list(JournalReader(path)) == log


def test_damage_is_refused_with_file_and_line(journal_file: Path) -> None:
    lines = journal_file.read_bytes().splitlines(keepends=True)
    wrong = {
        "does not match its checksum": [
            *lines[:3],
            lines[3].replace(b'"tick":1', b'"tick":2'),
            *lines[4:],
        ],
        "lines are missing": lines[:3] + lines[4:],
        "Expecting value": [*lines[:3], b"nonsense\n", *lines[4:]],
        "codec can't decode": [*lines[:3], b"\xfc\n", *lines[4:]],
    }
    for why, damaged in wrong.items():
        journal_file.write_bytes(b"".join(damaged))
        for read in (
            lambda: list(JournalReader(journal_file)),
            lambda: Journal(journal_file, resume=True),
        ):
            where = re.escape(f"{journal_file}: line 4 of the log")
            with pytest.raises(JournalError, match=f"{where}.*{why}"):
                read()
        assert journal_file.read_bytes() == b"".join(damaged)


def test_invalid_paths_are_refused_with_a_fix(tmp_path: Path, journal_file: Path) -> None:
    for path in (tmp_path / "none" / "run.journal", journal_file / "run.journal"):
        where = re.escape(f"{path}: the journal cannot be written")
        with pytest.raises(JournalError, match=f"{where}.*choose another path"):
            Journal(path)
    for path in (tmp_path / "none.journal", tmp_path, Path("/dev/full")):
        with pytest.raises(JournalError, match=re.escape(f"{path}: there is no such journal")):
            Journal(path, resume=True)
    with pytest.raises(ConfigError, match="sync = 'often'"):
        Journal(tmp_path / "run2.journal", sync="often")  # type: ignore[arg-type]
    with pytest.raises(JournalError, match="cannot be read"):
        list(JournalReader(tmp_path / "none.journal"))


@contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """Imitate a full disk: write the bytes that fit, then raise an error."""
    resource = pytest.importorskip("resource")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def test_a_full_disk_is_an_error_after_which_the_journal_can_be_resumed(tmp_path: Path) -> None:
    log, path = run_events().log, tmp_path / "run.journal"
    journal = Journal(path)
    journal.append(log[:2])
    with files_of_at_most(path.stat().st_size + 30):
        with pytest.raises(JournalError, match=re.escape(f"{path}: ") + ".*free disk space there"):
            journal.append(log[2:4])
        with pytest.raises(JournalError, match="is closed"):
            journal.append(log[2:4])
    with Journal(path, resume=True) as journal:
        assert journal.sequence == 2
        assert journal.dropped.startswith("line 3 ")
        journal.append(log[2:])
    assert list(JournalReader(path)) == log


def test_the_memory_of_a_journal_does_not_grow(tmp_path: Path) -> None:
    idle = [Begin(0, 1), Begin(0, 2)]
    with Journal(tmp_path / "run.journal") as journal:
        journal.append(idle)
        tracemalloc.start()
        for _ in range(2000):
            journal.append(idle)
        grown, _ = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    assert grown < 20_000


def test_a_coordinator_continues_with_its_journal(journal_file: Path) -> None:
    bench = run_events()
    records = tuple(JournalReader(journal_file))
    directory = Directory.restore(records, range(2), bench, bench.limits)
    assert directory.table.owners == bench.directory.table.owners
    assert directory.table.tick == bench.directory.table.tick


# Contents


def test_a_summary_counts_committed_events(journal_file: Path) -> None:
    summary, table = summarize(journal_file)
    assert summary.to_dict() == {
        "run": bytes(range(16)).hex(), "lines": len(run_events().log), "episodes": 1,
        "ticks": 6, "first_tick": 1, "last_tick": 6, "births": 2, "removals": 1, "switches": 2,
        "forced": 1, "deferrals": 2, "hosts": 3, "fences": 1, "unfinished": -1,
        "torn": "",
    }  # fmt: skip
    assert table.owners == {7: (1, 1)}
    assert table.hosts[1] == (1, 2)


def test_the_summary_names_a_tick_that_was_not_committed(journal_file: Path) -> None:
    whole = journal_file.read_bytes()
    journal_file.write_bytes(whole[: whole.rindex(b'{"schema"')])
    assert summarize(journal_file)[0].unfinished == 6
    journal_file.write_bytes(whole[:-5])
    summary, table = summarize(journal_file)
    assert (summary.unfinished, summary.last_tick) == (6, 5)
    assert summary.torn.startswith("line ")
    assert table.owners == {7: (1, 1), 8: (0, 1)}


def test_the_journal_gives_the_owners_at_every_tick(journal_file: Path) -> None:
    at = {tick: owners_at(journal_file, tick) for tick in range(1, 7)}
    assert at[1].owners == {7: (0, 0)}
    assert at[2].owners == {7: (1, 1), 8: (1, 0)}
    assert at[4].owners == at[2].owners
    assert at[4].deferred == {8: 2}
    assert at[5].owners == {7: (1, 1), 8: (0, 1)}
    with pytest.raises(
        JournalError, match="tick 9 was not committed; use a tick up to the last one, 6"
    ):
        owners_at(journal_file, 9)


def test_impossible_records_are_refused_with_their_line(tmp_path: Path) -> None:
    def refused(records: list[Record]) -> str:
        path = tmp_path / f"{len(list(tmp_path.iterdir()))}.journal"
        with Journal(path) as journal:
            journal.append(records)
        with pytest.raises(JournalError) as said:
            summarize(path)
        assert str(said.value).startswith(f"{path}: ")
        return str(said.value)

    log = run_events().log
    assert "first line is not a RESET" in refused(log[1:])
    assert "no complete line" in refused([])
    assert "line 5 of the log: BEGIN of tick 1" in refused([*log[:4], log[3]])


# The page


def lines_of_all_kinds() -> dict[str, str]:
    """Return the longest line of each kind of record in a run with hand-offs."""
    found: dict[str, str] = {}
    for line in lines_of(run_events().log):
        kind = json.loads(line)["kind"]
        if len(line) > len(found.get(kind, "")):
            found[kind] = line
    return {kind: found[kind] for kind in KINDS}


def form(hint: Any, name: str = "") -> str:
    """Return the type of a field in the notation of the page."""
    if get_origin(hint) is tuple:
        return f"list of {form(get_args(hint)[0])}"
    if hint in (int, bool):
        return name or ("number" if hint is int else "true or false")
    if hint is bytes:
        return name or "hex"
    inner = get_type_hints(hint)
    return f"[{', '.join(form(inner[field], field) for field in inner)}]"


MEANINGS = {
    "run": "16 bytes that name the run",
    "teleports": "vehicles among `switches` whose new zone is no neighbour of the old one",
    "inputs": "digest of the actions",
    "removed": "vehicles that left; the reason is the runtime's code",
    "zones": "of each zone: its process, how many vehicles it owns and the digest of their ids and "
    "epochs, the digest of their rows (hex)",
    "world": "digest of all rows (hex)",
    "switches": "hand-offs, with the new epoch",
    "deferred": "vehicles that stay, and for how many ticks in a row",
    "births": "vehicles that enter, at epoch 0, with their state (hex)",
    "waiting": "vehicles before a border, for how many ticks in a row, and whether held there",
    "zone": "number of the zone",
    "incarnation": "how often the zone has had a new process",
    "worker": "number of the process",
}


def test_the_page_explains_every_key_of_a_line() -> None:
    rows = []
    for kind, record in KINDS.items():
        hints = get_type_hints(record)
        for field in fields(record):
            if field.name not in ("episode", "tick"):
                shown = "hex" if field.name == "world" else form(hints[field.name])
                rows.append((kind, f"`{field.name}`", shown, MEANINGS[field.name]))
    examples = "".join(lines_of_all_kinds().values())
    text = table(("line", "key", "form", "meaning"), rows)
    check_block(PAGE, "lines", f"{text}\n\n```json\n{examples}```")


def independent_replay(journal: Path) -> Any:
    """Return the owners that the program of the page computes, without cavmarl."""
    page = PAGE.read_text(encoding="utf-8")
    _, program = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    assert "cavmarl" not in re.sub(r'"cavmarl[^"]*"', "", program)
    names: dict[str, Any] = {}
    exec(compile(program, str(PAGE), "exec"), names)
    return names["owners"](journal)


@pytest.mark.parametrize("seed", [4, 11])
def test_the_replay_of_the_page_finds_the_same_owners(tmp_path: Path, seed: int) -> None:
    simulator = campaign(seed, "corner")
    simulator.run(30)
    path = tmp_path / "run.journal"
    path.write_text(simulator.log, encoding="utf-8")
    owners = simulator.directory.table.owners
    assert len(owners) > 1
    assert independent_replay(path) == owners == replay(tuple(JournalReader(path))).owners


def test_the_replay_of_the_page_refuses_damage(journal_file: Path) -> None:
    assert independent_replay(journal_file) == summarize(journal_file)[1].owners
    whole = journal_file.read_bytes()
    journal_file.write_bytes(whole.replace(b'"tick":3', b'"tick":4', 1))
    with pytest.raises(AssertionError):
        independent_replay(journal_file)
