"""`SignalAgents`: the agents of signals, with their spaces, and the check of their choices."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.config.signals import SIGNAL_TERMS
from cavmarl.env.roadside_agents import RoadsideAgents
from cavmarl.parallel.worlds.step_arrays import StepArrays
from cavmarl.roads.network import RoadNetwork
from cavmarl.signals.controllers import ProgramController, SignalView
from cavmarl.signals.kernels.green_choices import GREEN
from cavmarl.signals.signal_table import SignalTable

PREFIX = "signal_"  # prefix of these agents' ids, followed by the signal's id

# Key of the arrays of the signals' agents, beside `roadside_agents.VEHICLES`.
SIGNALS = "signals"


class SignalAgents(RoadsideAgents):
    """The agents of S signals in W worlds, and their results.

    Args:
        config: configuration of the worlds.
        network: map of the worlds.
        arrays: inputs and outputs of a step.

    Attributes:
        table: the signals with their greens, lanes and movements.
    """

    kind, prefix, choice = SIGNALS, PREFIX, "green"
    terms: ClassVar[tuple[str, ...]] = SIGNAL_TERMS

    def __init__(self, config: EnvConfig, network: RoadNetwork, arrays: StepArrays) -> None:
        self._config = config.signals
        self._dt = config.clock.sim_dt_s
        self.table = SignalTable(network, self._config.range_m)
        greens = self.table.arrays.num_greens
        cyclic = self._config.action == "keep_or_next"
        super().__init__(
            arrays,
            self.table.ids,
            np.minimum(greens, 2) if cyclic else greens,
            self.table.features,
            is_strict=config.action.missing_action == "error",
            forbids=self._config.forbidden == "error",
        )

    @property
    def view(self) -> SignalView:
        """The state for controllers; see `signals.controllers`."""
        arrays = self._arrays
        return SignalView(
            config=self._config,
            dt=self._dt,
            table=self.table,
            observations=arrays.signal_observations,
            ticks=arrays.ticks,
            counts=arrays.signal_counts,
            states=arrays.signal_states,
            masks=arrays.signal_masks,
            decides=arrays.signal_decides,
            history=arrays.signal_history,
            loops=arrays.signal_loops,
        )

    def suggest(self) -> NDArray[np.int64]:
        """Return the choices (W, S) that follow the durations of the map's programs."""
        return ProgramController().choose(self.view)

    def kept(self) -> NDArray[np.int64]:
        """Return the choices (W, S) that keep the greens."""
        if self._config.action == "next_phase":
            return self._arrays.signal_states[..., GREEN]
        return np.zeros(self._arrays.signal_choices.shape, dtype=np.int64)
