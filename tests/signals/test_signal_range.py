"""`signals.range_m`: signals at lanes that are shorter than a vehicle."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl.env.vector import make_vec
from cavmarl.evaluate.signals.signal_runs import run_controller
from cavmarl.roads.cache import load_network
from cavmarl.signals.signal_table import lanes_before
from tests.support.netgenerate import netconvert

NODES = {"w": (-300, 0), "a": (-150, 0), "m": (-11, 0), "s": (0, 0), "e": (300, 0)}
NODES |= {"n": (0, 300), "z": (0, -300)}


@pytest.fixture(scope="module")
def crossing(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a map with a signal `s`; the road from the west has the edges `wa`, `am` and `ms`."""
    folder = tmp_path_factory.mktemp("crossing")
    kinds = dict.fromkeys(NODES, "priority") | {"s": "traffic_light"}
    nodes = (
        f'<node id="{name}" x="{x}" y="{y}" type="{kinds[name]}"/>'
        for name, (x, y) in NODES.items()
    )
    edges = (
        f'<edge id="{name}" from="{name[0]}" to="{name[1]}" numLanes="1" speed="13.9"/>'
        for name in ("wa", "am", "ms", "se", "ns", "sz")
    )
    links = (
        f'<connection from="{before}" to="{after}"/>'
        for before, after in (("ms", "se"), ("ns", "sz"))
    )
    for end, kind, parts in (
        ("nod", "node", nodes),
        ("edg", "edge", edges),
        ("con", "connection", links),
    ):
        (folder / f"m.{end}.xml").write_text(f"<{kind}s>{''.join(parts)}</{kind}s>")
    return netconvert(folder, "m")


def test_the_range_adds_lanes_that_lead_to_the_last_lane(crossing: Path) -> None:
    network = load_network(crossing)

    def names(lane: str, range_m: float) -> list[str]:
        rows = lanes_before(network, network.lane_ids.index(lane), range_m)
        return [name for name in map(network.lane_ids.__getitem__, rows) if name[0] != ":"]

    assert network.lanes["length_m"][network.lane_ids.index("ms_0")] < 4.0
    assert names("ms_0", 0.0) == []
    assert names("ms_0", 50.0) == ["am_0"]
    assert names("ms_0", 200.0) == ["am_0", "wa_0"]
    assert names("se_0", 1000.0) == []  # a signal is before this lane


def test_rewards_with_a_range_do_not_depend_on_zones(crossing: Path) -> None:
    demand = crossing.with_name("few.rou.xml")
    demand.write_text(
        '<routes><route id="x" edges="wa am ms se"/>'
        '<flow id="a" route="x" begin="0" end="200" period="4"/></routes>'
    )
    keys: dict[str, Any] = {
        "traffic.demand": [str(demand)],
        "population.mode": "open",
        "signals.agents": "all",
        "signals.max_green_s": 0.0,
        "signals.range_m": 200.0,
        "signals.terms": {"delay": 1.0, "wait": 1.0},
    }

    def run(zones: int) -> list[Any]:
        vec = make_vec(crossing, agents=0, background=0, zones=zones, overrides=keys)
        found = []
        with closing(vec):
            vec.reset(seed=1)
            steps = round(60.0 / vec.config.clock.ctrl_dt_s)
            for green in np.repeat(
                [0, 1], steps
            ):  # in one of the two greens, the road from the west has red
                _, rewards, *_ = vec.step({"signals": np.array([[green]])})
                found.append((rewards["signals"].tolist(), vec.state_hash()))
        assert min(rewards[0][0] for rewards, _ in found) < -2.0
        return found

    undivided = run(1)
    assert run(2) == undivided
    assert run(4) == undivided


def test_controllers_serve_a_road_whose_last_lane_is_short(crossing: Path) -> None:
    demand = crossing.with_name("d.rou.xml")
    demand.write_text(
        '<routes><vType id="car" sigma="0"/><route id="x" edges="wa am ms se"/>'
        '<route id="y" edges="ns sz"/>'
        '<flow id="a" type="car" route="x" begin="20" end="280" period="10"/>'
        '<flow id="b" type="car" route="y" begin="0" end="300" period="6"/></routes>'
    )
    keys = {"traffic.demand": [str(demand)], "population.background": 0, "signals.max_green_s": 0}
    figures = {
        range_m: run_controller(
            crossing,
            "longest_queue",
            seconds=330,
            seeds=[1],
            overrides=keys | {"signals.range_m": range_m, "population.mode": "open"},
        )[0]
        for range_m in (0.0, 50.0)
    }
    assert figures[50.0].arrived > figures[0.0].arrived + 10
    assert figures[50.0].delay_of_all_s < 0.5 * figures[0.0].delay_of_all_s
