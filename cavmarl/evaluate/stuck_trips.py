"""Which agents stand, and whether they have to: what becomes of trips that do not end."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.records.codes import ACTION_FASTER
from cavmarl.env.vector import CavVectorEnv
from cavmarl.evaluate.recorder import STILL_S, Recorder

ASK_S = 5.0  # between the questions what the built-in driver would do
STILL_MPS = 0.1  # slower than this a vehicle stands
GO_MPS2 = 0.5  # the built-in driver would set off if it accelerated like this


class StandingWatch:
    """Writes into a recorder how long agents have stood, and whether the built-in driver would."""

    def __init__(self, vec: CavVectorEnv, recorder: Recorder) -> None:
        self._vec = vec
        self._recorder = recorder
        self._every = max(1, round(ASK_S / vec.step_s))
        self._meta = vec.config.action.kind == "discrete"
        self._places_m = np.full((vec.num_envs, vec.num_agents, 2), np.nan)

    def look(self, step: int, mask: NDArray[np.bool_]) -> None:
        """Before a step of the agents (W, A) that act, once they are located."""
        recorder = self._recorder
        moved_m = np.abs(recorder.places_m - self._places_m).sum(axis=2)
        stands = mask & (moved_m < STILL_MPS * self._vec.step_s)  # no place before: it is new
        recorder.still_s = np.where(stands, recorder.still_s + self._vec.step_s, 0.0)
        self._places_m[:] = np.where(mask[..., None], recorder.places_m, np.nan)
        if step % self._every == 0 and (recorder.still_s >= STILL_S - ASK_S).any():
            self._vec.worlds.suggest()
            asked = self._vec.worlds.arrays.suggested[..., 0]
            recorder.would_go[:] = asked == ACTION_FASTER if self._meta else asked >= GO_MPS2
