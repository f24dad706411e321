"""Eight worlds, undivided and divided, have the hashes that `make record` has recorded."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.golden.worlds import ROWS, WAYS, drive, recorded, write_inputs

CASES = [(name, way) for name, row in ROWS.items() for way in ("", *row.ways.split())]


def test_each_row_is_recorded() -> None:
    assert list(recorded()) == list(ROWS)


@pytest.mark.parametrize(("name", "way"), CASES, ids=lambda word: word or "undivided")
def test_a_world_gives_the_recorded_results(name: str, way: str, tmp_path: Path) -> None:
    if name in ("town", "sumo-traffic"):
        pytest.importorskip("libsumo", reason="needs the extra 'sumo'")
    write_inputs(str(tmp_path))
    assert drive(ROWS[name], WAYS[way] if way else {}, str(tmp_path)) == recorded()[name]
