"""Manifolds of one's own: their axioms, their mutants, and problems in which they are solved like shipped ones."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.random import Generator
from scipy.linalg import expm
from scipy.optimize import least_squares

import own_manifolds as own
import unifg as fg
from groups import integrated
from own_manifolds import GROUPS, OWN, S2, SE23, STRAIGHT, XYZW
from problems.graphs import graph_with
from unifg.codegen.jit import compiled
from unifg.lie import se2
from unifg.lie.functions import functions_of
from unifg.problem.compiled_problem import CompiledProblem
from unifg.solvers import (
    KKT,
    SQP,
    AugmentedLagrangian,
    GaussNewton,
    InteriorPoint,
    LevenbergMarquardt,
)
from unifg.typing import Array, ArrayLike

SHIPPED: list[fg.Manifold] = [fg.SO2, fg.SE2, fg.SO3, fg.SE3, fg.Rn(3), fg.Product(a=fg.SE3, b=fg.Product(c=fg.SO2))]

# ---------------------------------------------------------------- axioms


@pytest.mark.parametrize("manifold", SHIPPED + OWN, ids=lambda m: m.name)
@pytest.mark.product(1)
def test_axioms_hold(manifold: fg.Manifold) -> None:
    report = fg.check_manifold(manifold)
    assert report.ok, str(report)
    assert str(report) == f"{manifold.name}: {len(report.tried)} axioms hold"
    report.require()


@pytest.mark.parametrize("group", GROUPS[:3], ids=lambda g: g.name)
@pytest.mark.product(1, of="own manifolds")
def test_what_follows_is_exact(group: fg.LieGroup, rng: Generator) -> None:
    """Everything but four functions is derived; against exponentials of matrices, to rounding."""
    x, d = group.random(rng, (20,)), 0.9 * rng.standard_normal((20, group.dim))
    matrix = group.matrix(x)
    moved = matrix @ group.hat(d) @ np.linalg.inv(matrix)
    along = group.hat((group.adjoint(x) @ d[..., None])[..., 0])
    np.testing.assert_allclose(moved, along, atol=1e-13 * np.abs(moved).max())
    small = group.ad(d)
    np.testing.assert_allclose(expm(small), group.adjoint(group.exp(d)), atol=1e-13 * np.abs(small).max() ** 3)
    for sign, found in ((-1.0, group.right_jacobian(d)), (1.0, group.left_jacobian(d))):
        np.testing.assert_allclose(found, integrated(sign * small), atol=1e-13 * np.abs(found).max())


# ---------------------------------------------------------------- mutants


def backwards(d: Array, out: Array) -> None:
    """Exponential with the wrong sign of one coordinate."""
    own.last_exp(np.array([d[0], -d[1], d[2]]), out)


def long_sphere(x: Array, d: Array, out: Array) -> None:
    """A retraction that forgets to keep the length."""
    basis = np.empty((2, 3))
    own.along(x, basis)
    for i in range(3):
        out[i] = x[i] + d[0] * basis[0, i] + d[1] * basis[1, i]


def without_series(d: Array, out: Array) -> None:
    """An exponential that divides by an angle of zero."""
    half = 0.5 * math.sqrt(d[0] ** 2 + d[1] ** 2 + d[2] ** 2)
    s = 0.5 * math.sin(half) / half
    out[0], out[1], out[2], out[3] = s * d[0], s * d[1], s * d[2], math.cos(half)


def on_the_left(x: Array, d: Array, out: Array) -> None:
    """A retraction that moves in the world's axes."""
    step = np.empty(3)
    se2.exp(d, step)
    se2.compose(step, x, out)


def swapped(x: Array, y: Array, out: Array) -> None:
    """The product in the other order."""
    se2.compose(y, x, out)


def transposed(x: Array, out: Array) -> None:
    """The adjoint, transposed."""
    ahead = np.empty((3, 3))
    se2.adjoint(x, ahead)
    out[:] = ahead.T


def of_the_other_side(d: Array, out: Array) -> None:
    """The left Jacobian for the right one."""
    se2.right_jacobian(-d, out)


def of_the_other_sign(x: Array, out: Array) -> None:
    """An inverse that forgets to turn the position."""
    out[0], out[1], out[2] = -x[0], -x[1], -x[2]


def in_haste(x: Array, y: Array, out: Array) -> None:
    """A product that reads its argument again after it has written over it."""
    out[2] = x[2] + y[2]
    c, s = math.cos(out[2] - y[2]), math.sin(out[2] - y[2])
    out[0] = x[0] + c * y[0] - s * y[1]
    out[1] = x[1] + s * y[0] + c * y[1]


MUTANTS: list[tuple[fg.Manifold, str, Callable[..., None], str]] = [
    (XYZW, "exp", backwards, "Log(Exp(d)) = d"),
    (XYZW, "exp", without_series, "Exp(0) = e"),
    (S2, "retract", long_sphere, "x [+] d is a valid point"),
    (fg.SE2, "retract", on_the_left, "x [+] d = x Exp(d) to first order"),
    (fg.SE2, "compose", swapped, "between(x, y) = x^-1 y"),
    (fg.SE2, "adjoint", transposed, "x Exp(d) x^-1 = Exp(Ad(x) d)"),
    (fg.SE2, "right_jacobian", of_the_other_side, "Exp(d + s) = Exp(d) Exp(Jr(d) s) to first order"),
    (fg.SE2, "right_jacobian_inverse", of_the_other_side, "Jr^-1(d) Jr(d) = I"),
    (fg.SE2, "inverse", of_the_other_sign, "x x^-1 = e"),
    (fg.SE2, "compose", in_haste, "the compiled compose may write over argument 1"),
]


@pytest.mark.parametrize(("good", "name", "wrong", "axiom"), MUTANTS, ids=[f"{m[1]} {m[2].__name__}" for m in MUTANTS])
@pytest.mark.product(1)
def test_mutants_are_named(good: fg.Manifold, name: str, wrong: Callable[..., None], axiom: str) -> None:
    mutant: Any = type("Mutant", (type(good),), {name: fg.elementwise(compiled(wrong)), "name": "mutant"})()
    report = fg.check_manifold(mutant)
    assert axiom in [breach.axiom for breach in report.breaches], str(report)
    with pytest.raises(fg.UnifgError, match="axioms do not hold"):
        report.require()
    breach = next(breach for breach in report.breaches if breach.axiom == axiom)
    assert not breach.error <= breach.allowed
    assert all(name in str(breach) for name in breach.where)


def test_methods_that_raise_or_have_the_wrong_shape_are_reported() -> None:
    class Raising(own.SphereManifold):
        def local(self, x: ArrayLike, y: ArrayLike, /) -> Array:
            raise ValueError("not today")

    class Short(own.SphereManifold):
        def local(self, x: ArrayLike, y: ArrayLike, /) -> Array:
            return S2.local(x, y)[..., :1]

    class Nowhere(own.SphereManifold):
        def random(self, rng: Generator, /, shape: tuple[int, ...] = ()) -> Array:
            raise RuntimeError("lost")

    assert "local(x, x) = 0: raises ValueError: not today" in str(fg.check_manifold(Raising()))
    assert "has shape (32, 1), expected (32, 2)" in str(fg.check_manifold(Short()))
    assert "raises RuntimeError: lost" in str(fg.check_manifold(Nowhere()))


def test_a_reach_that_is_too_long_is_told() -> None:
    assert "local(x, x [+] d) = d" in str(fg.check_manifold(fg.SO3, reach=4.0))


# ---------------------------------------------------------------- statements


def test_what_is_no_function_of_one_element_is_refused() -> None:
    with pytest.raises(fg.UnifgError, match="elementwise takes a function compiled by Numba's njit, found"):
        fg.elementwise(lambda x, out: None)
    with pytest.raises((fg.UnifgError, RuntimeError)) as caught:
        type("Odd", (own.SphereManifold,), {"identity": fg.elementwise(own.last_exp)})
    told = f"{caught.value} {caught.value.__cause__}"
    assert "Odd.identity cannot be stated for one element; these can: exp, log" in told
    with pytest.raises(TypeError, match="abstract method"):
        type("Half", (fg.LieGroup,), {"name": "half", "storage": 4, "dim": 3, "exp": fg.elementwise(own.last_exp)})()
    with pytest.raises(fg.UnifgError, match="moves no points"):
        XYZW.act(np.zeros(4), np.zeros(3))


@pytest.mark.product(1, of="own manifolds")
def test_a_subclass_inherits_and_replaces() -> None:
    functions, straight = functions_of(fg.SE2), functions_of(STRAIGHT)
    assert functions is not None and straight is not None
    assert straight.retract is own.straight_retract and straight.exp is functions.exp
    assert functions.log_between is functions.local and straight.log_between is not straight.local

    class Slow(type(fg.SE2)):  # type: ignore[misc]
        def exp(self, d: ArrayLike, /) -> Array:
            return 1.0 * fg.SE2.exp(d)

    slow = functions_of(Slow())
    assert slow is not None and not hasattr(slow, "exp") and slow.log is functions.log

    class Derived(own.ExtendedPoses):
        def compose(self, x: ArrayLike, y: ArrayLike, /) -> Array:
            return SE23.compose(x, y)

    with pytest.raises(fg.UnifgError, match="has no adjoint: state it, or exp, log, compose and inverse by compiled"):
        Derived().adjoint(SE23.identity())  # it followed from the product, which is NumPy's now
    np.testing.assert_array_equal(Derived().retract(SE23.identity(), np.zeros(9)), SE23.identity())


# ---------------------------------------------------------------- problems

SIGMA, SMOOTH, COUNT = 0.1, 2.0, 5


class Chain:
    """Points seen with noise, each near the one before; the answer from charts and SciPy."""

    def __init__(self, manifold: fg.Manifold) -> None:
        rng = np.random.default_rng(4)
        start = manifold.random(rng)
        steps = 0.3 * rng.standard_normal((COUNT, manifold.dim))
        self.manifold, self.seen = manifold, manifold.retract(start, steps)
        self.graph = fg.Graph()
        self.x = self.graph.variables("x", manifold, COUNT)
        self.graph.minimize(fg.prior, self.x, self.seen, sigma=SIGMA)
        self.graph.minimize(fg.difference, self.x[:-1], self.x[1:], sigma=SMOOTH)

    def apart(self, x: Array, y: Array) -> Array:
        """Value of ``prior`` and ``difference``, on a group whatever its steps."""
        leaves = fg.Product(m=self.manifold).components["m"].manifold
        if isinstance(leaves, fg.Product):
            parts = [
                Chain.apart_of(c.manifold, x[..., c.storage], y[..., c.storage]) for c in leaves.components.values()
            ]
            return np.concatenate(parts, axis=-1)
        return Chain.apart_of(self.manifold, x, y)

    @staticmethod
    def apart_of(m: fg.Manifold, x: Array, y: Array) -> Array:
        if isinstance(m, fg.LieGroup):
            return m.log(m.compose(m.inverse(x), y))
        return m.local(x, y)

    def answer(self) -> Array:
        """Levenberg-Marquardt of SciPy in the steps from what was seen."""

        def residuals(steps: Array) -> Array:
            x = self.manifold.retract(self.seen, steps.reshape(COUNT, -1))
            known, near = self.apart(self.seen, x), self.apart(x[:-1], x[1:])
            return np.concatenate([known.ravel() / SIGMA, near.ravel() / SMOOTH])

        found = least_squares(residuals, np.zeros(COUNT * self.manifold.dim), method="lm", xtol=1e-14, ftol=1e-14)
        return self.manifold.retract(self.seen, found.x.reshape(COUNT, -1))

    def assert_same(self, found: Array, answer: Array, tolerance: float) -> None:
        np.testing.assert_allclose(self.manifold.local(answer, found), 0.0, atol=tolerance)


@pytest.mark.parametrize("manifold", OWN, ids=lambda m: m.name)
@pytest.mark.product(1, of="own manifolds")
def test_all_backends_find_the_answer_of_charts(manifold: fg.Manifold) -> None:
    chain = Chain(manifold)
    answer = chain.answer()
    program = CompiledProblem(chain.graph)
    assert program.fully_compiled and program.retraction.compiled  # nothing is left to Python
    for solver in (
        GaussNewton(),
        LevenbergMarquardt(),
        SQP(hessian="exact"),
        InteriorPoint(),
        AugmentedLagrangian(),
        KKT(),
    ):
        solution = solver.solve(chain.graph, {chain.x: chain.seen}, check=True)
        chain.assert_same(solution[chain.x], answer, 2e-6)


@pytest.mark.parametrize("manifold", OWN, ids=lambda m: m.name)
@pytest.mark.product(1, of="own manifolds")
def test_smoothers_find_the_answer_of_charts(manifold: fg.Manifold) -> None:
    chain = Chain(manifold)
    smoother, lag = fg.Incremental(relinearize=0.0, wildfire=0.0), fg.FixedLag(COUNT)
    for each in (smoother, lag):
        y = each.variables("x", manifold)
        for k in range(COUNT):
            each.minimize(fg.prior, y[k], chain.seen[k], sigma=SIGMA)
            if k:
                each.minimize(fg.difference, y[k - 1], y[k], sigma=SMOOTH)
            each.update({y: chain.seen[k]}, iterations=8)
        chain.assert_same(each.estimate(y), chain.answer(), 1e-6 if each is smoother else 1e-2)


@compiled
def beam(x: Array, seen: Array, r: Array) -> None:
    """Cross product with a measured direction."""
    r[0], r[1], r[2] = x[1] * seen[2] - x[2] * seen[1], x[2] * seen[0] - x[0] * seen[2], x[0] * seen[1] - x[1] * seen[0]


def test_compiled_residuals_are_differenced_along_own_steps() -> None:
    """Mean direction, limited to a cap: Jacobians and exact Hessians of a compiled residual on the sphere."""
    rng = np.random.default_rng(1)
    seen = S2.retract(np.array([0.6, 0.0, 0.8]), 0.2 * rng.standard_normal((12, 2)))
    residual = fg.residual(beam, rows=3)  # type: ignore[arg-type]
    graph, u = graph_with(S2, 1, "u")
    graph.minimize(residual, u[np.zeros(12, dtype=int)], seen, sigma=0.1)
    scatter = seen.T @ seen  # the sum of squared sines is N - u' S u
    mean = np.linalg.eigh(scatter)[1][:, -1]
    for solver in (GaussNewton(), SQP(hessian="exact"), InteriorPoint(), AugmentedLagrangian()):
        solution = solver.solve(graph, {u: np.array([[0.0, 0.0, 1.0]])}, check=True)
        np.testing.assert_allclose(solution[u][0], mean * np.sign(mean[2]), atol=1e-6)
    graph.constrain(lambda u: u[:, :1], u, upper=0.3, name="cap")
    for solver in (SQP(), SQP(hessian="exact"), InteriorPoint(), AugmentedLagrangian()):
        solution = solver.solve(graph, {u: np.array([[0.0, 0.0, 1.0]])}, check=True)
        found = solution[u][0]
        assert found[0] == pytest.approx(0.3, abs=1e-6)
        angle = math.atan2(found[1], found[2])
        cap = least_squares(
            lambda a: np.cross([0.3, math.sqrt(0.91) * math.sin(a[0]), math.sqrt(0.91) * math.cos(a[0])], seen).ravel(),
            [angle], xtol=1e-14, ftol=1e-14,
        )  # fmt: skip
        assert angle == pytest.approx(cap.x[0], abs=1e-5)
