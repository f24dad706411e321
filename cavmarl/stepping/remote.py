"""`RemoteWorlds`: worlds shared out over the machines of a Ray cluster."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from cavmarl.balance.plan import Plan
from cavmarl.errors import ConfigError, WorkerFailureError
from cavmarl.hosts.orders import Arrays, HostProgram
from cavmarl.hosts.pool import HostPool
from cavmarl.hosts.ray_actors import RayActors
from cavmarl.runtime.compilation import compiled_before
from cavmarl.runtime.pool import Death
from cavmarl.runtime.simulation import Simulation
from cavmarl.stepping.arrays import StepArrays, layout_of
from cavmarl.stepping.job import Task, fingerprint
from cavmarl.stepping.ordered import OrderedWorlds, own_error
from cavmarl.stepping.parts import make_plans, parts_of
from cavmarl.stepping.remote_job import code_stamp, host_worlds, inputs_of, results_of
from cavmarl.stepping.watched import refuse_watched
from cavmarl.worlds import World

__all__ = ["RemoteWorlds"]


class RemoteWorlds(OrderedWorlds):
    """W worlds over m hosts, whole worlds each.

    Args:
        world: what each is made of.
        base_dir: the folder that its relative files start from, on every machine.
        num_worlds: W.
        workers: m, from 1 to W; None: as many as the cluster has free CPUs.
        in_next_step: when worlds begin anew; see `SteppedWorlds`.

    Attributes:
        world: what each is made of.
        arrays: of this process; what hosts send is written to them.
        pool: the hosts.
        in_next_step: when worlds begin anew.

    Raises:
        MissingExtraError: Ray is not installed.
        ConfigError: a setting that worlds elsewhere cannot have, more hosts than worlds, or than
            CPUs.
        WorkerError: no cluster, or no host comes.
    """

    def __init__(
        self,
        world: World,
        base_dir: Path,
        num_worlds: int,
        workers: int | None,
        in_next_step: bool = False,
    ) -> None:
        self.world = world
        self.in_next_step = in_next_step
        config = world.config
        refuse_watched(
            config.zones, "of worlds on hosts", "run them on this machine; leave out hosts"
        )
        if workers is not None and workers > num_worlds:
            raise ConfigError(
                f"workers = {workers}, hosts = 'ray': a world lives on one host, so {num_worlds} "
                "world(s) need at most as many; use fewer workers, more worlds, or no hosts to "
                "divide a world over processes of this machine"
            )
        if config.workers.balance_steps:
            raise ConfigError(
                f"workers.balance_steps = {config.workers.balance_steps}, hosts = 'ray': worlds "
                "stay on their host; leave it 0, or leave out the hosts"
            )
        if config.workers.sensors:
            raise ConfigError(
                f"workers.sensors = {config.workers.sensors}, hosts = 'ray': sensor workers are on "
                "the machine of the worlds; leave it 0, or leave out the hosts"
            )
        if not compiled_before():
            Simulation(config, world.network, 1, world.demand, world.partition)
        layout = layout_of(config, world.capacity, num_worlds).items()
        self.arrays = StepArrays.of({name: np.zeros(shape, kind) for name, (kind, shape) in layout})
        recipe = {
            "config": asdict(config),
            "base_dir": str(base_dir.resolve()),
            "fingerprint": fingerprint(world),
            "in_next_step": in_next_step,
        }

        def told(count: int) -> str:
            return json.dumps({**recipe, "size": -(-num_worlds // count)})

        actors = RayActors(host_worlds, told, workers, num_worlds)
        self._plans = tuple(make_plans(world, num_worlds, actors.workers))
        self._parts = parts_of(self._plans, world.partition.count)
        program = HostProgram(
            tuple(part.names[0] for part in self._parts),
            tuple(part.last - part.first for part in self._parts),
            tuple(task.name.lower().replace("_", " ") for task in Task),
            Task.STEP,
            code_stamp(),
        )
        try:
            self.pool = HostPool(actors, program, config.workers.timeout_s, config.workers.repeats)
        except WorkerFailureError as failure:
            raise own_error(failure) from failure
        self._mine = [self.arrays.part(part.first, part.last) for part in self._parts]

    @property
    def plans(self) -> tuple[Plan, ...]:
        """Who hosts what."""
        return self._plans

    @property
    def simulation(self) -> Simulation:
        """Refused: the worlds live elsewhere.

        Raises:
            ConfigError: always.
        """
        raise ConfigError("the worlds live on other machines: use workers=0 to look into them")

    @property
    def deaths(self) -> list[Death]:
        """Of hosts, up to now."""
        return self.pool.deaths

    def close(self) -> None:
        """End the hosts, and the cluster if it was started for them."""
        self.pool.close()

    def _send(self, task: Task, letter: Any, commits: bool) -> None:
        def outputs(k: int, ended: Any) -> Arrays:
            return results_of(task, self._mine[k], ended)

        letters = [letter] * len(self._mine)
        if task == Task.RESET:  # a host counts its worlds from 0
            firsts = [letter["first_world"] + part.first for part in self._parts]
            letters = [{**letter, "first_world": first} for first in firsts]
        inputs = [inputs_of(task, arrays) for arrays in self._mine]
        self.pool.run(task, letters, inputs, outputs, commits)

    def _ask(self, task: Task, world: int, more: Any = None) -> Any:
        number = range(len(self.arrays.mask))[world]
        k = next(k for k, part in enumerate(self._parts) if number < part.last)
        number -= self._parts[k].first
        return self.pool.ask(k, task, number if more is None else [number, more])
