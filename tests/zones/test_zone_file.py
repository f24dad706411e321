from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings

from cavmarl.core.errors import ConfigError
from cavmarl.roads.sumo_net.reader import read_network
from cavmarl.zones.partition.zone_file import read_zones, write_zones, zones_for
from cavmarl.zones.partition.zone_partition import ZonePartition
from tests.support.partitions import PINWHEEL, four, partitions

Change = Callable[[dict[str, Any]], object]


@given(partitions())
@settings(
    deadline=None, max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_a_written_zone_file_is_read_back(tmp_path: Path, partition: ZonePartition) -> None:
    path = tmp_path / "zones.json"
    write_zones(path, partition)
    again = read_zones(path)
    assert again.rects.tobytes() == partition.rects.tobytes()
    assert (again.bounds, again.content_hash) == (partition.bounds, partition.content_hash)
    assert json.loads(path.read_text())["schema"] == "cavmarl.zones"


def test_yaml_and_any_order_of_zones_are_accepted(tmp_path: Path) -> None:
    path = tmp_path / "zones.yaml"
    path.write_text(
        "schema: cavmarl.zones\nversion: 1\nbounds_m: [0, 0, 2, 1]\nzones:\n"
        "- {id: 1, rect_m: [0, 0, 1.5, 1]}\n- {id: 0, rect_m: [1.5, 0, 2, 1]}\n"
    )
    assert read_zones(path).rects.tolist() == [[1.5, 0.0, 2.0, 1.0], [0.0, 0.0, 1.5, 1.0]]


def document() -> dict[str, Any]:
    return {
        "schema": "cavmarl.zones",
        "version": 1,
        "bounds_m": [0, 0, 30, 30],
        "zones": [
            {"id": zone, "rect_m": rect} for zone, rect in enumerate(PINWHEEL.rects.tolist())
        ],
    }


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda it: it.update(version=2), r"version = 2: must be 1"),
        (lambda it: it.update(schema="zones"), r"schema = 'zones': must be 'cavmarl.zones'"),
        (lambda it: it.update(halo_m=3.0), r"halo_m: unknown key"),
        (lambda it: it.pop("bounds_m"), r"bounds_m: missing"),
        (lambda it: it["zones"][2].update(rect=1), r"zones\.2\.rect: unknown key; use rect_m"),
        (lambda it: it["zones"][2].pop("id"), r"zones\.2\.id: missing"),
        (lambda it: it["zones"][2].update(id=True), r"zones\.2\.id = True"),
        (lambda it: it["zones"][2].update(id=0), r"2 zones have id 0"),
        (lambda it: it["zones"][2].update(id=7), r"no zone has the id 2; .* 0 to 4"),
        (lambda it: it["zones"][4]["rect_m"].append(1.0), r"zones\.4\.rect_m"),
        (lambda it: it["zones"][4].update(rect_m=[10, 10, "20", 20]), r"zones\.4\.rect_m\.2"),
        (
            lambda it: it["zones"][4].update(rect_m=[10, 10, 21, 20]),
            r"zones 1 and 4 overlap in x 20 to 21, y 10 to 20",
        ),
        (
            lambda it: it["zones"][4].update(rect_m=[10, 10, 20, 19]),
            r"no zone covers x 10 to 20, y 19 to 20",
        ),
        (lambda it: it["zones"][1]["rect_m"].__setitem__(2, 31), r"zone 1: .* exceeds bounds_m"),
        (lambda it: it.update(zones=[]), r"there are no zones"),
        (
            lambda it: it.update(zones=[{"id": 0, "rect_m": [0, 0, 1, 1]}] * 300),
            r"300 zones; use at most 256",
        ),
    ],
)
def test_the_error_for_an_invalid_zone_file_names_the_key(
    tmp_path: Path, change: Change, words: str
) -> None:
    content = document()
    change(content)
    path = tmp_path / "bad.json"
    path.write_text(json.dumps(content))
    with pytest.raises(ConfigError, match=rf"bad\.json: .*{words}"):
        read_zones(path)


@pytest.mark.parametrize("number", [".nan", ".inf", "-.inf"])
def test_infinite_numbers_and_nan_are_refused(tmp_path: Path, number: str) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(json.dumps(document()).replace("[20.0, 0.0", f"[20.0, {number}"))
    with pytest.raises(ConfigError, match=r"bad\.yaml: "):
        read_zones(path)


@pytest.mark.parametrize("text", ["", "[]", "{", "zones: 3", '{"zones": 1, "zones": 2}', "\0"])
def test_an_invalid_zone_file_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "bad.json"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"bad\.json"):
        read_zones(path)
    with pytest.raises(ConfigError, match="No such file"):
        read_zones(tmp_path / "none.json")


def test_an_unwritable_zone_file_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be written"):
        write_zones(tmp_path / "no" / "folder.json", four())


def test_a_file_for_another_map_or_number_of_zones_is_refused(
    tmp_path: Path, crossing: Callable[..., Path]
) -> None:
    network, path = read_network(crossing()), tmp_path / "zones.json"
    write_zones(path, four())
    with pytest.raises(ConfigError, match=r"zones\.count = 2: .*zones\.json has 4 zones; use 4"):
        zones_for(network, path, 2)
    with pytest.raises(ConfigError, match=r"not contain the roads of 'crossing', which extend"):
        zones_for(network, path, 4)
