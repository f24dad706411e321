"""A run that begins with a driver's weights acts like the driver, also with further sensors."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from cavmarl.config.action import ActionConfig
from cavmarl.config.sensors import ConflictsConfig, HistoryConfig, SensorsConfig
from cavmarl.core.errors import PolicyError
from cavmarl.learning.actor_critic import ActorCritic, save_network
from cavmarl.learning.warm_start import begin_with
from cavmarl.networks.network_files import NetworkConfig
from cavmarl.sensors.observed import feature_names

FEWER = SensorsConfig(stack=2, conflicts=ConflictsConfig(count=2), history=HistoryConfig(steps=1))
MORE = SensorsConfig(
    stack=3, conflicts=ConflictsConfig(count=3, indicators=True), history=HistoryConfig(steps=2)
)
FORMS = ({"shared": True}, {"residual": True}, {"state_size": 4})


def made(sensors: SensorsConfig, form: dict[str, int], seed: int) -> NetworkConfig:
    size = sensors.stack * len(feature_names(sensors)) + (2 if "residual" in form else 0)
    config = NetworkConfig("merge", size, sensors, ActionConfig(), (8, 8), agent_steps=7)
    return replace(config, seed=seed, **form)


def network(config: NetworkConfig) -> ActorCritic:
    torch.manual_seed(config.seed)
    made = ActorCritic(config)
    with torch.no_grad():
        for weights in (*made.parameters(), made.mean):
            weights.normal_()
        made.deviation.uniform_(0.5, 2.0)
    return made


def in_double_precision(*networks: ActorCritic) -> None:
    """Let sums in another order differ by less than the tolerance."""
    for network in networks:
        network.double()


def named(sensors: SensorsConfig) -> list[tuple[int, str, str]]:
    """Name the observed numbers; the newest frame is the last."""
    frames = range(-sensors.stack, 0)
    return [(frame, *name) for frame in frames for name in feature_names(sensors)]


@pytest.mark.parametrize("form", FORMS, ids=str)
def test_a_warm_start_has_the_actions_and_values_of_the_driver(
    form: dict[str, int], tmp_path: Path
) -> None:
    its, ours = made(FEWER, form, 1), made(MORE, form, 2)
    driver, run = network(its), network(ours)
    save_network(tmp_path, driver, its)
    assert begin_with(run, ours, tmp_path) == 7
    in_double_precision(driver, run)
    more = torch.randn(16, ours.observation_size, dtype=torch.float64)
    more[0] = 0.0  # equal to the mean of the numbers that the driver does not observe
    places = {name: k for k, name in enumerate(named(MORE))}
    columns = [places[name] for name in named(FEWER)]
    if "residual" in form:
        columns += [ours.observation_size - 2, ours.observation_size - 1]
    states = torch.randn(16, its.state_size, dtype=torch.float64) if its.state_size else None
    torch.testing.assert_close(run(more), driver(more[:, columns]))
    torch.testing.assert_close(run.value(more, states), driver.value(more[:, columns], states))


def test_with_the_same_sensors_the_weights_are_the_same(tmp_path: Path) -> None:
    its = made(FEWER, {}, 1)
    driver, run = network(its), network(replace(its, seed=2))
    save_network(tmp_path, driver, its)
    begin_with(run, replace(its, seed=2), tmp_path)
    for name, tensor in driver.state_dict().items():
        assert run.state_dict()[name].equal(tensor), name


@pytest.mark.parametrize("form", FORMS, ids=str)
def test_observations_that_the_run_does_not_have_are_left_out_and_counted(
    form: dict[str, int], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    its, ours = made(MORE, form, 1), made(FEWER, form, 2)
    driver, run = network(its), network(ours)
    save_network(tmp_path, driver, its)
    begin_with(run, ours, tmp_path)
    in_double_precision(driver, run)
    fewer = torch.randn(16, ours.observation_size, dtype=torch.float64)
    seen = driver.mean.repeat(16, 1)  # numbers that the run does not observe equal their mean
    places = {name: k for k, name in enumerate(named(MORE))}
    columns = [places[name] for name in named(FEWER)]
    if "residual" in form:
        columns += [its.observation_size - 2, its.observation_size - 1]
    seen[:, columns] = fewer
    states = torch.randn(16, its.state_size, dtype=torch.float64) if its.state_size else None
    torch.testing.assert_close(run(fewer), driver(seen))
    torch.testing.assert_close(run.value(fewer, states), driver.value(seen, states))
    assert f"observes {len(named(MORE)) - len(named(FEWER))} numbers that this" in caplog.text


def test_a_driver_with_another_network_is_refused(tmp_path: Path) -> None:
    its, ours = made(FEWER, {}, 1), made(MORE, {"shared": True}, 2)
    save_network(tmp_path, network(its), its)
    with pytest.raises(PolicyError, match="does not fit this run"):
        begin_with(network(ours), ours, tmp_path)
