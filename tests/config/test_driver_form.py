"""The form of a trained driver: its settings of sensors and actions."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict
from operator import attrgetter
from pathlib import Path
from typing import Any

import pytest

from cavmarl.config.action import ActionConfig
from cavmarl.config.driver_form import (
    Form,
    common_form,
    differing_keys,
    form_of,
    form_of_driver,
    forms_in,
    read_form,
    with_form,
    with_sensors_of,
)
from cavmarl.config.driver_names import drivers_in, find_driver, name_of_driver
from cavmarl.config.io import dotted_keys
from cavmarl.config.registry import agent_entries, load_config
from cavmarl.config.sensors import SensorsConfig
from cavmarl.config.world_spec import WorldSpec, with_sensors_of_drivers
from cavmarl.core.errors import ConfigError, PolicyError

TRAINED = {name: path for name, path in agent_entries().items() if path.is_dir()}


def plain(value: Any) -> Any:
    return json.loads(json.dumps(value))


@pytest.mark.parametrize("name", TRAINED)
def test_the_form_of_a_trained_driver_equals_its_file(name: str) -> None:
    raw = json.loads((TRAINED[name] / "config.json").read_text())
    defaults = {"sensors": asdict(SensorsConfig()), "action": asdict(ActionConfig())}
    form = form_of_driver(name)
    assert {key for key in form if key.startswith("sensors.")} == {
        f"sensors.{key}" for key in dotted_keys(SensorsConfig)
    }
    assert form["action.kind"] == raw["action"]["kind"]
    switches = {part: own.switches for part, own in SensorsConfig().sections().items()}
    for key, value in form.items():
        section = key.split(".")[1]
        if section in switches and not any(
            form[f"sensors.{section}.{s}"] for s in switches[section]
        ):
            continue  # the sensor is off, so this key has no effect
        found: Any = raw
        default: Any = defaults
        for part in key.split("."):
            default = default[part]
            found = found.get(part, plain(default)) if isinstance(found, dict) else found
        assert plain(value) == found, key


@pytest.mark.parametrize("name", TRAINED)
def test_an_environment_with_the_form_of_a_driver_differs_in_no_key(name: str) -> None:
    home = json.loads((TRAINED[name] / "config.json").read_text())["environment"]
    form = form_of_driver(name)
    config, _ = load_config(home, overrides=with_sensors_of(None, name))
    assert differing_keys(form, config) == {}
    assert form_of(config.sensors, config.action) == form


def test_a_form_has_the_keys_of_its_kind_of_action() -> None:
    sensors = SensorsConfig()
    kinds = {
        kind: {
            key.removeprefix("action.")
            for key in form_of(sensors, ActionConfig(kind=kind))
            if key.startswith("action.")
        }
        for kind in ("continuous", "discrete", "grid")
    }
    scales = {"acceleration_mps2", "steering_rad"}
    assert kinds["continuous"] == {"kind", *scales}
    assert kinds["discrete"] == {"kind", "target_speeds_mps"}
    assert kinds["grid"] == {"kind", *scales, "grid_throttle", "grid_steering"}


def test_the_form_of_a_shared_or_shielded_policy_is_that_of_its_driver() -> None:
    assert drivers_in("merge_ippo+shielded:idm+blind") == ["merge_ippo", "idm", "blind"]
    assert list(forms_in(["idm+merge_ippo", "shielded:merge_ippo"])) == ["merge_ippo"]
    assert form_of_driver("shielded:merge_ippo+idm") == form_of_driver("merge_ippo")


def test_drivers_with_equal_forms_have_a_common_form() -> None:
    forms = forms_in(["cities_ippo", "cities_residual", "idm"])
    assert common_form(forms) == form_of_driver("cities_ippo")


def test_the_error_for_different_forms_names_the_keys() -> None:
    with pytest.raises(PolicyError) as caught:
        common_form(forms_in(["cities_residual", "merge_ippo"]))
    said = str(caught.value)
    assert said.startswith("The drivers cities_residual, merge_ippo need different sensors")
    assert "sensors.history.steps is 3 for cities_residual, 0 for merge_ippo" in said
    assert said.endswith("Run each of these drivers in a separate run")
    with pytest.raises(PolicyError, match="need different sensors"):
        form_of_driver("cities_residual+merge_ippo")


@pytest.mark.parametrize("name", ["idm", "idm+random_actions", "shielded:never_yield"])
def test_scripts_have_no_form(name: str) -> None:
    with pytest.raises(PolicyError, match=r"is a script.*an environment can copy.*cities_residual"):
        form_of_driver(name)


def test_the_error_for_an_unknown_driver_names_the_nearest() -> None:
    with pytest.raises(PolicyError, match="'cities_residul'; did you mean cities_residual"):
        with_sensors_of({}, "cities_residul")


@pytest.mark.parametrize("text", [None, "", "[]", "{}", '{"sensors": 3, "action": {}}'])
def test_the_error_for_an_incomplete_driver_names_the_file(
    tmp_path: Path, text: str | None
) -> None:
    with pytest.raises(PolicyError, match=r"no model\.safetensors in"):
        read_form(tmp_path)
    (tmp_path / "model.safetensors").touch()
    if text is not None:
        (tmp_path / "config.json").write_text(text)
    with pytest.raises(PolicyError, match=r"config\.json"):
        read_form(tmp_path)


def test_messages_use_the_shortest_name_of_a_driver(tmp_path: Path) -> None:
    copy = Path(shutil.copytree(TRAINED["merge_ippo"], tmp_path / "merge_ippo"))
    for path, name in ((TRAINED["merge_ippo"], "merge_ippo"), (copy, str(copy))):
        assert name_of_driver(path) == name
        assert find_driver(name) == path


FORM: Form = {
    "sensors.lidar.rays": 0,
    "sensors.way.distances_m": (3.0, 7.0),
    "sensors.kinematics.features_range": {},
}


@pytest.mark.parametrize(
    "overrides",
    [
        {"sensors.lidar.rays": 4},
        {"sensors.lidar": {"rays": 4}},
        {"sensors": {"lidar": {"rays": 4}}},
        {"sensors.way.distances_m": [3.0]},
        {"sensors.kinematics.features_range.x": [0.0, 1.0]},
    ],
)
def test_overrides_that_contradict_a_form_are_refused(overrides: dict[str, Any]) -> None:
    with pytest.raises(ConfigError) as caught:
        with_form(overrides, FORM, "mine")
    said = str(caught.value)
    assert "in the overrides" in said
    assert "for mine" in said
    assert "Leave out the overrides" in said


@pytest.mark.parametrize(
    "overrides",
    [
        None,
        {},
        {"sensors.lidar.rays": 0, "horizon_s": 4.0},
        {"sensors.way.distances_m": [3, 7]},
        {"sensors.lidar": {"rays": 0, "range_m": 9.0}},
        {"action.out_of_range": "clip"},
    ],
)
def test_overrides_that_agree_with_a_form_are_kept(overrides: dict[str, Any] | None) -> None:
    before = None if overrides is None else dict(overrides)
    assert with_form(overrides, FORM, "mine") == {**(overrides or {}), **FORM}
    assert overrides == before


def test_the_form_is_added_to_an_overridden_section() -> None:
    overrides = {"sensors": {"lidar": {"range_m": 60.0}}}
    given = with_sensors_of(overrides, "merge_ippo")
    config, _ = load_config("ring", overrides=given)
    assert differing_keys(form_of_driver("merge_ippo"), config) == {}
    assert overrides == {"sensors": {"lidar": {"range_m": 60.0}}}


@pytest.mark.parametrize("overrides", [3, "sensors.lidar.rays=3"])
def test_overrides_that_are_not_a_mapping_are_refused(overrides: Any) -> None:
    with pytest.raises(ConfigError, match="must map dotted keys to values"):
        with_sensors_of(overrides, "merge_ippo")


def test_a_world_spec_stores_the_form_of_a_driver_as_overrides() -> None:
    spec = WorldSpec.of("ring", sensors_of="cities_residual", overrides={"horizon_s": 3.0})
    assert spec.overrides == {"horizon_s": 3.0, **form_of_driver("cities_residual")}
    assert WorldSpec(**json.loads(json.dumps(asdict(spec)))).env == "ring"


def test_a_world_gets_and_logs_the_sensors_of_its_drivers(
    capsys: pytest.CaptureFixture[str],
) -> None:
    spec = WorldSpec.of("ring", agents=2)
    fitted = with_sensors_of_drivers(spec, ["idm", "cities_residual+idm", "cities_ippo"])
    config, _ = load_config(fitted.env, **fitted.keywords)
    form = form_of_driver("cities_residual")
    assert differing_keys(form, config) == {}
    (line,) = capsys.readouterr().err.splitlines()
    assert "ring gets the sensors and actions of cities_residual, cities_ippo" in line
    for name in attrgetter("sensors.history.steps", "sensors.conflicts.count")(config):
        assert name > 0
    assert with_sensors_of_drivers(fitted, ["cities_residual"]) is fitted
    assert with_sensors_of_drivers(spec, ["idm", "random_actions"]) is spec
    assert capsys.readouterr().err == ""


def test_a_world_whose_overrides_contradict_the_driver_is_refused() -> None:
    spec = WorldSpec.of("ring", overrides={"sensors.route.points": 8})
    with pytest.raises(ConfigError, match=r"sensors\.route\.points is 8 in the overrides, 0 for"):
        with_sensors_of_drivers(spec, ["cities_residual"])
