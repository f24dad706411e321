"""Choose nodes of a Ray cluster for actors; report missing clusters."""

from __future__ import annotations

import pytest

from cavmarl import ConfigError, make_vec
from cavmarl.balance.load_score import Utilisation
from cavmarl.core.errors import MissingExtraError, NoAdmissibleWorkerError
from cavmarl.parallel.network.ray_cluster import Node, choose_nodes

IDLE = Utilisation(0.0, 0.0)


def test_actors_are_placed_on_idle_nodes_in_turn() -> None:
    known = [Node("a", 2, IDLE), Node("b", 4, IDLE)]
    assert choose_nodes(known, 5) == ["a", "b", "a", "b", "b"]


def test_actors_are_placed_on_nodes_with_the_lowest_load() -> None:
    known = [Node("a", 2, Utilisation(0.5, 0.1)), Node("b", 2, Utilisation(0.2, 0.1))]
    assert choose_nodes(known, 3) == ["b", "b", "a"]


def test_busy_nodes_get_no_actor() -> None:
    known = [Node("a", 2, Utilisation(0.9, 0.1)), Node("b", 1, IDLE)]
    assert choose_nodes(known, 1) == ["b"]
    with pytest.raises(NoAdmissibleWorkerError, match=r"worker 0: cpu 0\.9"):
        choose_nodes(known, 2)


def test_more_workers_than_cpus_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"backend = 'ray:4'.*3 free CPUs on 2 nodes.*ray start"):
        choose_nodes([Node("a", 2, IDLE), Node("b", 1, IDLE)], 4)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"backend": "ray:3", "num_envs": 2}, "nodes = 3: a world of 1 zone"),
        ({"backend": "ray:5", "zones": 4}, "nodes = 5: a world of 4 zone"),
        (
            {"backend": "ray", "sensor_workers": 1, "overrides": {"rig": "ten_sensors"}},
            "workers.sensors = 1: not supported over nodes",
        ),
        ({"backend": "ray", "overrides": {"workers.monitor_cpu": True}}, "workers.monitor_cpu"),
    ],
)
def test_bad_settings_are_refused(arguments: dict[str, object], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        make_vec("ring", **arguments)  # type: ignore[arg-type]


def test_a_missing_ray_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "ray", None)
    with pytest.raises(MissingExtraError, match=r"'ray'.*pip install .*\[ray\]'"):
        make_vec("ring", backend="ray")
