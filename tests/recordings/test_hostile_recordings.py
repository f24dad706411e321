"""Forged recordings are refused with a one-line error and without much memory."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from cavmarl import RecordingError
from cavmarl.cli import app
from cavmarl.core.errors import CavmarlError
from cavmarl.recordings import part_files
from cavmarl.recordings.parquet_pages import parquet_size
from cavmarl.recordings.recording import Recording
from cavmarl.roads.cache import load_network
from cavmarl.roads.network_check import wrong_network
from tests.support.hostile_recordings import Use, limited_memory, make_recording, put_map

ROOT = Path(__file__).resolve().parents[2]
Forge = Callable[[Path], object]
VEHICLES, FRAMES, EVENTS = (
    f"world-0/{name}/000000.parquet" for name in ("vehicles", "frames", "events")
)
OBSERVATIONS = "world-0/observations/000000.parquet"


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_recording(tmp_path_factory.mktemp("hostile") / "good")


@pytest.fixture
def bad(good: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(good, tmp_path / "bad"))


def changed(file: str, column: str, number: Any, row: int = 0) -> Forge:
    """Replace one value in a column of a table."""

    def forge(path: Path) -> None:
        table = pq.read_table(path / file)
        values = table.column(column).to_pylist()
        values[row] = number
        at = table.column_names.index(column)
        field = table.schema.field(column)
        table = table.set_column(at, field, pa.array(values, field.type))
        pq.write_table(table, path / file)

    return forge


def columns_of(file: str, change: Callable[[pa.Table], pa.Table]) -> Forge:
    return lambda path: pq.write_table(change(pq.read_table(path / file)), path / file)


def with_swapped_columns(one: str, other: str) -> Callable[[pa.Table], pa.Table]:
    def change(table: pa.Table) -> pa.Table:
        names = [{one: other, other: one}.get(name, name) for name in table.column_names]
        return table.rename_columns(names)

    return change


def text_of(file: str, old: bytes, new: bytes) -> Forge:
    """Store a table uncompressed and without checksums, then replace bytes in its file."""

    def forge(path: Path) -> None:
        table = pq.read_table(path / file)
        pq.write_table(table, path / file, compression="none", use_dictionary=False)
        content = (path / file).read_bytes()
        assert old in content
        (path / file).write_bytes(content.replace(old, new))

    return forge


def many_rows(file: str, num_groups: int, num_rows: int) -> Forge:
    """Write many equal rows, which take little space."""

    def forge(path: Path) -> None:
        table = pq.read_table(path / file).slice(0, 1)
        table = pa.concat_tables([table] * num_rows).combine_chunks()
        with pq.ParquetWriter(path / file, table.schema, compression="zstd") as writer:
            for _ in range(num_groups):
                writer.write_table(table)

    return forge


def head_with(*keys: str | int, value: Any) -> Forge:
    def forge(path: Path) -> None:
        head = json.loads((path / "recording.json").read_text())
        inner = head
        for key in keys[:-1]:
            inner = inner[key]
        inner[keys[-1]] = value
        (path / "recording.json").write_text(json.dumps(head))

    return forge


def map_with(table: str, column: str, value: float) -> Forge:
    def forge(path: Path) -> None:
        network = Recording.open(path).network
        rows = getattr(network, table).copy()
        rows[column][0] = value
        put_map(path, replace(network, **{table: rows}))

    return forge


def pipe_at(name: str) -> Forge:
    def forge(path: Path) -> None:
        (path / name).unlink()
        os.mkfifo(path / name)

    return forge


FORGERIES: Sequence[tuple[Forge, str]] = [
    (changed(FRAMES, "num_vehicles", 2**31 - 1), "num_vehicles does not add up"),
    (changed(FRAMES, "num_vehicles", -1), "num_vehicles does not add up"),
    (changed(FRAMES, "tick", -5), "frames are not in order|other ticks"),
    (changed(FRAMES, "time_s", float("nan")), "time_s is nan"),
    (changed(FRAMES, "signals", [2**31 - 1]), "signals|phase"),
    (changed(FRAMES, "signals", [-7]), "signals|phase"),
    (changed(FRAMES, "ghosts", [[1], [2], [3]]), "ghosts of 3 zones"),
    (changed(FRAMES, "episode", None), "has empty fields"),
    (changed(VEHICLES, "x", 1e300), r"x = 1e\+300, which is not an allowed number up to"),
    (changed(VEHICLES, "y", float("nan")), "y = nan"),
    (changed(VEHICLES, "length", 3e38), "length = 3.0"),
    (changed(VEHICLES, "width", -1.0), "width = -1"),
    (changed(VEHICLES, "agent", 2**31 - 1), "agent = 2147483647"),
    (changed(VEHICLES, "zone", 999), "zone = 999, which is not in 0 to 1"),
    (changed(VEHICLES, "driver", 77), "driver = 77"),
    (changed(VEHICLES, "vclass", 99), "vclass = 99"),
    (changed(VEHICLES, "lane", -9), "lane = -9"),
    (changed(VEHICLES, "id", 10**12), "order of their ids"),
    (columns_of(VEHICLES, lambda table: table.drop_columns(["x"])), "it has the columns"),
    (columns_of(FRAMES, lambda table: table.drop_columns(["asked"])), "no column"),
    (columns_of(EVENTS, lambda table: table.drop_columns(["tick"])), "it has the columns"),
    (columns_of(VEHICLES, with_swapped_columns("x", "lane")), "it has the columns"),
    (columns_of(VEHICLES, with_swapped_columns("x", "y")), "it has the columns"),
    (text_of("world-0/handovers/000000.parquet", b"COMMIT", b"COMM\x80T"), "UTF8|UTF-8"),
    (many_rows(VEHICLES, 45, 100_000), "it has 4500000 rows"),
    (many_rows(VEHICLES, 1, 100_000), "100000 rows take"),
    (many_rows(FRAMES, 12, 100_000), "1200000 rows"),
    (head_with("extras", "observations", 5, 2, value=[2**30]), "rows of|list|terms|shape"),
    (head_with("extras", "observations", 8, 2, value=[]), "terms or features"),
    (head_with("extras", value={"../../secret": [["tick", "<i8", []]]}), "no table is called"),
    (head_with("sim_dt_s", value=1e-300), "sim_dt_s is 1e-300"),
    (head_with("step_s", value=10**400), "recording.json: is damaged"),
    (head_with("environment", value="x" * 10**6), "longer than"),
    (head_with("environment", value="a\x00b"), "cannot be printed"),
    (head_with("bounds", 0, value=float("nan")), "recording.json"),
    (head_with("features", value=[["a"]] * 3), "a feature has no sensor"),
    (head_with("manifest", "world", "config", value={"a": 1, "b": 2}), "no settings that.*a.*;.*b"),
    (map_with("links", "next_lane", -(2**31)), "next_lane of links leads to no row of lanes"),
    (map_with("lanes", "num_points", 2**31 - 1), "first_point and num_points"),
    (map_with("lanes", "length_m", 1e15), "length_m of lanes"),
    (map_with("points", "x", float("nan")), "x of points"),
    (map_with("points", "cos", float("inf")), "cos of points is not a number from -1 to 1"),
    (pipe_at("network.bin"), "network.bin"),
    (pipe_at(VEHICLES), "it is not a regular file"),
    (pipe_at("recording.json"), "it is not a regular file"),
]


@pytest.mark.parametrize(("forge", "words"), FORGERIES)
def test_the_error_for_a_forged_recording_has_one_line(
    bad: Path, tmp_path: Path, forge: Forge, words: str
) -> None:
    forge(bad)
    with limited_memory(1 << 30), pytest.raises(RecordingError, match=words) as caught:
        Use(pictures=True, page=True).read(bad, tmp_path)
    assert "\n" not in str(caught.value)
    assert ";" in str(caught.value)  # separates the fault and the remedy


def test_the_replay_command_reports_the_error_of_a_forged_recording(bad: Path) -> None:
    changed(VEHICLES, "x", 1e300)(bad)
    result = CliRunner().invoke(app, ["replay", str(bad), "--csv", str(bad / "rows.csv")])
    assert isinstance(result.exception, CavmarlError | SystemExit)
    assert result.exit_code != 0


def test_a_page_with_more_values_than_its_column_is_refused(good: Path, bad: Path) -> None:
    """The head of the page claims more values than the column has; Arrow would allocate them."""
    table = pa.table({"numbers": pa.array([[None] * 1000], pa.list_(pa.int32()))})
    pq.write_table(table, bad / "rows", data_page_version="1.0", use_dictionary=False)
    content = (bad / "rows").read_bytes()
    assert parquet_size(memoryview(content)).columns[0].num_values == 1000
    head = content.index(b"\x15\xd0\x0f")  # number of values: 1000
    forged = content[:head] + b"\x15\xd2\x0f" + content[head + 3 :]
    with pytest.raises(ValueError, match="another number of values than its pages"):
        parquet_size(memoryview(forged))


def test_the_maps_of_all_environments_pass_the_check_of_recorded_maps() -> None:
    maps = sorted((ROOT / "envs").rglob("*.net.xml*"))
    assert len(maps) > 10
    for path in maps:
        assert wrong_network(load_network(path)) == "", path


def test_written_recordings_are_within_the_limits(good: Path) -> None:
    for file in good.rglob("*.parquet"):
        content = file.read_bytes()
        size = parquet_size(memoryview(content))
        assert size.num_rows == pq.read_metadata(file).num_rows
        assert sum(one.num_bytes for one in size.columns) < part_files.MOST_RATIO * len(content)
        assert len(size.columns) == pq.read_metadata(file).num_columns
    assert np.all([one.num_values >= 0 for one in size.columns])
