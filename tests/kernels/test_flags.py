"""The flags that all kernels share.

Two functions: compiled code is cached by function, whatever the flags.
"""

from __future__ import annotations

import numpy as np
import pytest
from numba.core import config
from numba.core.errors import NumbaError

from cavmarl.kernels import allocating_kernel, kernel


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
