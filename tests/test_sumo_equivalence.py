"""Worlds coupled with SUMO: zones do not change results, and counts of vehicles equal SUMO's."""

from __future__ import annotations

from pathlib import Path

import pytest

from cavmarl.verify.equivalence import verify_zones
from tests.support.driving import drive
from tests.support.sumo_worlds import MODES, coupled, tiny_file

pytest.importorskip("sumo", reason="needs the extra 'sumo'")
pytest.importorskip("libsumo", reason="needs the extra 'sumo'")

CLOCK = {"clock.sim_dt_s": 0.1, "clock.ctrl_dt_s": 0.2, "sensors.signal.timing": False}


def overrides(source: str, demand: Path) -> dict[str, object]:
    return {"traffic.source": source, "traffic.demand": [str(demand)], **CLOCK}


@pytest.mark.parametrize("source", MODES)
def test_results_with_sumo_do_not_depend_on_zones(tmp_path: Path, source: str) -> None:
    """The world has agents, generated vehicles and SUMO's vehicles."""
    found = verify_zones(
        "grid4x4",
        (1, 2, 4, 9),
        steps=100,
        seed=2,
        agents=4,
        background=4,
        overrides=overrides(source, tiny_file(tmp_path)),
        check=True,
    )
    for result in found.results:
        assert result.difference is None, result
        assert result.steps == 100
    *_, four, nine = found.results
    assert min(four.crossings, nine.crossings) > 0


@pytest.mark.parametrize("source", MODES)
def test_vehicle_counts_of_bologna_match_sumo_for_two_minutes(
    shared_maps: Path, source: str
) -> None:
    bologna(shared_maps, source, 120)


@pytest.mark.slow
@pytest.mark.parametrize("source", MODES)
def test_vehicle_counts_of_bologna_match_sumo_for_an_hour(shared_maps: Path, source: str) -> None:
    bologna(shared_maps, source, 3600)


def bologna(maps: Path, source: str, seconds: int) -> None:
    """Run the map of Bologna with its demand; compare counts of vehicles with SUMO's."""
    folder = maps / "net" / "bologna_acosta"
    own = {"clock.sim_dt_s": 0.1, "clock.ctrl_dt_s": 0.5, "horizon_s": float(seconds + 10)}
    with coupled(
        folder / "acosta_buslanes.net.xml", [folder / "run.sumocfg"], source, overrides=own
    ) as simulation:
        for _ in range(2 * seconds):
            drive(simulation)
        assert simulation.sumo is not None
        stats, worlds = simulation.traffic_stats(), simulation.sumo.worlds
        come = len(worlds.names[0])
        assert come > 0.2 * seconds
        if source == "sumo-traffic":
            assert stats.running == len(worlds.at(0).seen)
            assert stats.departed == come == stats.running + stats.arrived + stats.removed
            assert stats.removed == worlds.teleports[0]
        else:
            assert stats.departed + stats.waiting == come
        assert stats.mean_speed_mps > 1.0
