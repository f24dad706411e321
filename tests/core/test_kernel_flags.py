"""The flags that all kernels share.

Two functions: compiled code is cached by function, whatever the flags.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numba.core import config
from numba.core.errors import NumbaError

from cavmarl.core.compiled import allocating_kernel, kernel


def _borrows_no_room() -> float:
    return float(np.ones(3)[0])


def _has_room() -> float:
    return float(np.ones(3)[0])


@pytest.mark.skipif(config.DISABLE_JIT, reason="nothing is compiled")
def test_a_kernel_cannot_allocate() -> None:
    with pytest.raises(NumbaError, match="array passed into the function"):
        kernel(_borrows_no_room)()


def test_an_allocating_kernel_can_allocate() -> None:
    assert allocating_kernel(_has_room)() == 1.0


LOOKS = """
import numpy as np
from cavmarl.core.compiled import allocating_kernel, kernel

def at(a, i):
    return a[i]

def at_usual(a, i):
    return a[i]

def last(a):
    return a[-1]

for function in (kernel(at), allocating_kernel(at_usual)):
    try:
        print(function(np.arange(3.0), -1))
    except IndexError:
        print("IndexError")
print(kernel(last)(np.arange(3.0)))
"""


@pytest.mark.skipif(config.DISABLE_JIT, reason="nothing is compiled")
def test_an_index_of_a_kernel_counts_from_the_front_unless_it_is_written_out(
    tmp_path: Path,
) -> None:
    script = tmp_path / "looks.py"
    script.write_text(LOOKS)
    # Checked: unchecked, a negative index reads what lies before the array.
    checked = {**os.environ, "NUMBA_BOUNDSCHECK": "1", "CAVMARL_CACHE_DIR": str(tmp_path)}
    checked["PYTHONPATH"] = str(Path(__file__).parents[2])
    told = subprocess.run(
        [sys.executable, str(script)], env=checked, check=True, capture_output=True, text=True
    )
    assert told.stdout.split() == ["IndexError", "2.0", "2.0"]
