"""Evacuations: their plans, vehicles, runs and result pages."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl.cli import main
from cavmarl.config.road_events import RoadEvent
from cavmarl.core.errors import ConfigError
from cavmarl.engine.world_setup import load_world
from cavmarl.evaluate.evacuation.evacuation_demand import find_evacuees
from cavmarl.evaluate.evacuation.evacuation_plan import (
    Area,
    EvacuationPlan,
    circle,
    default_exits,
    load_plan,
    middle_of,
    roads_of,
)
from cavmarl.evaluate.evacuation.evacuation_runs import (
    EvacuationResult,
    PreparedEvacuation,
    prepare,
    run_evacuation,
)
from cavmarl.maps.netconvert_process import run_netconvert
from cavmarl.roads.network import RoadNetwork

LATE = RoadEvent(at_s=5000.0, action="close", edges=("B1B2",))
MIDDLE = ("B1B2", "B2B1", "C1B1", "B1C1", "C2B2", "B2C2")
PLAN = EvacuationPlan(
    map="grid4x4",
    areas={
        "middle": Area(edges=MIDDLE, vehicles=60),
        "corner": Area(edges=("A0A1", "A1A0"), per_km=60.0),
    },
    exits=("A0left0", "D3right3"),
    start_s=10.0,
    within_s=60.0,
    horizon_s=700.0,
)


@pytest.fixture(scope="module")
def network() -> RoadNetwork:
    return load_world("grid4x4", agents=0, background=0).network


def prepared(plan: EvacuationPlan, tmp_path: Path, seed: int = 0) -> PreparedEvacuation:
    return prepare(plan, Path(), tmp_path, seed)


@pytest.fixture(scope="module")
def undivided(tmp_path_factory: pytest.TempPathFactory) -> EvacuationResult:
    return run_evacuation(prepared(PLAN, tmp_path_factory.mktemp("evacuation")))


def test_all_vehicles_leave_and_clearance_times_follow_from_arrivals(
    undivided: EvacuationResult,
) -> None:
    found = undivided.all
    assert found.vehicles == sum(area.vehicles for area in undivided.areas.values())
    assert (found.arrived, found.departed, found.unserved) == (found.vehicles, found.vehicles, 0)
    assert found.clearance_50_s is not None
    assert found.clearance_90_s is not None
    assert found.clearance_50_s <= found.clearance_90_s <= (found.clearance_s or 0.0)
    assert found.last_arrival_s == found.clearance_s
    times = dict(zip(undivided.series["time_s"], undivided.series["arrived"], strict=True))
    half = np.ceil(found.vehicles / 2)
    at = found.clearance_50_s + PLAN.start_s
    assert times[at] >= half > times[at - 1.0]
    assert sum(undivided.exits.values()) == found.arrived
    assert undivided.areas["middle"].left_by_s is not None
    assert undivided.longest_queue == max(undivided.series["standing"])
    assert undivided.recovery_s is None


def test_a_divided_evacuation_equals_the_undivided_one(
    undivided: EvacuationResult, tmp_path: Path
) -> None:
    here = prepared(PLAN, tmp_path)
    assert run_evacuation(here, zones=4) == undivided
    assert run_evacuation(here, zones=2, backend="processes:2") == undivided


@pytest.mark.slow
def test_an_evacuation_over_nodes_equals_the_undivided_one(
    undivided: EvacuationResult, tmp_path: Path
) -> None:
    assert run_evacuation(prepared(PLAN, tmp_path), zones=2, backend="nodes:2") == undivided


def test_each_vehicle_begins_on_the_road_of_its_trip(network: RoadNetwork, tmp_path: Path) -> None:
    from cavmarl import make_vec

    here = prepared(PLAN, tmp_path)
    vec = make_vec(tmp_path, num_envs=1, overrides={"clock.ctrl_dt_s": 0.1})
    vec.reset(seed=0)
    begun: dict[int, int] = {}
    idle = vec.suggest_actions()
    for _ in range(1500):
        vec.step(idle)
        rows = vec.present.vehicles(0)
        for order, lane in zip(rows["order"].tolist(), rows["lane"].tolist(), strict=True):
            begun.setdefault(order, int(network.lanes["edge"][lane]))
    vec.close()
    assert len(begun) == len(here.evacuees.edge)
    assert all(here.evacuees.edge[order] == edge for order, edge in begun.items())


NODES = """<nodes><node id="W" x="-400" y="0"/><node id="A" x="0" y="0"/>
<node id="B" x="900" y="0"/><node id="X" x="1300" y="200"/></nodes>"""
EDGES = """<edges><edge id="WA" from="W" to="A" numLanes="2"/><edge id="AW" from="A" to="W"/>
<edge id="AB" from="A" to="B"/><edge id="BA" from="B" to="A"/>
<edge id="BX" from="B" to="X" numLanes="2"/></edges>"""


def test_contraflow_lanes_shorten_an_evacuation_over_a_bridge(tmp_path: Path) -> None:
    pytest.importorskip("sumo", reason="needs the extra 'sumo'")
    (tmp_path / "bridge.nod.xml").write_text(NODES, encoding="utf-8")
    (tmp_path / "bridge.edg.xml").write_text(EDGES, encoding="utf-8")
    net = tmp_path / "bridge.net.xml"
    words = ["-n", str(tmp_path / "bridge.nod.xml"), "-e", str(tmp_path / "bridge.edg.xml")]
    run_netconvert([*words, "-o", str(net)], net, None)
    # Two lanes lead to the bridge AB, which has one lane per direction.
    plan = EvacuationPlan(
        map=str(net),
        areas={"west": Area(edges=("WA",), vehicles=200)},
        exits=("BX",),
        within_s=60.0,
        horizon_s=2000.0,
    )
    plain = run_evacuation(prepared(plan, tmp_path))
    helped = run_evacuation(prepared(replace(plan, contraflow=("BA",)), tmp_path))
    assert helped.all.unserved == plain.all.unserved == 0
    assert helped.contacts == plain.contacts == 0
    assert (helped.all.clearance_s or 0.0) < (plain.all.clearance_s or 0.0)
    assert helped.rerouted > 20
    assert plain.contraflow == {}
    assert 0 < helped.contraflow["BA"] < 200
    assert helped.contact_places == {}


def test_traffic_recovers_after_roads_open_again(tmp_path: Path) -> None:
    roads = ("B0A0", "A1A0")
    events = (
        RoadEvent(at_s=30.0, action="close", edges=roads, shuts_in=True),
        RoadEvent(at_s=200.0, action="open", edges=roads),
    )
    plan = replace(PLAN, exits=("A0left0",), events=events)
    found = run_evacuation(prepared(plan, tmp_path))
    assert found.all.unserved == 0
    assert found.recovery_s is not None
    assert found.recovery_s > 0.0
    assert found.series["standing"][200] > found.series["standing"][30]


def test_vehicles_that_do_not_leave_in_time_are_unserved(tmp_path: Path) -> None:
    found = run_evacuation(prepared(replace(PLAN, horizon_s=90.0), tmp_path))
    assert found.all.unserved > 0
    assert found.all.clearance_s is None
    assert found.all.arrived + found.all.unserved == found.all.vehicles


def test_vehicles_are_shared_among_exits(network: RoadNetwork) -> None:
    found = find_evacuees(PLAN, PLAN.exits, network, seed=3)
    goals, counts = np.unique(found.exit, return_counts=True)
    assert {network.edge_ids[goal] for goal in goals.tolist()} == set(PLAN.exits)
    assert counts.min() > 10
    assert (np.diff(found.depart_s) > 0.0).all()
    again = find_evacuees(PLAN, PLAN.exits, network, seed=3)
    assert (again.edge == found.edge).all()
    assert (find_evacuees(PLAN, PLAN.exits, network, seed=4).edge != found.edge).any()


def test_an_area_is_a_polygon_or_a_list_of_roads_and_default_exits_are_outside(
    network: RoadNetwork,
) -> None:
    x, y, radius_m = middle_of(network)
    inside = roads_of(circle(x, y, radius_m, 1), "area", network)
    more = roads_of(circle(x, y, 10.0 * radius_m, 1), "area", network)
    assert 0 < len(inside) < len(more)
    named = roads_of(Area(edges=("B1B2",), vehicles=1), "area", network)
    assert [network.edge_ids[row] for row in named.tolist()] == ["B1B2"]
    far = default_exits(replace(PLAN, exits=()), network)
    assert 0 < len(far) <= 8
    assert not set(far) & set(MIDDLE)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"exits": ("Z9",)}, "exits: the map has no road 'Z9'"),
        ({"contraflow": ("Z9",)}, "contraflow: the map has no road 'Z9'"),
        ({"contraflow": ("A0left0",)}, "'A0left0' is reversed by contraflow"),
        ({"areas": {"a": Area(edges=("Z9",), vehicles=1)}}, "the map has no road 'Z9'"),
        ({"areas": {"a": Area(edges=("B1B2",), vehicles=0)}}, "the area has no vehicles"),
        ({"areas": {"a": Area(edges=("B1B2",), per_km=0.1)}}, "the area has no vehicles"),
        (
            {"areas": {"a": Area(polygon=((9e5, 9e5), (9e5, 9.1e5), (9.1e5, 9e5)), vehicles=1)}},
            "no road for cars is in the area",
        ),
        (
            {"areas": {"a": Area(edges=("A0left0",), vehicles=1)}, "exits": ("D3right3",)},
            "no road of the area has a way to an exit",
        ),
        (
            {
                "exits": ("A0left0",),
                "events": (RoadEvent(at_s=1.0, action="close", edges=("B0A0", "A1A0")),),
            },
            "they close the last way",
        ),
        ({"map": "no_such_map"}, "there is no file no_such_map and no such environment"),
    ],
)
def test_impossible_plans_are_refused(change: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=message):
        prepared(replace(PLAN, **change), tmp_path)
    assert not (tmp_path / "env.yaml").exists()


def test_an_evacuation_without_exits_is_refused(network: RoadNetwork) -> None:
    with pytest.raises(ConfigError, match="needs a road over which vehicles leave"):
        find_evacuees(PLAN, (), network, seed=0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("map: grid4x4\nareas: {}\n", "areas = {}: must name an area"),
        ("map: grid4x4\nareas: {a: {edges: [B1B2]}}\n", "either vehicles or per_km"),
        ("map: grid4x4\nareas: {a: {vehicles: 3}}\n", "either a polygon or edges"),
        ("map: grid4x4\nareas: {a: {edges: [B1B2], vehicles: -1}}\n", "vehicles = -1"),
        ("map: grid4x4\nareas: {a: {polygon: [[0, 0]], vehicles: 1}}\n", "three corners"),
        (
            "map: grid4x4\nareas: {a: {edges: [B1B2], vehicles: 1}}\nhorizon_s: 600\n",
            "must be above",
        ),
        ("map: grid4x4\nareas: {a: {edges: [B1B2], vehicle: 1}}\n", "did you mean"),
        ("areas: {a: {edges: [B1B2], vehicles: 1}}\n", "map: missing"),
    ],
)
def test_wrong_plan_files_are_refused(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "plan.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=message):
        load_plan(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"horizon_s": 700.5}, "must be a whole number of seconds"),
        ({"events": (LATE,)}, "must be above 5000, the time of the last event"),
        (
            {
                "areas": {
                    "a": Area(polygon=((0.0, float("nan")), (1.0, 0.0), (0.0, 1.0)), vehicles=1)
                }
            },
            "must consist of finite numbers",
        ),
    ],
)
def test_values_without_a_meaning_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        replace(PLAN, **change)


def test_an_area_named_like_the_total_has_a_separate_row(
    undivided: EvacuationResult,
) -> None:
    pytest.importorskip("matplotlib", reason="needs the extra 'report'")
    from cavmarl.evaluate.evacuation.evacuation_page import table_of

    middle, corner = undivided.areas.values()
    rows = table_of(replace(undivided, areas={"all areas": middle, "corner": corner}))
    assert [row[:2] for row in rows] == [
        ("all areas", str(middle.vehicles)),
        ("corner", str(corner.vehicles)),
        ("all areas", str(undivided.all.vehicles)),
    ]


def exit_code(*words: str) -> int:
    with pytest.raises(SystemExit) as end:
        main(words)
    return int(end.value.code or 0)


def test_the_command_writes_a_page_and_an_environment(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib", reason="needs the extra 'report'")
    out = tmp_path / "out"
    words = ["evacuate", "grid4x4", "--vehicles", "20", "--within-s", "20", "--seconds", "400"]
    kept = tmp_path / "found.json"
    assert exit_code(*words, "--close", "B1B2", "--out", str(out), "--json", str(kept)) == 0
    said = capsys.readouterr().out
    assert "exits, chosen:" in said
    assert "all cleared, s" in said
    page = (out / "index.html").read_text(encoding="utf-8")
    assert "Evacuation on" in page
    assert page.count("<svg") == 3
    found = json.loads((out / "results.json").read_text(encoding="utf-8"))
    assert found["runs"][0]["all"]["vehicles"] == 20
    assert json.loads(kept.read_text(encoding="utf-8"))["runs"] == found["runs"]
    assert load_world(out / "seed-0").config.map.events[0].edges == ("B1B2",)
    assert exit_code(*words, "--out", str(out)) == 2
    assert "the folder is not empty" in capsys.readouterr().err


def test_a_refused_evacuation_leaves_no_folder(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="needs the extra 'report'")
    out = tmp_path / "out"
    for words in (("--exit", "Z9"), ("--contraflow", "Z9"), ("--close", "Z9")):
        assert exit_code("evacuate", "grid4x4", *words, "--out", str(out)) == 2
        assert not out.exists()
    out.mkdir()
    assert exit_code("evacuate", "grid4x4", "--exit", "Z9", "--out", str(out)) == 2
    assert not any(out.iterdir())


def test_the_command_runs_a_plan_and_refuses_options_of_maps(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib", reason="needs the extra 'report'")
    path = tmp_path / "plan.yaml"
    path.write_text(
        "map: grid4x4\nareas: {a: {edges: [B1B2, C1B1], vehicles: 10}}\nexits: [A0left0]\n"
        "within_s: 10\nhorizon_s: 300\n",
        encoding="utf-8",
    )
    assert exit_code("evacuate", str(path), "--out", str(tmp_path / "out"), "--repeats", "2") == 0
    assert (tmp_path / "out" / "seed-1" / "env.yaml").is_file()
    capsys.readouterr()
    assert exit_code("evacuate", str(path), "--vehicles", "3") == 2
    assert "a plan has its own areas" in capsys.readouterr().err
    assert exit_code("evacuate", "grid4x4", "--around", "here") == 2
    assert "must be X,Y in m" in capsys.readouterr().err
