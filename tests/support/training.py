"""Load the training programs as modules."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

TRAIN = Path(__file__).resolve().parents[2] / "train"


def load_program(name: str) -> ModuleType:
    """Load a program from its file, because `train` is not a package."""
    spec = importlib.util.spec_from_file_location(name, TRAIN / f"{name}.py")
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look up their module in sys.modules
    spec.loader.exec_module(module)
    return module
