"""The error for each kind of mistake in `env.yaml` has the place, the value and the remedy."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from cavmarl.config.env import EnvConfig
from cavmarl.config.io import MAX_BYTES, MAX_DEPTH, dotted_keys, read_yaml
from cavmarl.config.registry import load_config, resolve_programs
from cavmarl.core.errors import ConfigError, MapError

MINIMAL = "name: mine\nmap: {source: m.net.xml}\n"


def load(folder: Path, text: str | bytes) -> EnvConfig:
    data = text.encode() if isinstance(text, str) else text
    (folder / "env.yaml").write_bytes(data)
    return load_config(folder)[0]


def refusal(folder: Path, text: str | bytes) -> str:
    """Return the error message of a refused file; check that it begins with the file's path."""
    with pytest.raises(ConfigError) as caught:
        load(folder, text)
    message = str(caught.value)
    assert message.startswith(str(folder / "env.yaml"))
    return message


def test_the_shortest_file_has_a_name_and_a_map(tmp_path: Path) -> None:
    config = load(tmp_path, MINIMAL)
    assert (config.name, config.map.source) == ("mine", "m.net.xml")


def test_every_key_can_be_set_and_keeps_its_value(tmp_path: Path) -> None:
    config = load(
        tmp_path,
        MINIMAL
        + """
clock: {sim_dt_s: 1e-2, ctrl_dt_s: .2, control_latency_ticks: 2}
traffic: {origins: [a, b], max_trip_m: 500}
action: {kind: discrete, target_speeds_mps: [0, 5.5, 11]}
terms: {weights: {progress: 1}, team_share: 1}
""",
    )
    assert config.clock.ticks_per_step == 20
    assert config.traffic.origins == ("a", "b")
    assert isinstance(config.traffic.max_trip_m, float)
    assert config.action.target_speeds_mps == (0.0, 5.5, 11.0)
    assert config.terms.weights == {"progress": 1.0}


def test_reading_a_changed_file_again_returns_the_new_content(tmp_path: Path) -> None:
    path = tmp_path / "x.yaml"
    path.write_text("a: [1, 2]")
    first = read_yaml(path)
    assert isinstance(first, dict)
    first["a"].append(3)
    first["b"] = 4
    assert read_yaml(path) == {"a": [1, 2]}
    path.write_text("a: [1, 5]")
    assert read_yaml(path) == {"a": [1, 5]}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("sensor: {}", r"sensor: unknown key; did you mean sensors\?"),
        (
            "sensors: {lidar: {ray: 3}}",
            r"sensors\.lidar\.ray: .* did you mean sensors\.lidar\.rays\?",
        ),
        ("rays: 3", r"rays: unknown key; did you mean sensors\.lidar\.rays\?"),
        (
            "population: {xyz: 3}",
            r"population\.xyz: .*the keys here are: mode, agents, background, budget",
        ),
        ("terms: {weights: {crash: 1}}", r"terms\.weights = 'crash': no such term.*collision"),
    ],
)
def test_the_error_for_an_unknown_key_names_the_nearest_key(
    tmp_path: Path, text: str, expected: str
) -> None:
    assert re.search(expected, refusal(tmp_path, MINIMAL + text))


@pytest.mark.parametrize("key", ["range", "range_km", "range_mm"])
def test_the_error_for_a_wrong_unit_names_the_right_unit(tmp_path: Path, key: str) -> None:
    message = refusal(tmp_path, MINIMAL + f"sensors: {{lidar: {{{key}: 60}}}}")
    assert f"sensors.lidar.{key}: unknown key; use range_m" in message


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("population: {agents: true}", r"population\.agents = True: must be a valid integer"),
        ("population: {agents: '4'}", r"population\.agents = '4': must be a valid integer"),
        ("population: {agents: 4.0}", r"population\.agents = 4\.0: must be a valid integer"),
        ("population: {agents: ~}", r"population\.agents = None: must be a valid integer"),
        ("horizon_s: '60'", r"horizon_s = '60': must be a valid number"),
        ("horizon_s: false", r"horizon_s = False: must be a valid number"),
        ("horizon_s: 1:30", r"horizon_s = '1:30': must be a valid number"),
        ("horizon_s: 2026-11-21", r"horizon_s = '2026-11-21': must be a valid number"),
        ("sensors: {lidar: {speeds: on}}", r"lidar\.speeds = 'on': must be a valid boolean"),
        ("version: [1]", r"version = \[1\]: must be a valid integer"),
        ("clock: 3", r"clock = 3: must be a mapping from keys to values"),
        ("traffic: {origins: a}", r"traffic\.origins = 'a': must be a list"),
        ("population: {mode: ajar}", r"population\.mode = 'ajar': must be 'closed', 'open' or"),
    ],
)
def test_the_error_for_a_wrong_type_names_the_right_type(
    tmp_path: Path, text: str, expected: str
) -> None:
    assert re.search(expected, refusal(tmp_path, MINIMAL + text))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("population: {agents: -4}", r"population\.agents = -4: .*from 0"),
        ("population: {background: -1}", r"population\.background = -1: .*from 0"),
        ("horizon_s: .nan", r"horizon_s = nan: must be a number from"),
        ("horizon_s: .inf", r"horizon_s = inf: must be a number from"),
        ("horizon_s: 1e999", r"horizon_s = inf: must be a number from"),
        ("clock: {sim_dt_s: 0}", r"clock\.sim_dt_s = 0\.0: must be a number from 0\.001"),
        ("clock: {sim_dt_s: -0.05}", r"clock\.sim_dt_s = -0\.05: must be"),
        (
            "clock: {ctrl_dt_s: 0.12}",
            r"clock\.ctrl_dt_s = 0\.12: .*whole number of ticks.*try 0\.1",
        ),
        ("clock: {control_latency_ticks: 99}", r"control_latency_ticks = 99: .*0 to 16"),
        ("sensors: {lidar: {range_m: -1}}", r"sensors\.lidar\.range_m = -1\.0: must be"),
        ("action: {grid_steering: [-0.1, 0.1]}", r"grid_steering = .*including 0"),
        ("action: {grid_throttle: [1, 0]}", r"grid_throttle = .*increasing"),
        ("action: {target_speeds_mps: [3, 2]}", r"target_speeds_mps = .*increasing speeds"),
        ("terms: {weights: {collision: .nan}}", r"terms\.weights\.collision = nan: must be"),
        ("sensors: {stack: 0}", r"sensors\.stack = 0: must be a whole .* 1 to 64"),
        (
            "sensors: {kinematics: {vehicles_count: -1}}",
            r"vehicles_count = -1: must be a whole .* 0",
        ),
        (
            "sensors: {lidar_observation: {cells: 5000}}",
            r"cells = 5000: must be a whole .* 0 to 1024",
        ),
        ("sensors: {lidar_observation: {maximum_range_m: 0}}", r"maximum_range_m = 0\.0: must be"),
    ],
)
def test_the_error_for_a_value_out_of_range_names_the_range(
    tmp_path: Path, text: str, expected: str
) -> None:
    assert re.search(expected, refusal(tmp_path, MINIMAL + text))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("population: {mode: open, agents: 8, budget: 4}", r"budget = 4: must be at least .* 8"),
        ("traffic: {min_trip_m: 500, max_trip_m: 300}", r"max_trip_m = 300\.0: .*above.* 500"),
        ("horizon_s: 0.05", r"horizon_s = 0\.05: must be a number from 0\.1"),
    ],
)
def test_the_error_for_an_impossible_combination_names_a_fix(
    tmp_path: Path, text: str, expected: str
) -> None:
    assert re.search(expected, refusal(tmp_path, MINIMAL + text))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            "kinematics: {features: [presence, speed]}",
            r"kinematics\.features = 'speed': no such feature; must be one of presence, x, y",
        ),
        ("kinematics: {features: []}", r"kinematics\.features = \(\): must name at least one"),
        ("kinematics: {features: [x, x]}", r"kinematics\.features = .*must name each feature once"),
        ("kinematics: {features: [on_road]}", r"kinematics\.features = 'on_road': no such feature"),
        (
            "kinematics: {features_range: {vz: [0, 1]}}",
            r"kinematics\.features_range = 'vz': no such feature",
        ),
        (
            "kinematics: {features_range: {x: [1, 1]}}",
            r"kinematics\.features_range\.x = \(1\.0, 1\.0\): must be finite and increasing",
        ),
        ("kinematics: {order: nearest}", r"kinematics\.order = 'nearest': must be 'sorted' or"),
        ("occupancy_grid: {features: [road]}", r"occupancy_grid\.features = 'road': no such"),
        (
            "occupancy_grid: {grid_size_m: [[-5, 5]]}",
            r"grid_size_m = \(\(-5\.0, 5\.0\),\): must be \[\[min x, max x\], \[min y, max y\]\]",
        ),
        ("occupancy_grid: {grid_size_m: [[5, -5], [-5, 5]]}", r"grid_size_m = .*both increasing"),
        ("occupancy_grid: {grid_step_m: [5]}", r"grid_step_m = \(5\.0,\): must be \[x, y\]"),
        (
            "occupancy_grid: {grid_step_m: [0, 5]}",
            r"grid_step_m = 0\.0: must be a number from 0\.1",
        ),
        ("occupancy_grid: {grid_step_m: [99, 5]}", r"grid_step_m = .*must fit into grid_size_m"),
        (
            "occupancy_grid: {features: [x, y], grid_step_m: [0.1, 0.1]}",
            r"2 layers of 550 by 550 cells are 605000 numbers, more than 65536; use larger",
        ),
        (
            "{ego: {enabled: false}, signal: {enabled: false}, route: {points: 0}, "
            "neighbors: {count: 0}, lidar: {rays: 0}}",
            r"sensors = 'all off': an agent must observe something",
        ),
    ],
)
def test_the_error_for_an_invalid_sensor_gives_the_reason(
    tmp_path: Path, text: str, expected: str
) -> None:
    text = text if text.startswith("{") else f"{{{text}}}"
    assert re.search(expected, refusal(tmp_path, f"{MINIMAL}sensors: {text}"))


def test_the_error_for_a_missing_key_names_the_key(tmp_path: Path) -> None:
    assert "map: missing; this key has no default" in refusal(tmp_path, "name: mine\n")
    assert "map.source = '': must name a map" in refusal(tmp_path, "name: a\nmap: {source: ''}")


def test_all_errors_of_a_file_are_reported_at_once(tmp_path: Path) -> None:
    message = refusal(tmp_path, MINIMAL + "horizon_s: soon\npopulation: {agents: many, cars: 3}")
    assert len(message.splitlines()) == 3


NESTED_BOMB = "a: &a [x]\n" + "".join(
    f"{new}: &{new} [{', '.join([f'*{old}'] * 10)}]\n"
    for old, new in zip("abcdef", "bcdefg", strict=True)
)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("name: [", r"line 1: "),
        ("name: mine\n\tmap: x", r"line 2: .*'\\t'"),
        (MINIMAL + "name: yours", r"line 3: key 'name' is given twice"),
        (
            MINIMAL + "clock: {sim_dt_s: 0.1, sim_dt_s: 0.2}",
            r"line 3: key 'sim_dt_s' is given twice",
        ),
        (NESTED_BOMB, r"line 2: alias \*a: write the value out"),
        ("a: &a [*a]", r"line 1: alias \*a"),
        ("name: !!python/object/apply:os.getcwd []", r"line 1: tag .*os\.getcwd: write the plain"),
        ("[" * 5000, rf"line 1: nested more than {MAX_DEPTH} deep"),
        ("? [a]\n: b", r"line 1: a key must be a name"),
        ("", r"must be a mapping from keys to values, not None"),
        ("- name", r"must be a mapping from keys to values, not \['name'\]"),
        ("name: a\n---\nname: b", r"expected a single document|but found another document"),
        (b"name: \xff", r"not UTF-8 at byte 6"),
        ("name: \x00", r"special characters are not allowed"),
        ("#" * (MAX_BYTES + 1), r"larger than 64 KiB"),
    ],
    ids=lambda value: repr(value[:24]),
)
def test_a_file_that_is_not_plain_yaml_is_refused(
    tmp_path: Path, text: str | bytes, expected: str
) -> None:
    assert re.search(expected, refusal(tmp_path, text))


def test_the_error_for_an_unreadable_file_gives_the_reason(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"absent\.yaml: No such file"):
        read_yaml(tmp_path / "absent.yaml")


@pytest.mark.parametrize("key", dotted_keys(EnvConfig))
def test_every_key_can_be_overridden(key: str) -> None:
    with pytest.raises(ConfigError, match=rf"{re.escape(key)}.*( = |unknown key)"):
        load_config("ring", overrides={key: [{"no": "such value"}]})


def test_overrides_are_checked_like_the_file() -> None:
    with pytest.raises(
        ConfigError, match=r"sensors\.lidar\.ray: .*did you mean sensors\.lidar\.rays"
    ):
        load_config("ring", overrides={"sensors.lidar.ray": 3})
    with pytest.raises(ConfigError, match=r"population\.agents = True"):
        load_config("ring", agents=True)
    with pytest.raises(ConfigError, match=r"zones\.count = 0: must be .* from 1 to 256"):
        load_config("ring", zones=0)


@pytest.mark.parametrize("layout", ["grid", "strips", "bisection", "zones.json", "mine/zones.yaml"])
def test_the_layout_of_zones_is_a_name_or_a_file(tmp_path: Path, layout: str) -> None:
    config = load(tmp_path, f"name: a\nmap: {{source: m.net.xml}}\nzones: {{layout: {layout}}}")
    assert config.zones.layout == layout


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("layout", "rings"),
        ("count", 257),
        ("weight", "speeding"),
        ("avoid_junctions", 1),
        ("hysteresis_m", -1.0),
        ("hysteresis_m", float("nan")),
        ("max_deferred_ticks", -1),
        ("max_deferred_ticks", 2.5),
        ("approach_ticks", 0),
        ("backoff_ticks", 1001),
        ("halo_m", -1.0),
        ("halo_m", float("inf")),
        ("check_invariants", 1),
        ("journal", 3),
    ],
)
def test_invalid_settings_of_zones_are_refused(key: str, value: object) -> None:
    with pytest.raises(ConfigError, match=rf"zones\.{key} = "):
        load_config("ring", overrides={f"zones.{key}": value})


def test_signal_programs_can_be_set_and_missing_files_are_refused(tmp_path: Path) -> None:
    config = load(
        tmp_path, "name: a\nmap: {source: m.net.xml, programs: [p.add.xml], program: {j: night}}"
    )
    assert (config.map.programs, config.map.program) == (("p.add.xml",), {"j": "night"})
    with pytest.raises(MapError, match=r"map\.programs = 'p\.add\.xml': no file"):
        resolve_programs(config, tmp_path)
