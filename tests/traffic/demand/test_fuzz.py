"""A demand file with any content is read or is refused with an error of cavmarl."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cavmarl.core.errors import CavmarlError
from cavmarl.roads.network import RoadNetwork
from cavmarl.traffic.demand import read_demand

WHOLE = """<?xml version="1.0" encoding="UTF-8"?>
<routes>
  <vType id="t" vClass="bus" length="9" speedFactor="normc(1,0.1,0.2,2)" carFollowModel="IDM"/>
  <vTypeDistribution id="d" vTypes="t DEFAULT_VEHTYPE" probabilities="1 2"/>
  <busStop id="s" lane="BC_0" startPos="10" endPos="30"/>
  <route id="r" edges="AB BC" repeat="0"><stop busStop="s" duration="20"/></route>
  <routeDistribution id="m">
    <route refId="r"/><route edges="CB BA" probability="2"/>
  </routeDistribution>
  <vehicle id="v" type="d" route="r" depart="0:00:03" departLane="best" departPos="-3"/>
  <trip id="w" from="AB" to="CB" via="BC" depart="4"><stop lane="BC_1" duration="3"/></trip>
  <interval begin="0" end="20"><flow id="f" route="m" period="exp(0.3)"/></interval>
  <flow id="g" begin="2" end="9" number="3" departSpeed="max"><route edges="AB BC"/></flow>
  <person id="p" depart="1"><walk edges="AB"/></person>
</routes>
"""
PIECES = WHOLE.replace("<", "\0<").replace('"', '\0"').replace(" ", "\0 ").split("\0")
VALUES = [
    "", "-1", "0", "nan", "1e308", "99999999999999999999", "AB", "BX", "r", "m", "d", "é", ":",
]  # fmt: skip


def check(town: RoadNetwork, folder: Path, content: bytes) -> None:
    path = folder / "x.rou.xml"
    path.write_bytes(content)
    for mode in ("error", "skip"):
        with suppress(CavmarlError):
            read_demand([path], town, on_bad_route=mode, max_departures=10_000).draw(1)  # type: ignore[arg-type]


@settings(max_examples=150, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_mutated_files_are_read_or_refused(
    town: RoadNetwork, tmp_path: Path, data: st.DataObject
) -> None:
    pieces = list(PIECES)
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(pieces) - 1))
        change = data.draw(st.sampled_from(["drop", "double", "swap", "value"]))
        if change == "drop":
            del pieces[at]
        elif change == "double":
            pieces.insert(at, pieces[at])
        elif change == "swap":
            other = data.draw(st.integers(0, len(pieces) - 1))
            pieces[at], pieces[other] = pieces[other], pieces[at]
        elif pieces[at].startswith('"'):
            pieces[at] = '"' + data.draw(st.sampled_from(VALUES))
    check(town, tmp_path, "".join(pieces).encode())


@settings(max_examples=100, deadline=None, suppress_health_check=list(HealthCheck))
@given(content=st.binary(max_size=60), at=st.integers(0, len(WHOLE)))
def test_files_with_inserted_bytes_are_read_or_refused(
    town: RoadNetwork, tmp_path: Path, content: bytes, at: int
) -> None:
    whole = WHOLE.encode()
    check(town, tmp_path, whole[:at] + content + whole[at:])


def test_the_unchanged_file_is_read(town: RoadNetwork, tmp_path: Path) -> None:
    path = tmp_path / "x.rou.xml"
    path.write_text(WHOLE, encoding="utf-8")
    assert len(read_demand([path], town).elements) == 4


@pytest.mark.parametrize("value", VALUES)
def test_odd_values_of_any_attribute_are_read_or_refused(
    town: RoadNetwork, tmp_path: Path, value: str
) -> None:
    for at, piece in enumerate(PIECES):
        if piece.startswith('"') and PIECES[at - 1].endswith("="):
            pieces = [*PIECES[:at], f'"{value}', *PIECES[at + 1 :]]
            check(town, tmp_path, "".join(pieces).encode())
