"""Checks whether worlds can be drawn, and copies remote worlds to draw them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.config.terms import TERMS
from cavmarl.core.errors import ConfigError
from cavmarl.core.records.codes import (
    EVENT_ARRIVED,
    EVENT_COLLIDED,
    EVENT_OFF_ROAD,
    EVENT_RED_LIGHT,
    EVENT_WRONG_WAY,
)
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.world_frame import ENDED, NONE_ENDED
from cavmarl.parallel.backends import shows_state
from cavmarl.parallel.nodes.node_worlds import NodeWorlds
from cavmarl.parallel.placement.backend_name import BackendName
from cavmarl.parallel.worlds.journaled_worlds import without_journals
from cavmarl.parallel.worlds.local_worlds import LocalWorlds, kept_elsewhere
from cavmarl.parallel.worlds.step_arrays import StepArrays, SteppedWorlds

RENDER_MODES = ("human", "rgb_array")

# Terms of the events that end the trip of an agent's vehicle.
_ENDS = {
    TERMS.index("collision"): EVENT_COLLIDED,
    TERMS.index("off_road"): EVENT_OFF_ROAD,
    TERMS.index("wrong_way"): EVENT_WRONG_WAY,
    TERMS.index("red_light"): EVENT_RED_LIGHT,
    TERMS.index("arrival"): EVENT_ARRIVED,
}


def check_rendering(
    config: EnvConfig,
    render_mode: str | None,
    backend: BackendName,
    modes: tuple[str, ...] = RENDER_MODES,
) -> None:
    """Raise an error for worlds that cannot be drawn.

    Raises:
        ConfigError: the mode is not one of `modes`, or the worlds' state is not available here.
    """
    if render_mode is None:
        return
    if render_mode not in modes:
        raise ConfigError(f"render_mode = {render_mode!r}: must be {' or '.join(modes)}, or None")
    if obstacle := why_not_copied(config, backend):
        raise ConfigError(
            f"render_mode = {render_mode!r} with {obstacle}: such worlds can only be drawn in the "
            "caller's process; use backend='local'"
        )


def check_external_agents(config: EnvConfig, backend: BackendName) -> None:
    """Raise a ConfigError if external agents need a copy of the worlds and there is none."""
    if config.population.external_agents and (obstacle := why_not_copied(config, backend)):
        raise ConfigError(
            f"population.external_agents with {obstacle}: such vehicles can only sense in the "
            "caller's process; use backend='local', or set population.external_agents = false"
        )


def why_not_copied(config: EnvConfig, backend: BackendName) -> str:
    """Return the settings that prevent this process from copying the worlds; "": none do."""
    if backend.is_local:
        return ""
    with_sumo = config.traffic.source != "native"
    key = f"traffic.source = {config.traffic.source!r}" if with_sumo else kept_elsewhere(config)
    if key:
        return f"backend = '{backend}' and {key}"
    return "" if shows_state(backend) else f"backend = '{backend}'"


def unguarded(worlds: SteppedWorlds) -> SteppedWorlds:
    """Return the worlds inside the wrapper of a time master; other worlds are returned as is."""
    found: SteppedWorlds = getattr(worlds, "guarded", worlds)
    return found


class WorldCopy:
    """The worlds of an environment in this process: local worlds, or a copy of remote ones."""

    def __init__(self) -> None:
        self._copied: LocalWorlds | None = None

    def standing(self, worlds: SteppedWorlds) -> Simulation:
        """Return the local worlds, or a copy of remote worlds that may be outdated."""
        worlds = unguarded(worlds)
        if isinstance(worlds, LocalWorlds):
            return worlds.simulation
        if self._copied is None:
            self._copied = LocalWorlds(without_journals(worlds.world), len(worlds.arrays.mask))
        return self._copied.simulation

    def present(self, worlds: SteppedWorlds, with_sumo: bool = True) -> Simulation:
        """Return the local worlds, or an up-to-date copy of remote worlds.

        `with_sumo`: see `Simulation.load`.
        """
        worlds = unguarded(worlds)
        simulation = self.standing(worlds)
        if self._copied is not None:
            if isinstance(worlds, NodeWorlds):
                simulation.zones.set_zones(worlds.partition)
            self._copied.load(self._copied.read_worlds(worlds.save_worlds()), with_sumo)
        return simulation

    def close(self) -> None:
        """Close the copy, if there is one."""
        if self._copied is not None:
            self._copied.close()
            self._copied = None


def vehicles_that_ended(arrays: StepArrays, world: int) -> NDArray[np.void]:
    """Return ENDED: agents whose vehicles' trips ended in a world's last step, and why."""
    if not arrays.vehicle_done[world].any():
        return NONE_ENDED
    agents = np.flatnonzero(arrays.vehicle_done[world])
    ended = np.zeros(len(agents), dtype=ENDED)
    ended["agent"] = agents
    for term, bit in _ENDS.items():
        ended["events"][arrays.terms[world, agents, term] > 0.0] |= bit
    return ended
