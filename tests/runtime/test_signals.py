"""Signals follow the programs of the map, read here by themselves from its XML."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from cavmarl.registry import load_config, resolve_map
from cavmarl.roads.network import SIGNAL_STATES
from cavmarl.runtime.simulation import Simulation
from tests.driving import idle, make_traffic, start


def letters(simulation: Simulation) -> dict[str, str]:
    """What every signal shows now."""
    network = simulation.network
    shown = {}
    for k, phase in enumerate(simulation.signal_phases()):
        first = network.phases[phase]["first_state"]
        codes = network.phase_states[first : first + network.signals[k]["num_links"]]
        shown[network.signal_ids[k]] = "".join(SIGNAL_STATES[code] for code in codes)
    return shown


def planned(source: Path, time: Fraction) -> dict[str, str]:
    """What the programs of a SUMO network say, as SUMO runs them: at time - offset in the cycle."""
    states: dict[str, str] = {}
    for program in ElementTree.parse(source).getroot().iter("tlLogic"):
        phases = [(Fraction(p.get("duration", "")), p.get("state", "")) for p in program]
        left = (time - Fraction(program.get("offset", "0"))) % sum(d for d, _ in phases)
        for duration, state in phases:
            if left < duration:
                states.setdefault(program.get("id", ""), state)
                break
            left -= duration
    return states


@pytest.mark.parametrize("env", ["grid4x4", "town"])
@pytest.mark.parametrize("offset", [None, "10"])
def test_signals_show_what_the_map_plans(env: str, offset: str | None, tmp_path: Path) -> None:
    source = resolve_map(*load_config(env))
    if offset is not None:
        text = source.read_text(encoding="utf-8").replace('offset="0"', f'offset="{offset}"')
        source = tmp_path / "shifted.net.xml"
        source.write_text(text, encoding="utf-8")
    simulation = make_traffic(source, background=0, overrides={"clock.ctrl_dt_s": 0.05})
    start(simulation, seed=0)
    tick = Fraction(1, 20)
    seen = set()
    for k in range(0, 2400):
        now = letters(simulation)
        if k % 13 == 0 or k < 3:
            assert now == planned(source, k * tick), f"tick {k}"
        seen.add(tuple(now.values()))
        simulation.step(idle(simulation))
    assert len(seen) > 3
    assert np.all(simulation.ticks() == 2400)
