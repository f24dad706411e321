from __future__ import annotations

import gzip
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from cavmarl.config.registry import find_entry
from cavmarl.core.atomic_file import draft_folder
from cavmarl.core.errors import ConfigError, MapError
from cavmarl.maps import netconvert_process
from cavmarl.maps.netconvert import OSM_OPTIONS, build_network, map_file
from cavmarl.roads.sumo_net.reader import read_network

pytest.importorskip("sumo", reason="needs the extra 'sumo'")

TOWN = """<osm version="0.6">
  <node id="1" lat="48.000" lon="11.000"/><node id="2" lat="48.001" lon="11.000"/>
  <node id="3" lat="48.002" lon="11.000"/><node id="4" lat="48.001" lon="11.002"/>
  <way id="5"><nd ref="1"/><nd ref="2"/><nd ref="3"/><tag k="highway" v="KIND"/></way>
  <way id="6"><nd ref="2"/><nd ref="4"/><tag k="highway" v="KIND"/></way>
</osm>
"""
REFUSED = {
    "xodr/newmarket.xodr": "In laneLink-element: incoming road '8' is not known.",
    "xodr/soderleden_invalid.xodr": "Attribute 'connectingRoad' is missing in definition",
}


@pytest.fixture
def town(tmp_path: Path) -> Path:
    path = tmp_path / "town.osm"
    path.write_text(TOWN.replace("KIND", "residential"))
    return path


def test_an_osm_file_becomes_a_network(town: Path, tmp_path: Path) -> None:
    result = build_network(town, tmp_path / "out" / "town.net.xml")
    assert result.kind == "osm"
    assert result.options == OSM_OPTIONS
    assert result.dropped == ()
    network = read_network(result.path)
    assert len(network.links) > 0
    assert list(result.path.parent.iterdir()) == [result.path]


def test_two_builds_have_equal_bytes(town: Path, tmp_path: Path) -> None:
    one = build_network(town, tmp_path / "one.net.xml").path.read_bytes()
    other = build_network(town, tmp_path / "other" / "town.net.xml").path.read_bytes()
    packed = build_network(town, tmp_path / "packed.net.xml.gz").path.read_bytes()
    assert one == other == gzip.decompress(packed)
    assert b"generated on" not in one
    assert str(tmp_path).encode() not in one


def test_the_kind_of_a_source_does_not_depend_on_its_extension(town: Path, tmp_path: Path) -> None:
    odd = town.rename(tmp_path / "download.bin")
    assert build_network(odd, tmp_path / "town.net.xml").kind == "osm"


@pytest.mark.parametrize("name", REFUSED)
def test_errors_of_netconvert_are_part_of_the_message(
    shared_maps: Path, tmp_path: Path, name: str
) -> None:
    with pytest.raises(MapError) as caught:
        build_network(shared_maps / name, tmp_path / "out.net.xml")
    message = str(caught.value)
    assert REFUSED[name] in message
    assert f"cavmarl map build {shared_maps / name} --tolerant" in message
    assert "exit code 1" in message
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", REFUSED)
def test_tolerant_builds_list_dropped_elements(
    shared_maps: Path, tmp_path: Path, name: str
) -> None:
    result = build_network(shared_maps / name, tmp_path / "out.net.xml", tolerant=True)
    assert any(REFUSED[name] in line for line in result.dropped)
    assert result.options[-1] == "--ignore-errors"


@pytest.mark.parametrize(
    ("name", "corrections", "warnings"),
    [
        (
            "berlin_siegessaeule.osm.gz",
            {"Guessed 1 roundabout(s)"},
            {"The traffic light '%' does not control any links; it will not be build.": 4},
        ),
        (
            "laufamholz.osm.xml",
            {"Joined 1 junction cluster(s)"},
            {"PT line '%' in relation % has a gap of % stops, only keeping first part.": 7},
        ),
        (
            "monaco.osm.gz",
            {"Joined 18 junction cluster(s)", "Guessed 9 roundabout(s)"},
            {"Ambiguity in turnarounds computation at junction '%'.": 5, "Speed of": 74},
        ),
    ],
)
def test_corrections_and_warnings_are_counted_by_kind(
    shared_maps: Path, tmp_path: Path, name: str, corrections: set[str], warnings: dict[str, int]
) -> None:
    result = build_network(shared_maps / "osm" / name, tmp_path / "built.net.xml")
    assert corrections <= set(result.corrections)
    for begin, count in warnings.items():
        found = sum(n for text, n in result.warnings.items() if text.startswith(begin))
        assert found == count, begin


def test_a_box_crops_the_map(shared_maps: Path, tmp_path: Path) -> None:
    whole = shared_maps / "osm" / "laufamholz.osm.xml"  # a map of 1,425 m by 692 m
    box = (11.153, 49.464, 11.159, 49.468)
    result = build_network(whole, tmp_path / "part.net.xml", bbox=box)
    min_x, min_y, max_x, max_y = read_network(result.path).extent_m
    assert 700.0 < max_x - min_x < 1200.0  # roads that lie partly within the box are not cut
    assert 300.0 < max_y - min_y < 600.0


def test_a_box_without_roads_is_refused(town: Path, tmp_path: Path) -> None:
    with pytest.raises(MapError, match="No edges loaded"):
        build_network(town, tmp_path / "out.net.xml", bbox=(1.0, 1.0, 2.0, 2.0))
    with pytest.raises(ConfigError, match="is empty"):
        build_network(town, tmp_path / "out.net.xml", bbox=(2.0, 1.0, 1.0, 2.0))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (TOWN.replace("KIND", "footway"), "no road for cars: .*are: 2 footway; export an area"),
        (
            TOWN.replace('<way id="6">', '<way id="6"><!--')
            .replace("</osm>", "--></way></osm>")
            .replace("KIND", "primary"),
            "no two roads for cars meet",
        ),
        ('<osm version="0.6"/>', "no way has a highway tag"),
        (TOWN.replace("48.001", "nan").replace("KIND", "residential"), "town.osm: "),
        ("<html/>", "not the root of a map"),
        (TOWN[:200], "line 4: broken XML"),
        ("", "broken XML"),
        ('<!DOCTYPE o [<!ENTITY a "aa">]><osm>&a;</osm>', "document type or entities"),
        ('<!DOCTYPE o SYSTEM "http://example.org/x.dtd"><osm/>', "document type or entities"),
    ],
)
def test_unusable_and_hostile_sources_are_refused(
    tmp_path: Path, content: str, message: str
) -> None:
    path = tmp_path / "town.osm"
    path.write_text(content)
    for tolerant in (False, True):
        with pytest.raises(MapError, match=message):
            build_network(path, tmp_path / "out.net.xml", tolerant=tolerant)
    assert list(tmp_path.iterdir()) == [path]


def test_invalid_networks_are_refused(shared_maps: Path, tmp_path: Path) -> None:
    text = (shared_maps / "net" / "Town10HD.net.xml").read_text()
    path = tmp_path / "town.net.xml"
    path.write_text(text.replace('speed="13.89" length', 'speed="nan" length', 1))
    with pytest.raises(MapError, match="speed='nan'"):
        build_network(path)
    with pytest.raises(MapError, match="speed='nan'"):
        build_network(path, tmp_path / "out.net.xml")
    assert list(tmp_path.iterdir()) == [path]


def test_a_network_is_copied_unchanged(shared_maps: Path, tmp_path: Path) -> None:
    source = shared_maps / "net" / "Town10HD.net.xml"
    result = build_network(source, tmp_path / "copy.net.xml")
    assert result.path.read_bytes() == source.read_bytes()
    assert (result.kind, result.options) == ("sumo", ())
    assert build_network(source).path == source


def test_a_target_that_is_the_source_is_refused(town: Path) -> None:
    before = town.read_bytes()
    with pytest.raises(MapError, match="target is the source"):
        build_network(town, town)
    assert town.read_bytes() == before


def test_a_target_that_cannot_be_written_is_refused(town: Path, tmp_path: Path) -> None:
    with pytest.raises(MapError, match="cannot be written"):
        build_network(town, town / "below" / "out.net.xml")
    with pytest.raises(MapError, match="cannot be written"):
        build_network(town, tmp_path)


def test_the_time_of_netconvert_is_limited(town: Path, tmp_path: Path) -> None:
    with pytest.raises(MapError, match=r"longer than 0\.0001 s"):
        build_network(town, tmp_path / "out.net.xml", timeout_s=0.0001)


def test_an_environment_variable_limits_the_time_of_netconvert(
    town: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CAVMARL_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr("cavmarl.maps.netconvert_process.MAX_NETCONVERT_S", 0.0001)
    with pytest.raises(MapError, match=r"longer than 0\.0001 s.*CAVMARL_MAX_NETCONVERT_S"):
        map_file(town)
    monkeypatch.setenv("CAVMARL_MAX_NETCONVERT_S", "soon")
    with pytest.raises(ConfigError, match="CAVMARL_MAX_NETCONVERT_S = 'soon'"):
        map_file(town)


def test_map_file_builds_once(town: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CAVMARL_CACHE_DIR", str(tmp_path / "cache"))
    first = map_file(town)
    assert first.name == "town.net.xml"
    assert first.is_relative_to(tmp_path / "cache")

    def refuse(*args: object, **kwargs: object) -> None:
        raise AssertionError("netconvert ran again")

    monkeypatch.setattr(subprocess, "run", refuse)
    assert map_file(town) == first
    town.write_text(TOWN.replace("KIND", "tertiary"))
    with pytest.raises(AssertionError, match="ran again"):
        map_file(town)


def test_map_file_returns_networks_unchanged(tmp_path: Path) -> None:
    assert map_file(tmp_path / "x.net.xml") == tmp_path / "x.net.xml"
    plain = tmp_path / "x.xml"
    plain.write_text("<net/>")
    assert map_file(plain) == plain


def test_the_error_without_sumo_names_the_extra(
    town: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing(module: str, extra: str) -> None:
        raise MapError(f"no {module}, install {extra}")

    monkeypatch.setattr(netconvert_process, "require", missing)
    with pytest.raises(MapError, match="no sumo, install sumo"):
        build_network(town, tmp_path / "out.net.xml")


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGKILL])
def test_netconvert_ends_with_the_process_that_runs_it(tmp_path: Path, how: signal.Signals) -> None:
    _end_in_netconvert(
        tmp_path,
        "from cavmarl.maps.netconvert import build_network; build_network(source, target)",
        how,
    )


def test_a_terminated_command_leaves_no_partial_file(tmp_path: Path) -> None:
    code = _end_in_netconvert(
        tmp_path,
        "from cavmarl.cli import main; main(['map', 'build', source, '-o', target])",
        signal.SIGTERM,
    )
    assert code == 128 + signal.SIGTERM
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.osm", "bin", "pid"]


def _end_in_netconvert(tmp_path: Path, call: str, how: signal.Signals) -> int:
    """Kill a program during its netconvert, check that netconvert ends, return the exit code."""
    slow = tmp_path / "bin" / "netconvert"
    slow.parent.mkdir()
    slow.write_text(f"#!/bin/sh\necho $$ > {tmp_path}/pid\nexec sleep 600\n")
    slow.chmod(0o755)
    source = tmp_path / "a.osm"
    source.write_text(TOWN.replace("KIND", "residential"))
    program = (
        "from types import SimpleNamespace; from cavmarl.maps import netconvert_process; "
        f"netconvert_process.require = lambda *_: SimpleNamespace(SUMO_HOME={str(tmp_path)!r}); "
        f"source, target = {str(source)!r}, {str(tmp_path / 'a.net.xml')!r}; {call}"
    )
    with subprocess.Popen([sys.executable, "-c", program]) as caller:
        told = tmp_path / "pid"
        until_s = time.monotonic() + 30.0
        while not (told.exists() and told.read_text().strip()) and time.monotonic() < until_s:
            time.sleep(0.02)
        pid = int(told.read_text())
        assert Path(f"/proc/{pid}").exists()
        caller.send_signal(how)
        code = caller.wait(10.0)
    while _runs(pid) and time.monotonic() < until_s:
        time.sleep(0.02)
    assert not _runs(pid)
    return code


def _runs(pid: int) -> bool:
    try:
        return ") Z" not in Path(f"/proc/{pid}/stat").read_text()
    except FileNotFoundError:
        return False


def test_the_next_build_removes_files_of_a_killed_build(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CAVMARL_CACHE_DIR", str(tmp_path / "cache"))
    place, cached = tmp_path / "place", tmp_path / "cache" / "maps"
    left = [place / ".build-left", cached / ".build-left"]
    for folder in left:
        folder.mkdir(parents=True)
        (folder / "half.net.xml").write_text("<net")
    ring = find_entry("ring") / "map" / "map.net.xml"
    with draft_folder(place) as living:
        build_network(ring, place / "copy.net.xml")
        assert living.exists(), "the build removed a folder that another process may use"
    assert [folder.exists() for folder in left] == [False, True]
    made = build_network(ring, options=["--no-turnarounds"]).path
    assert made.is_relative_to(cached)
    assert not list(cached.rglob(".build-*"))
