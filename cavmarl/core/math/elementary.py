"""Elementary functions of float64 that return the same bits on every processor.

They consist of IEEE 754 operations that every processor rounds in the same way: + - * / and sqrt,
comparisons, remainders, conversions, and operations on bits. The functions of the C library and of
NumPy differ between processors in the last bit.

A call in a kernel is compiled into the kernel. A call from Python runs the plain function, with the
same bits. No argument raises an error. The sign of a NaN result is unspecified.

Sources: the reductions, polynomials and constants of `cos_sin`, `log`, `log1p` and `exp`, and the
polynomial of `atan2`, are from fdlibm (Sun Microsystems, 1993). Errors are in units in the last
place (ULP) of the exact result; `tests/core/test_elementary.py` measures them.
"""

from __future__ import annotations

import math

from cavmarl.core.compiled import inlined_function
from cavmarl.core.math.float_bits import bits_to_float, float_to_bits

_NAN = math.nan
_INFINITY = math.inf
# Adding and subtracting this rounds a number below 2**51 to an integer. After the addition, the
# lowest bits of the sum are the bits of the integer.
_ROUNDER = 6755399441055744.0  # 1.5 * 2**52

# pi / 2 in three parts (Cody and Waite: "Software Manual for the Elementary Functions", 1980). The
# first two have 33 bits, so their products with an integer below 2**20 are exact.
_PER_QUARTER = 0.6366197723675814  # 2 / pi
_QUARTER_1 = 1.5707963267341256
_QUARTER_2 = 6.077100506303966e-11
_QUARTER_3 = 2.0222662487959506e-21
_TURN = 6.283185307179586
_FAR = 1e6  # beyond this many radians, angles are first reduced by the float64 nearest to 2 pi

_S1 = -1.66666666666666324348e-01
_S2 = 8.33333333332248946124e-03
_S3 = -1.98412698298579493134e-04
_S4 = 2.75573137070700676789e-06
_S5 = -2.50507602534068634195e-08
_S6 = 1.58969099521155010221e-10

_C1 = 4.16666666666666019037e-02
_C2 = -1.38888888888741095749e-03
_C3 = 2.48015872894767294178e-05
_C4 = -2.75573143513906633035e-07
_C5 = 2.08757232129817482790e-09
_C6 = -1.13596475577881948265e-11

# Angles in two parts. The first part is a multiple of 2**-50, so sums of first parts are exact.
_HALF_1, _HALF_2 = 0.46364760900080526, 8.553660459218291e-16  # atan(1 / 2)
_EIGHTH_1, _EIGHTH_2 = 0.7853981633974483, 3.061616997868383e-17  # pi / 4
_RIGHT_1, _RIGHT_2 = 1.5707963267948966, 6.123233995736766e-17  # pi / 2
_BACK_1, _BACK_2 = 3.141592653589793, 1.2246467991473532e-16  # pi

_A0 = 3.33333333333329318027e-01
_A1 = -1.99999999998764832476e-01
_A2 = 1.42857142725034663711e-01
_A3 = -1.11111104054623557880e-01
_A4 = 9.09088713343650656196e-02
_A5 = -7.69187620504482999495e-02
_A6 = 6.66107313738753120669e-02
_A7 = -5.83357013379057348645e-02
_A8 = 4.97687799461593236017e-02
_A9 = -3.65315727442169155270e-02
_A10 = 1.62858201153657823623e-02

# Between these bounds, no operation of `atan2` overflows or loses bits to underflow.
_SMALL = 1e-280
_LARGE = 1e300
_UP = 1.3407807929942597e154  # 2**512
_DOWN = 7.458340731200207e-155  # 2**-512

_LN2_1 = 6.93147180369123816490e-01  # its lowest 32 bits are zero
_LN2_2 = 1.90821492927058770002e-10
_LN10 = 2.302585092994046
_L1 = 6.666666666666735130e-01
_L2 = 3.999999999940941908e-01
_L3 = 2.857142874366239149e-01
_L4 = 2.222219843214978396e-01
_L5 = 1.818357216161805012e-01
_L6 = 1.531383769920937332e-01
_L7 = 1.479819860511658591e-01
_FRACTION_BITS = 52
_FRACTION = 0x000FFFFFFFFFFFFF
_EXPONENT_BIAS = 1023
_ONE = 0x3FF0000000000000  # bits of 1
_ROOT_HALF = 0x3FE6A09E00000000  # bits of sqrt(1 / 2), nearly
_SMALLEST_NORMAL = 2.2250738585072014e-308
_TWO_54 = 18014398509481984.0

_PER_LN2 = 1.4426950408889634
_E1 = 1.66666666666666019037e-01
_E2 = -2.77777777770155933842e-03
_E3 = 6.61375632143793436117e-05
_E4 = -1.65339022054652515390e-06
_E5 = 4.13813679705723846039e-08
_LARGEST_EXPONENT = 709.782712893384
_SMALLEST_EXPONENT = -745.1332191019412

_PER_ROOT_PI = 0.5641895835477563
_F0 = 3.1611237438705655
_F1 = 113.86415415105016
_F2 = 377.485237685302
_F3 = 3209.3775891384694
_F4 = 0.18577770618460315
_G0 = 23.601290952344122
_G1 = 244.02463793444417
_G2 = 1282.6165260773723
_G3 = 2844.236833439171
_H0 = 0.5641884969886701
_H1 = 8.883149794388377
_H2 = 66.11919063714163
_H3 = 298.6351381974001
_H4 = 881.952221241769
_H5 = 1712.0476126340707
_H6 = 2051.0783778260716
_H7 = 1230.3393547979972
_H8 = 2.1531153547440383e-08
_I0 = 15.744926110709835
_I1 = 117.6939508913125
_I2 = 537.1811018620099
_I3 = 1621.3895745666903
_I4 = 3290.7992357334597
_I5 = 4362.619090143247
_I6 = 3439.3676741437216
_I7 = 1230.3393548037495
_J0 = 0.30532663496123236
_J1 = 0.36034489994980445
_J2 = 0.12578172611122926
_J3 = 0.016083785148742275
_J4 = 0.0006587491615298378
_J5 = 0.016315387137302097
_K0 = 2.568520192289822
_K1 = 1.8729528499234673
_K2 = 0.5279051029514285
_K3 = 0.06051834131244132
_K4 = 0.0023352049762686918


@inlined_function
def _reduce(angle: float) -> tuple[int, float, float]:
    """Subtract quarter turns from an angle.

    Returns:
        The number of quarter turns, whose lowest two bits are valid; and the remainder
        in two parts, a number in about [-pi / 4, pi / 4] and a correction.
    """
    angle = float(angle)
    if not abs(angle) <= _FAR:
        angle = math.copysign(abs(angle) % _TURN, angle)  # exact; NaN for inf
    shifted = angle * _PER_QUARTER + _ROUNDER
    quarters = shifted - _ROUNDER
    near = angle - quarters * _QUARTER_1
    step = quarters * _QUARTER_2
    rest = near - step
    return float_to_bits(shifted), rest, ((near - rest) - step) - quarters * _QUARTER_3


@inlined_function
def _near_sin(high: float, low: float) -> float:
    """Return sin(high + low) for an angle in about [-pi / 4, pi / 4]."""
    square = high * high
    cube = square * high
    tail = (_S2 + square * (_S3 + square * _S4)) + square * (square * square) * (_S5 + square * _S6)
    return high - ((square * (0.5 * low - cube * tail) - low) - cube * _S1)


@inlined_function
def _near_cos(high: float, low: float) -> float:
    """Return cos(high + low) for an angle in about [-pi / 4, pi / 4]."""
    square = high * high
    fourth = square * square
    tail = square * (_C1 + square * (_C2 + square * _C3)) + fourth * fourth * (
        _C4 + square * (_C5 + square * _C6)
    )
    half = 0.5 * square
    rest = 1.0 - half
    return rest + (((1.0 - rest) - half) + (square * tail - high * low))


@inlined_function
def cos_sin(angle: float) -> tuple[float, float]:
    """Return the cosine and the sine of an angle in radians.

    The error is below 0.8 ULP for angles up to 1e5, and below 1.2 ULP up to 1e6. Beyond, the
    results are in [-1, 1], and the error grows with the angle. The results for inf and NaN are NaN.
    """
    # Both polynomials are evaluated: a mispredicted branch takes longer than a polynomial.
    quarters, high, low = _reduce(angle)
    near_sin = _near_sin(high, low)
    near_cos = _near_cos(high, low)
    sin = near_cos if quarters & 1 else near_sin
    cos = near_sin if quarters & 1 else near_cos
    return -cos if (quarters + 1) & 2 else cos, -sin if quarters & 2 else sin


@inlined_function
def sine(angle: float) -> float:
    """Return the sine of an angle in radians; see `cos_sin`."""
    return cos_sin(angle)[1]


@inlined_function
def cosine(angle: float) -> float:
    """Return the cosine of an angle in radians; see `cos_sin`."""
    return cos_sin(angle)[0]


@inlined_function
def tangent(angle: float) -> float:
    """Return the tangent of an angle in radians, sine / cosine.

    The error is below 2.5 ULP for angles up to 1e6. The result for inf and NaN is NaN.
    """
    cos, sin = cos_sin(angle)
    return sin / cos


@inlined_function
def atan2(y: float, x: float) -> float:
    """Return the angle of the point (x, y) in [-pi, pi].

    The error is below 1.4 ULP. Signed zeros and infinite coordinates are treated as in C. The
    result is NaN if a coordinate is NaN.
    """
    y = float(y)
    x = float(x)
    top = abs(y)
    bottom = abs(x)
    is_steep = top > bottom
    if is_steep:
        top, bottom = bottom, top
    if not (_SMALL < bottom < _LARGE and top == top):
        if top != top or bottom != bottom:
            return _NAN
        if bottom == 0.0:
            bottom = 1.0
        elif bottom <= _SMALL:
            top *= _UP
            bottom *= _UP
        elif top == _INFINITY:
            top = bottom = 1.0
        elif bottom < _INFINITY:
            top *= _DOWN
            bottom *= _DOWN
    # The angle of (bottom, top), in [0, pi / 4], is first + (second + atan(ratio)).
    if top < 0.4375 * bottom:
        first, second = 0.0, 0.0
        ratio = top / bottom
    elif top < 0.6875 * bottom:
        first, second = _HALF_1, _HALF_2
        ratio = (2.0 * top - bottom) / (2.0 * bottom + top)
    else:
        first, second = _EIGHTH_1, _EIGHTH_2
        ratio = (top - bottom) / (top + bottom)
    if is_steep:
        first, second, ratio = _RIGHT_1 - first, _RIGHT_2 - second, -ratio
    if math.copysign(1.0, x) < 0.0:
        first, second, ratio = _BACK_1 - first, _BACK_2 - second, -ratio
    square = ratio * ratio
    fourth = square * square
    odd = square * (
        _A0 + fourth * (_A2 + fourth * (_A4 + fourth * (_A6 + fourth * (_A8 + fourth * _A10))))
    )
    even = fourth * (_A1 + fourth * (_A3 + fourth * (_A5 + fourth * (_A7 + fourth * _A9))))
    return math.copysign(first + (ratio + (second - ratio * (odd + even))), y)


@inlined_function
def atan(slope: float) -> float:
    """Return the arctangent of a slope in [-pi / 2, pi / 2], with an error below 1 ULP."""
    return atan2(slope, 1.0)


@inlined_function
def asin(sine: float) -> float:
    """Return the arcsine in [-pi / 2, pi / 2], with an error below 2.5 ULP.

    The result is NaN for NaN and for numbers outside of [-1, 1].
    """
    if not abs(sine) <= 1.0:
        return _NAN
    return atan2(sine, math.sqrt((1.0 - sine) * (1.0 + sine)))


@inlined_function
def acos(cosine: float) -> float:
    """Return the arccosine in [0, pi], with an error below 2.5 ULP.

    The result is NaN for NaN and for numbers outside of [-1, 1].
    """
    if not abs(cosine) <= 1.0:
        return _NAN
    return atan2(math.sqrt((1.0 - cosine) * (1.0 + cosine)), cosine)


@inlined_function
def _log_of_sum(large: float, small: float, extra: int) -> float:
    """Return log((large + small) * 2**extra) for a normal `large` > 0 and a `small` below its ULP.

    large = 2**k * (1 + f) with 1 + f in [sqrt(1 / 2), sqrt(2)].
    """
    bits = float_to_bits(large) + (_ONE - _ROOT_HALF)
    k = float((bits >> _FRACTION_BITS) - _EXPONENT_BIAS + extra)
    f = bits_to_float((bits & _FRACTION) + _ROOT_HALF) - 1.0
    half = 0.5 * f * f
    share = f / (2.0 + f)
    square = share * share
    fourth = square * square
    odd = square * (_L1 + fourth * (_L3 + fourth * (_L5 + fourth * _L7)))
    even = fourth * (_L2 + fourth * (_L4 + fourth * _L6))
    rest = share * (half + (odd + even)) + (k * _LN2_2 + small / large)
    return k * _LN2_1 - ((half - rest) - f)


@inlined_function
def log(value: float) -> float:
    """Return the natural logarithm, with an error below 1 ULP.

    The result is -inf for 0 and NaN for negative numbers and NaN.
    """
    value = float(value)
    if not value > 0.0:
        return -_INFINITY if value == 0.0 else _NAN
    if value == _INFINITY:
        return _INFINITY
    if value < _SMALLEST_NORMAL:
        return _log_of_sum(value * _TWO_54, 0.0, -54)
    return _log_of_sum(value, 0.0, 0)


@inlined_function
def log1p(value: float) -> float:
    """Return log(1 + value), with an error below 1 ULP.

    The result is -inf for -1, and NaN for smaller numbers and NaN.
    """
    value = float(value)
    if not value > -1.0:
        return -_INFINITY if value == -1.0 else _NAN
    if value == _INFINITY or abs(value) < 1e-17:
        return value
    whole = 1.0 + value
    # The rounding error of the sum, computed from its larger term first.
    lost = value - (whole - 1.0) if value < 1.0 else 1.0 - (whole - value)
    return _log_of_sum(whole, lost, 0)


@inlined_function
def log10(value: float) -> float:
    """Return the logarithm to base 10, with an error below 2.5 ULP and the limits of `log`."""
    return log(value) / _LN10


@inlined_function
def exp(power: float) -> float:
    """Return e**power, with an error below 1 ULP.

    The result is inf or 0 if the exact value is too large or too small for a float64.
    """
    power = float(power)
    if power != power:
        return power
    if power > _LARGEST_EXPONENT:
        return _INFINITY
    if power < _SMALLEST_EXPONENT:
        return 0.0
    doublings = (power * _PER_LN2 + _ROUNDER) - _ROUNDER
    high = power - doublings * _LN2_1
    low = doublings * _LN2_2
    rest = high - low
    square = rest * rest
    shape = rest - square * (_E1 + square * (_E2 + square * (_E3 + square * (_E4 + square * _E5))))
    value = 1.0 - ((low - (rest * shape) / (2.0 - shape)) - high)
    # Two factors, as 2**doublings may be outside of the normal numbers.
    count = int(doublings)
    half = count >> 1
    return (
        value
        * bits_to_float((half + _EXPONENT_BIAS) << _FRACTION_BITS)
        * bits_to_float((count - half + _EXPONENT_BIAS) << _FRACTION_BITS)
    )


@inlined_function
def erf(value: float) -> float:
    """Return the error function, with an error below 3.5 ULP.

    Rational functions of Cody: "Rational Chebyshev approximations for the error function",
    Mathematics of Computation 23, 1969.
    """
    value = float(value)
    size = abs(value)
    if size <= 0.46875:
        square = size * size
        top = (((_F4 * square + _F0) * square + _F1) * square + _F2) * square + _F3
        bottom = (((square + _G0) * square + _G1) * square + _G2) * square + _G3
        return value * (top / bottom)
    if size > 6.0:  # the exact value rounds to 1
        return math.copysign(1.0, value)
    if size <= 4.0:
        top = ((((_H8 * size + _H0) * size + _H1) * size + _H2) * size + _H3) * size + _H4
        top = ((top * size + _H5) * size + _H6) * size + _H7
        bottom = ((((size + _I0) * size + _I1) * size + _I2) * size + _I3) * size + _I4
        bottom = ((bottom * size + _I5) * size + _I6) * size + _I7
        rest = top / bottom
    else:
        square = 1.0 / (size * size)
        top = ((((_J5 * square + _J0) * square + _J1) * square + _J2) * square + _J3) * square
        bottom = ((((square + _K0) * square + _K1) * square + _K2) * square + _K3) * square
        rest = (_PER_ROOT_PI - square * (top + _J4) / (bottom + _K4)) / size
    return math.copysign(1.0 - rest * exp(-size * size), value)


@inlined_function
def hypot(x: float, y: float) -> float:
    """Return sqrt(x * x + y * y), with an error below 1.1 ULP.

    Overflow and underflow of the squares are not avoided.
    """
    x = float(x)
    y = float(y)
    return math.sqrt(x * x + y * y)
