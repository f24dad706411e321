"""Finds signals that hold one phase so long that an episode ends before the next phase.

Maps of games have such signals, which a player switches.
"""

from __future__ import annotations

from cavmarl.core.records.codes import SIGNAL_RED
from cavmarl.roads.network import RoadNetwork

HELD_S = 1000.0
_SHOWN = 5


def held_signals(network: RoadNetwork) -> tuple[str, ...]:
    """Return the ids of signals that show red to some movement for at least `HELD_S`."""
    found = []
    for row, signal in enumerate(network.signals):
        program = network.programs[signal["program"]]
        first = program["first_phase"]
        phases = network.phases[first : first + program["num_phases"]]
        is_actuated = program["controller"] >= 0
        held_s = phases["min_ms"] / 1000.0 if is_actuated else phases["duration_s"]
        for phase in phases[held_s >= HELD_S]:
            start = phase["first_state"]
            if (network.phase_states[start : start + signal["num_links"]] == SIGNAL_RED).any():
                found.append(network.signal_ids[row])
                break
    return tuple(found)


def held_signals_note(network: RoadNetwork) -> str:
    """Return a note about the signals of `held_signals`, or an empty text."""
    ids = held_signals(network)
    if not ids:
        return ""
    shown = ", ".join(ids[:_SHOWN]) + (", …" if len(ids) > _SHOWN else "")
    verb = "signal holds" if len(ids) == 1 else "signals hold"
    return (
        f"{len(ids)} {verb} a phase with red for {HELD_S:,.0f} s or more, so that vehicles wait: "
        f"{shown}; to replace their programs, set map.programs"
    )
