"""Worlds with demand files: results do not depend on the order of rows, and no vehicle is lost."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cavmarl.core.records.codes import COUNT_DEPARTED
from cavmarl.engine.simulation import Simulation
from tests.engine.test_row_order import shuffle_rows
from tests.support import demand_worlds
from tests.support.demand_worlds import TINY, real, tiny
from tests.support.driving import drive, start

Make = Callable[..., Simulation]


@pytest.fixture(params=[*TINY, "bologna", "mcity"])
def make(request: pytest.FixtureRequest, tmp_path: Path) -> Make:
    name: str = request.param
    if name in TINY:
        return lambda **options: tiny(name, tmp_path, **options)
    maps: Path = request.getfixturevalue("shared_maps")
    return lambda **options: real(name, maps, **options)


def steps(simulation: Simulation, seconds: float) -> int:
    return round(seconds / simulation.config.clock.ctrl_dt_s)


def test_shuffled_rows_give_the_same_bytes(make: Make) -> None:
    tidy, shuffled = make(), make()
    for simulation in (tidy, shuffled):
        start(simulation, seed=5)
    rng = np.random.default_rng(0)
    moved = 0
    for step in range(steps(tidy, 120.0)):
        moved += shuffle_rows(shuffled, rng)
        drive(tidy)
        drive(shuffled)
        if step % 5 == 0:
            assert shuffled.state_hash() == tidy.state_hash(), f"step {step}"
    assert shuffled.traffic_stats() == tidy.traffic_stats()
    assert shuffled.state_hash() == tidy.state_hash()
    assert tidy.traffic_stats().departed > 30
    assert moved > 10 * step, "few rows were shuffled"


def test_worlds_of_one_simulation_differ_and_equal_single_worlds(make: Make) -> None:
    together = make(num_worlds=3)
    start(together, seed=9)
    alone = [make() for _ in range(3)]
    for world, simulation in enumerate(alone):
        simulation.seed(9, first_world=world)
        simulation.reset()
    for _ in range(steps(together, 45.0)):
        drive(together)
        for simulation in alone:
            drive(simulation)
    hashes = [together.state_hash(world) for world in range(3)]
    assert hashes == [simulation.state_hash() for simulation in alone]
    assert len(set(hashes)) == 3
    for world, simulation in enumerate(alone):
        assert together.traffic_stats(world) == simulation.traffic_stats()


def test_a_reset_with_the_seed_repeats_the_episode_and_a_reset_without_a_seed_does_not(
    make: Make,
) -> None:
    simulation = make()

    def episode() -> list[str]:
        hashes = []
        for _ in range(steps(simulation, 30.0)):
            drive(simulation)
            hashes.append(simulation.state_hash())
        return hashes

    start(simulation, seed=2)
    first = episode()
    simulation.reset()
    second = episode()
    start(simulation, seed=2)
    assert episode() == first
    assert second[-1] != first[-1]


def test_no_vehicle_is_lost_or_duplicated(make: Make) -> None:
    simulation = make()
    start(simulation, seed=3)
    departures = simulation.departures
    due = departures.orders[0, : departures.num_orders[0]]["due"]
    assert (np.diff(due) >= 0).all()
    most_waiting = 0
    for _ in range(steps(simulation, 120.0)):
        drive(simulation)
        stats = simulation.traffic_stats()
        assert stats.departed == stats.running + stats.arrived
        called = int(np.count_nonzero(due <= simulation.ticks()[0]))
        assert (
            stats.departed + stats.waiting
            == called
            == departures.next_order[0]
            == departures.next_id[0]
        )
        queue = departures.queue[0, : departures.num_queue[0]]
        assert stats.waiting == len(queue)
        assert (np.diff(queue["id"]) > 0).all()
        orders = simulation.vehicles()["order"]
        assert np.unique(orders).size == orders.size
        most_waiting = max(most_waiting, stats.waiting)
    assert departures.counts[0, COUNT_DEPARTED] > 30
    if len(due) > 40:
        assert most_waiting > 0, "the queue was never used"


def test_two_processes_compute_equal_states(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path\n"
        "from tests.support.demand_worlds import TINY, tiny\n"
        "from tests.support.driving import drive, start\n"
        "for env in TINY:\n"
        "    world = tiny(env, Path(sys.argv[1])); start(world, seed=6)\n"
        "    for _ in range(150): drive(world)\n"
        "    print(env, world.state_hash(), world.traffic_stats().departed)\n"
    )
    said = []
    for seed in ("0", "4711"):
        folder = tmp_path / seed
        folder.mkdir()
        done = subprocess.run(
            [sys.executable, "-c", code, str(folder)],
            capture_output=True, text=True, check=True, env=os.environ | {"PYTHONHASHSEED": seed},
            cwd=Path(__file__).resolve().parents[2],
        )  # fmt: skip
        said.append(done.stdout.split())
    assert said[0] == said[1]
    assert int(said[0][2]) > 5


def test_the_hash_covers_waiting_vehicles_and_the_next_departure(tmp_path: Path) -> None:
    simulation = tiny("merge", tmp_path)
    start(simulation, seed=1)
    departures = simulation.departures
    while not departures.num_queue[0]:
        drive(simulation)
    before = simulation.state_hash()
    for field in departures.queue.dtype.names or ():
        value = departures.queue[field][0, 0].copy()
        departures.queue[field][0, 0] += 1
        assert simulation.state_hash() != before, field
        departures.queue[field][0, 0] = value
    for array in (departures.next_order, departures.next_id):
        array[0] += 1
        assert simulation.state_hash() != before
        array[0] -= 1
    for field in ("way", "order", "stop", "stops_end", "stopped_s", "vtype"):
        value = simulation.vehicles()[field][0].copy()
        simulation.vehicles()[field][0] += 1
        assert simulation.state_hash() != before, field
        simulation.vehicles()[field][0] = value
    assert simulation.state_hash() == before


@pytest.mark.parametrize("model", ["Krauss", "IDM"])
def test_a_slow_type_alone_on_its_route_has_no_delay(tmp_path: Path, model: str) -> None:
    """SUMO's timeLoss of this vehicle is also 0."""
    path = tmp_path / "slow.rou.xml"
    path.write_text(
        f'<routes><vType id="slow" maxSpeed="4" sigma="0" speedDev="0" carFollowModel="{model}"/>'
        '<vehicle id="s" type="slow" depart="0" departLane="0" departSpeed="max">'
        '<route edges="weave main_out"/></vehicle></routes>',
        encoding="utf-8",
    )
    simulation = demand_worlds.make("merge", [path], overrides={"clock.sim_dt_s": 0.1})
    start(simulation, seed=0)
    while simulation.traffic_stats().arrived == 0:
        drive(simulation)
        assert simulation.vehicles()["speed"].max(initial=0.0) <= 4.0 + 1e-9
    assert simulation.traffic_stats().mean_delay_s == pytest.approx(0.0, abs=1.0)
