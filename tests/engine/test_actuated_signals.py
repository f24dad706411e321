"""Actuated signals switch in the same ticks as in SUMO."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl.core.records.arrays import Worlds
from cavmarl.roads.kernels.signal_phases import detect, switch_signals
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.sumo_net.reader import read_network
from cavmarl.shards.shard import make_worlds
from tests.support.actuated import actuated_grid
from tests.support.driving import idle, make_traffic, start

# Run in a child process: a process can load libsumo only once.
SUMO_RUN = """
import json, sys
import libsumo as sumo
net, routes, step, seconds = sys.argv[1:]
sumo.start(["sumo", "-n", net, "-r", routes, "--step-length", step, "--no-step-log",
            "--no-warnings", "--xml-validation", "never"])
ticks = []
for _ in range(round(float(seconds) / float(step))):
    sumo.simulationStep()
    ticks.append({
        "states": {s: sumo.trafficlight.getRedYellowGreenState(s)
                   for s in sumo.trafficlight.getIDList()},
        "vehicles": [(sumo.vehicle.getLaneID(v), sumo.vehicle.getLanePosition(v),
                      sumo.vehicle.getSpeed(v), sumo.vehicle.getLength(v))
                     for v in sumo.vehicle.getIDList()],
    })
print(json.dumps({
    "ticks": ticks,
    "detectors": sorted((sumo.inductionloop.getLaneID(d), sumo.inductionloop.getPosition(d))
                        for d in sumo.inductionloop.getIDList()),
}))
"""


@pytest.fixture(scope="module")
def grid(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("libsumo")
    return actuated_grid(tmp_path_factory.mktemp("grid"))


def demand(path: Path, headway_s: float) -> Path:
    """Write flows that go straight or turn; each flow has its own headway."""
    ways = [("left0A0", "B0right0"), ("bottom0A0", "A1top0"), ("right1B1", "A1left1")]
    ways += [("top1B1", "B0bottom1"), ("left1A1", "B0right0"), ("bottom1B0", "A1left1")]
    flows = "".join(
        f'<flow id="f{k}" from="{a}" to="{b}" begin="{k}" end="900" '
        f'period="{headway_s * (1.0 + 0.17 * k):.2f}" departLane="best" departSpeed="max"/>'
        for k, (a, b) in enumerate(ways)
    )
    path.write_text(f"<routes>{flows}</routes>", encoding="utf-8")
    return path


def run_sumo(net: Path, routes: Path, step_s: float, seconds: float) -> Any:
    arguments = [str(net), str(routes), str(step_s), str(seconds)]
    done = subprocess.run(
        [sys.executable, "-c", SUMO_RUN, *arguments], check=True, capture_output=True, text=True
    )
    return json.loads(done.stdout.splitlines()[-1])


def place(
    network: RoadNetwork, worlds: Worlds, vehicles: list[tuple[str, float, float, float]]
) -> None:
    """Put SUMO's vehicles into the rows of world 0; SUMO's positions are those of the fronts."""
    rows = worlds.rows[0]
    for row, (lane_id, front, speed, length) in zip(rows, vehicles, strict=False):
        row["lane"] = network.lane_ids.index(lane_id)
        row["s"], row["speed"], row["length"] = front - 0.5 * length, speed, length
    worlds.num_owned[0] = len(vehicles)


def look_and_switch(network: RoadNetwork, worlds: Worlds, step_s: float) -> None:
    """Update the detectors, then switch the signals."""
    places = network.arrays.lane_place, network.arrays.places
    detect(*places, worlds.rows, worlds.num_owned, worlds.ticks, step_s, worlds.detected_s)
    switch_signals(
        network.arrays,
        worlds.keys,
        worlds.ticks,
        worlds.detected_s,
        step_s,
        worlds.controllers,
        worlds.signal_phase,
    )


def shown(network: RoadNetwork, worlds: Worlds, world: int = 0) -> dict[str, str]:
    states = {}
    for name, signal, phase in zip(
        network.signal_ids, network.signals, worlds.signal_phase[world], strict=True
    ):
        first = network.phases[phase]["first_state"]
        codes = network.phase_states[first : first + signal["num_links"]]
        states[name] = "".join("rugGysoOY"[code] for code in codes)
    return states


@pytest.mark.parametrize(("headway_s", "step_s"), [(4.0, 0.5), (15.0, 0.5), (6.0, 0.1)])
def test_signals_switch_in_the_same_ticks_as_in_sumo(
    grid: Path, tmp_path: Path, headway_s: float, step_s: float
) -> None:
    seconds = 300.0 if step_s > 0.2 else 100.0
    theirs = run_sumo(grid, demand(tmp_path / "d.rou.xml", headway_s), step_s, seconds)
    network = read_network(grid)
    worlds = make_worlds(1, 500, network)
    seen = set()
    for tick, sumo_tick in enumerate(theirs["ticks"]):
        worlds.ticks[0] = tick
        look_and_switch(network, worlds, step_s)
        # SUMO reports after a step the signal state that applied during the step.
        assert shown(network, worlds) == sumo_tick["states"], f"at {tick * step_s} s"
        seen.add(tuple(sumo_tick["states"].values()))
        place(network, worlds, sumo_tick["vehicles"])
    assert len(seen) > 10


def test_detectors_have_the_positions_of_sumos_detectors(grid: Path, tmp_path: Path) -> None:
    theirs = run_sumo(grid, demand(tmp_path / "d.rou.xml", 9.0), 1.0, 1.0)["detectors"]
    network = read_network(grid)
    ours = sorted((network.lane_ids[row["lane"]], float(row["s_m"])) for row in network.detectors)
    assert [lane for lane, _ in ours] == [lane for lane, _ in theirs]
    np.testing.assert_allclose([s for _, s in ours], [s for _, s in theirs], atol=0.02)


def test_signals_do_not_depend_on_the_order_of_rows_or_on_other_worlds(grid: Path) -> None:
    network = read_network(grid)
    rng = np.random.default_rng(0)
    one, many = make_worlds(1, 40, network), make_worlds(2, 40, network)
    normal = np.flatnonzero(~network.lanes["internal"])
    for tick in range(600):
        lanes = rng.choice(normal, 40)
        rows = one.rows[0]
        rows["lane"], rows["length"] = lanes, 5.0
        rows["s"] = rng.uniform(0.0, 1.0, 40) * network.lanes["length_m"][lanes]
        rows["speed"] = rng.uniform(0.0, 14.0, 40)
        many.rows[1] = rows[rng.permutation(40)]
        one.num_owned[:], many.num_owned[1] = 40, 40
        one.ticks[:], many.ticks[:] = tick, tick
        look_and_switch(network, one, 0.5)
        look_and_switch(network, many, 0.5)
        look_and_switch(network, many, 0.5)
        for name in ("signal_phase", "controllers", "detected_s"):
            assert getattr(one, name)[0].tobytes() == getattr(many, name)[1].tobytes()
    assert shown(network, many, 0) != shown(network, many, 1), (
        "the empty world and the full world show the same letters"
    )


def test_a_reset_restarts_the_cycle(grid: Path) -> None:
    simulation = make_traffic(grid, background=30, num_worlds=2)
    start(simulation, seed=5)
    first = simulation.state_hash(0)
    hashes = []
    for _ in range(200):
        simulation.step(idle(simulation))
        hashes.append(simulation.state_hash(0))
    simulation.seed(5)
    simulation.reset(np.array([True, False]))
    assert simulation.state_hash(0) == first
    for expected in hashes:
        simulation.step(idle(simulation))
        assert simulation.state_hash(0) == expected
