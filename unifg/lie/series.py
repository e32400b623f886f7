"""The functions of an angle that exponentials and their Jacobians are made of, exact to rounding at every angle.

With ``t = theta^2``, ``h = theta / 2`` and ``'`` for d/dtheta:

=============  ============================  =======
name           value                         at zero
=============  ============================  =======
``sinc``       sin(x) / x                    1
``x_cot_x``    x cot(x)                      1
``b``          (1 - cos theta) / theta^2     1/2
``c_value``    (theta - sin theta)/theta^3   1/6
``k_value``    (1 - h cot h) / theta^2       1/12
``b_slope``    b' / theta                    -1/12
``c_slope``    c' / theta                    -1/60
``k_slope``    k' / theta                    1/360
=============  ============================  =======

``sinc``, ``x_cot_x`` and ``b = sinc(h)^2 / 2`` do not cancel near zero; a floor under the angle takes the place of a
branch. The others cancel, and are summed for ``t < SERIES_BELOW``. The series of b and c alternate with falling terms,
so each errs by less than the first term left out. The terms of ``k = sum_n 2 zeta(2n) t^(n-1) / (2 pi)^(2n)`` fall by a
factor of 158 or more, those of its slope by 100 or more, so they err by less than 1.02 times the first term left out.
That term is below 1e-17, a tenth of the rounding of the smallest value, wherever a sum below stops.
"""

from __future__ import annotations

import math

from unifg.codegen.jit import compiled

TINY = 1e-300  # below every angle that matters: sin(TINY) / TINY is 1
SERIES_BELOW = 0.25  # of theta^2 [rad^2]


@compiled
def sinc(x: float) -> float:
    """Return sin(x) / x, with 1 at zero."""
    floored = max(abs(x), TINY)
    return math.sin(floored) / floored


@compiled
def sinc_and_cos(x: float) -> tuple[float, float]:
    """Return sin(x) / x and cos(x) for the price of one; sin(x) is the first times x."""
    floored = max(abs(x), TINY)
    return math.sin(floored) / floored, math.cos(floored)


@compiled
def x_cot_x(x: float) -> float:
    """Return x cot(x), with 1 at zero."""
    floored = max(abs(x), TINY)
    return floored / math.tan(floored)


@compiled
def c_value(theta: float, sine: float) -> float:
    """Return (theta - sin theta) / theta^3 given the sine; the series lacks t^7 / 17! < 2e-19."""
    t = theta * theta
    if t < SERIES_BELOW:
        tail = 1 / 362880 - t * (1 / 39916800 - t * (1 / 6227020800 - t / 1307674368000))
        return 1 / 6 - t * (1 / 120 - t * (1 / 5040 - t * tail))
    return (theta - sine) / (t * theta)


@compiled
def k_value(t: float, g: float) -> float:
    """Return (1 - g) / t given g = h cot h; the series lacks a term below 2e-19."""
    if t < SERIES_BELOW:
        tail = 1 / 47900160 + t * (691 / 1307674368000 + t * (1 / 74724249600 + t * (3617 / 10670622842880000)))
        return 1 / 12 + t * (1 / 720 + t * (1 / 30240 + t * (1 / 1209600 + t * tail)))
    return (1.0 - g) / t


@compiled
def b_slope(t: float, a: float, b: float) -> float:
    """Return b' / theta = (a - 2 b) / t given a = sin(theta) / theta; the series lacks 16 t^7 / 18! < 2e-19."""
    if t < SERIES_BELOW:
        tail = 1 / 47900160 - t * (1 / 7264857600 - t / 1494484992000)
        return -1 / 12 + t * (1 / 180 - t * (1 / 6720 - t * (1 / 453600 - t * tail)))
    return (a - 2.0 * b) / t


@compiled
def c_slope(t: float, b: float, c: float) -> float:
    """Return c' / theta = (b - 3 c) / t; the series lacks 14 t^6 / 17! < 1e-17."""
    if t < SERIES_BELOW:
        tail = 1 / 4989600 - t * (1 / 622702080 - t / 108972864000)
        return -1 / 60 + t * (1 / 1260 - t * (1 / 60480 - t * tail))
    return (b - 3.0 * c) / t


@compiled
def k_slope(t: float, g: float) -> float:
    """Return k' / theta = (g^2 + g + h^2 - 2) / t^2 given g = h cot h; the series lacks a term below 1e-19."""
    if t < SERIES_BELOW:
        tail = 691 / 130767436800 + t * (
            1 / 6227020800 + t * (3617 / 762187345920000 + t * (43867 / 319318388573184000))
        )
        return 1 / 360 + t * (1 / 7560 + t * (1 / 201600 + t * (1 / 5987520 + t * tail)))
    return (g * g + g + 0.25 * t - 2.0) / (t * t)
