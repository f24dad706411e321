"""The functions of `elementary` for arrays, with the same bits as for single numbers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.math.elementary import atan2, cosine, exp, log1p, sine

Numbers = NDArray[np.float64]


@kernel
def apply_sin(values: Numbers) -> None:
    """Replace each of `values` (n,) by its sine."""
    for i in range(values.shape[0]):
        values[i] = sine(values[i])


@kernel
def apply_cos(values: Numbers) -> None:
    """Replace each of `values` (n,) by its cosine."""
    for i in range(values.shape[0]):
        values[i] = cosine(values[i])


@kernel
def apply_log1p(values: Numbers) -> None:
    """Replace each of `values` (n,) by log(1 + value)."""
    for i in range(values.shape[0]):
        values[i] = log1p(values[i])


@kernel
def apply_exp(values: Numbers) -> None:
    """Replace each of `values` (n,) by e**value."""
    for i in range(values.shape[0]):
        values[i] = exp(values[i])


@kernel
def apply_atan2(values: Numbers, x: Numbers) -> None:
    """Replace each of `values` (n,) by the angle of the point (x, value)."""
    for i in range(values.shape[0]):
        values[i] = atan2(values[i], x[i])


def _mapped(apply: Callable[..., None], *arguments: Any) -> Numbers:
    """Return the result of a kernel on copies of its arguments, which have the same shape."""
    copies = [np.array(argument, np.float64, order="C") for argument in arguments]
    apply(*(copy.reshape(-1) for copy in copies))
    return copies[0]


def sin_all(angles: ArrayLike) -> Numbers:
    """Return the sines of angles in radians."""
    return _mapped(apply_sin, angles)


def cos_all(angles: ArrayLike) -> Numbers:
    """Return the cosines of angles in radians."""
    return _mapped(apply_cos, angles)


def log1p_all(values: ArrayLike) -> Numbers:
    """Return log(1 + value) of each value."""
    return _mapped(apply_log1p, values)


def exp_all(powers: ArrayLike) -> Numbers:
    """Return e**power of each power."""
    return _mapped(apply_exp, powers)


def atan2_all(y: ArrayLike, x: ArrayLike) -> Numbers:
    """Return the angles of points (x, y) in [-pi, pi]; both arrays have the same shape."""
    return _mapped(apply_atan2, y, x)


def hypot_all(x: Numbers, y: Numbers) -> Numbers:
    """Return the lengths of vectors (x, y), with the bits of `hypot`."""
    lengths: Numbers = np.sqrt(x * x + y * y)
    return lengths
