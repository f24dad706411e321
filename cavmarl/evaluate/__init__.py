"""Evaluation: seeded runs, what they say about policies, and what they were made with."""

from __future__ import annotations

from cavmarl.evaluate.evaluation import evaluate, load_report
from cavmarl.evaluate.report import EvaluationReport

__all__ = ["EvaluationReport", "evaluate", "load_report"]
