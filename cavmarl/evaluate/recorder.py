"""`Recorder`: records the trips and episodes of worlds that are stepped together."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.terms import TERMS
from cavmarl.evaluate.statistics import gini_coefficient, jain_index
from cavmarl.evaluate.tables import EPISODE, TRIP, reward_column
from cavmarl.rewards.kernels.terms import TTC_HORIZON_S

SHORT_TTC_S = 1.5  # below this, a driver has no time to react (Hayward 1972; SSAM)
PET_HORIZON_S = 10.0  # a pass after a longer time is no encounter
SLOWEST = 3.0  # longest duration of a success, as a multiple of the free travel time
STILL_S = 10.0  # a vehicle that has been stopped this long when its trip is cut counts as stopped
MIN_DISTANCE_M = 1.0  # shortest trip whose delay per kilometre is compared
JERK_UNIT_MPS3 = 10.0  # unit of the term `jerk`
BACKGROUND_COLUMNS = ("background_energy_wh_per_km", "background_co2_g_per_km")
MESSAGE_COLUMNS = ("v2x_reception_ratio", "v2x_latency_s", "v2x_busy_ratio")

_TERM = {name: k for k, name in enumerate(TERMS)}


class Recorder:
    """Records W worlds with A agents through one episode each.

    A trip counts if it began in the first half of its episode. So each counted trip has at least
    half an episode to end, and which trips count does not depend on how they end.

    `weights` (T,) are the weights of the terms in the reward. `slowest` is the longest duration of
    a success as a multiple of the free travel time.
    """

    def __init__(
        self,
        num_worlds: int,
        num_agents: int,
        max_steps: int,
        step_s: float,
        weights: NDArray[np.float64],
        slowest: float = SLOWEST,
    ) -> None:
        shape = (num_worlds, num_agents)
        self._half = max_steps / 2.0
        self._step_s = step_s
        self._weights = weights
        self._slowest = slowest
        self._sums = np.zeros((*shape, weights.size))
        self._rewards = np.zeros(shape)
        self._worst_ttc = np.zeros(shape)
        self._short_ttc = np.zeros(shape, dtype=np.int64)
        self._steps = np.zeros(shape, dtype=np.int64)
        self._began = np.zeros(shape, dtype=np.int64)
        self._world_steps = np.zeros(num_worlds, dtype=np.int64)
        self._background_arrivals = np.zeros(num_worlds, dtype=np.int64)
        self._world_terms = np.zeros((num_worlds, weights.size))
        self._world_rewards = np.zeros(num_worlds)
        self._trips: list[NDArray[np.void]] = []
        self.least_pet_s = np.full(shape, np.inf)  # written by `EncounterWatch`
        self.places_m = np.full((*shape, 2), np.nan)  # written by `EncounterWatch` before the step
        self.still_s = np.zeros(shape)  # written by `StandingWatch`
        self.would_go = np.zeros(
            shape, dtype=np.bool_
        )  # written by `StandingWatch`: whether the built-in driver would drive on
        self.maps = np.zeros(num_worlds, dtype=np.int64)  # map of each world

    def add(
        self,
        step: int,
        acted: NDArray[np.bool_],
        rewards: NDArray[np.float32],
        terms: NDArray[np.float32],
        done: NDArray[np.bool_],
        over: NDArray[np.bool_],
        arrivals: NDArray[np.int64],
    ) -> NDArray[np.void]:
        """Record one step and return the TRIP records of trips that ended in it.

        Args:
            step: number of the step in the episode, from 0.
            acted: (W, A) agents with a trip that this step is part of; none in finished worlds.
            rewards: (W, A).
            terms: (W, A, T).
            done: (W, A) agents with a trip that ended in this step.
            over: (W,) worlds with an episode that ended in this step, which cuts running trips.
            arrivals: (W,) vehicles that have arrived so far, agents included.
        """
        self._began[acted & (self._steps == 0)] = step
        self._steps += acted
        mine = np.where(acted[..., None], terms, 0.0)
        paid = np.where(acted, rewards, 0.0)
        self._sums += mine
        self._rewards += paid
        ttc = mine[..., _TERM["ttc_risk"]]
        np.maximum(self._worst_ttc, ttc, out=self._worst_ttc)
        self._short_ttc += ttc > 1.0 - SHORT_TTC_S / TTC_HORIZON_S
        self._world_terms += mine.sum(axis=1)
        self._world_rewards += paid.sum(axis=1)
        self._world_steps[over] = step + 1
        agents_arrived = self._world_terms[:, _TERM["arrival"]].astype(np.int64)
        self._background_arrivals[over] = arrivals[over] - agents_arrived[over]
        ended = (self._steps > 0) & (done | over[:, None])
        if not ended.any():
            return np.zeros(0, dtype=TRIP)
        rows = self._close(ended)
        self._trips.append(rows)
        return rows

    def _close(self, ended: NDArray[np.bool_]) -> NDArray[np.void]:
        """Return TRIP records of ended trips, and reset the sums of their agents."""
        world, agent = np.nonzero(ended)
        sums, steps = self._sums[ended], self._steps[ended]
        began = self._began[ended]
        pet = self.least_pet_s[ended]
        rows = np.zeros(world.size, dtype=TRIP)
        rows["episode"], rows["agent"], rows["map"] = world, agent, self.maps[world]
        rows["began_s"] = began * self._step_s
        rows["counted"] = began < self._half
        rows["collision"] = sums[:, _TERM["collision"]] > 0.0
        rows["off_road"] = (sums[:, _TERM["off_road"]] > 0.0) & ~rows["collision"]
        out = rows["collision"] | rows["off_road"]
        rows["arrived"] = (sums[:, _TERM["arrival"]] > 0.0) & ~out
        rows["unfinished"] = late = ~(rows["arrived"] | out)
        still, would_go = self.still_s[ended] >= STILL_S, self.would_go[ended]
        rows["blocked"], rows["stood"] = late & still & ~would_go, late & still & would_go
        rows["out_of_time"] = late & ~still
        rows["red_light"] = sums[:, _TERM["red_light"]] > 0.0
        rows["wrong_way"] = sums[:, _TERM["wrong_way"]] > 0.0
        rows["reward"] = self._rewards[ended]
        rows["duration_s"] = steps * self._step_s
        rows["distance_m"] = sums[:, _TERM["progress"]]
        rows["mean_speed_mps"] = rows["distance_m"] / rows["duration_s"]
        rows["delay_s"] = sums[:, _TERM["delay"]]
        at_fault = rows["red_light"] | rows["wrong_way"]
        free_s = rows["duration_s"] - rows["delay_s"]
        in_time = rows["duration_s"] <= self._slowest * free_s
        rows["success"] = rows["arrived"] & ~at_fault & in_time
        rows["mean_jerk_mps3"] = JERK_UNIT_MPS3 * sums[:, _TERM["jerk"]] / steps
        rows["energy_wh"], rows["co2_g"] = sums[:, _TERM["energy"]], sums[:, _TERM["co2"]]
        rows["mean_speeding"] = sums[:, _TERM["speeding"]] / steps
        rows["least_ttc_s"] = TTC_HORIZON_S * (1.0 - self._worst_ttc[ended])
        rows["short_ttc_share"] = self._short_ttc[ended] / steps
        rows["least_pet_s"] = np.where(pet <= PET_HORIZON_S, pet, np.nan)
        rows["end_x_m"], rows["end_y_m"] = self.places_m[ended].T
        for room in (self._sums, self._rewards, self._worst_ttc, self._short_ttc, self._steps):
            room[ended] = 0
        self.least_pet_s[ended] = np.inf
        return rows

    def trips(self) -> NDArray[np.void]:
        """Return TRIP (N,) of all ended trips, sorted by episode, agent and time."""
        rows = np.concatenate([np.zeros(0, dtype=TRIP), *self._trips])
        return rows[np.lexsort((rows["began_s"], rows["agent"], rows["episode"]))]

    def episodes(self) -> NDArray[np.void]:
        """Return EPISODE (W,) of all worlds; an unfinished episode has a duration of 0.

        Values about zones, messages and the energy of other vehicles are filled in elsewhere.
        """
        rows = np.zeros(self._world_steps.size, dtype=EPISODE)
        for name in ("zone_imbalance", *MESSAGE_COLUMNS, *BACKGROUND_COLUMNS):
            rows[name] = np.nan
        num_agents = self._steps.shape[1] or np.nan  # no agents: the means are NaN
        trips = self.trips()
        bounds = np.searchsorted(trips["episode"], np.arange(rows.size + 1))
        hours = np.maximum(self._world_steps, 1) * self._step_s / 3600.0
        rows["episode"] = np.arange(rows.size)
        rows["duration_s"] = self._world_steps * self._step_s
        rows["trips"] = np.diff(bounds)
        rows["episode_return"] = self._world_rewards / num_agents
        rows["agent_arrivals_per_h"] = self._world_terms[:, _TERM["arrival"]] / hours
        rows["background_arrivals_per_h"] = self._background_arrivals / hours
        for k, term in enumerate(TERMS):
            rows[reward_column(term)] = self._weights[k] * self._world_terms[:, k] / num_agents
        for row, begin, end in zip(rows, bounds[:-1], bounds[1:], strict=True):
            counted = trips[begin:end][trips["counted"][begin:end]]
            row["jain_speed"] = jain_index(np.maximum(counted["mean_speed_mps"], 0.0))
            way = counted[counted["distance_m"] >= MIN_DISTANCE_M]
            row["gini_delay"] = gini_coefficient(way["delay_s"] / way["distance_m"])
        return rows
