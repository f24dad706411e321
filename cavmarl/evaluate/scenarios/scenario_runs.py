"""Runs of a scenario with agents of one driver: criticality and verdicts."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.world_spec import WorldKeys, WorldSpec
from cavmarl.core.errors import ConfigError
from cavmarl.core.records.codes import (
    DRIVER_BACKGROUND,
    DRIVER_SCRIPTED,
    EVENT_ARRIVED,
    EVENT_COLLIDED,
    EVENT_OFF_ROAD,
    EVENT_RED_LIGHT,
    EVENTS_THAT_END,
)
from cavmarl.engine.world_setup import load_world
from cavmarl.env.vector import CavVectorEnv, make_vec
from cavmarl.evaluate.scenarios.criticality import (
    TRACE,
    least_ttc_s,
    post_encroachment_s,
    trace_of,
)
from cavmarl.policies.loading import load_policy

DENSITIES = {"none": 0.0, "low": 2.0, "high": 8.0}
"""Background vehicles per kilometre of lane."""

HORIZON_S = 180.0

VERDICTS = {
    "collided": EVENT_COLLIDED,
    "off road": EVENT_OFF_ROAD,
    "stuck": 0,
    "passed": EVENT_ARRIVED,
}
"""Verdicts from the worst to the best, with the event that decides each."""


@dataclass(frozen=True)
class ScenarioRun:
    """The result of one run."""

    scenario: str  # name of the scenario
    environment: str  # environment whose map was used
    place: str  # place on the map
    driver: str  # driver of the agents
    seed: int  # seed of the place and of the traffic
    zones: int  # number of zones of the world
    agents: int  # number of agents
    background: int  # number of vehicles other than agents and actors
    # `passed`: all agents reached their goals without a collision; `collided`, `off road` or
    # `stuck`: the worst verdict of an agent; `actors collided`: two actors touched each other, and
    # no agent collided, so the scene was not as intended
    verdict: str
    verdicts: tuple[str, ...]  # verdict of each agent, the agent in the conflict first
    clash: str  # the first contact of two actors, with its time; empty: none
    # least time to collision of an agent with an actor, 0 after a collision; None: they were never
    # on a collision course
    min_ttc_s: float | None
    pet_s: (
        float | None
    )  # least post-encroachment time of an agent and an actor; None: no common place
    collisions: int  # contacts of vehicles and actors, agents included
    red_lights: int  # steps in which an agent entered a junction at red
    delay_s: float  # delay of the first agent, compared with its initial speed
    longest_wait_s: float  # longest wait of another vehicle at the end of the run
    time_s: float  # duration of the run
    state_hash: str  # hash of the world at the end

    @property
    def passed(self) -> bool:
        """True if all agents reached their goals and caused no collision."""
        return self.verdict == "passed"


def make_scenario(
    scenario: str,
    env: str | Path | WorldSpec = "grid4x4",
    *,
    params: Mapping[str, bool | float] | None = None,
    place: str = "",
    density: str = "none",
    zones: int | None = None,
    **keys: Unpack[WorldKeys],
) -> CavVectorEnv:
    """Return one world with a scenario for its agents, which steer and accelerate.

    Args:
        scenario: name, or path of a file.
        env: as in `make_vec`, like the other keywords.
        params: parameters of the scenario.
        place: place on the map; empty: drawn by the seed, which also seeds the first reset.
        density: density of the other traffic, one of `DENSITIES`.
        zones: number of zones; None: as configured by the environment.
        keys: keys of the world; `agents` is 1 by default. The first agent is in the conflict, the
            others follow it.

    Raises:
        ConfigError: no such scenario, no place for it on the map, no room for the agents, or a
            wrong parameter, density or key.
    """
    spec = WorldSpec.of(env, **keys)
    if density not in DENSITIES:
        raise ConfigError(f"density = {density!r}: must be one of {', '.join(DENSITIES)}")
    background = 0
    if density != "none":
        lanes = load_world(spec.env, agents=1, background=0).network.lanes
        lane_km = float(lanes["length_m"][~lanes["internal"]].sum()) / 1000.0
        background = round(DENSITIES[density] * lane_km)
    settings: dict[str, Any] = {
        "scenario.name": scenario,
        "scenario.place": place,
        "scenario.seed": spec.seed,
        "scenario.params": dict(params or {}),
        "population.mode": "closed",
        "population.budget": None,
        "action.kind": "continuous",
        "horizon_s": HORIZON_S,
        **spec.overrides,
    }
    return make_vec(
        spec.env,
        zones=zones,
        agents=1 if spec.agents is None else spec.agents,
        background=background,
        seed=spec.seed,
        autoreset_mode="NextStep",
        overrides=settings,
    )


def run_scenario(
    vec: CavVectorEnv,
    driver: str = "idm",
    seed: int = 0,
    look: Callable[[], None] | None = None,
) -> ScenarioRun:
    """Run the scenario of a world from reset to end; `look` is called at each step."""
    policy = load_policy(driver, vec)
    observations, infos = vec.reset(seed=seed)
    policy.reset(seed)
    record = _Record(vec)
    mask = infos["mask"]
    while True:
        record.take()
        if look is not None:
            look()
        results = vec.step(policy.act_batch(observations, mask))
        observations, mask = results[0], results[4]["mask"]
        record.note()
        if results[4]["episode_over"][0]:
            return record.finish(driver, seed)


class _Record:
    """Values of a run, collected step by step."""

    def __init__(self, vec: CavVectorEnv) -> None:
        simulation = vec.simulation
        if simulation.scene is None:
            raise ConfigError(
                "scenario.name = '': this world has no scenario to run; set scenario.name"
            )
        self._vec, self._simulation, self._scene = vec, simulation, simulation.scene
        rows = simulation.vehicles()
        agents = np.sort(rows[rows["agent"] >= 0], order="agent")
        self._agents = agents["id"].tolist()
        self._actors = rows["id"][rows["driver"] == DRIVER_SCRIPTED].tolist()
        self._traces: dict[int, list[tuple[float, ...]]] = {}
        self._events = np.zeros(len(agents), np.int64)
        self._driven_m, self._left_s = 0.0, 0.0
        self._red_lights = 0
        self._clash = ""

    def take(self) -> None:
        now_s = self._now_s()
        rows = self._simulation.vehicles()
        for row in rows[np.isin(rows["id"], [*self._agents, *self._actors])]:
            self._traces.setdefault(int(row["id"]), []).append(trace_of(row, now_s))
        for row in rows[rows["id"] == self._agents[0]]:
            self._driven_m = float(row["distance_m"])
        self._watch_actors(rows)
        self._red_lights += int(np.count_nonzero(self._now() & EVENT_RED_LIGHT))

    def note(self) -> None:
        if not self._events[0] & EVENTS_THAT_END:
            self._left_s = self._now_s()
        self._events |= self._now()

    def finish(self, driver: str, seed: int) -> ScenarioRun:
        config, simulation = self._vec.config, self._simulation
        verdicts = tuple(map(self._verdict, range(len(self._agents))))
        verdict = min(verdicts, key=list(VERDICTS).index)
        traces = {vehicle: np.array(t, TRACE) for vehicle, t in self._traces.items()}
        own = [traces.pop(agent) for agent in self._agents]
        touched = verdict == "collided"
        self._watch_actors(simulation.vehicles())
        # Over all agents and actors, and all their common moments.
        ttcs = [least_ttc_s(one, other) for one in own for other in traces.values()]
        pets = [post_encroachment_s(one, other) for one in own for other in traces.values()]
        rows = simulation.vehicles()
        waits = rows["wait_s"][rows["driver"] == DRIVER_BACKGROUND]
        return ScenarioRun(
            scenario=config.scenario.name,
            environment=config.name,
            place=self._scene.place,
            driver=driver,
            seed=seed,
            zones=simulation.partition.count,
            agents=len(self._agents),
            background=config.population.background,
            verdict="actors collided" if self._clash and not touched else verdict,
            verdicts=verdicts,
            clash=self._clash,
            min_ttc_s=0.0 if touched else _finite(min(ttcs, default=math.inf)),
            pet_s=0.0 if touched else _finite(min(pets, default=math.inf)),
            collisions=simulation.traffic_stats().contacts,
            red_lights=self._red_lights,
            delay_s=self._left_s - self._driven_m / self._scene.seat.speed_mps,
            longest_wait_s=float(waits.max(initial=0.0)),
            time_s=self._now_s(),
            state_hash=self._vec.state_hash(),
        )

    def _watch_actors(self, rows: NDArray[np.void]) -> None:
        together = np.isin(rows["id"], self._actors) & np.isin(rows["hit"], self._actors)
        if not self._clash and together.any():
            first = rows[together][0]
            one, other = sorted(map(self._actors.index, (int(first["id"]), int(first["hit"]))))
            self._clash = f"actors {one} and {other} touched at {self._now_s():.1f} s"

    def _now_s(self) -> float:
        return float(self._simulation.ticks()[0]) * self._vec.config.clock.sim_dt_s

    def _now(self) -> NDArray[np.int64]:
        found: NDArray[np.int64] = self._simulation.outputs.events[0].astype(np.int64)
        return found

    def _verdict(self, agent: int) -> str:
        events = int(self._events[agent])
        return next((name for name, event in VERDICTS.items() if events & event), "stuck")


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
