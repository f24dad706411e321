"""`DividedWorlds`: worlds whose zones are run on the machines of a Ray cluster."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from cavmarl.balance.balance_plan import Plan
from cavmarl.balance.plan_text import describe_plan
from cavmarl.core.errors import ConfigError, SumoError, WorkerError, WorkerFailureError
from cavmarl.engine.world_setup import World
from cavmarl.handoff.coordinator.coordinator_setup import check_faults
from cavmarl.parallel.commanded_worlds import own_error, uncopied, unsaved
from cavmarl.parallel.hosts.host_commands import HostProgram
from cavmarl.parallel.hosts.host_pool import HostPool
from cavmarl.parallel.hosts.host_process import code_stamp
from cavmarl.parallel.hosts.ray_actors import RayActors
from cavmarl.parallel.hosts.remote_worlds import refuse_on_hosts
from cavmarl.parallel.local_worlds import LocalWorlds
from cavmarl.parallel.mover import Mover
from cavmarl.parallel.processes.worker_pool import Death
from cavmarl.parallel.recipe import recipe_of
from cavmarl.parallel.split_hosts.zone_leader import ZoneLeader
from cavmarl.parallel.split_hosts.zones_job import host_zones, replicated_arrays
from cavmarl.parallel.step_placement import StepPlacement
from cavmarl.parallel.work_shares import Part, parts_of
from cavmarl.parallel.worlds_job import Task
from cavmarl.shards.shard import Commands, Shard

log = logging.getLogger("cavmarl.workers")


class DividedWorlds(LocalWorlds):
    """W worlds that this process leads, and m hosts that run their zones, the same of all worlds.

    Attributes:
        arrays: of this process.
        in_next_step: when worlds begin anew.
        leader: runs the phases.
        spent_s: (1, zones) processor time of each zone of all worlds, if hosts measure it.

    Raises:
        MissingExtraError: Ray is not installed.
        ConfigError: a setting that such worlds cannot have, more hosts than zones, or than CPUs.
        WorkerError: no cluster, or no host comes.
    """

    def __init__(
        self,
        world: World,  # what each is made of
        base_dir: Path,  # the folder that its relative files start from, on every machine
        num_worlds: int,  # W
        workers: int,  # m, from 2 to the zones of a world
        in_next_step: bool = False,  # when worlds begin anew; see `SteppedWorlds`
    ) -> None:
        _check(world, num_worlds, workers)
        config = world.config
        self.placement = StepPlacement(world, 1, workers)  # which host has which zones
        (part,) = parts_of(self.placement.plans, world.partition.count)
        memory, arrays, inputs = replicated_arrays(world, num_worlds)
        super().__init__(
            world, num_worlds, arrays, warm=True, in_next_step=in_next_step, zeros=memory.zeros
        )
        self._is_torn = False
        self.spent_s = np.zeros((1, world.partition.count))
        self.mover: Mover | None = None  # has that changed; None: it does not change
        if every := config.workers.balance_steps:
            self.mover = Mover(self.placement, world.partition.count, every, self.spent_s)

        def lead(shards: Sequence[Shard], gathering: tuple[float, float]) -> ZoneLeader:
            self.leader = ZoneLeader(shards, memory, inputs, part.zones, self.spent_s[0])
            return self.leader

        simulation = self.simulation
        simulation.host(lead, gathers=False)
        if simulation.mounted is not None:
            simulation.mounted.rig.sense = self.leader.sense
        recipe = recipe_of(
            world, base_dir, in_next_step=in_next_step, num_worlds=num_worlds,
            measures=self.mover is not None,
        )  # fmt: skip
        actors = RayActors(host_zones, lambda count: json.dumps(recipe), workers, workers)
        program = HostProgram(_names(part), (1,) * workers, ("phase",), -1, code_stamp())
        try:
            self.pool = HostPool(
                actors, program, config.workers.timeout_s, config.workers.max_retries
            )
        except WorkerFailureError as failure:
            raise own_error(failure) from failure
        self.leader.let_work(self.pool)

    def __reduce__(self) -> tuple[Any, ...]:
        raise uncopied()

    def save_worlds(self) -> list[bytes]:
        raise unsaved()

    def load_worlds(self, cases: Sequence[bytes]) -> None:
        raise unsaved()

    @property
    def plans(self) -> tuple[Plan, ...]:
        return self.placement.plans

    @property
    def deaths(self) -> list[Death]:
        return self.pool.deaths

    def reset(self, seed: int | None, first_world: int) -> None:
        """Begin an episode in the worlds of `chosen`.

        Raises:
            WorkerError: as of `step`; all worlds may be reset after an interruption.
        """
        everywhere = bool(self.arrays.chosen.all())
        with self._whole(begins_anew=everywhere):
            super().reset(seed, first_world)
        if everywhere:
            log.info("%s", "\n\n".join(map(describe_plan, self.plans)))

    def step(self, commands: Commands) -> None:
        """Let the agents act, and reset the worlds whose episode is over, now or a step later.

        Raises:
            WorkerError: hosts cannot go on, or a step before was interrupted in its middle.
        """
        if self.mover is not None:
            self.mover.before_step(self._host, self._pids)
        with self._whole():
            super().step(commands)

    def _host(self, task: Task, zones: Sequence[Sequence[Sequence[int]]], commits: bool) -> None:
        """Let zones have other hosts: they are sent whole with the next phase."""
        self.leader.host(zones[0])
        (part,) = parts_of(self.placement.plans, self.world.partition.count)
        self.pool.rename(_names(part))

    def _pids(self) -> dict[int, int]:
        return dict.fromkeys(range(len(self.pool.sizes)), 0)  # not measured: they run elsewhere

    def suggest(self) -> None:
        """Write what the built-in driver would do in the agents' place."""
        with self._whole():
            super().suggest()

    def close(self) -> None:
        """End the hosts, and the cluster if it was started for them."""
        self.pool.close()
        super().close()

    @contextmanager
    def _whole(self, begins_anew: bool = False) -> Iterator[None]:
        """The time in which worlds change; an interrupt then leaves them half changed."""
        if self._is_torn and not begins_anew:
            raise WorkerError(
                "the worlds were interrupted in the middle of a step: reset all of them"
            )
        self._is_torn = True
        try:
            yield
        except SumoError:  # the worlds have been put back
            self._is_torn = begins_anew
            raise
        except WorkerFailureError as failure:
            raise own_error(failure) from failure
        self._is_torn = False


def _names(part: Part) -> tuple[str, ...]:
    return tuple(
        f"{'zone' if len(zones) == 1 else 'zones'} {', '.join(map(str, zones))}"
        for zones in part.zones
    )


def _check(world: World, num_worlds: int, workers: int) -> None:
    config, count = world.config, world.partition.count
    if workers > count:
        raise ConfigError(
            f"workers = {workers}, hosts = 'ray': {num_worlds} world(s) of {count} zone(s) each: "
            "more hosts than worlds run the same zones of all worlds, so at most as many as zones; "
            "use fewer workers, more zones or more worlds"
        )
    refuse_on_hosts(config.workers)
    _, deaths = check_faults(config.zones, count, num_worlds)
    if deaths:
        raise ConfigError(
            f"zones.faults = {config.zones.faults!r}, zones.reproducers = "
            f"{config.zones.reproducers!r}: hosts of zones die by plan in one process only; use "
            "workers=0"
        )
