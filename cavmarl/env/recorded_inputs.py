"""The inputs of a world as a table of a recording: seeds, commands, and the resulting states.

With this table, a run can be repeated without its drivers, clients and traces. It has one row per
reset and per step. A row ends with the hash of the state that follows.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.parallel.worlds.step_arrays import StepArrays
from cavmarl.shards.shard import COMMANDS, Commands

INPUTS = "commands"  # name of the table
RESET, STEP = "reset", "step"


@dataclass
class StepInputs:
    """The inputs of a reset or of a step.

    Attributes:
        seed: seed of a reset; None: the reset begins the next episode of an earlier seed.
        commands: commands of a step; None for a reset.
    """

    seed: int | None = None
    commands: Commands | None = None


def inputs_dtype(config: EnvConfig, arrays: StepArrays) -> np.dtype[Any]:
    """Return the dtype of a row: the commands that one world can have."""
    columns: list[Any] = [("tick", "<i8"), ("kind", "O"), ("seed", "O"), ("state_hash", "O")]
    for name in COMMANDS:
        array = getattr(arrays, name)
        if array[0].size and (name != "declared" or config.v2x.enabled):
            columns.append((name, array.dtype.newbyteorder("<").str, array.shape[1:]))
    return np.dtype(columns)


def command_names(dtype: np.dtype[Any]) -> tuple[str, ...]:
    """Return the names of the commands in a row."""
    return tuple(name for name in dtype.names or () if name in COMMANDS)


def inputs_row(
    dtype: np.dtype[Any], inputs: StepInputs, tick: int, state_hash: str
) -> NDArray[np.void]:
    """Return the row (1,) of a reset or a step of one world that ends at a tick."""
    rows = np.zeros(1, dtype)
    rows["tick"], rows["state_hash"] = tick, state_hash
    commands = inputs.commands
    rows["kind"] = RESET if commands is None else STEP
    rows["seed"] = "" if commands is not None or inputs.seed is None else str(inputs.seed)
    for name in command_names(dtype) if commands is not None else ():
        array = getattr(commands, name)
        if array.size:  # empty if no events were declared
            rows[name] = array
    return rows


def commands_of(
    row: np.void, controls: NDArray[np.float64], choices: NDArray[np.int64]
) -> Commands:
    """Return the commands of a row of a step.

    Args:
        row: a row of the table.
        controls: `Commands.controls` without agents.
        choices: `Commands.meta_actions` without agents.
    """
    told = {
        name: np.ascontiguousarray(row[name])[np.newaxis]
        for name in command_names(row.dtype)
        if name != "declared" or row[name].any()
    }
    return Commands(**{"controls": controls, "meta_actions": choices, **told})
