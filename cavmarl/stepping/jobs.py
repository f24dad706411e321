"""The jobs of all workers that run worlds, made where they are forked."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cavmarl.config import EnvConfig
from cavmarl.errors import WorkerStartError
from cavmarl.runtime.shared_memory import Segment, arrays_in, shared_zeros
from cavmarl.runtime.worker import Job
from cavmarl.stepping.arrays import StepArrays, layout_of
from cavmarl.stepping.diary import Diary
from cavmarl.stepping.job import WorldsJob, fingerprint
from cavmarl.stepping.local import LocalWorlds
from cavmarl.stepping.parts import Part
from cavmarl.stepping.team_job import LeaderJob
from cavmarl.worlds import make_world

__all__ = ["make_jobs"]


def make_jobs(recipe: Mapping[str, Any]) -> list[Job]:
    """The jobs of all workers, every kernel loaded.

    Args:
        recipe: what `pooled.PooledWorlds` writes.

    Raises:
        WorkerStartError: a file is not what it was.
    """
    from cavmarl.config_io import validate  # pydantic is slow to import

    config = validate(EnvConfig, recipe["config"], "the environment")
    world = make_world(config, Path(recipe["base_dir"]))
    if fingerprint(world) != recipe["fingerprint"]:
        raise WorkerStartError(
            f"the files of '{config.name}' have changed while workers were started: try again"
        )
    layout = layout_of(config, recipe["capacity"], recipe["num_worlds"])
    arrays = StepArrays(**arrays_in(Segment(recipe["arrays"], 0).map(), layout))
    LocalWorlds(world, 1, warm=True)
    jobs: list[Job] = []
    for given, descriptors in zip(recipe["parts"], recipe["diaries"], strict=True):
        part = Part(*given)
        is_split = len(part.zones) > 1
        worlds = LocalWorlds(
            world,
            part.last - part.first,
            arrays.part(part.first, part.last),
            in_next_step=recipe["in_next_step"],
            zeros=shared_zeros if is_split else np.zeros,
        )
        if is_split:
            leader = LeaderJob(worlds, part.first, part.zones, Diary(config, descriptors))
            jobs += [leader, *leader.followers()]
        else:
            jobs.append(WorldsJob(worlds, part.first))
    return jobs
