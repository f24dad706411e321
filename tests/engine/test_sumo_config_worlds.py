"""SUMO's configuration file as an environment, as a map and as demand."""

from __future__ import annotations

from pathlib import Path

import pytest

from cavmarl.core.errors import ConfigError, MapError, UnknownEnvironmentError
from cavmarl.engine.world_setup import find_map, load_world
from cavmarl.traffic.demand import DemandFile
from tests.support.crossing import CROSSING

TRIPS = '<routes><trip id="a" depart="0" from="w" to="e"/></routes>'
NIGHT = (
    '<additional><tlLogic id="c" type="static" programID="night">'
    '<phase duration="5" state="Grr"/></tlLogic><poly id="p" shape="0,0 1,1"/></additional>'
)
INPUT = '<net value="m.net.xml"/><r value="a%20b.xml"/><additional value="night.add.xml"/>'


@pytest.fixture
def config(tmp_path: Path) -> Path:
    """Write SUMO's configuration of a crossing to a file without a suffix."""
    (tmp_path / "m.net.xml").write_text(CROSSING, encoding="utf-8")
    (tmp_path / "a b.xml").write_text(TRIPS, encoding="utf-8")
    (tmp_path / "night.add.xml").write_text(NIGHT, encoding="utf-8")
    path = tmp_path / "run"
    path.write_text(f"<configuration><input>{INPUT}</input></configuration>", encoding="utf-8")
    return path


def test_a_sumo_configuration_is_accepted_as_an_environment(config: Path) -> None:
    world = load_world(config, agents=1)
    assert (world.network.name, world.config.name) == ("m", "run")
    assert world.network.program_ids == ("0", "night")
    assert isinstance(world.demand, DemandFile)
    assert world.demand.element_ids == ("a",)
    assert world.config.population.background == 0
    assert list(world.demand.report.tolerated) == ["<poly> is not read"]
    assert find_map(config) == config.parent / "m.net.xml"


def test_a_sumo_configuration_is_accepted_as_a_map(config: Path, tmp_path: Path) -> None:
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "env.yaml").write_text("name: mine\nmap: {source: ../run}\n", encoding="utf-8")
    world = load_world(folder, agents=1)
    assert world.network.name == "m"
    assert world.network.program_ids == ("0", "night")
    assert world.demand is None
    again = load_world(folder, agents=1, overrides={"map.programs": ["../night.add.xml"]})
    assert again.network.program_ids == ("0", "night")


def test_a_sumo_configuration_is_accepted_as_demand(config: Path) -> None:
    world = load_world(
        config.parent / "m.net.xml", agents=1, overrides={"traffic.demand": [str(config)]}
    )
    assert isinstance(world.demand, DemandFile)
    assert any("<tlLogic>" in what for what in world.demand.report.tolerated)


def test_a_sumo_configuration_needs_no_demand(config: Path) -> None:
    config.write_text('<configuration><n value="m.net.xml"/></configuration>', encoding="utf-8")
    world = load_world(config, agents=1)
    assert world.demand is None


def test_files_that_are_no_maps_are_refused(config: Path) -> None:
    with pytest.raises(UnknownEnvironmentError, match="root element must be the <configuration>"):
        load_world(config.parent / "a b.xml")
    config.write_text('<configuration><r value="a b.xml"/></configuration>', encoding="utf-8")
    with pytest.raises(MapError, match="names 0 networks under <net-file>"):
        load_world(config)


def test_a_sumo_configuration_with_signal_programs_must_be_the_only_map(config: Path) -> None:
    both = {"map.source": ["run", "m.net.xml"], "traffic.demand": []}
    with pytest.raises(ConfigError, match="must be the only map"):
        load_world(config, agents=1, overrides=both)
