"""Bundles of arrays for kernels, codes, and predicates of a vehicle's row."""

from __future__ import annotations

from typing import Any

import numpy as np


def record(*fields: Any) -> np.dtype[np.void]:
    """Return the dtype of a record with these fields, each aligned to its size."""
    return np.dtype([*fields], align=True)
