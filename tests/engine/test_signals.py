"""Signals follow the programs in the map's XML."""

from __future__ import annotations

from fractions import Fraction
from itertools import accumulate
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from cavmarl.config.registry import load_config, resolve_map
from cavmarl.engine.simulation import Simulation
from cavmarl.roads.network import SIGNAL_STATES
from tests.support.driving import idle, make_traffic, start


def letters(simulation: Simulation) -> dict[str, str]:
    """Return the letters that each signal shows now."""
    network = simulation.network
    shown = {}
    for k, phase in enumerate(simulation.signal_phases()):
        first = network.phases[phase]["first_state"]
        codes = network.phase_states[first : first + network.signals[k]["num_links"]]
        shown[network.signal_ids[k]] = "".join(SIGNAL_STATES[code] for code in codes)
    return shown


Program = tuple[Fraction, list[tuple[Fraction, str]]]  # offset; (duration, state) of each phase


def programs(source: Path) -> dict[str, Program]:
    """Return the first program of each signal of a SUMO network, by the signal's name."""
    found: dict[str, Program] = {}
    for logic in ElementTree.parse(source).getroot().iter("tlLogic"):
        phases = [(Fraction(p.get("duration", "")), p.get("state", "")) for p in logic]
        found.setdefault(logic.get("id", ""), (Fraction(logic.get("offset", "0")), phases))
    return found


def planned(program: Program, time: Fraction) -> str:
    """Return the state of a program at a time; its cycle begins at the offset, as in SUMO."""
    offset, phases = program
    left = (time - offset) % sum(duration for duration, _ in phases)
    ends = accumulate(duration for duration, _ in phases)
    return next(state for end, (_, state) in zip(ends, phases, strict=True) if left < end)


@pytest.mark.parametrize("env", ["grid4x4", "town"])
@pytest.mark.parametrize("offset", [None, "10"])
def test_signals_follow_the_programs_of_the_map(
    env: str, offset: str | None, tmp_path: Path
) -> None:
    source = resolve_map(*load_config(env))
    text = source.read_text(encoding="utf-8").replace('type="actuated"', 'type="static"')
    if offset is not None:
        text = text.replace('offset="0"', f'offset="{offset}"')
    source = tmp_path / "fixed.net.xml"
    source.write_text(text, encoding="utf-8")
    simulation = make_traffic(source, background=0, overrides={"clock.ctrl_dt_s": 0.05})
    start(simulation, seed=0)
    plan = programs(source)
    seen = set()
    for tick in range(2400):
        now = letters(simulation)
        if tick % 13 == 0:
            time = Fraction(tick, 20)
            expected = {name: planned(program, time) for name, program in plan.items()}
            assert now == expected, f"tick {tick}"
        seen.add(tuple(now.values()))
        simulation.step(idle(simulation))
    assert len(seen) > 3
    assert np.all(simulation.ticks() == 2400)
