"""`LimitAgents`: the agents of units that set speed limits."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.config.limits import LIMIT_TERMS
from cavmarl.env.roadside_agents import RoadsideAgents
from cavmarl.limits.limit_controllers import LimitView
from cavmarl.limits.limit_table import LimitTable
from cavmarl.parallel.worlds.step_arrays import StepArrays
from cavmarl.roads.network import RoadNetwork
from cavmarl.signals.kernels.green_choices import GREEN, KEEP

LIMITS = "limits"  # key of the arrays of an environment in which units have agents


class LimitAgents(RoadsideAgents):
    """The agents of U units in W worlds, and their results.

    Args:
        config: configuration of the worlds.
        network: map of the worlds.
        arrays: inputs and outputs of a step.

    Attributes:
        table: the units with their lanes and sections.
    """

    kind, prefix, choice = LIMITS, "limit_", "limit"
    terms: ClassVar[tuple[str, ...]] = LIMIT_TERMS

    def __init__(self, config: EnvConfig, network: RoadNetwork, arrays: StepArrays) -> None:
        self._config = config.limits
        self.table = LimitTable(network, config.limits)
        sizes = self.table.sizes
        super().__init__(
            arrays,
            self.table.ids,
            np.full(sizes.signals, sizes.greens, dtype=np.int32),
            [sizes.features] * sizes.signals,
            is_strict=config.action.missing_action == "error",
            forbids=config.limits.forbidden == "error",
        )

    @property
    def view(self) -> LimitView:
        """The state for controllers; see `limits.limit_controllers`."""
        arrays = self._arrays
        return LimitView(
            config=self._config,
            table=self.table,
            observations=arrays.signal_observations,
            ticks=arrays.ticks,
            states=arrays.signal_states,
            masks=arrays.signal_masks,
            decides=arrays.signal_decides,
        )

    def suggest(self) -> NDArray[np.int64]:
        """Return choices (W, U) that raise the limits step by step to the highest."""
        change = self._config.most_change or len(self._config.speeds_mps)
        most = len(self._config.speeds_mps) - 1
        found = np.minimum(self._arrays.signal_states[..., GREEN] + change, most)
        return np.where(self._arrays.signal_decides[:, None], found, KEEP)

    def kept(self) -> NDArray[np.int64]:
        """Return the choices (W, U) that keep the limits."""
        return self._arrays.signal_states[..., GREEN]
