"""Maps made by SUMO's netgenerate."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

__all__ = ["netgenerate"]


def netgenerate(path: Path, *options: str) -> Path:
    """Make a network with these options in a file; the test is skipped where SUMO is absent."""
    sumo = pytest.importorskip("sumo", reason="needs the extra: sumo")
    tool = Path(sumo.SUMO_HOME) / "bin" / "netgenerate"
    command = [tool, *options, "--xml-validation", "never", "--output-file", str(path)]
    subprocess.run(command, check=True, capture_output=True)
    return path
