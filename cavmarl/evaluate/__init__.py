"""Evaluation: seeded runs, reports about policies, and the provenance of results."""

from __future__ import annotations

from cavmarl.evaluate.evaluation import evaluate, load_report
from cavmarl.evaluate.report import EvaluationReport

__all__ = ["EvaluationReport", "evaluate", "load_report"]
