"""What SUMO is given by a user's files writes no file."""

from __future__ import annotations

import gzip
import subprocess
from contextlib import suppress
from pathlib import Path

import pytest

from cavmarl.config.registry import find_entry
from cavmarl.core.errors import ConfigError, MapError
from cavmarl.roads.sumo_net.reader import read_network
from cavmarl.traffic.sumo.sumo_input import command_words, read_input, without_outputs

sumo = pytest.importorskip("sumo", reason="needs the extra 'sumo'")


MAP = find_entry("grid4x4") / "map" / "map.net.xml"
TRIP = '<vType id="t"/><trip id="a" type="t" depart="0" from="{}" to="{}"/>'


@pytest.fixture(scope="module")
def trip() -> str:
    """A trip over two edges of the map."""

    network = read_network(MAP)
    link = network.links[0]
    ends = (network.lanes["edge"][link[side]] for side in ("from_lane", "to_lane"))
    return TRIP.format(*(network.edge_ids[edge] for edge in ends))


def run(folder: Path, *demand: str) -> None:
    """SUMO itself, for ten seconds."""
    given = read_input([folder / name for name in demand])
    own = folder / "own"
    own.mkdir()
    words = command_words(MAP, given, own, 0.1, 1, {"end": "10"})
    program = Path(sumo.SUMO_HOME) / "bin" / "sumo"
    subprocess.run([program, *words], cwd=folder, check=True, capture_output=True)


ADDITIONAL = {
    "a calibrator": '<calibrator id="c" edge="{edge}" pos="1" output="victim"/>',
    "an angle bracket in an attribute": (
        '<e1Detector id="x>y" lane="{lane}" pos="1" period="5" file="victim"/>'
    ),
    "a reference": '<e1Detector id="d" lane="{lane}" pos="1" period="5" f&#105;le="victim"/>',
    "a detector": '<e1Detector id="d" lane="{lane}" pos="1" period="5" file="victim"/>',
    "edge data": '<edgeData id="d" file="victim"/>',
    "a timed event": '<timedEvent type="SaveTLSStates" source="{signal}" dest="victim"/>',
}


@pytest.mark.parametrize("element", ADDITIONAL.values(), ids=ADDITIONAL)
def test_additional_files_write_nothing(tmp_path: Path, element: str, trip: str) -> None:

    network = read_network(MAP)
    text = element.format(
        edge=trip.split('from="')[1].split('"')[0],
        lane=network.lane_ids[int(network.links[0]["from_lane"])],
        signal=network.signal_ids[0],
    )
    (tmp_path / "a.add.xml").write_text(f"<additional>{text}</additional>")
    (tmp_path / "r.rou.xml").write_text(f"<routes>{trip}</routes>")
    try:
        run(tmp_path, "a.add.xml", "r.rou.xml")
    except (ConfigError, subprocess.CalledProcessError):
        pass  # refused by us (no XML), or by SUMO
    assert not (tmp_path / "victim").exists()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.add.xml", "own", "r.rou.xml"]


@pytest.mark.parametrize("key", ["device.ssm.file", "device.ssm.f&#105;le"])
def test_devices_of_vehicles_write_nothing(tmp_path: Path, trip: str, key: str) -> None:
    device = f'<vType id="t"><param key="has.ssm.device" value="true"/><param key="{key}" '
    text = trip.replace('<vType id="t"/>', device + 'value="victim"/></vType>')
    (tmp_path / "r.rou.xml").write_text(f"<routes>{text}</routes>")
    run(tmp_path, "r.rou.xml")
    assert not (tmp_path / "victim").exists()


SECTIONS = {
    "processing": "fcd-output",
    "routing": "device.rerouting.output",
    "unknown": "summary-output",
    "ssm_device": "device.ssm.file",
    "taxi_device": "device.taxi.dispatch-algorithm.output",
    "mesoscopic": "save-state.files",
    "random_number": "error-log",
}


@pytest.mark.parametrize(("section", "option"), SECTIONS.items())
def test_options_that_write_are_not_passed_on(
    tmp_path: Path, trip: str, section: str, option: str
) -> None:
    (tmp_path / "r.rou.xml").write_text(f"<routes>{trip}</routes>")
    (tmp_path / "run.sumocfg").write_text(
        f'<c><input><route-files value="r.rou.xml"/></input>'
        f'<{section}><{option} value="victim"/></{section}></c>'
    )
    with suppress(ConfigError):  # refused, or left out
        run(tmp_path, "run.sumocfg")
    assert not (tmp_path / "victim").exists()


def test_options_that_change_traffic_are(tmp_path: Path, trip: str) -> None:
    (tmp_path / "r.rou.xml").write_text(f"<routes>{trip}</routes>")
    (tmp_path / "run.sumocfg").write_text(
        '<c><input><route-files value="r.rou.xml"/></input><processing><time-to-teleport '
        'value="-1"/><lateral-resolution value="0.8"/></processing><routing>'
        '<device.rerouting.probability value="0.5"/></routing></c>'
    )
    assert read_input([tmp_path / "run.sumocfg"]).options == {
        "time-to-teleport": "-1",
        "lateral-resolution": "0.8",
        "device.rerouting.probability": "0.5",
    }
    (tmp_path / "run.sumocfg").write_text(
        "<c><processing><what-is-this value='1'/></processing></c>"
    )
    with pytest.raises(ConfigError, match=r"<what-is-this>: is no option that changes traffic"):
        read_input([tmp_path / "run.sumocfg"])


@pytest.mark.parametrize("encoding", ["utf-16", "utf-7"])
def test_what_cannot_be_searched_is_refused(tmp_path: Path, trip: str, encoding: str) -> None:
    head = f'<?xml version="1.0" encoding="{encoding}"?>'
    text = f'{head}<additional><edgeData id="d" file="victim"/></additional>'
    (tmp_path / "a.add.xml").write_bytes(text.encode(encoding))
    (tmp_path / "r.rou.xml").write_text(f"<routes>{trip}</routes>")
    with pytest.raises(ConfigError):
        run(tmp_path, "a.add.xml", "r.rou.xml")
    assert not (tmp_path / "victim").exists()


def test_a_file_that_includes_another_is_refused(tmp_path: Path, trip: str) -> None:
    (tmp_path / "r.rou.xml").write_text(f'<routes><include href="x"/>{trip}</routes>')
    with pytest.raises(ConfigError, match="<include> is not followed"):
        run(tmp_path, "r.rou.xml")


def test_demand_deep_in_itself_is_refused_and_not_copied(tmp_path: Path) -> None:
    deep = tmp_path / "r.rou.xml"
    deep.write_text(f'<routes>{"<param>" * 50_000}<a file="x"/>{"</param>" * 50_000}</routes>')
    with pytest.raises(ConfigError, match=r"over 100 deep .*CAVMARL_MAX_XML_DEPTH"):
        without_outputs(deep, tmp_path)


def test_a_small_file_with_a_large_text_is_refused(
    tmp_path: Path, trip: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    bomb = tmp_path / "r.rou.xml.gz"
    bomb.write_bytes(gzip.compress(b"<routes>" + b" " * 50_000_000 + b"</routes>"))
    assert bomb.stat().st_size < 100_000
    monkeypatch.setenv("CAVMARL_MAX_XML_BYTES", "1000000")
    with pytest.raises(ConfigError, match=r"larger than 1000000 bytes.*CAVMARL_MAX_XML_BYTES"):
        read_input([bomb])
    bomb.write_bytes(gzip.compress(b'<net version="1.20">' + b" " * 50_000_000 + b"</net>"))
    with pytest.raises(MapError, match=r"larger than 1000000 bytes.*CAVMARL_MAX_XML_BYTES"):
        read_network(bomb)
    monkeypatch.setenv("CAVMARL_MAX_XML_BYTES", "much")
    with pytest.raises(ConfigError, match="must be a whole number"):
        read_network(bomb)
