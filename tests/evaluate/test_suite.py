"""Suites: their maps and worlds, and the files that are refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from cavmarl.config.registry import find_settings
from cavmarl.core.errors import ConfigError
from cavmarl.evaluate import load_report
from cavmarl.evaluate.suite import load_suite, run_suite, worlds_of

ROOT = Path(__file__).resolve().parents[2]


def test_the_standard_suite_has_its_maps_and_numbers_of_agents() -> None:
    suite = load_suite(find_settings("suite", "standard"))
    assert len(suite.maps) >= 4
    assert suite.agents == (1, 25, 50, 100)


def test_the_maps_of_the_suite_exist_and_each_world_has_its_own_name(shared_maps: Path) -> None:
    suite = load_suite(find_settings("suite", "standard"))
    labels = [world.label for world in worlds_of(suite, shared_maps)]
    assert len(set(labels)) == len(suite.maps) * len(suite.agents)


def test_every_map_is_driven_with_every_number_of_agents(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(
        "maps: [ring, merge/map/map.net.xml]\nagents: [1, 2]\nbackground: 2\nhorizon_s: 2\n"
    )
    suite = load_suite(find_settings("suite", str(file)))
    worlds = worlds_of(suite, ROOT / "envs")
    begun: list[str] = []
    reports = run_suite(
        suite,
        worlds,
        ["idm"],
        tmp_path / "out",
        episodes=1,
        repeats=1,
        seed=0,
        began=lambda world: begun.append(world.label),
    )
    assert begun == list(reports) == ["ring-1", "ring-2", "map-1", "map-2"]
    for world in worlds:
        population = reports[world.label].manifest["world"]["config"]["population"]
        assert population["agents"] == world.agents
        assert load_report(tmp_path / "out" / world.label) == reports[world.label]


def test_two_maps_with_the_same_name_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text("maps: [merge/map/map.net.xml, ring/map/map.net.xml]\nagents: [1]\n")
    with pytest.raises(ConfigError, match="two maps have the same name"):
        worlds_of(load_suite(file), ROOT / "envs")


def test_a_file_with_the_name_of_an_environment_keeps_its_suffix(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text("maps: [merge, ring]\nmore_maps: [ring.net.xml]\n")
    (tmp_path / "ring.net.xml").write_bytes((ROOT / "envs/ring/map/map.net.xml").read_bytes())
    found = worlds_of(load_suite(file), tmp_path)
    assert [world.label for world in found] == ["merge", "ring", "ring.net.xml"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("maps: []\nagents: [1]", "maps = "),
        ("maps: [ring, ring]\nagents: [1]", "contain a value twice"),
        ("maps: [ring]\nagents: []", "agents = "),
        ("maps: [ring]\nagents: [1]\nmap: x", "map: unknown key"),
        ("maps: ring", "maps"),
    ],
)
def test_an_invalid_suite_is_refused(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "bad.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=message):
        load_suite(file)


def test_the_suite_of_tasks_overrides_no_settings_of_its_environments() -> None:
    suite = load_suite(find_settings("suite", "tasks"))
    worlds = worlds_of(suite, ROOT / "envs")
    assert [world.env for world in worlds] == list(suite.maps)
    assert {world.agents for world in worlds} == {None}
    assert suite.background is None
    assert suite.horizon_s is None
