"""Background vehicles that trained drivers drive: `traffic.model = zoo:NAME`."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl import ConfigError, PolicyError
from cavmarl.core.records.codes import DRIVER_AGENT, DRIVER_BACKGROUND, DRIVER_LEARNED
from cavmarl.driving.vehicles import MEMORY_FIELDS
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.world_setup import load_world
from cavmarl.evaluate.traffic.native_side import idle_commands
from cavmarl.networks.driver_network import load_driver_network
from cavmarl.policies.loading import policy_files
from cavmarl.policies.other_side import OtherSide
from cavmarl.recordings.recording import Recording
from cavmarl.shards.shard import Commands
from tests.support.mirrored import mirror_net
from tests.support.netgenerate import netgenerate
from tests.support.vec_runs import Make, drive, same
from tests.support.world import tick_of

MIXED = {"zoo:cities_ippo": 0.5, "zoo:intersection_ippo": 0.3, "idm": 0.2}
# The driver ring22_ippo has no memory and no optional sensors.
TWO_KINDS = {"zoo:cities_ippo": 1.0, "zoo:ring22_ippo": 1.0}
FAST = {"clock.sim_dt_s": 0.1, "clock.ctrl_dt_s": 0.2}
SHOWN = ("x", "y", "heading", "speed", "throttle", "steering", "lane", "s", "d", "to_go")


def simulation(env: str, model: Any, background: int, agents: int = 0, **more: Any) -> Simulation:
    """Return a world after its reset."""
    keys = FAST | {"traffic.model": model} | {name.replace("__", "."): more[name] for name in more}
    config, network, demand, partition = load_world(
        env, agents=agents, background=background, overrides=keys
    )
    world = Simulation(config, network, demand=demand, partition=partition)
    world.seed(3)
    world.reset()
    return world


def owned(world: Simulation) -> NDArray[np.void]:
    """Return a writable view of the rows of the vehicles."""
    worlds = tick_of(world).worlds
    rows: NDArray[np.void] = worlds.rows[0, : worlds.num_owned[0]]
    return rows


@pytest.mark.parametrize(
    ("env", "model", "how"),
    [
        ("town", "zoo:cities_ippo", [{"zones": 4}, {"zones": 9}]),
        ("town", MIXED, [{"zones": 9}, {"zones": 4, "workers": 2}]),
        ("grid4x4", TWO_KINDS, [{"zones": 4}, {"zones": 4, "nodes": 2}]),
    ],
)
def test_divided_worlds_equal_undivided_ones(
    make: Make, env: str, model: Any, how: list[dict[str, int]]
) -> None:
    wanted: dict[str, Any] = {
        "agents": 4,
        "background": 50,
        "max_cycles": 40,
        "overrides": {"traffic.model": model, "zones.hysteresis_m": 0.5},
    }
    whole = drive(make(env, **wanted), 25)
    for one in how:
        assert same(drive(make(env, **wanted, **one), 25), whole), one


@pytest.mark.parametrize("left_hand", [False, True])
def test_a_network_drives_a_background_vehicle_as_it_drives_an_agent(
    tmp_path: Path, left_hand: bool
) -> None:
    lights = ("--default-junction-type", "traffic_light")
    net = netgenerate(tmp_path / "right.net.xml", "--grid", "--grid.number", "4", *lights)
    source = str(mirror_net(net, tmp_path / "left.net.xml") if left_hand else net)
    ours = simulation("cities", "zoo:cities_ippo", background=1, map__source=source)
    theirs = simulation("cities", "IDM", background=0, agents=1, map__source=source)
    sides = OtherSide(theirs.config) if left_hand else None
    row, agent = owned(ours)[0], owned(theirs)[0]
    assert (row["driver"], agent["driver"]) == (DRIVER_LEARNED, DRIVER_AGENT)
    for name in row.dtype.names:
        if name not in ("driver", "agent", "vtype", "due"):
            agent[name] = row[name]
    tick_of(theirs).sense(theirs.everywhere)
    network = load_driver_network(policy_files("cities_ippo")[0].parent)
    action = network.config.action
    scale = (action.acceleration_mps2, action.steering_rad)
    moved_m = 0.0
    for _ in range(150):
        seen = theirs.outputs.observations[0]
        if sides is None:
            controls = network.best(seen) * np.array(scale)
        else:
            controls = sides.actions(network.best(sides.observations(seen))) * np.array(scale)
        theirs.step(Commands(controls[np.newaxis], np.zeros((1, 1), np.int64)))
        ours.step(idle_commands(ours))
        row, agent = owned(ours)[0], owned(theirs)[0]
        assert {name: row[name] for name in SHOWN} == {name: agent[name] for name in SHOWN}
        moved_m = float(row["distance_m"])
    assert moved_m > 50.0


def test_vehicles_that_enter_have_the_given_shares_of_drivers() -> None:
    world = simulation("town", MIXED, background=400)
    types = tick_of(world).traffic.travel.types[owned(world)["vtype"]]
    counts = np.bincount(types["network"], minlength=3)
    np.testing.assert_allclose(counts / counts.sum(), [0.2, 0.5, 0.3], atol=0.08)
    drivers = np.where(types["network"] > 0, DRIVER_LEARNED, DRIVER_BACKGROUND)
    np.testing.assert_array_equal(owned(world)["driver"], drivers)


@pytest.mark.parametrize("model", [MIXED, {"Krauss": 1.0, "IDM": 2.0}])
def test_the_order_of_the_shares_makes_no_difference(model: dict[str, float]) -> None:
    turned = dict(reversed(model.items()))
    hashes = set()
    for one in (model, turned):
        world = simulation("town", one, background=20, agents=2)
        for _ in range(3):
            world.step(idle_commands(world))
        hashes.add(world.state_hash())
    assert len(hashes) == 1


def test_models_can_be_mixed_without_networks() -> None:
    world = simulation("town", {"IDM": 1, "Krauss": 1, "ACC": 0}, background=200)
    rows = owned(world)
    models = tick_of(world).traffic.travel.types["model"][rows["vtype"]]
    assert set(rows["driver"].tolist()) == {DRIVER_BACKGROUND}
    assert len(set(models.tolist())) == 2
    assert 60 <= np.bincount(rows["vtype"])[0] <= 140


def test_a_vehicle_that_has_touched_another_leaves_and_is_replaced() -> None:
    world = simulation("town", "zoo:cities_ippo", background=30, population__mode="respawn")
    victim = int(owned(world)[4]["id"])
    owned(world)[4]["hit"] = 7
    world.step(idle_commands(world))
    stats = world.traffic_stats()
    assert victim not in owned(world)["id"]
    assert (stats.removed, stats.arrived) == (1, 0)
    for _ in range(30):
        world.step(idle_commands(world))
    assert world.traffic_stats().departed >= 31


def test_saved_worlds_continue_with_the_memory_of_their_drivers(make: Make) -> None:
    wanted: dict[str, Any] = {
        "agents": 2,
        "background": 40,
        "max_cycles": 90,
        "overrides": {"traffic.model": MIXED},
    }
    vec = make("town", **wanted)
    vec.reset(seed=2)
    for _ in range(20):
        vec.step(vec.suggest_actions())
    saved = vec.save_state()
    other = make("town", zones=4, **wanted)
    other.reset(seed=9)
    other.load_state(saved)
    assert other.state_hash(0) == vec.state_hash(0)
    for _ in range(10):
        actions = vec.suggest_actions()
        for one in (vec, other):
            one.step(actions)
        assert other.state_hash(0) == vec.state_hash(0)


def test_the_hash_of_a_state_includes_the_memory() -> None:
    world = simulation("town", "zoo:cities_ippo", background=5)
    for _ in range(5):
        world.step(idle_commands(world))
    before = world.state_hash()
    assert all(owned(world)[name].any() for name in MEMORY_FIELDS)
    for name in MEMORY_FIELDS:
        kept = owned(world)[0][name]
        owned(world)[0][name] = kept + np.float32(0.125)
        assert world.state_hash() != before, name
        owned(world)[0][name] = kept
    assert world.state_hash() == before


def test_recordings_of_undivided_and_divided_worlds_show_equal_drivers(
    make: Make, tmp_path: Path
) -> None:
    wanted: dict[str, Any] = {
        "agents": 1,
        "background": 20,
        "max_cycles": 15,
        "overrides": {"traffic.model": MIXED},
    }
    seen = []
    for name, zones in (("whole", 1), ("divided", 4)):
        path = tmp_path / name
        vec = make("town", zones=zones, record=path, **wanted)
        vec.reset(seed=4)
        for _ in range(10):
            vec.step(vec.suggest_actions())
        vec.close()
        frames = list(Recording.open(path).frames())
        drivers = Recording.open(path).manifest["world"]["background_drivers"]
        assert list(drivers) == ["cities_ippo", "intersection_ippo"]
        assert DRIVER_LEARNED in frames[-1].vehicles["driver"]
        seen.append([frame.vehicles[["id", "driver", "x", "y"]].tolist() for frame in frames])
    assert len(seen[0]) == 11
    assert seen[0] == seen[1]


def test_a_vehicle_without_a_way_to_its_goal_gets_another_goal() -> None:
    world = simulation("town", "zoo:cities_ippo", background=60)
    plans = tick_of(world).traffic.plans
    lost = np.isinf(plans["to_go"][:, owned(world)["lane"]])  # (goals, vehicles)
    goal, vehicle = np.argwhere(lost)[0].tolist()
    row = owned(world)[vehicle]
    row["goal"], row["way"] = goal, goal * len(world.network.lanes)
    number = int(row["id"])
    for _ in range(10):
        world.step(idle_commands(world))
    row = owned(world)[owned(world)["id"] == number][0]
    assert row["goal"] != goal
    assert np.isfinite(row["to_go"])


def load(model: Any, **more: Any) -> None:
    load_world("merge", overrides={"traffic.model": model} | more)


@pytest.mark.parametrize(
    ("model", "said"),
    [
        ("zoo:cities_ipo", r"did you mean .*cities_ippo"),
        ("zoo:idm", "is a script .*: bottleneck_ippo, cities_ippo, "),
        ("zoo:cities_residual", "it observes the action of the built-in driver .*cities_ippo"),
        ("zoo:", "names no driver; name one of .*cities_ippo"),
        ({"zoo:cities_residual": 0.5, "IDM": 0.5}, "residual"),
    ],
)
def test_unusable_drivers_are_refused_by_name(model: Any, said: str) -> None:
    with pytest.raises(PolicyError, match=f"traffic.model = 'zoo:.*{said}"):
        load(model)


@pytest.mark.parametrize(
    "shares",
    [{}, {"IDM": -1.0, "ACC": 2.0}, {"IDM": 0.0}, {"IDM": float("inf")}, {"IDM": float("nan")}],
)
def test_unusable_shares_are_refused(shares: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=r"traffic.model = .*"):
        load(shares)


def test_values_of_other_types_are_refused() -> None:
    for model in (3, ["IDM"], {"IDM": "half"}, None):
        with pytest.raises(ConfigError, match=r"traffic.model"):
            load(model)


def test_unknown_models_in_a_mixture_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"traffic.model = 'IDN' is not a driver model"):
        simulation("town", {"IDN": 0.5, "IDM": 0.5}, background=4)


def test_networks_need_native_traffic_and_native_zones() -> None:
    for model in ("zoo:cities_ippo", {"IDM": 1.0, "ACC": 1.0}):
        with pytest.raises(ConfigError, match=r"traffic.source = sumo-traffic needs one"):
            load(model, **{"traffic.source": "sumo-traffic", "traffic.demand": ["a.rou.xml"]})
    with pytest.raises(ConfigError, match="other simulators cannot run a trained driver"):
        load("zoo:cities_ippo", **{"zones.simulators": {0: "carla://localhost:2000"}})


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    """Return a copy of a trained driver's folder."""
    folder = tmp_path / "copied"
    shutil.copytree(policy_files("cities_ippo")[0].parent, folder)
    return folder


def test_a_driver_from_a_folder_drives_like_the_bundled_driver(copied: Path) -> None:
    ours, theirs = (
        simulation("cities", model, background=6) for model in (f"zoo:{copied}", "zoo:cities_ippo")
    )
    for _ in range(20):
        ours.step(idle_commands(ours))
        theirs.step(idle_commands(theirs))
    assert ours.state_hash() == theirs.state_hash()


def test_weights_that_are_not_finite_are_refused(copied: Path) -> None:
    from safetensors.numpy import load_file, save_file

    path = copied / "model.safetensors"
    weights = load_file(path)
    weights["actor.bias"] = weights["actor.bias"] * np.float32(np.nan)
    save_file(weights, path)
    with pytest.raises(PolicyError, match=r"traffic.model = .*not finite"):
        load(f"zoo:{copied}")


@pytest.mark.parametrize("parts", [{}, {"zones": 4, "workers": 2}])
def test_a_network_that_gives_nan_ends_the_step_with_its_name(
    copied: Path, make: Make, parts: dict[str, int]
) -> None:
    from safetensors.numpy import load_file, save_file

    path = copied / "model.safetensors"
    weights = load_file(path)
    weights["body.0.bias"] = np.full_like(weights["body.0.bias"], 3e38)  # the sum overflows
    save_file(weights, path)
    wanted: dict[str, Any] = {"overrides": {"traffic.model": f"zoo:{copied}"}}

    def run() -> None:
        drive(make("town", agents=1, background=12, **wanted, **parts), 1)

    with pytest.raises(PolicyError, match=r"traffic.model = .*copied.* gives NaN .* vehicle \d+"):
        run()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ('"stack": 1|"stack": 2', "earlier frames"),
        ('"steps": 3|"steps": 4', "observes 4 steps"),
        ('"objects": 0|"objects": 2', "messages"),
        ('"range_m": 70.0|"range_m": 70.0, "heard": true', "known from messages"),
    ],
)
def test_sensors_that_background_vehicles_lack_are_refused(
    copied: Path, change: str, said: str
) -> None:
    path = copied / "config.json"
    before, after = change.split("|")
    text = path.read_text(encoding="utf-8")
    assert before in text
    path.write_text(text.replace(before, after), encoding="utf-8")
    with pytest.raises(PolicyError, match=f"traffic.model = .*{said}.*cities_ippo"):
        load(f"zoo:{copied}")
