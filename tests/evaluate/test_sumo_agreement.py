"""Runs of real demand have no contacts, and metrics near those of SUMO."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import pytest

from cavmarl.evaluate.traffic.traffic_comparison import compare_traffic

sumo = pytest.importorskip("sumo", reason="needs the extra 'sumo'")
pytest.importorskip("libsumo", reason="needs the extra 'sumo'")

GAME = Path(sumo.SUMO_HOME) / "tools" / "game"
NEAR = 0.15  # accepted difference, relative to SUMO's figure


class Case(NamedTuple):
    """A map, its demand, and the names of the figures to compare."""

    roads: str
    demand: tuple[str, ...]
    near: tuple[str, ...] = ("arrived", "mean_speed_mps")


# The number of arrivals is not compared on Town10HD, where only about twenty vehicles arrive.
REAL = {
    "bologna": Case(
        "net/bologna_acosta/acosta_buslanes.net.xml", ("net/bologna_acosta/run.sumocfg",)
    ),
    "mcity": Case(
        "net/mcity/mcity.net.xml", ("net/mcity/mcity.rou.xml", "net/mcity/mcity.add.xml")
    ),
    "town25": Case("net/Town10HD.net.xml", ("demand/town10hd_25.rou.xml",), ("mean_speed_mps",)),
    "town50": Case("net/Town10HD.net.xml", ("demand/town10hd_50.rou.xml",), ("mean_speed_mps",)),
}
WHEEL = {
    "kuehne": Case("kuehne/kuehne.net.xml", ("kuehne/kuehne.rou.xml",)),
    "cross_demo": Case("cross/cross.net.xml", ("cross_demo.sumocfg",)),
}


def compare(folder: Path, case: Case, seconds: int = 900) -> None:
    files = [folder / name for name in case.demand]
    found = compare_traffic(folder / case.roads, files, seconds=seconds, dt_s=0.1, seed=1)
    assert found.ours.figures.contacts == 0
    assert found.ours.figures.departed > 0
    for figure in case.near:
        ratio = found.ratio(figure)
        assert ratio is not None
        assert abs(ratio - 1.0) < NEAR, f"{figure}: {ratio:.2f} of SUMO's"


@pytest.mark.slow
@pytest.mark.parametrize("name", REAL)
def test_traffic_on_real_maps_agrees_with_sumo(shared_maps: Path, name: str) -> None:
    compare(shared_maps, REAL[name])


@pytest.mark.slow
@pytest.mark.parametrize("name", WHEEL)
def test_traffic_on_maps_of_sumos_wheel_agrees_with_sumo(name: str) -> None:
    compare(GAME, WHEEL[name])


def test_traffic_of_three_minutes_agrees_with_sumo() -> None:
    """This short variant is not slow, so it belongs to every run of the tests."""
    compare(GAME, WHEEL["kuehne"], 180)
