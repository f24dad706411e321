"""End-to-end speed of PPO compared with stable-baselines3 on highway-env.

Both sides learn on two cores with the same network, observation (highway-env's `Kinematics`),
actions, number of vehicles, batch, minibatches and epochs, on the same road, at 20 Hz with 10
decisions per second and new episodes after 40 s. Each side has one process per core for its worlds,
and one thread of torch.
"""

from __future__ import annotations

import importlib.util
import math
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from cavmarl.bench.harness import Say, check_range, paired_ratio, silent
from cavmarl.bench.highway_worlds import (
    THEIR_KINEMATICS,
    highway_env,
    length_m,
    overrides,
    straight_road,
)
from cavmarl.config.registry import programs, shadow
from cavmarl.core.errors import ConfigError, require
from cavmarl.core.machine import describe_hardware

if TYPE_CHECKING:
    from cavmarl.bench.highway_rows import HighwayRows

_Update = tuple[int, dict[str, float]]

HORIZON_S = 40.0
OUR_STEPS = 32  # steps of each world between two updates
EPOCHS = 4
MINIBATCHES = 8
HIDDEN = 64
STEPPING_STEPS = 100
RECIPE = {"num_envs": 64, "epochs": 2, "keep": 0.3, "hidden": 128, "shared": True}
RECIPE_KEYS: dict[str, Any] = {
    "action.kind": "grid",
    "sensors.kinematics.vehicles_count": 0,
    "sensors.ego.enabled": True,
    "sensors.way.distances_m": [5.0, 10.0, 20.0, 40.0, 60.0],
    "sensors.way.lines": 1,
    "sensors.way.timing": True,
    "sensors.conflicts.count": 6,
    "sensors.history.steps": 2,
}
OUR_SENSORS: dict[str, Any] = {
    "sensors.kinematics.vehicles_count": 5,
    "sensors.ego.enabled": False,
    "sensors.route.points": 0,
    "sensors.neighbors.count": 0,
    "sensors.signal.enabled": False,
    "sensors.lidar.rays": 0,
}


@dataclass(frozen=True)
class TrainingRow:
    """Measurements of one side."""

    name: str  # `cavmarl`, `stable_baselines3`, or `cavmarl_recipe` with the recommended settings
    worlds: int  # worlds stepped together
    decisions: int  # number of decisions per update
    rates: tuple[float, ...]  # agent-steps per second of each turn: one update, including learning
    # shares of time by phase; highway-env's `simulation` includes communication
    shares: dict[str, float]


@dataclass(frozen=True)
class TrainingSpeed:
    """Results of two benchmarks, training and stepping, whose numbers must not be compared."""

    agents: int  # number of agents per world
    workers: int  # number of workers per side
    numbers: int  # size of an observation
    recipe_numbers: int  # size of an observation with the recommended settings
    end_to_end: tuple[TrainingRow, ...]  # PPO, including collection and learning
    stepping: tuple[float, ...]  # agent-steps per second of worlds and sensors alone, by turn
    hardware: dict[str, Any]  # hardware of the machine

    @property
    def ratio(self) -> float:
        """Ratio of cavmarl's to stable-baselines3's agent-steps per second; median of the turns."""
        return self._over("cavmarl", "stable_baselines3")

    @property
    def recipe_rate(self) -> float:
        """Agent-steps per second with the recommended settings; median of the turns."""
        (row,) = (row for row in self.end_to_end if row.name == "cavmarl_recipe")
        return median(row.rates)

    @property
    def is_crowded(self) -> bool:
        return self.workers > (self.hardware["usable_cores"] or 1)

    def _over(self, one: str, other: str) -> float:
        rates = {row.name: row.rates for row in self.end_to_end}
        return paired_ratio(rates[one], rates[other])

    def facts(self) -> dict[str, Any]:
        """Return plain values for a report: everything except the rows of `end_to_end`."""
        return {
            "agents": self.agents,
            "workers": self.workers,
            "numbers": self.numbers,
            "recipe_numbers": self.recipe_numbers,
            "end_to_end": {
                "kind": "end_to_end",
                "ratio": self.ratio,
                "recipe_rate": self.recipe_rate,
            },
            "stepping": {"kind": "sensors", "agent_steps_per_s": self.stepping},
            "is_crowded": self.is_crowded,
        }


def measure_training(
    agents: int = 20, worlds: int = 16, workers: int = 2, repeats: int = 3, say: Say = silent
) -> TrainingSpeed:
    """Update both sides in turn, after one unmeasured update of each side."""
    check_range(
        agents=(agents, 1, math.inf), workers=(workers, 1, math.inf), repeats=(repeats, 1, math.inf)
    )
    if worlds % workers:
        raise ConfigError(f"{worlds} worlds over {workers} workers: must divide evenly")
    needs = {"torch": "train", "highway_env": "bench", "stable_baselines3": "train"}
    for module, extra in needs.items():
        require(module, extra)
    from cavmarl.bench.highway_rows import HighwayRows

    opened = training_program().opened

    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        say("starting stable-baselines3")
        rows = HighwayRows(workers, agents, THEIR_KINEMATICS, HORIZON_S)
        stack.callback(rows.close)
        theirs = _theirs(rows, workers, OUR_STEPS * worlds // workers)
        settings = _settings(folder, agents, worlds, workers)
        say("starting cavmarl")
        plain = stack.enter_context(opened(settings))
        other = stack.enter_context(opened(_recipe(folder, settings)))
        sides = [_ours("cavmarl", plain), _ours("cavmarl_recipe", other), theirs]
        stepping = []
        for turn in range(repeats + 1):
            for side in sides:
                say(f"update {turn} of {repeats}: {side.name}")
                side.update(counts=turn > 0)
            stepping.append(_stepping(plain))
        found = tuple(side.row() for side in sides)
        size = plain.config.observation_size
        wide = other.config.observation_size
    rates = tuple(stepping[1:])
    return TrainingSpeed(agents, workers, size, wide, found, rates, describe_hardware())


@cache
def training_program() -> Any:
    """Load `train/ppo.py` as a module from its file, since `train` is not a package."""
    spec = importlib.util.spec_from_file_location("ppo", programs()["ppo"])
    if spec is None or spec.loader is None:
        raise ConfigError("train/ppo.py: cannot be read as a module")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look up their module
    spec.loader.exec_module(module)
    return module


def _recipe(folder: Path, settings: Any) -> Any:
    """Return settings for the same road, with the keys that docs/guides/train.md recommends."""
    entry = yaml.safe_load((folder / "env.yaml").read_text(encoding="utf-8"))
    for key, value in RECIPE_KEYS.items():
        shadow(entry, key, value)
    (folder / "recipe").mkdir()
    (folder / "recipe" / "env.yaml").write_text(yaml.safe_dump(entry), encoding="utf-8")
    return replace(settings, env=str(folder / "recipe"), name="recipe", **RECIPE)


def _settings(folder: Path, agents: int, worlds: int, workers: int) -> Any:
    road_m = length_m(highway_env(agents, THEIR_KINEMATICS))
    entry: dict[str, Any] = {
        "name": "straight",
        "map": {"source": str(straight_road(folder, road_m))},
        "horizon_s": HORIZON_S,
    }
    for key, value in (overrides(OUR_SENSORS, agents) | {"population.mode": "respawn"}).items():
        shadow(entry, key, value)
    (folder / "env.yaml").write_text(yaml.safe_dump(entry), encoding="utf-8")
    return training_program().Args(
        env=str(folder),
        agents=agents,
        background=0,
        num_envs=worlds,
        workers=workers,
        total_agent_steps=10**12,
        num_steps=OUR_STEPS,
        epochs=EPOCHS,
        minibatches=MINIBATCHES,
        hidden=HIDDEN,
        runs=str(folder),
        name="plain",
    )


class _Side:
    """A side of the comparison: the measured results and durations of its updates.

    `update` collects and learns; it returns decisions and seconds by phase.
    """

    def __init__(self, name: str, worlds: int, update: Callable[[], _Update]) -> None:
        self.name = name
        self._worlds = worlds
        self._update = update
        self._decisions: list[int] = []
        self._rates: list[float] = []
        self._spent_s: Counter[str] = Counter()

    def update(self, counts: bool) -> None:
        began = time.perf_counter()
        decisions, spent_s = self._update()
        self._decisions.append(decisions)
        if counts:
            self._rates.append(decisions / (time.perf_counter() - began))
            self._spent_s.update(spent_s)

    def row(self) -> TrainingRow:
        total_s = sum(self._spent_s.values())
        shares = {phase: seconds / total_s for phase, seconds in self._spent_s.items()}
        decisions = sum(self._decisions) // len(self._decisions)
        return TrainingRow(self.name, self._worlds, decisions, tuple(self._rates), shares)


def _ours(name: str, run: Any) -> _Side:
    phases = training_program().PHASES

    def update() -> _Update:
        before = run.agent_steps
        row = run.update()
        return run.agent_steps - before, {phase: row[f"{phase}_s"] for phase in phases}

    return _Side(name, run.args.num_envs, update)


def _theirs(rows: HighwayRows, worlds: int, num_steps: int) -> _Side:
    from stable_baselines3 import PPO

    decisions = num_steps * rows.num_envs
    model = PPO(
        "MlpPolicy",
        rows,
        n_steps=num_steps,
        batch_size=decisions // MINIBATCHES,
        n_epochs=EPOCHS,
        policy_kwargs={"net_arch": [HIDDEN, HIDDEN]},
        seed=0,
        device="cpu",
    )

    def update() -> _Update:
        before_s, watch, began = rows.simulated_s, _watch(), time.perf_counter()
        model.learn(decisions, watch, reset_num_timesteps=False)
        simulated_s = rows.simulated_s - before_s
        return decisions, {
            "simulation": simulated_s,
            "inference": watch.collected_s - began - simulated_s,
            "learning": time.perf_counter() - watch.collected_s,
        }

    return _Side("stable_baselines3", worlds, update)


def _watch() -> Any:
    """Return a stable-baselines3 callback that records when the collection ends."""
    from stable_baselines3.common.callbacks import BaseCallback

    class Watch(BaseCallback):
        collected_s = 0.0

        def _on_step(self) -> bool:
            return True

        def _on_rollout_end(self) -> None:
            self.collected_s = time.perf_counter()

    return Watch()


def _stepping(run: Any) -> float:
    """Return agent-steps per second of a run's worlds, with all agents repeating one action."""
    vec = run.vec
    actions = np.ones((vec.num_envs, vec.num_agents), dtype=np.int64)
    decisions = 0
    began = time.perf_counter()
    for _ in range(STEPPING_STEPS):
        decisions += int(vec.step(actions)[4]["acted"].sum())
    return decisions / (time.perf_counter() - began)
