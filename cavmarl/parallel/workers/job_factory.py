"""The program of worker processes that run worlds. The fork server makes the jobs here."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cavmarl.parallel.memory.shared_huge_pages import huge_shared_zeros
from cavmarl.parallel.memory.shared_memory import Segment, arrays_in
from cavmarl.parallel.placement.work_shares import Part
from cavmarl.parallel.processes.worker_loop import Job, serve
from cavmarl.parallel.state.checkpoint_log import CheckpointLog
from cavmarl.parallel.state.state_image import Image
from cavmarl.parallel.state.world_bytes import SavedWorlds
from cavmarl.parallel.workers.logged_worlds import LoggedWorlds
from cavmarl.parallel.workers.movable_worlds import MovableWorlds
from cavmarl.parallel.workers.team_job import LedTeam
from cavmarl.parallel.workers.worlds_job import WorldsJob
from cavmarl.parallel.worlds.journaled_worlds import open_runs, without_journals
from cavmarl.parallel.worlds.local_worlds import LocalWorlds
from cavmarl.parallel.worlds.sensor_worker_setup import sensor_workers_of
from cavmarl.parallel.worlds.step_arrays import StepArrays, layout_of
from cavmarl.parallel.worlds.world_message import CHANGED, world_of


def make_jobs(message: Mapping[str, Any]) -> list[Job]:
    """Make the jobs of all workers, and load all kernels.

    Raises:
        WorkerError: a file has changed since the pool read it.
        JournalError: a journal cannot be opened.
    """
    world = world_of(message, CHANGED)
    config = world.config
    layout = layout_of(config, message["capacity"], message["num_worlds"], world.signal_sizes)
    arrays = StepArrays.of(arrays_in(Segment(message["arrays"], 0).map(), layout))
    one = LocalWorlds(without_journals(world), 1, warm=True)
    parts = [Part(*given) for given in message["parts"]]

    runs = open_runs(message["runs"])  # workers inherit the open files

    def make(first: int, last: int) -> LocalWorlds:
        return LocalWorlds(
            world,
            last - first,
            arrays.part(first, last),
            in_next_step=message["in_next_step"],
            like=one,
            runs=runs[first:last] or None,
        )

    def make_shared(number: int) -> LocalWorlds:
        """Make a world whose zones several workers share."""
        return LocalWorlds(
            world,
            1,
            arrays.part(number, number + 1),
            in_next_step=message["in_next_step"],
            zeros=huge_shared_zeros,
            runs=runs[number : number + 1] or None,
        )

    def attach_sensors(worlds: LocalWorlds, part: Part) -> None:
        if config.workers.sensors:
            memory = Segment(os.dup(message["arrays"]), 0)
            bounds = (part.first, part.last)
            base_dir, num_worlds = Path(message["base_dir"]), message["num_worlds"]
            sensors = sensor_workers_of(world, base_dir, memory, bounds, num_worlds)
            worlds.attach_sensor_workers(sensors)

    saved = [SavedWorlds(Segment(fd, 0)) for fd in message["saved_worlds"]]
    mover, spent_s = message["mover"], None
    if mover is not None:
        spent_s = arrays_in(Segment(mover["spent"], 0).map(), mover["layout"])["spent_s"]
        outboxes = [Image(Segment(fd, 0)) for fd in mover["outboxes"]]
        if outboxes:
            bounds = [part.first for part in parts] + [parts[-1].last]
            whole_s = spent_s[:, 0]
            return [
                WorldsJob(MovableWorlds(make, bounds, k, outboxes, whole_s), saved[k])
                for k in range(len(parts))
            ]
    jobs: list[Job] = []
    for part, descriptors, memory in zip(parts, message["checkpoint_logs"], saved, strict=True):
        checkpoint_log = CheckpointLog(
            config, part.last - part.first, world.signal_sizes.signals, descriptors
        )
        is_team = len(part.zones) > 1
        worlds = make_shared(part.first) if is_team else make(part.first, part.last)
        attach_sensors(worlds, part)
        kept = LoggedWorlds(worlds, part.first, checkpoint_log, limits_repeat=not is_team)
        if not is_team:
            jobs.append(WorldsJob(kept, memory))
            continue
        own_s = None if spent_s is None else spent_s[part.first]
        team = LedTeam(kept, part.zones, checkpoint_log.entries, own_s)
        jobs += [WorldsJob(kept, memory, team), *team.members()]
    return jobs


if __name__ == "__main__":
    serve(make_jobs)
