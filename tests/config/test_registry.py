"""Search for environments by name, path or map file, and for their maps."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from cavmarl.config import registry
from cavmarl.config.registry import (
    MAP_SUFFIXES,
    agent_entries,
    entries,
    find_entry,
    load_config,
    resolve_map,
)
from cavmarl.core.errors import ConfigError, MapError, MissingExtraError, UnknownEnvironmentError

ENVS = Path(__file__).resolve().parents[2] / "envs"


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Change to an empty folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def make_entry(folder: Path, text: str = "name: mine\nmap: {source: m.net.xml}\n") -> Path:
    folder.mkdir(parents=True)
    (folder / "env.yaml").write_text(text)
    return folder


def test_the_registry_has_the_folders_of_envs(here: Path) -> None:
    on_disk = {path.parent.name: path.parent for path in sorted(ENVS.glob("*/env.yaml"))}
    assert entries() == on_disk
    assert {"ring", "merge", "grid4x4", "town"} <= on_disk.keys()


def test_an_entry_of_the_working_directory_is_found_and_comes_first(here: Path) -> None:
    mine = make_entry(here / "envs" / "my_city")
    ring = make_entry(here / "envs" / "ring")
    assert find_entry("my_city") == mine
    assert find_entry("ring") == ring
    assert find_entry("town") == ENVS / "town"


def test_an_installed_package_finds_only_its_own_entries(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    packaged = make_entry(here / "site" / "cavmarl" / "data" / "envs" / "packaged")
    make_entry(here / "site" / "envs" / "beside")
    monkeypatch.setattr(registry, "PACKAGE", here / "site" / "cavmarl")
    assert entries() == {"packaged": packaged}


def test_any_folder_with_an_env_yaml_is_an_entry(here: Path) -> None:
    folder = make_entry(here / "somewhere")
    for env in (folder, str(folder), "somewhere", Path("somewhere")):
        config, base_dir = load_config(env)
        assert config.name == "mine"
        assert base_dir.samefile(folder)


@pytest.mark.parametrize("suffix", MAP_SUFFIXES)
def test_a_bare_map_file_gets_a_default_environment(here: Path, suffix: str) -> None:
    path = here / f"some.city{suffix}"
    path.touch()
    config, base_dir = load_config(path, agents=7)
    assert (config.name, config.population.agents) == ("some.city", 7)
    assert resolve_map(config, base_dir) == path


def test_the_error_for_an_unknown_name_lists_the_nearest_name_and_all_names(here: Path) -> None:
    with pytest.raises(UnknownEnvironmentError, match=r"'twon'; did you mean town\?") as told:
        load_config("twon")
    assert str(told.value).split("Environments: ")[1].split(", ") == sorted(entries())


def test_the_error_for_a_file_that_is_not_a_map_names_map_files(here: Path) -> None:
    (here / "city.png").touch()
    with pytest.raises(UnknownEnvironmentError, match=r"city\.png: not a map file.*\.net\.xml"):
        load_config("city.png")


def test_the_error_for_a_folder_without_an_entry_names_the_missing_file(here: Path) -> None:
    (here / "empty").mkdir()
    with pytest.raises(UnknownEnvironmentError, match=r"empty: a folder without env\.yaml"):
        load_config("empty")


def test_keywords_and_overrides_replace_values_of_the_entry() -> None:
    plain, _ = load_config("ring")
    config, _ = load_config(
        "ring", zones=1, agents=3, background=0, overrides={"sensors.lidar.rays": 16}
    )
    assert (config.population.agents, config.population.background) == (3, 0)
    assert config.sensors.lidar.rays == 16
    assert config.sensors.lidar.range_m == plain.sensors.lidar.range_m


def test_an_override_of_one_weight_keeps_the_other_weights() -> None:
    plain, _ = load_config("ring")
    config, _ = load_config("ring", overrides={"terms.weights.collision": -3})
    assert config.terms.weights == {**plain.terms.weights, "collision": -3.0}


@pytest.mark.parametrize("ctrl_dt_s", [0.05, 0.1, 0.15, 0.7])
@pytest.mark.parametrize("max_cycles", [1, 7, 333])
def test_an_episode_has_exactly_max_cycles_steps(ctrl_dt_s: float, max_cycles: int) -> None:
    overrides = {"clock.ctrl_dt_s": ctrl_dt_s}
    config, _ = load_config("ring", max_cycles=max_cycles, overrides=overrides)
    assert config.max_steps == max_cycles


@pytest.mark.parametrize("max_cycles", [0, -1, True, 2.0, "3"])
def test_max_cycles_that_is_not_a_positive_integer_is_refused(max_cycles: object) -> None:
    with pytest.raises(ConfigError, match=r"max_cycles = .*whole number, at least 1"):
        load_config("ring", max_cycles=max_cycles)  # type: ignore[arg-type]


def test_a_key_that_is_given_twice_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"population\.agents is given in overrides"):
        load_config("ring", agents=3, overrides={"population.agents": 4})
    with pytest.raises(ConfigError, match=r"horizon_s is given in overrides"):
        load_config("ring", max_cycles=3, overrides={"horizon_s": 4})


def test_an_override_of_a_key_inside_a_value_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"horizon_s\.minutes: horizon_s has no keys inside"):
        load_config("ring", overrides={"horizon_s.minutes": 1})


def test_a_relative_path_of_a_map_is_relative_to_the_entry(here: Path) -> None:
    shutil.copytree(ENVS / "ring", here / "copied")
    assert resolve_map(*load_config("copied")).samefile(here / "copied" / "map" / "map.net.xml")


def test_an_absolute_path_of_a_map_does_not_depend_on_the_entry(here: Path) -> None:
    source = str(ENVS / "ring" / "map" / "map.net.xml")
    config, base_dir = load_config("ring", overrides={"map.source": source})
    assert resolve_map(config, base_dir / "elsewhere") == Path(source)


@pytest.mark.parametrize("source", ["nowhere.net.xml", "/nowhere.net.xml"])
def test_the_error_for_a_missing_map_names_the_map(source: str) -> None:
    config, base_dir = load_config("ring", overrides={"map.source": source})
    with pytest.raises(MapError, match=rf"map\.source = '{source}': no file"):
        resolve_map(config, base_dir)


@pytest.mark.parametrize("source", ["sumo:tools/game/nowhere.net.xml", "sumo:../pip/__init__.py"])
def test_the_error_names_a_map_that_is_missing_from_sumos_wheel(source: str) -> None:
    pytest.importorskip("sumo")
    config, base_dir = load_config("town", overrides={"map.source": source})
    with pytest.raises(MapError, match=r"map\.source = 'sumo:"):
        resolve_map(config, base_dir)


def test_the_error_without_sumos_wheel_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(module: str) -> None:
        raise ModuleNotFoundError(name=module)

    town = load_config("town")  # before imports fail
    monkeypatch.setattr("cavmarl.core.errors.importlib.import_module", absent)
    with pytest.raises(MissingExtraError, match=r"pip install .*\[sumo\]'"):
        resolve_map(*town)


def test_agents_are_single_files_and_folders_with_weights(here: Path) -> None:
    place = here / "agents"
    for name in ("cruise.py", "_shared.py", "notes.md", "mine/model.safetensors", "half/README.md"):
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        (place / name).touch()
    found = {name: path for name, path in agent_entries().items() if path.is_relative_to(here)}
    assert found == {"mine": place / "mine"}, "a script of the working directory is listed"
    assert {"idm", "merge_ippo"} <= agent_entries().keys()


@pytest.mark.parametrize("written", ["play.py", "play.py/", "play.py/.", "./play.py//"])
def test_an_env_yaml_that_names_code_is_refused(here: Path, written: str) -> None:
    name = f"cool/{written}"
    entry = make_entry(
        here / "mine", f"name: mine\nmap: {{source: m.net.xml}}\nscenario: {{name: {name}}}\n"
    )
    with pytest.raises(ConfigError, match=r"mine/env\.yaml: scenario\.name.*is code.*overrides"):
        load_config(entry)
    config, _ = load_config("ring", overrides={"scenario.name": "cool/play.py"})
    assert config.scenario.name == "cool/play.py", "an override may name code"


def test_searching_environments_does_not_import_pydantic() -> None:
    code = "import sys; from cavmarl.config.registry import *"
    code += "; entries(); print('pydantic' in sys.modules)"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "False"
