"""Training runs that begin with the weights of a driver (warm start)."""

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


def config_of(sensors: SensorsConfig, form: dict[str, int], seed: int) -> NetworkConfig:
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
    """Convert networks to float64, in which sums in another order differ little."""
    for network in networks:
        network.double()


def feature_places(sensors: SensorsConfig) -> list[tuple[int, str, str]]:
    """Return the name of each observed number, with its frame (-1 is the newest)."""
    frames = range(-sensors.stack, 0)
    return [(frame, *name) for frame in frames for name in feature_names(sensors)]


@pytest.mark.parametrize("form", FORMS, ids=str)
def test_a_warm_start_with_more_sensors_acts_like_the_driver(
    form: dict[str, int], tmp_path: Path
) -> None:
    its, ours = config_of(FEWER, form, 1), config_of(MORE, form, 2)
    driver, run = network(its), network(ours)
    save_network(tmp_path, driver, its)
    assert begin_with(run, ours, tmp_path) == 7
    in_double_precision(driver, run)
    more = torch.randn(16, ours.observation_size, dtype=torch.float64)
    more[0] = 0.0  # the mean of numbers that the driver does not observe
    places = {name: k for k, name in enumerate(feature_places(MORE))}
    columns = [places[name] for name in feature_places(FEWER)]
    if "residual" in form:
        columns += [ours.observation_size - 2, ours.observation_size - 1]
    states = torch.randn(16, its.state_size, dtype=torch.float64) if its.state_size else None
    torch.testing.assert_close(run(more), driver(more[:, columns]))
    torch.testing.assert_close(run.value(more, states), driver.value(more[:, columns], states))


def test_a_warm_start_with_equal_sensors_has_equal_weights(tmp_path: Path) -> None:
    its = config_of(FEWER, {}, 1)
    driver, run = network(its), network(replace(its, seed=2))
    save_network(tmp_path, driver, its)
    begin_with(run, replace(its, seed=2), tmp_path)
    for name, tensor in driver.state_dict().items():
        assert run.state_dict()[name].equal(tensor), name


@pytest.mark.parametrize("form", FORMS, ids=str)
def test_a_warm_start_with_fewer_sensors_logs_the_missing_numbers(
    form: dict[str, int], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    its, ours = config_of(MORE, form, 1), config_of(FEWER, form, 2)
    driver, run = network(its), network(ours)
    save_network(tmp_path, driver, its)
    begin_with(run, ours, tmp_path)
    in_double_precision(driver, run)
    fewer = torch.randn(16, ours.observation_size, dtype=torch.float64)
    seen = driver.mean.repeat(16, 1)  # numbers that only the driver observes
    places = {name: k for k, name in enumerate(feature_places(MORE))}
    columns = [places[name] for name in feature_places(FEWER)]
    if "residual" in form:
        columns += [its.observation_size - 2, its.observation_size - 1]
    seen[:, columns] = fewer
    states = torch.randn(16, its.state_size, dtype=torch.float64) if its.state_size else None
    torch.testing.assert_close(run(fewer), driver(seen))
    torch.testing.assert_close(run.value(fewer, states), driver.value(seen, states))
    assert (
        f"observes {len(feature_places(MORE)) - len(feature_places(FEWER))} numbers that this"
        in caplog.text
    )


def test_a_driver_with_another_network_is_refused(tmp_path: Path) -> None:
    its, ours = config_of(FEWER, {}, 1), config_of(MORE, {"shared": True}, 2)
    save_network(tmp_path, network(its), its)
    with pytest.raises(PolicyError, match="does not fit this run"):
        begin_with(network(ours), ours, tmp_path)
