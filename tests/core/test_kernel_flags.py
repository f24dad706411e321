"""The compiler flags of all kernels."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numba.core.errors import NumbaError

from cavmarl.core.compiled import IS_PLAIN, kernel


def _allocates() -> float:
    return float(np.ones(3)[0])


@pytest.mark.skipif(IS_PLAIN, reason="nothing is compiled")
def test_a_kernel_cannot_allocate() -> None:
    with pytest.raises(NumbaError, match="array passed into the function"):
        kernel(_allocates)()


PROGRAM = """
import numpy as np
from cavmarl.core.compiled import kernel

def at(a, i):
    return a[i]

def last(a):
    return a[-1]

try:
    print(kernel(at)(np.arange(3.0), -1))
except IndexError:
    print("IndexError")
print(kernel(last)(np.arange(3.0)))
"""


@pytest.mark.skipif(IS_PLAIN, reason="nothing is compiled")
def test_only_constant_negative_indices_count_from_the_end(
    tmp_path: Path,
) -> None:
    script = tmp_path / "program.py"
    script.write_text(PROGRAM)
    # Without bounds checks, a negative index would read memory before the array.
    checked = {**os.environ, "NUMBA_BOUNDSCHECK": "1", "CAVMARL_CACHE_DIR": str(tmp_path)}
    checked["PYTHONPATH"] = str(Path(__file__).parents[2])
    done = subprocess.run(
        [sys.executable, str(script)], env=checked, check=True, capture_output=True, text=True
    )
    assert done.stdout.split() == ["IndexError", "2.0"]
