"""Tracing on manifolds of one's own, and of functions that decide: against closed forms that are known."""

import math
from functools import cache
from typing import Any

import numpy as np
import pytest

import unifg as fg
from own_manifolds import OWN, S2, XYZW, SphereManifold, along, sphere_retract
from own_manifolds import SE23 as EXTENDED
from test_derive import compared, curved, evaluated, packed, points
from unifg.codegen.native import Native
from unifg.factors.autodiff.rows import traced
from unifg.factors.autodiff.symbols import TraceError
from unifg.factors.kernel import Argument, evaluate_rows
from unifg.lie import SE2, SE3, SE23, SO2, SO3, Rn
from unifg.typing import Array, ArrayLike

# ---------------------------------------------------------------- groups of one's own


class Complex(fg.LieGroup):
    """Unit complex numbers, by NumPy."""

    name, storage, dim = "Complex", 2, 1

    def identity(self) -> Array:
        return np.array([1.0, 0.0])

    def random(self, rng: np.random.Generator, /, shape: tuple[int, ...] = ()) -> Array:
        return self.exp(rng.uniform(-np.pi, np.pi, (*shape, 1)))

    def exp(self, d: ArrayLike, /) -> Array:
        d = np.asarray(d, dtype=np.float64)
        return np.concatenate([np.cos(d), np.sin(d)], axis=-1)

    def log(self, x: ArrayLike, /) -> Any:
        x = np.asarray(x, dtype=np.float64)
        return np.arctan2(x[..., 1:], x[..., :1])

    def compose(self, x: ArrayLike, y: ArrayLike, /) -> Any:
        x, y = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
        real = x[..., 0] * y[..., 0] - x[..., 1] * y[..., 1]
        return np.stack([real, x[..., 0] * y[..., 1] + x[..., 1] * y[..., 0]], axis=-1)

    def inverse(self, x: ArrayLike, /) -> Any:
        return np.asarray(x) * np.array([1.0, -1.0])


COMPLEX = Complex()
TWINS: dict[str, tuple[Any, Any, Any]] = {  # of the user's, of the library, and from there to here
    "compiled with branches": (XYZW, SO3, lambda x: np.roll(x, -1, axis=-1)),
    "by NumPy": (COMPLEX, SO2, lambda x: np.concatenate([np.cos(x), np.sin(x)], axis=-1)),
    "compiled, by parts": (EXTENDED, SE23, lambda x: x),
    "product": (
        fg.Product(a=XYZW, v=Rn(2), b=COMPLEX),
        fg.Product(a=SO3, v=Rn(2), b=SO2),
        lambda x: np.concatenate(
            [np.roll(x[..., :4], -1, axis=-1), x[..., 4:6], np.cos(x[..., 6:]), np.sin(x[..., 6:])], axis=-1
        ),
    ),
}


@pytest.mark.parametrize("name", TWINS)
@pytest.mark.product(2)
def test_a_group_of_ones_own_has_the_derivatives_of_its_twin(name: str) -> None:
    """Same group, other numbers: residuals, Jacobians and Hessians in tangent coordinates are the same."""
    mine, known, carried = TWINS[name]
    rng = np.random.default_rng(3)
    x = known.random(rng, (6,))
    # The closed forms above lose digits near zero, each derivative more of them: keep away from it.
    y = known.retract(x, rng.uniform(0.6, 0.9, (6, known.dim)) * rng.choice([-1.0, 1.0], (6, known.dim)))
    w = rng.normal(size=(6, known.dim))
    answers = []
    for group, values in ((mine, (carried(x), carried(y))), (known, (x, y))):
        expression = traced(lambda x, y, group=group: group.local(x, y), (group, group), name=name)
        variables, parameters = packed((group, group), values)
        r, J = evaluated(expression, variables, parameters)
        np.testing.assert_allclose(r, group.local(*values), rtol=0, atol=1e-13)
        answers.append((r, J, curved(expression, variables, parameters, w)))
    for found, expected in zip(*answers, strict=True):
        compared(found, expected)


# ---------------------------------------------------------------- a manifold that is no group


@fg.compiled
def short_retract(x: Array, d: Array, out: Array) -> None:
    sphere_retract(x, d, out)
    if math.hypot(d[0], d[1]) < 1e-7:
        basis = np.empty((2, 3))
        along(x, basis)
        for i in range(3):
            out[i] = x[i] + d[0] * basis[0, i] + d[1] * basis[1, i]


class Careless(SphereManifold):
    name = "Careless"
    retract = fg.elementwise(short_retract)


def test_a_manifold_is_moved_along_its_retraction() -> None:
    """On the unit sphere w'x bends by -w'x in every direction: points move along great circles."""
    x = S2.random(np.random.default_rng(0), (12,))
    w = np.random.default_rng(1).normal(size=(12, 3))
    expression = traced(lambda x: x, (S2,))
    r, J = evaluated(expression, x, np.zeros((1, 0)))
    np.testing.assert_allclose(r, x, rtol=0, atol=1e-15)
    np.testing.assert_allclose(np.swapaxes(J, 1, 2) @ J, np.broadcast_to(np.eye(2), (12, 2, 2)), rtol=0, atol=1e-14)
    np.testing.assert_allclose(np.einsum("ni,nij->nj", x, J), 0.0, rtol=0, atol=1e-14)
    S = curved(expression, x, np.zeros((1, 0)), w)
    np.testing.assert_allclose(S, -np.sum(w * x, axis=1)[:, None, None] * np.eye(2), rtol=0, atol=1e-14)


def test_a_retraction_too_short_for_second_derivatives_is_refused() -> None:
    with pytest.raises(TraceError, match=r"Careless, whose retraction .* terms up to the second"):
        traced(lambda x: x, (Careless(),))


@pytest.mark.parametrize("manifold", OWN, ids=lambda manifold: manifold.name)
@pytest.mark.product(1, of="own manifolds")
def test_manifolds_that_know_nothing_of_tracing(manifold: fg.Manifold) -> None:
    """Retraction and local coordinates agree with fourth-order differences along the manifold's own retraction."""
    rng = np.random.default_rng(6)
    x = manifold.random(rng, (3,))
    y = manifold.retract(x, 0.3 * rng.normal(size=(3, manifold.dim)))
    expression = traced(lambda x, y: manifold.local(x, y), (manifold, manifold))
    variables, parameters = packed((manifold, manifold), (x, y))
    r, J = evaluated(expression, variables, parameters)
    np.testing.assert_allclose(r, manifold.local(x, y), rtol=0, atol=1e-12)
    w, h, d = rng.normal(size=r.shape), 1e-3, rng.normal(size=(3, 2 * manifold.dim))
    S = curved(expression, variables, parameters, w)

    def along(t: float) -> Any:
        moved = manifold.retract(x, t * d[:, : manifold.dim]), manifold.retract(y, t * d[:, manifold.dim :])
        return manifold.local(*moved)

    slope = (8.0 * (along(h) - along(-h)) - (along(2 * h) - along(-2 * h))) / (12.0 * h)
    np.testing.assert_allclose(np.einsum("nij,nj->ni", J, d), slope, rtol=0, atol=1e-8)
    bend = (16.0 * (along(h) + along(-h)) - (along(2 * h) + along(-2 * h)) - 30.0 * along(0.0)) / (12.0 * h * h)
    found = np.einsum("nij,ni,nj->n", S, d, d)
    np.testing.assert_allclose(found, np.sum(w * bend, axis=1), rtol=0, atol=1e-5 * (1 + np.abs(found).max()))


# ---------------------------------------------------------------- functions that decide


@fg.compiled
def branching(x: Array, y: Array, r: Array) -> None:
    total = 0.0
    for k in range(3):
        if x[k] > y[k]:
            total += x[k] * x[k] * y[k]
        elif x[k] > 0.0:
            total -= math.sin(x[k])
        else:
            total += y[k]
    r[0] = total
    r[1] = total * total if total > 0.5 else total


def test_a_compiled_function_may_decide_on_values() -> None:
    arguments: tuple[Argument, ...] = (Rn(3), Rn(3))
    x, y = points(arguments, 200)
    expression = traced(branching, arguments, rows=2)
    variables, parameters = packed(arguments, (x, y))
    r, J = evaluated(expression, variables, parameters)
    expected = np.empty((200, 2))
    for k in range(200):
        branching(x[k], y[k], expected[k])
    np.testing.assert_allclose(r, expected, rtol=1e-15, atol=1e-15)
    smooth = traced(  # the same as a formula
        lambda x, y: np.stack([(t := np.sum(np.where(x > y, x * x * y, np.where(x > 0, -np.sin(x), y)), axis=1)),
                               np.where(t > 0.5, t * t, t)], axis=1), arguments,
    )  # fmt: skip
    compared(J, evaluated(smooth, variables, parameters)[1])
    w = np.random.default_rng(0).normal(size=(200, 2))
    compared(curved(expression, variables, parameters, w), curved(smooth, variables, parameters, w))


@fg.compiled
def endless(x: Array, r: Array) -> None:
    value = x[0]
    while value > 1e-3:
        value *= 0.5
    r[0] = value


@fg.compiled
def forked(x: Array, r: Array) -> None:
    r[0] = 0.0
    for k in range(12):
        if x[0] > k:
            r[0] += x[0] * k


@pytest.mark.parametrize(("function", "words"), [(endless, "without end"), (forked, "more than 64 ways")])
def test_what_decides_too_often_is_said(function: Any, words: str) -> None:
    with pytest.raises(TraceError, match=rf"test_derive_manifolds\.py:\d+: decides .*{words}"):
        traced(function, (Rn(1),), rows=1)


# ---------------------------------------------------------------- near turns of zero, half pi and pi, and far away


def in_digits(kind: str) -> tuple[Any, Any]:
    """Exponential and logarithm of x^-1 y of SE(2) or SE(3) in sixty digits, from lists to lists."""
    mp = pytest.importorskip("mpmath")
    mp.mp.dps = 60

    def sines(t: Any) -> tuple[Any, Any, Any]:
        if t == 0:
            return mp.mpf(1), mp.mpf(1) / 2, mp.mpf(1) / 6
        return mp.sin(t) / t, (1 - mp.cos(t)) / t**2, (t - mp.sin(t)) / t**3

    def cross(a: Any, b: Any) -> Any:
        return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]

    def rotated(q: Any, p: Any) -> Any:
        twice = [2 * c for c in cross(q[1:], p)]
        return [a + q[0] * b + c for a, b, c in zip(p, twice, cross(q[1:], twice), strict=True)]

    def product(p: Any, q: Any) -> Any:
        inner = p[0] * q[0] - sum(a * b for a, b in zip(p[1:], q[1:], strict=True))
        return [inner, *(p[0] * b + q[0] * a + c for a, b, c in zip(p[1:], q[1:], cross(p[1:], q[1:]), strict=True))]

    def planar_retract(x: Any, d: Any) -> Any:
        a, b, _ = sines(d[2])
        u, v = a * d[0] - b * d[2] * d[1], b * d[2] * d[0] + a * d[1]
        c, s = mp.cos(x[2]), mp.sin(x[2])
        return [x[0] + c * u - s * v, x[1] + s * u + c * v, x[2] + d[2]]

    def planar_local(x: Any, y: Any) -> Any:
        t, c, s = y[2] - x[2], mp.cos(x[2]), mp.sin(x[2])
        t -= 2 * mp.pi * mp.nint(t / (2 * mp.pi))
        px, py = y[0] - x[0], y[1] - x[1]
        u, v = c * px + s * py, c * py - s * px
        k = t / 2 * mp.cot(t / 2) if t else mp.mpf(1)
        return [k * u + t / 2 * v, k * v - t / 2 * u, t]

    def spatial_retract(x: Any, d: Any) -> Any:
        t = mp.sqrt(sum(a * a for a in d[3:]))
        _, b, c = sines(t)
        half, _, _ = sines(t / 2)
        once = cross(d[3:], d[:3])
        step = [v + b * e + c * f for v, e, f in zip(d[:3], once, cross(d[3:], once), strict=True)]
        moved = [a + e for a, e in zip(x[:3], rotated(x[3:], step), strict=True)]
        return [*moved, *product(x[3:], [mp.cos(t / 2), *(half * a / 2 for a in d[3:])])]

    def spatial_local(x: Any, y: Any) -> Any:
        back = [x[3], -x[4], -x[5], -x[6]]
        p, q = rotated(back, [b - a for a, b in zip(x[:3], y[:3], strict=True)]), product(back, y[3:])
        q = [-a for a in q] if q[0] < 0 else q
        n = mp.sqrt(sum(a * a for a in q[1:]))
        w = [2 * (mp.atan2(n, q[0]) / n if n else 1 / q[0]) * a for a in q[1:]]
        t = mp.sqrt(sum(a * a for a in w))
        k = (1 - t / 2 * mp.cot(t / 2)) / t**2 if t else mp.mpf(1) / 12
        once = cross(w, p)
        return [*(a - b / 2 + k * c for a, b, c in zip(p, once, cross(w, once), strict=True)), *w]

    return (planar_retract, planar_local) if kind == "SE2" else (spatial_retract, spatial_local)


@cache
def local_code(group: Any) -> tuple[Native, Native]:
    expression = traced(lambda x, y: group.local(x, y), (group, group))
    return expression.residual(), expression.second()


@pytest.mark.parametrize("far", [0.0, 1e6])
@pytest.mark.parametrize(
    "turn", [0.0, 1e-12, 1e-8, 1e-5, 1e-3, 0.05, 0.3, 0.4999, 0.5001, np.pi / 2, np.pi - 1e-2, np.pi - 1e-5]
)
@pytest.mark.parametrize("group", [SE2, SE3], ids=["SE2", "SE3"])
def test_derivatives_keep_their_digits(group: Any, turn: float, far: float) -> None:
    """First and second derivatives of Log(x^-1 y) against differences in sixty digits along one direction."""
    mp = pytest.importorskip("mpmath")
    retract, local = in_digits(group.name)
    rng = np.random.default_rng(2)
    x = group.random(rng)
    d = rng.normal(size=group.dim)
    axis = d[group.dim // 2 :] if group.dim == 6 else d[2:]
    axis *= turn / np.linalg.norm(axis)
    x[: 2 if group.dim == 3 else 3] += far
    y = group.retract(x, d)
    if group.dim == 6:  # of unit length in sixty digits too, or the oracle leaves the group
        x[3:] /= np.linalg.norm(x[3:])
    w, along = rng.normal(size=group.dim), rng.normal(size=2 * group.dim)
    variables, nothing = np.concatenate([x, y])[None], np.zeros((1, 0))
    r, J, S = np.empty((1, group.dim)), np.empty((1, group.dim, 2 * group.dim)), np.empty((1, *[2 * group.dim] * 2))
    first, second = local_code(group)
    evaluate_rows(first.address, variables, nothing, nothing[0], r, J)
    evaluate_rows(second.address, variables, nothing, nothing[0], w[None], S)

    h = mp.mpf(10) ** -18
    exact = [[mp.mpf(float(a)) for a in part] for part in (x, y)]
    steps = [[mp.mpf(float(a)) for a in part] for part in np.split(along, 2)]

    def at(t: Any) -> Any:
        moved = [retract(p, [t * a for a in step]) for p, step in zip(exact, steps, strict=True)]
        return sum(mp.mpf(float(a)) * b for a, b in zip(w, local(*moved), strict=True))

    middle, ahead, behind = at(mp.mpf(0)), at(h), at(-h)
    size = 1.0 + float(np.abs(S).max())
    assert abs(w @ r[0] - float(middle)) < 1e-12 * (1.0 + abs(float(middle)))
    assert abs(w @ J[0] @ along - float((ahead - behind) / (2 * h))) < 1e-12 * size
    assert abs(along @ S[0] @ along - float((ahead - 2 * middle + behind) / (h * h))) < 1e-11 * size
