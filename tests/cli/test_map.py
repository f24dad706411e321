from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from cavmarl.cli.map import app
from cavmarl.core.errors import ConfigError, MapError, UnknownEnvironmentError

runner = CliRunner()


@pytest.fixture(autouse=True)
def cache_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CAVMARL_CACHE_DIR", str(tmp_path / "cache"))


def test_build_writes_the_network_and_its_statistics(shared_maps: Path, tmp_path: Path) -> None:
    out = tmp_path / "town.net.xml"
    source = shared_maps / "xodr" / "Town10HD.xodr"
    report = tmp_path / "report.json"

    result = runner.invoke(app, ["build", str(source), "-o", str(out), "--json", str(report)])
    assert result.exit_code == 0, result.output
    assert "1.64 km / 3.10 km" in result.output
    statistics = json.loads((tmp_path / "town.stats.json").read_text())
    assert statistics == json.loads(report.read_text())
    assert statistics["map"]["edges"] == 46
    assert statistics["build"]["kind"] == "opendrive"
    assert out.exists()


def test_build_names_its_target_after_the_source(
    shared_maps: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)

    source = shared_maps / "osm" / "laufamholz.osm.xml"
    assert runner.invoke(app, ["build", str(source)]).exit_code == 0
    assert (tmp_path / "laufamholz.net.xml").exists()


def test_build_lists_dropped_elements(shared_maps: Path, tmp_path: Path) -> None:
    source = str(shared_maps / "xodr" / "soderleden_invalid.xodr")
    out = str(tmp_path / "out.net.xml")

    refused = runner.invoke(app, ["build", source, "-o", out])
    assert isinstance(refused.exception, MapError)
    tolerated = runner.invoke(app, ["build", source, "-o", out, "--tolerant"])
    assert tolerated.exit_code == 0
    assert "dropped: Attribute 'connectingRoad' is missing" in tolerated.output


def test_an_unwritable_path_for_the_repaired_network_is_refused(tmp_path: Path) -> None:
    place = tmp_path / "none" / "out.net.xml"
    refused = runner.invoke(app, ["check", "ring", "--fix", str(place)])
    assert isinstance(refused.exception, ConfigError)
    assert f"--fix {place}: cannot be written: there is no folder" in str(refused.exception)


@pytest.mark.parametrize("name", ["net/mcity/mcity.net.xml", "osm/berlin_siegessaeule.osm.gz"])
def test_check_accepts_networks_and_their_sources(
    shared_maps: Path, tmp_path: Path, name: str
) -> None:
    report = tmp_path / "report.json"

    result = runner.invoke(app, ["check", str(shared_maps / name), "--json", str(report)])
    assert result.exit_code == 0, result.output
    assert json.loads(report.read_text())["drivable"] is True
    assert "note: " in result.output


def test_check_fails_on_a_map_that_cannot_be_driven(tmp_path: Path) -> None:
    path = tmp_path / "buses.net.xml"
    path.write_text(
        """<net version="1.20">
        <edge id="a" from="A" to="B">
          <lane id="a_0" index="0" allow="bus" speed="9" length="50" shape="0,0 50,0"/>
        </edge>
        <junction id="A" type="dead_end" x="0" y="0" incLanes="" intLanes="" shape=""/>
        <junction id="B" type="dead_end" x="50" y="0" incLanes="a_0" intLanes="" shape=""/>
        </net>"""
    )

    result = runner.invoke(app, ["check", str(path)])
    assert result.exit_code == 1
    assert "no edge is open to passenger cars" in result.output


@pytest.mark.parametrize("box", ["1,2,3", "a,b,c,d", ""])
def test_a_malformed_box_is_refused(shared_maps: Path, tmp_path: Path, box: str) -> None:
    source = str(shared_maps / "xodr" / "fabriksgatan.xodr")

    result = runner.invoke(app, ["build", source, "-o", str(tmp_path / "x.net.xml"), "--bbox", box])
    assert result.exit_code == 2
    assert "--bbox" in result.output


@pytest.mark.parametrize("name", ["x.txt", "x.xml", "x", "x.net.xml.bz2"])
def test_a_network_file_with_another_suffix_is_refused(tmp_path: Path, name: str) -> None:
    source, out = tmp_path / "source.osm", tmp_path / name
    source.write_text("<osm/>")
    result = runner.invoke(app, ["build", str(source), "-o", str(out)])
    assert result.exit_code == 2
    assert ".net.xml" in result.output
    assert not out.exists()


@pytest.mark.parametrize("command", ["build", "check"])
def test_the_error_for_a_file_that_is_not_a_map_names_the_suffixes_of_maps(
    tmp_path: Path, command: str
) -> None:
    path = tmp_path / "README.md"
    path.write_text("# A text\n")
    error = runner.invoke(app, [command, str(path)]).exception
    assert isinstance(error, MapError)
    assert all(word in str(error) for word in ("not a map", ".net.xml", ".osm", ".xodr"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<net></net>", "no version attribute, so it is not a SUMO"),
        ('<net version="new"></net>', "version='new'"),
    ],
)
def test_a_network_without_a_valid_version_is_refused(
    tmp_path: Path, text: str, message: str
) -> None:
    path = tmp_path / "empty.net.xml"
    path.write_text(text)
    error = runner.invoke(app, ["check", str(path)]).exception
    assert isinstance(error, MapError)
    assert message in str(error)
    assert "KeyError" not in str(error)


def test_missing_files_and_unknown_options_are_refused(tmp_path: Path) -> None:
    missing = runner.invoke(app, ["check", str(tmp_path / "none.net.xml")]).exception
    assert isinstance(missing, UnknownEnvironmentError)
    assert "none.net.xml" in str(missing)
    assert runner.invoke(app, ["build", str(tmp_path)]).exit_code == 2
    assert runner.invoke(app, ["check"]).exit_code == 2
    assert runner.invoke(app, ["check", __file__, "--nonsense"]).exit_code == 2


def test_an_unwritable_report_is_an_error(shared_maps: Path, tmp_path: Path) -> None:
    source = str(shared_maps / "xodr" / "fabriksgatan.xodr")
    taken = tmp_path / "file"
    taken.write_text("")

    result = runner.invoke(app, ["check", source, "--json", str(taken / "report.json")])
    assert isinstance(result.exception, ConfigError)


def test_zones_are_cut_written_and_read_again(shared_maps: Path, tmp_path: Path) -> None:
    source = str(shared_maps / "net" / "Town10HD.net.xml")
    out, report, again = (tmp_path / name for name in ("zones.json", "a.json", "b.json"))

    words = ["zones", source, "--count", "4", "--avoid-junctions"]
    result = runner.invoke(app, [*words, "--out", str(out), "--json", str(report)])
    assert result.exit_code == 0, result.output
    assert "junctions cut: 0 of 9" in result.output
    found = json.loads(report.read_text())
    assert found["neighbors"] == [[1, 2], [0, 2, 3], [0, 1, 3], [1, 2]]
    assert found["statistics"]["lane_imbalance"] < 1.3

    read = runner.invoke(app, ["zones", source, "--layout", str(out), "--json", str(again)])
    assert read.exit_code == 0, read.output
    assert json.loads(again.read_text()) == found


def test_zones_narrower_than_the_halo_are_reported(shared_maps: Path) -> None:
    source = str(shared_maps / "net" / "Town10HD.net.xml")
    words = ["zones", source, "--layout", "strips", "--count", "3", "--halo", "200"]
    assert "narrower than the halo of 200 m: zones 1;" in runner.invoke(app, words).output


def test_zones_are_drawn(shared_maps: Path, tmp_path: Path) -> None:
    pytest.importorskip("pygame", reason="pictures need the extra 'render'")
    source = str(shared_maps / "net" / "Town10HD.net.xml")
    picture = tmp_path / "zones.png"
    result = runner.invoke(app, ["zones", source, "--picture", str(picture)])
    assert result.exit_code == 0, result.output
    assert picture.read_bytes().startswith(b"\x89PNG")
    result = runner.invoke(app, ["zones", source, "--picture", str(tmp_path / "no" / "z.png")])
    assert isinstance(result.exception, ConfigError)


def test_wrong_options_of_zones_are_refused(shared_maps: Path) -> None:
    source = str(shared_maps / "net" / "Town10HD.net.xml")
    result = runner.invoke(app, ["zones", source, "--picture", "zones.jpg"])
    assert result.exit_code == 2
    assert "must end in .png" in " ".join(result.output.replace("│", " ").split())
    result = runner.invoke(app, ["zones", source, "--layout", "rings"])
    assert isinstance(result.exception, ConfigError)
    assert "does not exist; use grid, strips, bisection" in str(result.exception)


def test_more_zones_than_the_map_can_hold_are_refused(shared_maps: Path) -> None:
    source = str(shared_maps / "net" / "Town10HD.net.xml")
    result = runner.invoke(app, ["zones", source, "--count", "256", "--layout", "strips"])
    assert isinstance(result.exception, ConfigError)


@pytest.mark.parametrize("command", ["check", "zones"])
def test_commands_accept_the_name_of_an_environment(command: str) -> None:
    result = runner.invoke(app, [command, "grid4x4"])
    assert result.exit_code == 0, result.output
    assert "grid4x4" in result.output or "map" in result.output
    missing = runner.invoke(app, [command, "grid5x5"])
    assert isinstance(missing.exception, UnknownEnvironmentError)
    assert "grid4x4" in str(missing.exception)
