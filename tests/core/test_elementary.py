"""Elementary functions: error bounds, special values, and equal bits in Python and in kernels."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.math import elementary_arrays as arrays
from cavmarl.core.math.elementary import (
    acos,
    asin,
    atan,
    atan2,
    cos_sin,
    cosine,
    erf,
    exp,
    hypot,
    log,
    log1p,
    log10,
    sine,
    tangent,
)
from cavmarl.core.math.float_bits import bits_to_float, float_to_bits

Numbers = NDArray[np.float64]
Function = Callable[[float], float]

FUNCTIONS: dict[str, Function] = {
    "sin": sine, "cos": cosine, "tan": tangent, "atan": atan, "asin": asin, "acos": acos,
    "log": log, "log1p": log1p, "log10": log10, "exp": exp, "erf": erf,
}  # fmt: skip
# The largest errors according to the docstrings of the functions, in ULP.
MOST_ULP = {
    "sin": 0.8, "cos": 0.8, "tan": 2.5, "atan": 1.0, "asin": 2.5, "acos": 2.5,
    "log": 1.0, "log1p": 1.0, "log10": 2.5, "exp": 1.0, "erf": 3.5, "atan2": 1.4,
}  # fmt: skip
TINY = 5e-324
EDGES = (
    0.0, -0.0, 1.0, -1.0, 0.5, -0.5, TINY, -TINY, 2.0**-1022, 1e-17, 1e300, -1e300, 1.7e308,
    math.inf, -math.inf, math.nan, math.pi, -math.pi, math.pi / 2, math.pi / 4, math.e,
    math.nextafter(1.0, 2.0), math.nextafter(1.0, 0.0), 709.782712893384, -745.13, 1e22,
)  # fmt: skip
floats = st.floats() | st.floats(-10.0, 10.0) | st.sampled_from(EDGES)


@kernel
def fill(x: Numbers, y: Numbers, out: Numbers) -> None:
    """Write the values of all functions to `out` (n, 16): one row per x and y (n,)."""
    for i in range(x.shape[0]):
        out[i, 0] = sine(x[i])
        out[i, 1] = cosine(x[i])
        out[i, 2] = tangent(x[i])
        out[i, 3] = atan(x[i])
        out[i, 4] = asin(x[i])
        out[i, 5] = acos(x[i])
        out[i, 6] = log(x[i])
        out[i, 7] = log1p(x[i])
        out[i, 8] = log10(x[i])
        out[i, 9] = exp(x[i])
        out[i, 10] = erf(x[i])
        out[i, 11] = atan2(x[i], y[i])
        out[i, 12] = hypot(x[i], y[i])
        cos, sin = cos_sin(x[i])
        out[i, 13] = cos
        out[i, 14] = sin
        out[i, 15] = bits_to_float(float_to_bits(x[i]))


def compiled(x: Numbers, y: Numbers) -> Numbers:
    """Return the rows that `fill` writes, (n, 16)."""
    out = np.zeros((len(x), 16))
    fill(x, y, out)
    return out


def plain(x: float, y: float) -> list[float]:
    """Return one row of `fill`, computed by the functions in Python."""
    of_one = [function(x) for function in FUNCTIONS.values()]
    cos, sin = cos_sin(x)
    return [*of_one, atan2(x, y), hypot(x, y), cos, sin, bits_to_float(float_to_bits(x))]


def bits(numbers: Any) -> list[int]:
    """Return the bits of numbers, with equal bits for all NaNs."""
    values = np.array(numbers, np.float64)
    values[np.isnan(values)] = np.nan
    return values.view(np.int64).tolist()  # type: ignore[no-any-return]


@given(st.lists(st.tuples(floats, floats), min_size=1))
@example([(x, y) for x in EDGES for y in EDGES])
def test_functions_return_the_same_bits_in_python_and_in_kernels(
    pairs: list[tuple[float, float]],
) -> None:
    x, y = np.array(pairs).T.copy()
    found = compiled(x, y)
    for row, pair in zip(found, pairs, strict=True):
        assert bits(row) == bits(plain(*pair)), pair


@given(st.lists(floats))
@example([*EDGES])
def test_functions_return_the_same_bits_for_arrays_as_for_numbers(values: list[float]) -> None:
    x = np.array(values, np.float64)
    for of_all, of_one in (
        (arrays.sin_all, sine),
        (arrays.cos_all, cosine),
        (arrays.log1p_all, log1p),
        (arrays.exp_all, exp),
    ):
        assert bits(of_all(x)) == bits([of_one(value) for value in values])
    assert bits(arrays.atan2_all(x, x[::-1])) == bits(list(map(atan2, values, values[::-1])))
    with np.errstate(all="ignore"):
        assert bits(arrays.hypot_all(x, x[::-1])) == bits(list(map(hypot, values, values[::-1])))


def test_functions_of_arrays_keep_the_shape_and_do_not_change_the_argument() -> None:
    angles = np.arange(6.0).reshape(2, 3).T
    sines = arrays.sin_all(angles)
    assert sines.shape == (3, 2)
    assert sines[2, 1] == sine(5.0)
    assert angles[2, 1] == 5.0
    assert float(arrays.sin_all(0.5)) == sine(0.5)
    assert arrays.atan2_all(np.zeros(0), np.zeros(0)).shape == (0,)


@pytest.mark.parametrize("name", FUNCTIONS)
@given(value=floats)
@example(value=0.0)
@example(value=-0.0)
@example(value=-1.0)
@example(value=1.0)
@example(value=math.inf)
@example(value=-math.inf)
@example(value=math.nan)
def test_results_equal_those_of_numpy_except_for_rounding(name: str, value: float) -> None:
    with np.errstate(all="ignore"):
        expected = math.erf(value) if name == "erf" else float(getattr(np, _NUMPY[name])(value))
    found = FUNCTIONS[name](value)
    if name in ("sin", "cos", "tan") and abs(value) > 1e5:
        assert name == "tan" or not abs(found) > 1.0
        assert math.isnan(found) == math.isinf(value) or math.isnan(value)
    elif expected == 0.0 or not math.isfinite(expected):
        assert bits(found) == bits(expected)
    else:
        assert abs(found - expected) <= 5.0 * math.ulp(expected)


_NUMPY = {
    "sin": "sin", "cos": "cos", "tan": "tan", "atan": "arctan", "asin": "arcsin",
    "acos": "arccos", "log": "log", "log1p": "log1p", "log10": "log10", "exp": "exp",
}  # fmt: skip


@pytest.mark.parametrize("y", EDGES)
def test_atan2_has_the_same_sign_as_in_the_math_module(y: float) -> None:
    for x in EDGES:
        found, expected = atan2(y, x), math.atan2(y, x)
        assert found == pytest.approx(expected, rel=4e-16, abs=TINY, nan_ok=True)
        if not math.isnan(expected):
            assert math.copysign(1.0, found) == math.copysign(1.0, expected)


def test_no_argument_causes_a_warning() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for x in EDGES:
            for function in FUNCTIONS.values():
                function(np.float64(x))
                function(x)


def spread(low: float, high: float, count: int, seed: int) -> Numbers:
    """Draw numbers of both signs, whose logarithms are uniform."""
    draws = np.random.default_rng(seed)
    sizes = np.exp2(draws.uniform(np.log2(low), np.log2(high), count))
    return sizes * draws.choice([-1.0, 1.0], count)


def arguments(name: str, count: int = 1500) -> Numbers:
    """Return arguments in the range in which the error bound of the function holds."""
    draws = np.random.default_rng(1)
    if name in ("sin", "cos", "tan"):
        zeros = 0.5 * math.pi * draws.integers(-60_000, 60_000, count)
        return np.concatenate([spread(1e-9, 1e5, count, 2), draws.uniform(-7, 7, count), zeros])
    if name in ("asin", "acos"):
        near_one = 1.0 - abs(spread(1e-15, 1.0, count, 3))
        return np.concatenate(
            [draws.uniform(-1.0, 1.0, count), spread(1e-9, 1.0, count, 4), near_one]
        )
    if name in ("log", "log10"):
        near_one = draws.uniform(0.5, 2.0, count)
        return np.concatenate([abs(spread(1e-320, 1e300, count, 5)), near_one])
    if name == "log1p":
        large = abs(spread(1e-5, 1e12, count, 6))
        return np.concatenate([spread(1e-12, 0.999, count, 7), large])
    if name == "exp":
        return np.concatenate([spread(1e-9, 700.0, count, 8), draws.uniform(-2.0, 2.0, count)])
    return np.concatenate([spread(1e-9, 1e9, count, 9), draws.uniform(-5.0, 5.0, count)])


@pytest.mark.parametrize("name", MOST_ULP)
def test_the_error_of_each_function_is_below_its_bound(name: str) -> None:
    mpmath = pytest.importorskip("mpmath", reason="exact values need mpmath, which torch brings")
    with mpmath.workprec(160):
        exact = {
            **{each: getattr(mpmath.mp, each) for each in ("sin", "cos", "tan", "atan", "exp")}
        }
        exact |= {each: getattr(mpmath.mp, each) for each in ("asin", "acos", "log", "log10")}
        exact |= {"erf": mpmath.mp.erf, "log1p": lambda value: mpmath.log(1 + value)}
        if name == "atan2":
            y, x = spread(1e-9, 1e9, 3000, 10), spread(1e-3, 1e3, 3000, 11)
            cases = [
                (mpmath.atan2(*map(mpmath.mpf, pair)), atan2(*pair))
                for pair in zip(y, x, strict=True)
            ]
        else:
            values = arguments(name).tolist()
            cases = [(exact[name](mpmath.mpf(value)), FUNCTIONS[name](value)) for value in values]
        errors = [
            float(abs((mpmath.mpf(found) - value) / mpmath.mpf(math.ulp(float(value)))))
            for value, found in cases
        ]
    assert max(errors) < MOST_ULP[name]
    assert max(errors) > 0.4  # a smaller value would show that rounding is not measured
