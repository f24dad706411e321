"""`sensors_of` makes environments with the sensors and actions of a trained driver."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl.adapters.gymnasium_env import CavEgoEnv
from cavmarl.core.errors import ConfigError, PolicyError
from cavmarl.env.parallel import parallel_env
from cavmarl.env.vector import CavVectorEnv, make_vec
from cavmarl.policies.loading import driver_keys, load_policy

SMALL: dict[str, Any] = {"agents": 2, "background": 2}


@pytest.mark.parametrize("name", ["cities_residual", "u_turn_ippo"])
def test_a_trained_driver_drives_in_an_environment_with_its_sensors(name: str) -> None:
    pytest.importorskip("torch")
    one = parallel_env("merge", sensors_of=name, **SMALL)
    driver = load_policy(name, one)
    seen, _ = one.reset(seed=1)
    one.step(driver.act(seen))
    vec = make_vec("merge", sensors_of=name, **SMALL)
    observations, infos = vec.reset(seed=1)
    vec.step(load_policy(name, vec).act_batch(observations, infos["mask"]))
    by_overrides = make_vec("merge", overrides=driver_keys(name), **SMALL)
    assert by_overrides.config == vec.config == one.config


def test_the_refusal_of_a_driver_names_the_remedy() -> None:
    pytest.importorskip("torch")
    with pytest.raises(PolicyError) as caught:
        load_policy("cities_residual", make_vec("merge", **SMALL))
    said = str(caught.value)
    assert said.startswith("The policy cities_residual expects different sensors and actions than")
    assert "Add --sensors-of cities_residual" in said
    assert "sensors_of='cities_residual' in Python" in said


@pytest.mark.parametrize("make", [parallel_env, make_vec])
def test_overrides_that_contradict_the_driver_are_refused(make: Any) -> None:
    with pytest.raises(ConfigError, match=r"sensors\.lidar\.rays is 8 in the overrides, 0 for"):
        make("merge", sensors_of="merge_ippo", overrides={"sensors.lidar.rays": 8})
    with pytest.raises(PolicyError, match="did you mean merge_ippo"):
        make("merge", sensors_of="merge_ipo")
    with pytest.raises(PolicyError, match="'idm' is a script"):
        make("merge", sensors_of="idm")


def test_adapters_accept_sensors_of() -> None:
    ego = CavEgoEnv("ring", sensors_of="merge_ippo")
    lenient = parallel_env("ring", sensors_of="merge_ippo", lenient=True, **SMALL)
    (size,) = make_vec("merge").single_observation_space.shape
    assert ego.observation_space.shape == lenient.observation_space("car_0").shape == (size,)
    assert lenient.config.action.out_of_range == "clip"


def test_observations_with_sensors_of_do_not_depend_on_workers() -> None:
    def rows(vec: CavVectorEnv) -> list[bytes]:
        found = [vec.reset(seed=3)[0].tobytes()]
        for _ in range(3):
            actions = np.zeros(vec.action_space.shape, dtype=np.float32)
            found.append(vec.step(actions)[0].tobytes())
        vec.close()
        return found

    here, there = (
        rows(make_vec("merge", num_envs=2, sensors_of="cities_residual", workers=workers, **SMALL))
        for workers in (0, 2)
    )
    assert here == there


def test_sensors_of_loads_no_torch(tmp_path: Path) -> None:
    code = (
        "import sys; from cavmarl import make_vec; "
        "make_vec('merge', sensors_of='cities_residual'); print('torch' in sys.modules)"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "False"
