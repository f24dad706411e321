"""The errors for damaged or incomplete recordings, and for recordings of another version."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from cavmarl import EpisodeError, RecordingError, make_vec, parallel_env
from cavmarl.recordings import recording_writer
from cavmarl.recordings.recording import Recording


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a recording of three parts."""
    path = tmp_path_factory.mktemp("recordings") / "good"
    with pytest.MonkeyPatch.context() as patch, closing(parallel_env("ring", record=path)) as env:
        patch.setattr(recording_writer, "COMMIT_S", 0.05)
        env.reset(seed=1)
        for part in range(3):
            until = time.monotonic() + 30.0
            while len(list((path / "world-0" / "frames").glob("0*"))) <= part:
                env.step(env.suggest_actions())
                assert time.monotonic() < until
                time.sleep(0.03)
    for table in ("vehicles", "events", "frames"):
        for file in (path / "world-0" / table).iterdir():
            if int(file.stem) > 2:
                file.unlink()
    return path


@pytest.fixture
def bad(good: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(good, tmp_path / "bad"))


def read(path: Path) -> int:
    recording = Recording.open(path)
    assert recording.network
    list(recording.events())
    return len(list(recording.frames()))


def replaced(name: str, old: str, new: str) -> Callable[[Path], object]:
    def change(path: Path) -> None:
        text = (path / name).read_text()
        assert old in text
        (path / name).write_text(text.replace(old, new))

    return change


def with_flipped_byte(name: str, place: float) -> Callable[[Path], object]:
    def change(path: Path) -> None:
        content = bytearray((path / name).read_bytes())
        content[int(place * len(content))] ^= 0x55
        (path / name).write_bytes(content)

    return change


def truncated(name: str) -> Callable[[Path], object]:
    def change(path: Path) -> None:
        content = (path / name).read_bytes()
        (path / name).write_bytes(content[: len(content) // 2])

    return change


def removed(name: str) -> Callable[[Path], object]:
    return lambda path: (path / name).unlink()


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (removed("recording.json"), ["no recording.json", "give the path"]),
        (truncated("recording.json"), ["recording.json", "cannot be read", "record the run again"]),
        (
            replaced("recording.json", '"cavmarl_recording": 2', '"other": 1'),
            ["not the head of a recording"],
        ),
        (
            replaced("recording.json", '"cavmarl_recording": 2', '"cavmarl_recording": 9'),
            ["format 9", "reads 2", "use the version of cavmarl that wrote it"],
        ),
        (replaced("recording.json", '"sim_dt_s"', '"dt"'), ["recording.json", "is damaged"]),
        (replaced("recording.json", '"rects"', '"rects_"'), ["recording.json", "is damaged"]),
        (removed("network.bin"), ["network.bin", "has no map", "put the file back"]),
        (with_flipped_byte("network.bin", 0.5), ["network.bin", "put the file back"]),
        (
            replaced("recording.json", '"layout": "', '"layout": "x'),
            ["network.bin", "layout x", "use the version"],
        ),
        (
            truncated("world-0/frames/000001.parquet"),
            ["frames/000001.parquet", "damaged", "restore"],
        ),
        (truncated("world-0/vehicles/000001.parquet"), ["vehicles/000001.parquet", "is damaged"]),
        (
            with_flipped_byte("world-0/vehicles/000001.parquet", 0.3),
            ["000001.parquet", "is damaged"],
        ),
        (truncated("world-0/events/000001.parquet"), ["events/000001.parquet", "is damaged"]),
        (
            removed("world-0/vehicles/000002.parquet"),
            ["000002.parquet", "is missing", "restore it"],
        ),
        (
            removed("world-0/frames/000001.parquet"),
            ["000001.parquet", "is missing, although later"],
        ),
    ],
)
def test_a_damaged_recording_is_refused(
    bad: Path, damage: Callable[[Path], object], words: list[str]
) -> None:
    damage(bad)
    with pytest.raises(RecordingError) as caught:
        read(bad)
    for word in words:
        assert word in str(caught.value)


def test_parts_before_a_damaged_part_can_be_read_after_its_removal(good: Path, bad: Path) -> None:
    truncated("world-0/vehicles/000002.parquet")(bad)
    with pytest.raises(RecordingError):
        read(bad)
    for table in ("vehicles", "events", "frames"):
        (bad / "world-0" / table / "000002.parquet").unlink()
    assert 0 < read(bad) < read(good)


def test_uncommitted_parts_are_ignored(good: Path, bad: Path) -> None:
    shutil.copy(bad / "world-0/vehicles/000000.parquet", bad / "world-0/vehicles/000003.parquet")
    (bad / "world-0/frames/.000003.parquet.77").write_bytes(b"half")
    assert read(bad) == read(good)


def test_a_table_of_another_part_is_refused(bad: Path) -> None:
    vehicles = bad / "world-0" / "vehicles"
    shutil.copy(vehicles / "000000.parquet", vehicles / "000001.parquet")
    # Parts end by the clock, so two of them may have equally many vehicles.
    with pytest.raises(RecordingError, match=r"does not add up|its vehicles have other ticks"):
        read(bad)


def test_an_empty_folder_a_file_and_a_missing_path_are_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no")
    (tmp_path / "empty").mkdir()
    with pytest.raises(RecordingError, match="the folder is no recording"):
        Recording.open(tmp_path / "empty")
    for name in ("file", "nothing"):
        with pytest.raises(RecordingError):
            Recording.open(tmp_path / name)


def test_recording_into_an_existing_recording_or_file_is_refused(
    good: Path, tmp_path: Path
) -> None:
    before = json.loads((good / "recording.json").read_text())
    with pytest.raises(RecordingError, match="give a new folder"):
        parallel_env("ring", record=good)
    assert json.loads((good / "recording.json").read_text()) == before
    (tmp_path / "file").write_text("no")
    with pytest.raises(RecordingError, match="cannot record there"):
        make_vec("ring", record=tmp_path / "file")
    env = parallel_env("ring", record=tmp_path / "one")
    with pytest.raises(EpisodeError, match="is being recorded"):
        env.record(tmp_path / "two")
    env.close()


def test_worlds_in_workers_can_be_recorded_with_a_journal(tmp_path: Path) -> None:
    settings = {"zones.journal": str(tmp_path / "journal.jsonl")}
    vec = make_vec("ring", workers=1, record=tmp_path / "run", overrides=settings)
    vec.reset(seed=0)
    vec.step(vec.suggest_actions())
    vec.close()
    assert (tmp_path / "run").exists()
    assert (tmp_path / "journal.jsonl").stat().st_size > 0


def test_a_full_disk_is_reported_at_the_end_of_a_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, content: bytes) -> None:
        raise OSError(28, "No space left on device")

    env = parallel_env("ring", record=tmp_path / "run")
    env.reset(seed=1)
    monkeypatch.setattr(recording_writer, "write_whole", full)
    with pytest.raises(RecordingError, match=r"No space left .*free space"):
        env.close()
    monkeypatch.undo()
    assert Recording.open(tmp_path / "run").worlds == []
