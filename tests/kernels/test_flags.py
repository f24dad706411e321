"""The flags that all kernels share."""

from __future__ import annotations

import numpy as np
import pytest
from numba.core import config
from numba.core.errors import NumbaError

from cavmarl.kernels import kernel, setup_kernel


def _sum_of_room(size: int) -> float:
    room = np.ones(size)
    total = 0.0
    for k in range(size):
        total += room[k]
    return total


@pytest.mark.skipif(config.DISABLE_JIT, reason="nothing is compiled")
def test_a_kernel_cannot_allocate() -> None:
    with pytest.raises(NumbaError, match="array passed into the function"):
        kernel(_sum_of_room)(3)


def test_a_setup_kernel_can_allocate() -> None:
    assert setup_kernel(_sum_of_room)(3) == 3.0
