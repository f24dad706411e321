"""Evaluation: seeded episodes, what they say about a driver, and what they were made with."""

from __future__ import annotations

from cavmarl.evaluate.episodes import evaluate
from cavmarl.evaluate.manifest import Manifest
from cavmarl.evaluate.report import EvaluationReport

__all__ = ["EvaluationReport", "Manifest", "evaluate"]
