"""The manifest of a training run, which lies beside the driver's checkpoint.

It is written before the first update and closed after the last one with the hashes of the results.
If the run dies, the manifest stays open.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cavmarl.balance.balance_plan import Plan
from cavmarl.balance.plan_file import PLACEMENT, PLACEMENT_AT_END
from cavmarl.core.errors import ManifestError
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.world_description import describe_world
from cavmarl.engine.world_setup import World
from cavmarl.evaluate.provenance.manifest import (
    MANIFEST_FILE,
    close_manifest,
    open_manifest,
    read_closed,
)

CSV_FILE = "progress.csv"  # the learning curve, a row for each update
CHECKPOINT_FILE = "checkpoint.pt"  # from which a run resumes; see `learning.checkpoint`


def begin_training(
    folder: Path,
    program: str,
    settings: Mapping[str, Any],
    world: World | Simulation,
    plans: Sequence[Plan] = (),
) -> None:
    """Write the manifest of a training run; an earlier manifest in the folder is replaced.

    `plans` say which worker hosts which shards; `cavmarl plan --again FOLDER/manifest.json`
    recomputes them. `seed` is one of the settings.
    """
    (folder / MANIFEST_FILE).unlink(missing_ok=True)
    open_manifest(
        folder,
        {
            "program": program,
            "settings": dict(settings),
            "seeds": [settings["seed"]],
            "world": describe_world(world.config, world.network, world.demand, world.partition),
            PLACEMENT: [plan.to_dict() for plan in plans],
        },
    )


def end_training(folder: Path, files: Sequence[str], plans: Sequence[Plan] = ()) -> None:
    placement = {PLACEMENT_AT_END: [plan.to_dict() for plan in plans]}
    close_manifest(folder, list(files), placement)


def is_trained(folder: Path) -> bool:
    """Return whether the folder has the unchanged files of a run that has ended."""
    try:
        read_closed(folder)
    except ManifestError:
        return False
    return True
