"""The states of links in a SPAT report whose signal the caller has overridden.

Such a report has the code −1 − PHASE row. The fields that other SPAT reports leave unused hold 4
bits per link, by the index of the link's letter: 0, or 1 + the SIGNAL_* code. If these fields have
no room for an index, the state of the overridden link is not sent.
"""

from __future__ import annotations

import numpy as np

from cavmarl.core.compiled import kernel
from cavmarl.core.records.codes import SIGNAL_NONE

LETTERS_PER_FIELD = 13  # 52 bits, which float64 represents exactly
NUM_LETTERS = 3 * LETTERS_PER_FIELD
NOT_SHOWN = -1


@kernel
def note_shown(report: np.void, index: int, state: int) -> None:
    """Write the state of an overridden link, once per index."""
    if report["code"] >= 0:
        report["code"] = -1 - report["code"]
    bits = (1.0 + state) * np.float64(np.int64(1) << 4 * (index % LETTERS_PER_FIELD))
    field = index // LETTERS_PER_FIELD
    if shown_at(report, index) >= 0:
        return
    if field == 0:
        report["speed"] += bits
    elif field == 1:
        report["accel"] += bits
    elif field == 2:
        report["yaw_rate"] += bits


@kernel
def shown_at(report: np.void, index: int) -> int:
    """Return the SIGNAL_* code of an overridden link, NOT_SHOWN, or SIGNAL_NONE if not sent."""
    if report["code"] >= 0:
        return NOT_SHOWN
    field = index // LETTERS_PER_FIELD
    bits = 0.0
    if field == 0:
        bits = report["speed"]
    elif field == 1:
        bits = report["accel"]
    elif field == 2:
        bits = report["yaw_rate"]
    else:
        return SIGNAL_NONE
    return int(np.int64(bits) >> 4 * (index % LETTERS_PER_FIELD) & 15) - 1


@kernel
def phase_of(report: np.void) -> int:
    """Return the PHASE row of the signal's program."""
    code: int = report["code"]
    return code if code >= 0 else -1 - code
