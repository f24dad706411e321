"""The page's table of hand-overs: one row a figure, one cell a driver."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from cavmarl.evaluate.report import EvaluationReport
from cavmarl.ownership.transfer_summary import Spread, TransferSummary

NOTHING = "-"


class _Figure(NamedTuple):
    label: str
    unit: str
    meaning: str
    value: Callable[[TransferSummary], Spread | float | None]


FIGURES = (
    _Figure("changes", "", "vehicles that changed their owner", lambda found: found.transfers),
    _Figure("forced", "", "of them with the state attached, since no answer had come in time",
            lambda found: found.forced),
    _Figure("failure rate", "%", "share that had to be forced",
            lambda found: None if found.failure_rate is None else 100.0 * found.failure_rate),
    _Figure("put off", "ticks", "in which a vehicle that had crossed stayed with its owner",
            lambda found: found.deferred),
    _Figure("refused", "", "states that a zone did not take", lambda found: found.refused),
    _Figure("withdrawn", "", "approaches that ended without a change",
            lambda found: found.aborted),
    _Figure("left meanwhile", "", "vehicles that left the world in the tick of their change",
            lambda found: found.removed),
    _Figure("timeouts, acknowledge", "", "no answer by the end of a tick",
            lambda found: found.timeouts["acknowledge"]),
    _Figure("timeouts, switch", "", "none by the deadline",
            lambda found: found.timeouts["switch"]),
    _Figure("timeouts, replica", "", "states that were neither asked for nor withdrawn",
            lambda found: found.timeouts["replica"]),
    _Figure("latency", "ticks", "from the first state at the new owner until it had confirmed",
            lambda found: found.latency_ticks),
    _Figure("of these behind the border", "ticks", "for which the old owner drove on",
            lambda found: found.waited_ticks),
    _Figure("latency", "ms", "the same by the clock; not repeatable",
            lambda found: found.latency_ms),
    _Figure("state", "bytes", "of a vehicle", lambda found: found.state_bytes),
    _Figure("depth at PREPARE", "m", "outside of the old zone at the first state; inside, below 0",
            lambda found: found.prepare_depth_m),
    _Figure("depth at SWITCH", "m", "when the change was decided",
            lambda found: found.switch_depth_m),
    _Figure("depth at RELEASE", "m", "when it was committed, and the old owner's copy went",
            lambda found: found.release_depth_m),
)  # fmt: skip


def transfer_rows(report: EvaluationReport) -> list[dict[str, Any]]:
    """Label, unit, meaning and cells of each figure; nothing of undivided worlds."""
    found = [policy.transfers for policy in report.policies.values()]
    if all(summary is None for summary in found):
        return []
    return [
        {
            "label": figure.label,
            "unit": figure.unit,
            "meaning": figure.meaning,
            "cells": [
                NOTHING if summary is None else _text(figure.value(summary)) for summary in found
            ],
        }
        for figure in FIGURES
    ]


def _text(value: Spread | float | None) -> str:
    if isinstance(value, Spread):
        return " / ".join(_text(part) for part in value)
    if value is None:
        return NOTHING
    return f"{value:,}" if isinstance(value, int) else f"{value:.2f}"
