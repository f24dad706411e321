"""Check of recorded commands. Kernels use their numbers as indices, so files are not trusted."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError
from cavmarl.core.records.changed_lanes import wrong_changes
from cavmarl.core.records.codes import ACTION_SLOWER
from cavmarl.core.records.external_records import EXTERNAL_NONE
from cavmarl.core.seeds import check_seed
from cavmarl.engine.external_component import records_of, wrong_commands
from cavmarl.engine.override_component import wrong_states
from cavmarl.env.declared_events import wrong_causes
from cavmarl.env.external_commands import KINDS
from cavmarl.env.insertions import wrong_insertions
from cavmarl.env.recorded_inputs import RESET, STEP, command_names
from cavmarl.roads.network import RoadNetwork
from cavmarl.signals.kernels.green_choices import KEEP


def seed_of(row: np.void) -> int | None:
    """Return the seed in the row of a reset; None: the reset continues with an earlier seed.

    Raises:
        ConfigError: the value is not a valid seed.
    """
    if not row["seed"]:
        return None
    return check_seed(int(row["seed"]) if str(row["seed"]).isdecimal() else row["seed"])


def wrong_inputs(
    rows: NDArray[np.void],
    network: RoadNetwork,
    num_choices: NDArray[np.int32] | None,
) -> str:
    """Return what is wrong with the rows (n,) of a recording; empty if nothing.

    Args:
        rows: rows with the dtype of `inputs_dtype`.
        network: map of the world.
        num_choices: (S,) number of choices of each controlled signal or unit with speed limits;
            None: nothing is controlled.
    """
    if not np.isin(rows["kind"].astype(str), (RESET, STEP)).all():
        return f"a row is neither a {RESET} nor a {STEP}"
    try:
        for row in rows[rows["kind"] == RESET]:
            seed_of(row)
    except ConfigError as error:
        return str(error)
    checks: dict[str, Callable[[Any], str]] = {
        "controls": _wrong_controls,
        "meta_actions": _wrong_meta_actions,
        "declared": wrong_causes,
        "inserted": lambda told: wrong_insertions(told[told.any(axis=2)], network.lanes),
        "external": _wrong_external,
        "overridden": lambda told: wrong_states(told, network.links["signal"] >= 0),
        "lane_changes": lambda told: wrong_changes(told, network.lanes),
        "signal_choices": lambda told: _wrong_choices(told, num_choices),
    }
    found = (checks[name](np.ascontiguousarray(rows[name])) for name in command_names(rows.dtype))
    return next(filter(None, found), "")


def _wrong_controls(told: NDArray[np.float64]) -> str:
    return "" if np.isfinite(told).all() else "a control is not finite"


def _wrong_meta_actions(told: NDArray[np.int64]) -> str:
    is_known = ((told >= 0) & (told <= ACTION_SLOWER)).all()
    return "" if is_known else "a choice of a vehicle is unknown"


def _wrong_external(told: NDArray[np.float64]) -> str:
    """Return what is wrong with `Commands.external` of all rows (n, E, K), except for the bodies.

    The world checks the bodies of the vehicles that enter.
    """
    given = records_of(told)
    return wrong_commands(given[given["kind"] != EXTERNAL_NONE], KINDS)


def _wrong_choices(told: NDArray[np.int64], num_choices: NDArray[np.int32] | None) -> str:
    """Return what is wrong with `Commands.signal_choices` of all rows (n, S)."""
    if num_choices is not None and ((told == KEEP) | ((told >= 0) & (told < num_choices))).all():
        return ""
    return "a choice of a signal or of a speed limit is out of range"
