"""The broadcast time to the next change of a signal, compared with the actual change."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.driving.kernels.junctions.gaps import link_signal
from cavmarl.driving.kernels.junctions.signal_timing import time_to_change
from cavmarl.roads.kernels.signal_phases import switch_signals
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.sumo_net.reader import read_network
from cavmarl.shards.shard import make_worlds
from tests.support.traffic import network

DT = 0.5


def watch(
    roads: RoadNetwork, seconds: float, busy: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return two arrays (ticks, links with a signal): states, and predicted times to their change.

    Each detector is occupied in the share `busy` of the ticks.
    """
    random = np.random.default_rng(1)
    links = [k for k, link in enumerate(roads.links) if link["signal"] >= 0]
    worlds = make_worlds(1, 1, roads)
    shown = np.zeros((int(seconds / DT), len(links)))
    told = np.zeros_like(shown)
    for tick in range(len(shown)):
        worlds.ticks[:] = tick
        worlds.detected_s[random.random(worlds.detected_s.shape) < busy] = tick * DT
        switch_signals(
            roads.arrays,
            worlds.keys,
            worlds.ticks,
            worlds.detected_s,
            DT,
            worlds.controllers,
            worlds.signal_phase,
        )
        phase, controllers = worlds.signal_phase[0], worlds.controllers[0]
        for k, link in enumerate(links):
            shown[tick, k] = link_signal(roads.arrays, link, phase)
            told[tick, k] = time_to_change(roads.arrays, controllers, link, phase, tick * DT, DT)
    return shown, told


def true_times(shown: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the actual time until each state changed; nan if it did not change by the end."""
    found = np.full_like(shown, np.nan)
    for k in range(shown.shape[1]):
        changes = np.flatnonzero(np.diff(shown[:, k])) + 1
        before = np.arange(changes[-1])
        after = changes[np.searchsorted(changes, before, side="right")]
        found[before, k] = (after - before) * DT
    return found


def test_fixed_time_signals_change_at_the_predicted_time() -> None:
    roads = network("grid4x4")
    shown, told = watch(roads, 3 * float(roads.programs["cycle_s"].max()), busy=0.0)
    true = true_times(shown)
    known = np.isfinite(true)
    assert known.sum() > 1000
    assert told[known] == pytest.approx(true[known])


def test_actuated_signals_change_no_earlier_than_predicted(tmp_path: Path) -> None:
    sumo = pytest.importorskip("sumo", reason="needs the extra: sumo")
    path = tmp_path / "crossing.net.xml"
    options = ["--grid", "--grid.number", "1", "--grid.attach-length", "100", "--output", str(path)]
    signals = ["--default-junction-type", "traffic_light", "--tls.default-type", "actuated"]
    command = [Path(sumo.SUMO_HOME) / "bin" / "netgenerate", *options, *signals]
    subprocess.run(command, check=True, capture_output=True)
    shown, told = watch(read_network(path), 400.0, busy=0.3)
    true = true_times(shown)
    known = np.isfinite(true)
    assert (told[known] <= true[known] + 1e-9).all()
    assert (told[known] < true[known] - 5.0).any()  # some greens were extended by over 5 s
    assert (told[known] > 3.0).any()
