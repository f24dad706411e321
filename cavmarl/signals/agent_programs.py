"""Programs of signals whose phases agents choose, made from the programs of the map.

A program has the greens of the map's program, and then a yellow phase and an all-red phase for each
ordered pair of greens.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

from cavmarl.config.signals import ALL_SIGNALS, SignalsConfig
from cavmarl.core.errors import ConfigError
from cavmarl.roads.network import SIGNAL_STATES, RoadNetwork
from cavmarl.roads.sumo_net.signal_plans import remade
from cavmarl.roads.sumo_net.signal_rows import ControlledPhase, SignalRows

AGENT_PROGRAM = "agent"
MAX_GREENS = 64
_GREENS, _YELLOWS, _REDS = "gG", "yYu", "rs"

log = logging.getLogger(__name__)


class AgentProgram(NamedTuple):
    """The phases from which an agent chooses.

    Attributes:
        greens: letters of each green, and the green's duration in s in the map's program.
        yellow: whether there is a yellow phase between two greens.
        all_red: whether an all-red phase comes before a green.
    """

    greens: tuple[tuple[str, float], ...]
    yellow: bool
    all_red: bool

    def phases(self, config: SignalsConfig) -> list[ControlledPhase]:
        """Return the phases in the form of `SignalRows.add_controlled`."""
        n = len(self.greens)
        min_ms, max_ms = round(1e3 * config.min_green_s), round(1e3 * config.max_green_s)
        greens = [
            ControlledPhase(state, duration_s, min_ms, max_ms, k, True)
            for k, (state, duration_s) in enumerate(self.greens)
        ]
        pairs = [(i, j) for i in range(n) for j in range(n) if i != j]
        found = [*greens]
        for is_used, duration_s, make in (
            (self.yellow, config.yellow_s, between_greens),
            (self.all_red, config.all_red_s, _all_red),
        ):
            if not is_used:
                continue
            ms = round(1e3 * duration_s)
            is_last = make is _all_red or not self.all_red
            for place, (i, j) in enumerate(pairs):
                following = j if is_last else n + len(pairs) + place
                state = make(self.greens[i][0], self.greens[j][0])
                found.append(ControlledPhase(state, duration_s, ms, ms, following, False))
        return found

    def cycle_s(self, config: SignalsConfig) -> float:
        """Return the duration in s of a cycle with the durations of the map's program."""
        change_s = config.yellow_s + config.all_red_s
        return sum(duration_s + change_s for _, duration_s in self.greens)


def with_agent_programs(network: RoadNetwork, config: SignalsConfig) -> RoadNetwork:
    """Return a network in which agents choose the phases of signals.

    The greens of a signal are the phases of its program with a green letter and no yellow letter,
    in the order of the program; see `signals.greens`. Other programs and timetables of these
    signals are not used.

    Args:
        network: the map.
        config: the signals that agents control, and durations.

    Returns:
        A network with a new `source_hash`, or the same network if no agents control signals.

    Raises:
        ConfigError: a signal is unknown or has fewer than two greens, there are several maps, or no
            signal of the map has two greens.
    """
    if not config.are_controlled:
        return network
    greens = {
        name: greens_of(network, row, config.greens == "all")[: MAX_GREENS + 1]
        for row, name in enumerate(network.signal_ids)
    }
    chosen = _chosen(network, config, greens)
    rows = SignalRows.of(network)
    for name in chosen:
        program = AgentProgram(greens[name], config.yellow_s > 0.0, config.all_red_s > 0.0)
        rows.add_controlled(name, AGENT_PROGRAM, program.phases(config), program.cycle_s(config))
    return remade(network, rows, (network.source_hash, *chosen, repr(config)))


def greens_of(
    network: RoadNetwork, signal: int, every: bool = False
) -> tuple[tuple[str, float], ...]:
    """Return the greens of a signal's current program: letters, and duration in s.

    `every`: whether to apply the rule of `signals.greens = all`.
    """
    links = network.links[network.links["signal"] == signal]
    used = sorted({int(index) for index in links["signal_index"]})
    program = network.programs[network.signals["program"][signal]]
    num_links = int(network.signals["num_links"][signal])
    first = int(program["first_phase"])
    found: list[tuple[str, float]] = []
    for phase in network.phases[first : first + program["num_phases"]]:
        start = int(phase["first_state"])
        codes = network.phase_states[start : start + num_links].tolist()
        letters = "".join(SIGNAL_STATES[code] for code in codes)
        if every:
            is_green = "y" not in letters and bool(set(letters) - set(_REDS))
        else:
            shown = {letters[index] for index in used}
            is_green = bool(shown & set(_GREENS)) and not shown & set(_YELLOWS)
            is_green = is_green and letters not in dict(found)
        if is_green:
            found.append((letters, float(phase["duration_s"])))
    return tuple(found)


def _chosen(
    network: RoadNetwork,
    config: SignalsConfig,
    greens: dict[str, tuple[tuple[str, float], ...]],
) -> Sequence[str]:
    """Return the ids of the signals that agents control, in the order of the map."""
    if len(network.maps) > 1:
        raise ConfigError(
            f"signals.agents = {config.agents!r}: needs a single map, but map.source names several"
        )
    if config.agents != ALL_SIGNALS:
        for name in config.agents:
            if name not in greens:
                raise ConfigError(
                    f"signals.agents: no signal {name!r}; the map has "
                    f"{', '.join(list(greens)[:8]) or 'no signals'}"
                )
            if len(greens[name]) < 2:
                raise ConfigError(
                    f"signals.agents: the program of signal {name!r} has {len(greens[name])} "
                    "greens; a signal with an agent needs two or more"
                )
        return [name for name in network.signal_ids if name in config.agents]
    chosen = [name for name, found in greens.items() if 2 <= len(found) <= MAX_GREENS]
    others = [name for name in greens if name not in chosen]
    if not chosen:
        raise ConfigError(
            f"signals.agents = 'all': no signal of this map has 2 to {MAX_GREENS} greens; "
            "set signals.agents to 'none'"
        )
    if others:
        _tell_once(network.source_hash, network.name, len(others), ", ".join(others[:5]))
    return chosen


@cache
def _tell_once(source_hash: str, name: str, count: int, shown: str) -> None:
    log.warning(
        "%s: %d signals keep their programs, because they do not have 2 to %d greens: %s%s",
        name, count, MAX_GREENS, shown, ", …" if count > 5 else "",
    )  # fmt: skip


def between_greens(before: str, after: str) -> str:
    """Return the letters between two greens: green links that become red show yellow."""
    return "".join(
        "y" if old in _GREENS and new in _REDS else old
        for old, new in zip(before, after, strict=True)
    )


def _all_red(before: str, after: str) -> str:
    """Return the letters of the all-red phase; links whose signal is off (o, O) stay off."""
    return "".join(old if old in "oO" else "r" for old in before)
