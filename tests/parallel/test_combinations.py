"""Each feature works on each backend bit for bit, or is refused by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl import CavVectorEnv
from cavmarl.balance import probe
from cavmarl.balance.load_snapshot import LoadSnapshot, idle_snapshot
from cavmarl.core.errors import ConfigError
from cavmarl.v2x.v2x_messages import RECEPTION, Exchange
from tests.support.actuated import actuated_grid
from tests.support.exact_zone import EXACT
from tests.support.generated import check_block, table
from tests.support.rerouting import CARS, DEVICE, FLOW, make_map, write_demand
from tests.support.sumo_worlds import write_stops
from tests.support.vec_runs import Make, Run, drive, same

pytestmark = pytest.mark.filterwarnings("ignore:workers = ")

Keywords = dict[str, Any]
SMALL: Keywords = {"agents": 4, "background": 20, "max_cycles": 6}


def _with(**overrides: Any) -> Callable[[Path], Keywords]:
    named = {name.replace("__", "."): value for name, value in overrides.items()}
    return lambda folder: {"env": "grid4x4", **SMALL, "overrides": named}


def _rerouting(folder: Path) -> Keywords:
    files = write_demand(folder, CARS.format(device=DEVICE) + FLOW)
    overrides = {
        "traffic.demand": [str(path) for path in files],
        "clock.sim_dt_s": 0.2,
        "clock.ctrl_dt_s": 1.0,
    }
    return {"env": make_map(folder), **SMALL, "background": 0, "overrides": overrides}


def _sumo(source: str) -> Callable[[Path], Keywords]:
    def keywords(folder: Path) -> Keywords:
        overrides = {
            "traffic.source": source,
            "traffic.demand": [str(path) for path in write_stops(folder)],
            "sensors.signal.timing": False,
        }
        return {"env": "merge", **SMALL, "agents": 2, "background": 0, "overrides": overrides}

    return keywords


FEATURES: dict[str, Callable[[Path], Keywords]] = {
    "stacked frames, discrete actions, seats": _with(
        sensors__stack=3, action__kind="discrete", population__mode="respawn"
    ),
    "delayed commands": _with(clock__control_latency_ticks=2),
    "mounted sensors": _with(rig="ten_sensors", observation__mode="sensors"),
    "messages": _with(v2x__enabled=True),
    "a network simulator": _with(
        v2x__enabled=True, v2x__channel__external=True, sensors__messages__objects=4
    ),
    "a scenario": lambda folder: {
        **_with(scenario__name="unprotected_left_turn")(folder),
        "agents": 1,
    },
    "actuated signals": lambda folder: {**_with()(folder), "env": str(actuated_grid(folder))},
    "rerouting": _rerouting,
    "SUMO's demand": _sumo("sumo-demand"),
    "SUMO's traffic": _sumo("sumo-traffic"),
    "sensor workers": lambda folder: {
        **_with(rig="ten_sensors")(folder),
        "sensor_workers": 1,
    },
    "balance": _with(workers__balance_steps=3),
    "balance by LoadScore": _with(workers__balance_steps=3, workers__monitor_cpu=True),
    "a journal": lambda folder: _with(zones__journal=str(folder / "run.jsonl"))(folder),
    "invariant checks": _with(zones__check_invariants=True),
    "repartitions": _with(zones__repartition_steps=3),
    "zones of other simulators": _with(zones__simulators={0: EXACT}),
}
PLACES: dict[str, Keywords] = {
    "zones": {"zones": 3},
    "workers": {"num_envs": 2, "workers": 2},
    "zones over workers": {"zones": 2, "workers": 2},
    "nodes": {"zones": 3, "nodes": 2},
    "worlds over nodes": {"num_envs": 2, "nodes": 2},
    "worlds on Ray": {"num_envs": 2, "backend": "ray:2"},
    "nodes on Ray": {"zones": 3, "backend": "ray:2"},
}
# The undivided world of a comparison does not have these settings.
ONLY_DIVIDED = (
    "zones.journal", "zones.check_invariants", "zones.repartition_steps",
    "workers.balance_steps", "workers.monitor_cpu", "zones.simulators",
)  # fmt: skip
OF_THE_CALLER = "cannot call a network simulator in the process of the caller"
BY_COSTS = "whole worlds on nodes are balanced by their costs only"
NOT_OVER_NODES = "not supported over nodes"
REFUSED = {
    ("a network simulator", "workers"): OF_THE_CALLER,
    ("a network simulator", "zones over workers"): OF_THE_CALLER,
    ("repartitions", "zones over workers"): "needs zones that do not change",
    ("sensor workers", "nodes"): NOT_OVER_NODES,
    ("sensor workers", "worlds over nodes"): NOT_OVER_NODES,
    ("balance by LoadScore", "worlds over nodes"): BY_COSTS,
    ("sensor workers", "worlds on Ray"): NOT_OVER_NODES,
    ("balance by LoadScore", "worlds on Ray"): BY_COSTS,
    ("sensor workers", "nodes on Ray"): NOT_OVER_NODES,
}


class _OddIdsNetwork:
    """A network simulator that delivers only messages of vehicles with odd ids."""

    def exchange(self, sent: Exchange) -> NDArray[np.void]:
        odd = np.flatnonzero(sent.packets["sender"] % 2).tolist()
        pairs = [(sent.tick, n, r) for n in odd for r in range(len(sent.receivers))]
        return np.array(pairs, dtype=RECEPTION)


def _run(vec: CavVectorEnv) -> Run:
    v2x = vec.config.v2x
    if v2x.enabled and v2x.channel.external:
        vec.worlds.connect_network(_OddIdsNetwork())
    return drive(vec, steps=8)


def _idle_machine(workers: Mapping[int, Any]) -> LoadSnapshot:
    """Return the load of an idle machine, because worlds refuse workers on busy machines."""
    return idle_snapshot(len(workers))


def check(make: Make, folder: Path, feature: str, place: str) -> None:
    """Compare worlds with the undivided world bit for bit; expect an error if `REFUSED` says so."""
    keywords, where = FEATURES[feature](folder), PLACES[place]
    if words := REFUSED.get((feature, place)):
        with pytest.raises(ConfigError, match=words):
            make(**keywords, **where)
        return
    overrides = keywords.get("overrides", {})
    plain = {name: value for name, value in overrides.items() if name not in ONLY_DIVIDED}
    alone = {**keywords, "overrides": plain, "num_envs": where.get("num_envs", 1)}
    alone.pop("sensor_workers", None)
    whole = _run(make(**alone))
    with patch.object(probe, "take_snapshot", _idle_machine):
        vec = make(**keywords, **where)
    assert same(_run(vec), whole)


@pytest.mark.parametrize("feature", FEATURES)
def test_each_feature_works_in_zones_or_is_refused(
    make: Make, tmp_path: Path, feature: str
) -> None:
    check(make, tmp_path, feature, "zones")


def each_feature(*elsewhere: str) -> pytest.MarkDecorator:
    """Parametrize a test with all features; features that another test covers become slow tests."""
    slow = (*elsewhere, *(feature for feature in FEATURES if feature.startswith("SUMO")))
    return pytest.mark.parametrize(
        "feature",
        [
            pytest.param(feature, marks=pytest.mark.slow) if feature in slow else feature
            for feature in FEATURES
        ],
    )


# `tests/traffic/test_sumo_processes.py` tests SUMO over workers, `test_node_parts.py` over nodes.
@each_feature()
def test_each_feature_works_over_workers_or_is_refused(
    make: Make, tmp_path: Path, feature: str
) -> None:
    check(make, tmp_path, feature, "workers")


@each_feature()
def test_each_feature_works_in_zones_over_workers_or_is_refused(
    make: Make, tmp_path: Path, feature: str
) -> None:
    check(make, tmp_path, feature, "zones over workers")


# `test_node_parts.py`, `test_node_network.py` and `test_node_cuts.py` test these features while
# a node dies.
@each_feature(
    "mounted sensors",
    "messages",
    "a network simulator",
    "a scenario",
    "rerouting",
    "repartitions",
)
def test_each_feature_works_in_zones_over_nodes_or_is_refused(
    make: Make, tmp_path: Path, feature: str
) -> None:
    check(make, tmp_path, feature, "nodes")


@each_feature()
def test_each_feature_works_in_whole_worlds_over_nodes_or_is_refused(
    make: Make, tmp_path: Path, feature: str
) -> None:
    check(make, tmp_path, feature, "worlds over nodes")


def test_the_page_has_the_table_of_these_tests() -> None:
    rows = [
        (feature, *("refused" if (feature, place) in REFUSED else "yes" for place in PLACES))
        for feature in FEATURES
    ]
    page = Path(__file__).resolve().parents[2] / "docs" / "guides" / "divide_a_world.md"
    check_block(page, "combinations", table(("", *PLACES), rows))
