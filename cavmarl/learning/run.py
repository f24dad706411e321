"""`Run`: a run of PPO, where it stands and how it goes on."""

from __future__ import annotations

import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import torch
from gymnasium.vector import AutoresetMode
from rich.console import Console

from cavmarl.env.vector import CavVectorEnv, make_vec
from cavmarl.learning.batch import Batch
from cavmarl.learning.checkpoint import Parts
from cavmarl.learning.collector import Collector
from cavmarl.learning.learner import Learner, Scales
from cavmarl.learning.log import describe, progress_bar
from cavmarl.learning.ppo_settings import PpoSettings
from cavmarl.learning.run_folder import RunFolder
from cavmarl.policies.networks import ActorCritic, NetworkConfig


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

    def __init__(self, settings: PpoSettings, vec: CavVectorEnv, folder: RunFolder) -> None:
        self.settings, self.vec, self.folder = settings, vec, folder
        began = folder.began
        self.agent_steps, self.updates = began.agent_steps, began.updates
        torch.set_num_threads(settings.threads)
        seed = settings.seed + self.updates
        torch.manual_seed(seed)
        self.config = _network_config(settings, vec)
        self.network = ActorCritic(self.config, (settings.throttle_std, settings.steering_std))
        self.learner = Learner(self.network, settings)
        self.scales = Scales(self.network)
        # A process that collects while another learns draws from numbers of its own.
        generator = torch.Generator().manual_seed(seed) if settings.overlap else None
        self.collector = Collector(vec, self.network, settings.num_steps, seed, generator)
        self._aside = ThreadPoolExecutor(1) if settings.overlap else None
        self._next: Future[Batch] | None = None
        if not folder.began.parts:
            self.save()  # a run that is killed early begins from here
        if parts := folder.resume():
            self._load(parts)

    def _load(self, parts: Parts) -> None:
        self.learner.load(parts["learner"])
        self.scales.load(parts["scales"])
        self.collector.load(parts["collector"])
        if parts["next"] is not None:
            self._next = Future()
            self._next.set_result(Batch(**parts["next"]))

    def done(self) -> float:
        """The share of the run that is over, by decisions or by the clock."""
        done = self.agent_steps / self.settings.total_agent_steps
        if self.settings.minutes:
            done = max(done, self.folder.seconds / (60.0 * self.settings.minutes))
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
            "seconds": self.folder.seconds,
            "agent_steps_per_s": new / (now - started),
            **trips,
            **numbers,
            "std": network.log_std.detach().exp().mean().item() if network.continuous else 0.0,
            **{f"{phase}_s": seconds for phase, seconds in spent_s.items()},
        }
        self.folder.log.write(row)
        return row

    def _collected(self, left: float) -> Batch:
        return self._collect(left) if self._next is None else self._next.result()

    def _collect(self, left: float) -> Batch:
        return self.collector.collect(self.learner.imitation_weight(left) > 0.0)

    def save(self) -> None:
        """A checkpoint of what is now, with the batch that is being collected; and the driver."""
        following = None if self._next is None else vars(self._next.result())
        parts = {
            "learner": self.learner.save(),
            "scales": self.scales.save(),
            "collector": self.collector.save(),
            "next": following,
        }
        self.folder.save(self.agent_steps, self.updates, parts)
        self.folder.save_driver(self.network, replace(self.config, agent_steps=self.agent_steps))

    def close(self) -> None:
        if self._aside is not None:
            self._aside.shutdown()


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


@contextmanager
def opened(settings: PpoSettings) -> Iterator[Run]:
    """A run in its worlds and its folder, which are closed at the end."""
    vec = make_worlds(settings)
    try:
        with RunFolder(settings, vec.worlds.world, vec.plans) as folder:
            run = Run(settings, vec, folder)
            try:
                yield run
            finally:
                run.close()
    finally:
        vec.close()


def train(settings: PpoSettings, console: Console) -> Path:
    """Run PPO until its decisions or its minutes are used up; returns the folder of the run."""
    with opened(settings) as run:
        _improve(run, console)
        return run.folder.end(plans=run.vec.plans)


def _improve(run: Run, console: Console) -> None:
    if run.vec.plans:
        console.print(run.vec.plan_text(), highlight=False)
    with progress_bar(console) as bar:
        task = bar.add_task("", total=1.0)
        done = run.done() if run.updates else 0.0
        while done < 1.0:
            row = run.update()
            done = run.done()
            if done == 1.0 or run.folder.is_due(run.updates):
                run.save()
            bar.update(task, completed=done, description=describe(row))
