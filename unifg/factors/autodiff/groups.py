"""The groups on symbols: what their compiled functions compute, every decision as a choice between two expressions.

Where a function of the angle has 0/0 at zero, the choice is between the closed form and a power series of the *squared*
angle. It falls at half a radian, not near zero: derivatives of the closed form lose a power of the angle each, of the
series none, so that second derivatives keep their digits everywhere.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Sequence
from typing import Any, cast

import numpy as np

from unifg.factors.autodiff.symbols import UFUNCS, choose
from unifg.lie import SE2, SE3, SE23, SO2, SO3, Manifold, Rn

Numbers = Sequence[Any]
TWO_PI = 2.0 * math.pi
LEADING = float(np.float32(TWO_PI))  # so short that its multiples are exact, and the rest
TRAILING = TWO_PI - LEADING
SWITCH = 0.25  # squared angle [rad^2]
TERMS = 10
BERNOULLI = [1 / 6, 1 / 30, 1 / 42, 1 / 30, 5 / 66, 691 / 2730, 7 / 6, 3617 / 510, 43867 / 798, 174611 / 330]
"""|B_2k|, k = 1, 2, ..."""

_sqrt, _sin, _cos, _arctan2, _rint = (UFUNCS[name] for name in ("sqrt", "sin", "cos", "arctan2", "rint"))


def wrap(angle: Any) -> Any:
    """The angle in [-pi, pi), moving as the angle does; of one within a turn bit for bit what SO(2) makes of it."""
    whole = _rint(angle * (1.0 / TWO_PI))
    rest = choose(UFUNCS["less"](abs(angle), TWO_PI), angle, (angle - whole * LEADING) - whole * TRAILING)
    above, below = UFUNCS["less_equal"](math.pi, rest), UFUNCS["less"](rest, -math.pi)
    return rest - choose(above, TWO_PI, choose(below, -TWO_PI, 0.0))


def moved_closed(manifold: Manifold, point: Numbers, step: Numbers) -> list[Any] | None:
    """A point moved by a small step, exact to second order; None for a manifold that is none of those here."""
    if isinstance(manifold, Rn) or manifold == SO2:
        return [x + d for x, d in zip(point, step, strict=True)]
    if manifold == SE2:
        c, s = _cos(point[2]), _sin(point[2])
        x, y = step[0] - 0.5 * step[2] * step[1], step[1] + 0.5 * step[2] * step[0]
        return [point[0] + (c * x - s * y), point[1] + (s * x + c * y), point[2] + step[2]]
    if manifold == SO3:
        return _turned(point, step)
    if manifold == SE3:
        v, w = step[:3], step[3:]
        bent = [a + 0.5 * b for a, b in zip(v, _cross(w, v), strict=True)]
        along = _rotate(point[3:], bent)
        return [*(p + a for p, a in zip(point[:3], along, strict=True)), *_turned(point[3:], w)]
    if manifold == SE23:
        position, velocity = (
            moved_closed(SE3, point_, step_) for point_, step_ in zip(_two(point), _two(step), strict=True)
        )
        assert position is not None and velocity is not None
        return _one(position, velocity)
    return None


def _two(x: Numbers) -> tuple[list[Any], list[Any]]:
    """An element of SE_2(3), or a tangent, as two of SE(3)."""
    return [*x[:3], *x[6:]], [*x[3:6], *x[6:]]


def _one(position: Numbers, velocity: Numbers) -> list[Any]:
    """And back."""
    return [*position[:3], *velocity[:3], *position[3:]]


def _turned(q: Numbers, w: Numbers) -> list[Any]:
    square = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    return _product(q, [1.0 - 0.125 * square, 0.5 * w[0], 0.5 * w[1], 0.5 * w[2]])


# ---------------------------------------------------------------- functions of the squared angle


def _series(square: Any, coefficients: Numbers, closed: Callable[[Any], Any]) -> Any:
    """A power series near zero, the closed form beyond."""
    near = UFUNCS["less"](square, SWITCH)
    total: Any = coefficients[-1]
    for coefficient in reversed(coefficients[:-1]):
        total = total * square + coefficient
    return choose(near, total, closed(choose(near, 1.0, square)))


def sinc(square: Any) -> Any:
    """sin(t) / t of t^2."""
    return _series(
        square, [(-1.0) ** k / math.factorial(2 * k + 1) for k in range(TERMS)], lambda s: _sin(_sqrt(s)) / _sqrt(s)
    )


def cosine(square: Any) -> Any:
    """cos(t) of t^2."""
    return _series(square, [(-1.0) ** k / math.factorial(2 * k) for k in range(TERMS)], lambda s: _cos(_sqrt(s)))


def versine(square: Any) -> Any:
    """(1 - cos(t)) / t^2 of t^2."""
    return _series(
        square, [(-1.0) ** k / math.factorial(2 * k + 2) for k in range(TERMS)], lambda s: (1.0 - _cos(_sqrt(s))) / s
    )


def sine_rest(square: Any) -> Any:
    """(t - sin(t)) / t^3 of t^2."""
    return _series(
        square,
        [(-1.0) ** k / math.factorial(2 * k + 3) for k in range(TERMS)],
        lambda s: (1.0 - _sin(_sqrt(s)) / _sqrt(s)) / s,
    )


def half_cotangent(square: Any) -> Any:
    """(t / 2) cot(t / 2) of t^2: 1 - sum |B_2k| t^2k / (2k)!."""
    coefficients = [1.0, *(-b / math.factorial(2 * k) for k, b in enumerate(BERNOULLI, 1))]
    return _series(square, coefficients, lambda s: 0.5 * _sqrt(s) * _cos(0.5 * _sqrt(s)) / _sin(0.5 * _sqrt(s)))


def tangent_rest_slope(square: Any) -> Any:
    """Derivative of :func:`tangent_rest` by t^2: with g = (t / 2) cot(t / 2), g' = (g - g^2 - t^2 / 4) / (2 t^2)."""

    def closed(s: Any) -> Any:
        g = half_cotangent(s)
        return -((g - g * g - 0.25 * s) / (2.0 * s) + (1.0 - g) / s) / s

    return _series(square, [(k - 1) * b / math.factorial(2 * k) for k, b in enumerate(BERNOULLI, 1)][1:], closed)


def log_factor(w: Any, square: Any) -> Any:
    """2 atan2(n, w) / n of n^2, w the real part of a quaternion and n the norm of the others; 2 atan(n / w) / n near 0.

    With z = (n / w)^2 the series of atan(sqrt z) / sqrt z converges for z < 1 and is used below a hundredth.
    """
    ratio = square / (w * w)
    near = UFUNCS["less"](ratio, 0.01)
    total: Any = 1.0 / (2 * TERMS - 1) * (-1.0) ** (TERMS - 1)
    for k in range(TERMS - 2, -1, -1):
        total = total * ratio + (-1.0) ** k / (2 * k + 1)
    safe = choose(near, 1.0, square)
    return choose(near, 2.0 * total / w, 2.0 * _arctan2(_sqrt(safe), w) / _sqrt(safe))


# ---------------------------------------------------------------- vectors and quaternions


def _cross(a: Numbers, b: Numbers) -> list[Any]:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _dot(a: Numbers, b: Numbers) -> Any:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _product(p: Numbers, q: Numbers) -> list[Any]:
    w, x, y, z = p
    v, a, b, c = q
    return [
        w * v - x * a - y * b - z * c,
        w * a + x * v + y * c - z * b,
        w * b - x * c + y * v + z * a,
        w * c + x * b - y * a + z * v,
    ]


def _rotate(q: Numbers, p: Numbers) -> list[Any]:
    u = q[1:]
    twice = [2.0 * c for c in _cross(u, p)]
    return [a + (q[0] * b + c) for a, b, c in zip(p, twice, _cross(u, twice), strict=True)]


def _conjugate(q: Numbers) -> list[Any]:
    return [q[0], -q[1], -q[2], -q[3]]


def _upright(q: Numbers) -> list[Any]:
    """The one of a quaternion and its negative whose real part is not negative."""
    below = UFUNCS["less"](q[0], 0.0)
    return [choose(below, -a, a) for a in q]


# ---------------------------------------------------------------- the groups, one element at a time


def _so3_exp(w: Numbers) -> list[Any]:
    square = 0.25 * _dot(w, w)
    half = 0.5 * sinc(square)
    return _upright([cosine(square), half * w[0], half * w[1], half * w[2]])


def _so3_log(q: Numbers) -> list[Any]:
    q = _upright(q)
    factor = log_factor(q[0], _dot(q[1:], q[1:]))
    return [factor * a for a in q[1:]]


def _so3_matrix(q: Numbers) -> list[list[Any]]:
    columns = [_rotate(q, e) for e in ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0])]
    return [[columns[j][i] for j in range(3)] for i in range(3)]


def _se2_exp(d: Numbers) -> list[Any]:
    square = d[2] * d[2]
    a, b = sinc(square), versine(square) * d[2]
    return [a * d[0] - b * d[1], b * d[0] + a * d[1], wrap(d[2])]


def _se2_log(x: Numbers) -> list[Any]:
    angle = wrap(x[2])
    a, b = half_cotangent(angle * angle), 0.5 * angle
    return [a * x[0] + b * x[1], a * x[1] - b * x[0], angle]


def _lock(angle: Any, p: Numbers) -> list[Any]:
    c, s = _cos(angle), _sin(angle)
    return [c * p[0] - s * p[1], s * p[0] + c * p[1]]


def _se3_exp(d: Numbers) -> list[Any]:
    v, w = d[:3], d[3:]
    square = _dot(w, w)
    b, c = versine(square), sine_rest(square)
    once = _cross(w, v)
    twice = _cross(w, once)
    return [*(v[i] + b * once[i] + c * twice[i] for i in range(3)), *_so3_exp(w)]


def tangent_rest(square: Any) -> Any:
    """(1 - (t / 2) cot(t / 2)) / t^2 of t^2: what ad^2 is multiplied by in the inverse of a right Jacobian."""
    coefficients = [b / math.factorial(2 * k) for k, b in enumerate(BERNOULLI, 1)]
    return _series(square, coefficients, lambda s: (1.0 - half_cotangent(s)) / s)


def _se3_log(x: Numbers) -> list[Any]:
    p, w = x[:3], _so3_log(x[3:])
    once = _cross(w, p)
    twice = _cross(w, once)
    k = tangent_rest(_dot(w, w))
    return [*(p[i] - 0.5 * once[i] + k * twice[i] for i in range(3)), *w]


def _polynomial(a: list[list[Any]], first: Any, second: Any) -> list[list[Any]]:
    """I + first a + second a^2."""
    size = range(len(a))
    square = [[sum((a[i][j] * a[j][k] for j in size), 0.0) for k in size] for i in size]
    return [[(1.0 if i == k else 0.0) + first * a[i][k] + second * square[i][k] for k in size] for i in size]


def _turning(w: Numbers) -> list[list[Any]]:
    """The small adjoint of SO(3)."""
    return [[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]]


def _sliding(d: Numbers) -> list[list[Any]]:
    """The small adjoint of SE(2)."""
    return [[0.0, -d[2], d[1]], [d[2], 0.0, -d[0]], [0.0, 0.0, 0.0]]


def _se3_inverse_jacobian(d: Numbers) -> list[list[Any]]:
    """That of SO(3) over dual numbers: beside it stands its derivative as w moves by v."""
    v, w = d[:3], d[3:]
    square, along = _dot(w, w), _dot(w, v)
    k, slope = tangent_rest(square), 2.0 * along * tangent_rest_slope(square)
    turn, slide = _polynomial(_turning(w), 0.5, k), _turning(v)
    beside = [
        [
            0.5 * slide[i][j]
            + k * (v[i] * w[j] + w[i] * v[j])
            + slope * w[i] * w[j]
            - (2.0 * k * along + slope * square if i == j else 0.0)
            for j in range(3)
        ]
        for i in range(3)
    ]
    return [*([*turn[i], *beside[i]] for i in range(3)), *([0.0, 0.0, 0.0, *turn[i]] for i in range(3))]


def _se3_act(x: Numbers, p: Numbers) -> list[Any]:
    return [a + b for a, b in zip(x[:3], _rotate(x[3:], p), strict=True)]


def _twice(form: Callable[..., list[Any]]) -> Callable[..., list[Any]]:
    """Operations of SE_2(3) from those of SE(3)."""
    return lambda *arguments: _one(*(form(*parts) for parts in zip(*map(_two, arguments), strict=True)))


def _join_blocks(position: list[list[Any]], velocity: list[list[Any]]) -> list[list[Any]]:
    """The square matrix of two of SE(3)."""
    none = [0.0, 0.0, 0.0]
    return [
        *([*row[:3], *none, *row[3:]] for row in position[:3]),
        *([*none, *row] for row in velocity[:3]),
        *([*none, *none, *row[3:]] for row in position[3:]),
    ]


FORMS: dict[Hashable, dict[str, Callable[..., list[Any]]]] = {
    SO2: {
        "exp": lambda d: [wrap(d[0])],
        "log": lambda x: [wrap(x[0])],
        "compose": lambda x, y: [wrap(x[0] + y[0])],
        "inverse": lambda x: [wrap(-x[0])],
        "act": lambda x, p: _lock(x[0], p),
    },
    SE2: {
        "exp": _se2_exp,
        "log": _se2_log,
        "compose": lambda x, y: [*(a + b for a, b in zip(x[:2], _lock(x[2], y[:2]), strict=True)), wrap(x[2] + y[2])],
        "inverse": lambda x: [*(-a for a in _lock(-x[2], x[:2])), wrap(-x[2])],
        "between": lambda x, y: [*_lock(-x[2], [y[0] - x[0], y[1] - x[1]]), wrap(y[2] - x[2])],
        "act": lambda x, p: [a + b for a, b in zip(x[:2], _lock(x[2], p), strict=True)],
        "right_jacobian": lambda d: _polynomial(_sliding(d), -versine(d[2] * d[2]), sine_rest(d[2] * d[2])),
        "right_jacobian_inverse": lambda d: _polynomial(_sliding(d), 0.5, tangent_rest(d[2] * d[2])),
    },
    SO3: {
        "exp": _so3_exp,
        "log": _so3_log,
        "compose": lambda x, y: _upright(_product(x, y)),
        "inverse": lambda x: _upright(_conjugate(x)),
        "act": _rotate,
        "right_jacobian": lambda w: _polynomial(_turning(w), -versine(_dot(w, w)), sine_rest(_dot(w, w))),
        "right_jacobian_inverse": lambda w: _polynomial(_turning(w), 0.5, tangent_rest(_dot(w, w))),
    },
    SE3: {
        "exp": _se3_exp,
        "log": _se3_log,
        "compose": lambda x, y: [*_se3_act(x, y[:3]), *_upright(_product(x[3:], y[3:]))],
        "inverse": lambda x: [*(-a for a in _rotate(_conjugate(x[3:]), x[:3])), *_upright(_conjugate(x[3:]))],
        "between": lambda x, y: [
            *_rotate(_conjugate(x[3:]), [b - a for a, b in zip(x[:3], y[:3], strict=True)]),
            *_upright(_product(_conjugate(x[3:]), y[3:])),
        ],
        "act": _se3_act,
        "right_jacobian_inverse": _se3_inverse_jacobian,
    },
}
FORMS[SE23] = {name: _twice(FORMS[SE3][name]) for name in ("exp", "log", "compose", "inverse", "between")} | {
    "act": lambda x, p: _se3_act(_two(x)[0], p),
    "right_jacobian_inverse": lambda d: _join_blocks(*(_se3_inverse_jacobian(part) for part in _two(d))),
}
"""Group, operation -> what it computes of single elements."""
_VECTORS: dict[str, Callable[..., list[Any]]] = {
    "exp": list,
    "log": list,
    "compose": lambda x, y: [a + b for a, b in zip(x, y, strict=True)],
    "inverse": lambda x: [-a for a in x],
    "between": lambda x, y: [b - a for a, b in zip(x, y, strict=True)],
    "act": lambda x, p: [a + b for a, b in zip(x, p, strict=True)],
}
MATRICES: dict[Hashable, Callable[[Numbers], list[list[Any]]]] = {
    SO3: _so3_matrix,
    SO2: lambda x: [[_cos(x[0]), -_sin(x[0])], [_sin(x[0]), _cos(x[0])]],
    SE2: lambda x: [[_cos(x[2]), -_sin(x[2]), x[0]], [_sin(x[2]), _cos(x[2]), x[1]], [0.0, 0.0, 1.0]],
    SE3: lambda x: [
        *([*row, p] for row, p in zip(_so3_matrix(x[3:]), x[:3], strict=True)),
        [0.0, 0.0, 0.0, 1.0],
    ],
    SE23: lambda x: [
        *([*row, v, p] for row, v, p in zip(_so3_matrix(x[6:]), x[3:6], x[:3], strict=True)),
        [0.0, 0.0, 0.0, 1.0, 0.0],
        [0.0, 0.0, 0.0, 0.0, 1.0],
    ],
}

GROUPS = (SO2, SE2, SO3, SE3, SE23)
KINDS = {type(group) for group in GROUPS}


def closed_form(manifold: Manifold, name: str) -> Callable[..., Any] | None:
    """Closed-form operations of a manifold on single elements, where there are some."""
    if isinstance(manifold, Rn):
        forms = _VECTORS
    elif type(manifold) in KINDS:
        forms = FORMS[cast(Hashable, manifold)]
        if name == "matrix":
            return MATRICES[cast(Hashable, manifold)]
    else:
        return None
    compose, inverse, between = forms["compose"], forms["inverse"], forms.get("between")
    if name == "retract":
        return lambda x, d: compose(x, forms["exp"](d))
    if name == "between":
        return between or (lambda x, y: compose(inverse(x), y))
    if name == "local":
        return lambda x, y: forms["log"](between(x, y) if between else compose(inverse(x), y))
    return forms.get(name)
