"""`Run`: a run of PPO, where it stands and how it goes on."""

from __future__ import annotations

import time
from concurrent.futures import Future, ThreadPoolExecutor
from copy import deepcopy
from dataclasses import asdict, replace
from pathlib import Path

import torch
from gymnasium.vector import AutoresetMode
from rich.console import Console

from cavmarl.core.errors import ConfigError
from cavmarl.env.vector import CavVectorEnv, make_vec
from cavmarl.evaluate.provenance.training_record import begin_training, end_training
from cavmarl.learning.batch import Batch
from cavmarl.learning.checkpoint import RunState, load_checkpoint, read_state, save_checkpoint
from cavmarl.learning.collector import Collector
from cavmarl.learning.learner import Learner, Scales
from cavmarl.learning.log import CSV_FILE, Log, describe, progress_bar
from cavmarl.learning.ppo_settings import PpoSettings
from cavmarl.policies.networks import CONFIG_FILE, WEIGHTS_FILE, ActorCritic, NetworkConfig


def make_worlds(settings: PpoSettings) -> CavVectorEnv:
    central = settings.central_critic
    return make_vec(
        settings.env,
        num_envs=settings.num_envs,
        zones=settings.zones or None,
        workers=settings.workers,
        agents=settings.agents or None,
        background=None if settings.background < 0 else settings.background,
        # Only so can one still ask for the last state of an episode.
        autoreset_mode=AutoresetMode.NEXT_STEP if central else AutoresetMode.SAME_STEP,
        copy=False,
    )


class Run:
    """A run of PPO: where it stands and how it goes on."""

    def __init__(self, settings: PpoSettings) -> None:
        folder = settings.folder
        self.began = read_state(folder) if settings.resume else RunState({})
        self.agent_steps, self.updates = self.began.agent_steps, self.began.updates
        if self.agent_steps >= settings.total_agent_steps:
            raise ConfigError(
                f"--total-agent-steps {settings.total_agent_steps}: the run has {self.agent_steps}"
            )
        self.settings = settings
        torch.set_num_threads(settings.threads)
        seed = settings.seed + self.updates
        torch.manual_seed(seed)
        self.vec = vec = make_worlds(settings)
        self.config = _network_config(settings, vec)
        self.network = ActorCritic(self.config, (settings.throttle_std, settings.steering_std))
        self.learner = Learner(self.network, settings)
        if settings.resume:
            load_checkpoint(folder, self.network, self.learner.optimizer, self.config)
        self.scales = Scales(self.network, self.agent_steps)
        # A process that collects while another learns draws from numbers of its own.
        generator = torch.Generator().manual_seed(seed) if settings.overlap else None
        self.collector = Collector(vec, self.network, settings.num_steps, seed, generator)
        self._aside = ThreadPoolExecutor(1) if settings.overlap else None
        self._next: Future[Batch] | None = None
        try:
            folder.mkdir(parents=True, exist_ok=True)
            program = f"{settings.algorithm}_torch.py"
            begin_training(folder, program, asdict(settings), vec.worlds.world, vec.plans)
            self.log = Log(folder, bool(settings.resume), settings.tensorboard)
        except OSError as error:
            reason = error.strerror or error
            raise ConfigError(f"{folder}: cannot be written ({reason})") from error
        self._began_at = time.perf_counter()

    def done(self) -> float:
        """The share of the run that is over, by decisions or by the clock."""
        already = self.began.agent_steps
        done = (self.agent_steps - already) / (self.settings.total_agent_steps - already)
        if self.settings.minutes:
            seconds = time.perf_counter() - self._began_at
            done = max(done, seconds / (60.0 * self.settings.minutes))
        return min(done, 1.0)

    def update(self) -> dict[str, float]:
        """Collect, learn, and log the numbers, which are returned."""
        started = time.perf_counter()
        left = 1.0 - self.done()
        batch = self._collected(left)
        trips, spent_s = self.collector.trips.means(), self.collector.clock.take()
        if self._aside is not None:
            self.collector.network = deepcopy(self.network)
            self._next = self._aside.submit(self._collect, left)
        learning = time.perf_counter()
        numbers = self.learner.update(batch, left)
        self.scales.add(batch.observations[batch.acted])
        now = time.perf_counter()
        spent_s["learning"] = now - learning
        new = int(batch.acted.sum())
        self.agent_steps += new
        self.updates += 1
        network = self.network
        row = {
            "updates": self.updates,
            "agent_steps": self.agent_steps,
            "seconds": self.began.seconds + now - self._began_at,
            "agent_steps_per_s": new / (now - started),
            **trips,
            **numbers,
            "std": network.log_std.detach().exp().mean().item() if network.continuous else 0.0,
            **{f"{phase}_s": seconds for phase, seconds in spent_s.items()},
        }
        self.log.write(row)
        return row

    def _collected(self, left: float) -> Batch:
        return self._collect(left) if self._next is None else self._next.result()

    def _collect(self, left: float) -> Batch:
        return self.collector.collect(self.learner.imitation_weight(left) > 0.0)

    def save(self, row: dict[str, float]) -> None:
        """A checkpoint after the update that gave `row`."""
        settings = replace(self.settings, resume="")
        state = RunState(asdict(settings), self.agent_steps, self.updates, row["seconds"])
        save_checkpoint(
            self.settings.folder, self.network, self.learner.optimizer, self.config, state
        )

    def close(self) -> None:
        if self._aside is not None:
            self._aside.shutdown()
        self.vec.close()
        self.log.close()


def _network_config(settings: PpoSettings, vec: CavVectorEnv) -> NetworkConfig:
    return NetworkConfig(
        environment=vec.config.name,
        observation_size=vec.single_observation_space.shape[0],
        sensors=vec.config.sensors,
        action=vec.config.action,
        hidden=(settings.hidden, settings.hidden),
        seed=settings.seed,
        state_size=vec.state_size if settings.central_critic else 0,
    )


def train(settings: PpoSettings, console: Console) -> Path:
    """Run PPO until its decisions or its minutes are used up; returns the folder of the run."""
    run = Run(settings)
    if run.vec.plans:
        console.print(run.vec.plan_text(), highlight=False)
    try:
        with progress_bar(console) as bar:
            task = bar.add_task("", total=1.0)
            done = 0.0
            while done < 1.0:
                row = run.update()
                done = run.done()
                if done == 1.0 or run.updates % settings.checkpoint_updates == 0:
                    run.save(row)
                bar.update(task, completed=done, description=describe(row))
    finally:
        run.close()
    files = (WEIGHTS_FILE, CONFIG_FILE, CSV_FILE)
    end_training(settings.folder, files, run.vec.plans)
    return settings.folder
