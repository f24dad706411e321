"""Bundles of arrays that kernels take together, codes, and questions about a vehicle's row."""

from __future__ import annotations

from typing import Any

import numpy as np


def record(*fields: Any) -> np.dtype[np.void]:
    """The dtype of a record with these fields, each at a multiple of its size."""
    return np.dtype([*fields], align=True)
