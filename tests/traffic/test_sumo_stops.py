"""`sumo-demand`: vehicles make the stops that SUMO reports."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from cavmarl import make_vec
from cavmarl.core.errors import CapacityError
from cavmarl.engine.simulation import Simulation
from cavmarl.traffic.demand import read_demand
from cavmarl.traffic.sumo.route_book import StopBook
from cavmarl.verify.equivalence import verify_zones
from tests.support.driving import drive
from tests.support.sumo_worlds import coupled, write_stops

pytest.importorskip("sumo", reason="needs the extra 'sumo'")
pytest.importorskip("libsumo", reason="needs the extra 'sumo'")

SECONDS = {"bus": [6.0, 4.0], "van": [3.0], "car": [], "taxi": [2.0]}
MODE = {"traffic.source": "sumo-demand", "sensors.signal.timing": False}


def stands(simulation: Simulation, seconds: int) -> dict[str, list[tuple[float, float, float]]]:
    """Drive; return (x of the centre in m, start in s, duration in s) of each vehicle's stops."""
    assert simulation.sumo is not None
    dt, tracks = simulation.config.clock.ctrl_dt_s, {}
    for step in range(round(seconds / dt)):
        drive(simulation)
        for row in simulation.vehicles():
            name = simulation.sumo.worlds.names[0][row["order"]]
            track = tracks.setdefault(name, [])
            track.append((dt * step, float(row["x"]), float(row["speed"])))
    found = {}
    for name, track in tracks.items():
        still = [speed < 0.1 for *_, speed in track]
        edges = [k for k, pair in enumerate(pairwise([False, *still, False])) if pair[0] != pair[1]]
        found[name] = [
            (track[first][1], track[first][0], dt * (end - first))
            for first, end in zip(edges[::2], edges[1::2], strict=True)
            if dt * (end - first) > 1.5
        ]
    return found


def test_stops_from_sumo_equal_stops_from_the_reader_of_demand(tmp_path: Path) -> None:
    """SUMO reports the same lanes, positions and times as cavmarl's reader, also for a bus stop."""
    paths = write_stops(tmp_path)
    with coupled("merge", paths, "sumo-demand") as simulation:
        network, travel = simulation.network, simulation.travel
        own = read_demand(paths, network).stops
        assert simulation.sumo is not None
        found = {}
        for _ in range(240):
            drive(simulation)
            for row in simulation.vehicles():
                name = simulation.sumo.worlds.names[0][row["order"]]
                if name not in found and row["stops_end"] >= 0:
                    found[name] = travel.stops[row["stop"] : row["stops_end"]].copy()
    assert "car" not in found
    assert {name: rows["duration"].tolist() for name, rows in found.items() if "." not in name} == {
        name: seconds for name, seconds in SECONDS.items() if seconds
    }
    assert len([name for name in found if name.startswith("more.")]) == 5
    for name in ("bus", "van", "taxi"):
        for row in found[name]:
            same = own[
                (own["lane"] == row["lane"])
                & np.isclose(own["end"], row["end"], atol=0.011)
                & np.isclose(own["start"], row["start"], atol=0.11)
                & (own["duration"] == row["duration"])
                & (own["parking"] == row["parking"])
            ]
            assert len(same), (name, row)
    assert found["bus"]["until"].tolist() == [25.0, -1.0]


def test_vehicles_stop_at_their_stops_for_the_given_time(tmp_path: Path) -> None:
    with coupled("merge", write_stops(tmp_path), "sumo-demand") as simulation:
        network = simulation.network
        found = stands(simulation, 110)
        ends = {
            name: network.lanes["length_m"][network.lane_ids.index(name)]
            for name in ("main_in_0", "main_out_0")
        }
    assert min(ends.values()) > 110.0
    assert found["car"] == []
    for name in ("bus", "van", "taxi"):
        assert len(found[name]) == len(SECONDS[name]), (name, found[name])
        for (_, _, lasted), seconds in zip(found[name], SECONDS[name], strict=True):
            assert lasted >= seconds - 0.2
    (_, since, lasted), _ = found["bus"]
    assert since + lasted == pytest.approx(25.0, abs=0.6), (
        "the bus did not leave at its time `until`"
    )
    first, second = (x for x, _, _ in found["bus"])
    assert second > first


def test_zones_and_workers_change_no_result(tmp_path: Path) -> None:
    paths = [str(path) for path in write_stops(tmp_path)]
    both = {**MODE, "traffic.demand": paths, "clock.sim_dt_s": 0.1, "clock.ctrl_dt_s": 0.2}
    verified = verify_zones(
        "merge", (1, 2), steps=200, seed=3, agents=2, background=2, overrides=both, check=True
    )
    assert [result.difference for result in verified.results] == [None, None]
    hashes = []
    for workers in (0, 2):
        vec = make_vec("merge", num_envs=3, agents=2, background=0, workers=workers, overrides=both)
        try:
            vec.reset(seed=5)
            for _ in range(120):
                vec.step(vec.suggest_actions())
            hashes.append([vec.state_hash(w) for w in range(3)])
        finally:
            vec.close()
    assert hashes[0] == hashes[1]


def test_too_many_stops_of_a_vehicle_are_refused(tmp_path: Path) -> None:
    with coupled("merge", write_stops(tmp_path), "sumo-demand", seed=None) as simulation:
        table = np.zeros(5, dtype=simulation.travel.stops.dtype)
        book = StopBook(simulation.network, table, 2)
        stop = (0, 1.0, 2.0, 3.0, -1.0, False)
        assert book.enter(0, []) == (-1, -1)
        assert book.enter(0, [stop]) == book.enter(0, [stop]) == (0, 1)
        assert book.enter(1, [stop, stop]) == (2, 4)
        with pytest.raises(CapacityError, match="over 2 stops in one world"):
            book.enter(0, [stop, stop])
        book.begin(0)
        assert book.enter(0, [stop, stop]) == (0, 2)
