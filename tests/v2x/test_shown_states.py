"""Encoding of the states of overridden signals in SPAT reports."""

from __future__ import annotations

import numpy as np
import pytest

from cavmarl.core.records.codes import SIGNAL_NONE, SIGNAL_YELLOW_MAJOR
from cavmarl.v2x.kernels.shown_states import (
    NOT_SHOWN,
    NUM_LETTERS,
    note_shown,
    phase_of,
    shown_at,
)
from cavmarl.v2x.kernels.v2x_records import REPORT


def test_written_states_are_read_back() -> None:
    random = np.random.default_rng(3)
    report = np.zeros(1, REPORT)[0]
    report["code"] = 41
    assert phase_of(report) == 41
    assert {shown_at(report, index) for index in range(50)} == {NOT_SHOWN}
    wanted = np.full(NUM_LETTERS, NOT_SHOWN)
    for index in random.permutation(NUM_LETTERS)[:30].tolist():
        wanted[index] = random.integers(0, SIGNAL_YELLOW_MAJOR + 1)
        note_shown(report, index, int(wanted[index]))
        note_shown(report, index, int(wanted[index]))  # writing twice changes nothing
    assert [shown_at(report, index) for index in range(NUM_LETTERS)] == wanted.tolist()
    assert report["code"] == -42
    assert phase_of(report) == 41


@pytest.mark.parametrize("index", [NUM_LETTERS, 200])
def test_states_of_links_beyond_the_report_are_unknown(index: int) -> None:
    report = np.zeros(1, REPORT)[0]
    note_shown(report, index, 2)
    assert report["code"] == -1
    assert shown_at(report, index) == SIGNAL_NONE
    assert shown_at(report, 0) == NOT_SHOWN
