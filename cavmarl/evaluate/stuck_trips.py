"""Detection of agents that are stopped with or without a reason, to explain unfinished trips."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.records.codes import ACTION_FASTER
from cavmarl.env.vector import CavVectorEnv
from cavmarl.evaluate.recorder import STILL_S, Recorder

ASK_S = 5.0  # time between two queries of the built-in driver's action
STILL_MPS = 0.1  # a slower vehicle counts as stopped
GO_MPS2 = 0.5  # acceleration with which the built-in driver would start


class StandingWatch:
    """Records how long agents have been stopped, and whether the built-in driver would stop."""

    def __init__(self, vec: CavVectorEnv, recorder: Recorder) -> None:
        self._vec = vec
        self._recorder = recorder
        self._every = max(1, round(ASK_S / vec.step_s))
        self._meta = vec.config.action.kind == "discrete"
        self._places_m = np.full((vec.num_envs, vec.num_agents, 2), np.nan)

    def look(self, step: int, mask: NDArray[np.bool_]) -> None:
        """Observe the acting agents (W, A) before a step, after they were located."""
        recorder = self._recorder
        moved_m = np.abs(recorder.places_m - self._places_m).sum(axis=2)
        stands = mask & (
            moved_m < STILL_MPS * self._vec.step_s
        )  # False for a new agent, as its earlier place is NaN
        recorder.still_s = np.where(stands, recorder.still_s + self._vec.step_s, 0.0)
        self._places_m[:] = np.where(mask[..., None], recorder.places_m, np.nan)
        if step % self._every == 0 and (recorder.still_s >= STILL_S - ASK_S).any():
            self._vec.worlds.suggest()
            asked = self._vec.worlds.arrays.suggested[..., 0]
            recorder.would_go[:] = asked == ACTION_FASTER if self._meta else asked >= GO_MPS2
