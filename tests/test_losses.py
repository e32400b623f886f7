"""Robust losses inside the compiled passes: formulas, derivatives and answers beside statements of their own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize

import unifg as fg
from problems.control import Unicycle
from problems.graphs import graph_of, graph_with, program_of
from unifg.factors.robust import Formula, Loss, bend_of, form_of
from unifg.modeling.terms import Cost
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.hessian import lagrangian_hessian
from unifg.solvers import InteriorPoint
from unifg.solvers.names import CONSTRAINED, LEAST_SQUARES, backend
from unifg.typing import Array

K = 1.3


def surrogate(mu: float) -> Callable[[complex], complex]:
    """Truncated least squares on the way to it, as the paper states them."""
    least, most = K**2 * mu / (mu + 1), K**2 * (mu + 1) / mu
    return lambda s: (
        s if s.real <= least else K**2 + 0 * s if s.real >= most
        else 2 * K * (s * mu * (mu + 1)) ** 0.5 - mu * (K**2 + s)
    )  # fmt: skip


# rho(s) as the papers state them, of a complex number whose imaginary part is infinitesimal.
PUBLISHED: dict[Loss, Callable[[complex], complex]] = {
    fg.Huber(K): lambda s: s if s.real <= K**2 else 2.0 * K * s**0.5 - K**2,
    fg.Cauchy(K): lambda s: K**2 * np.log1p(s / K**2),
    fg.Tukey(2.0 * K): lambda s: (4 * K**2) / 3 * (1 - (1 - s / (4 * K**2)) ** 3 if s.real < 4 * K**2 else 1),
    fg.DCS(K): lambda s: s if s.real <= K else 4 * K * s / (K + s) - K,
    fg.GemanMcClure(K, mu=2.0): lambda s: 2 * K**2 * s / (2 * K**2 + s),
    fg.TruncatedLeastSquares(K): lambda s: s if s.real <= K**2 else K**2 + 0 * s,
    fg.TruncatedLeastSquares(K, 0.5): surrogate(0.5),
}
SURROGATES: dict[Loss, Callable[[complex], complex]] = {
    fg.TruncatedLeastSquares(K, mu): surrogate(mu) for mu in (1e-5, 1.0, 50.0)
}
LOSSES = list(PUBLISHED)
HALF = fg.Reweighted(lambda s: np.where(s < 4.0, 1.0, 0.5))


class Welsch:
    """A user's own loss, in Python: rho(s) = k^2 (1 - exp(-s / k^2))."""

    held = False

    def value(self, squared: Array) -> Array:
        """rho(s)."""
        return K**2 * (1.0 - np.exp(-squared / K**2))

    def weight(self, squared: Array) -> Array:
        """rho'(s)."""
        return np.exp(-squared / K**2)


def slope(rho: Callable[[complex], complex], s: float) -> float:
    """rho'(s), exact to rounding."""
    return rho(complex(s, 1e-30)).imag / 1e-30


def objective(program: CompiledProblem, values: dict[fg.Family, Array], loss: Loss, active: Array) -> float:
    """Cost of the terms called "robust" by the published loss, of all others by squares, from the functions alone."""
    total, rho = 0.0, PUBLISHED.get(loss)
    for term in program.cost_terms:
        r = term.residual(program.values_from(values))
        assert isinstance(term.term, Cost)
        W = np.eye(term.size)
        if term.term.information is not None:
            W = np.linalg.cholesky(np.asarray(term.term.information, dtype=float)).T
        if term.term.sigma is not None:
            W = W / np.asarray(term.term.sigma)
        squared = ((r @ W.T) ** 2).sum(axis=1)
        if term.term.robust is not None:
            own = [rho(complex(s)).real for s in squared] if rho else loss.value(squared)
            squared = np.where(active, own, 0.0)
        total += 0.5 * float(squared.sum())
    return total


def poses(loss: Loss, compiled: bool) -> tuple[fg.Graph, dict[fg.Family, Array], Array]:
    """Poses and a shared offset; a pose twice in one factor, a fixed one, one factor switched off."""
    rng = np.random.default_rng(4)
    graph, x, shared = graph_of(("x", fg.SE2, 5), ("shared", fg.Rn(2), 1))
    graph.fix(x[0], [0.1, 0.2, 0.3])
    first, second = np.array([0, 1, 2, 3, 2, 4]), np.array([1, 2, 3, 4, 2, 0])
    active: Array = np.array([True, True, False, True, True, True])
    root = rng.standard_normal((3, 3))
    between = fg.between if compiled else fg.residual(lambda a, b, z: fg.SE2.local(z, fg.SE2.between(a, b)))
    seen = rng.standard_normal((6, 3))
    information = root @ root.T + np.eye(3)
    graph.minimize(
        between, x[first], x[second], seen, information=information, robust=loss, active=active, name="robust"
    )
    moved = fg.prior if compiled else fg.residual(lambda a, z: a - z)
    spread = rng.standard_normal((6, 2)) * 3.0
    graph.minimize(moved, shared, spread, sigma=[0.7, 1.3], robust=loss, active=active, name="offsets")
    graph.minimize(fg.prior, x, np.zeros(3), sigma=2.0, name="weak")
    guess = {x: 0.7 * rng.standard_normal((5, 3)), shared: np.array([[0.4, -0.6]])}
    return graph, guess, active


@pytest.mark.parametrize("loss", PUBLISHED | SURROGATES, ids=repr)
def test_formulas_are_those_of_the_papers(loss: Formula) -> None:
    form, rho = form_of(loss), (PUBLISHED | SURROGATES)[loss]
    assert form is not None
    numbers = [0.02, 0.3, 0.9, 1.4, 2.0, 3.0, 6.0, 8.0, 70.0, 1e5]
    assert np.all(np.diff(loss.value(np.array([0.0, *numbers]))) >= -1e-12) and loss.value(np.zeros(1))[0] == 0.0
    for s in numbers:
        np.testing.assert_allclose(loss.value(np.array([s]))[0], rho(complex(s)).real, rtol=1e-12)
        np.testing.assert_allclose(loss.weight(np.array([s]))[0], slope(rho, s), rtol=1e-9, atol=1e-13)
        h = 1e-5 * s
        bend = (slope(rho, s + h) - slope(rho, s - h)) / (2.0 * h)
        np.testing.assert_allclose(bend_of(*form, s), bend, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(loss.value(np.array([1e-9])), 1e-9, rtol=1e-8)
    edges = [bend_of(*form, s) for s in (0.0, K, K**2, K**2 / 3, 3 * K**2, 4 * K**2)]
    assert np.isfinite(edges).all()
    assert np.isnan(loss.value(np.array([np.nan]))[0])


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("loss", [*LOSSES, Welsch(), HALF], ids=lambda loss: repr(loss).split(" object")[0][:30])
def test_cost_gradient_and_hessian(loss: Loss, compiled: bool) -> None:
    graph, guess, active = poses(loss, compiled)
    program = program_of(graph)
    values = program.values_from(guess)
    lin = program.linearize(values)
    assert lin.cost == pytest.approx(objective(program, guess, loss, active), rel=1e-12)
    assert program.evaluate(values).cost == pytest.approx(lin.cost, rel=1e-13)
    assert program.evaluate(values, lin.weights).cost == pytest.approx(lin.cost, rel=1e-13)
    n, free, h = program.size, program.columns.free, 1e-5
    steps = [(program.retract(values, h * e), program.retract(values, -h * e)) for e in np.eye(n)]
    costs = [[objective(program, dict(v.items()), loss, active) for v in pair] for pair in steps]
    np.testing.assert_allclose(lin.gradient[free], [(a - b) / (2.0 * h) for a, b in costs], rtol=1e-5, atol=1e-7)
    # Residuals carry the roots of their weights; J'J is what the normal equations get.
    J = program.costs.matrix(lin.jacobian).toarray()
    np.testing.assert_allclose(J.T @ lin.residual, lin.gradient[free], rtol=1e-9, atol=1e-12)
    upper = program.normal.matrix(lin.hessian).toarray()
    np.testing.assert_allclose(upper, np.triu(J.T @ J), rtol=1e-9, atol=1e-10)
    if isinstance(loss, Welsch):
        return  # nobody knows the slope of its weights
    slopes = [[program.linearize(v).gradient[free] for v in pair] for pair in steps]
    wanted = np.array([(a - b) / (2.0 * h) for a, b in slopes])
    upper = program.normal.matrix(lagrangian_hessian(program, lin, np.zeros(0))).toarray()
    np.testing.assert_allclose(upper, np.triu(0.5 * (wanted + wanted.T)), rtol=1e-5, atol=1e-5)


RANGES_FROM = np.array([[0.0, 0.0], [6.0, 0.0], [0.0, 6.0], [6.0, 6.0], [3.0, -2.0], [8.0, 3.0]])


def ranges_to(place: Array, bias: Array) -> Array:
    """(n, 1) biased distances from the beacons."""
    distance: Array = np.linalg.norm(place - RANGES_FROM, axis=1)[:, None]
    return distance + bias


def beacons(loss: Loss, constrained: bool, equal: bool) -> tuple[fg.Graph, dict[fg.Family, Array], Array]:
    """A place and a bias from six distances, one of them 2 m too long; constraints change nothing."""
    truth = np.array([2.2, 3.1])
    measured = np.linalg.norm(truth - RANGES_FROM, axis=1)[:, None] + 0.2
    measured += 0.05 * np.array([[1.0], [-1.0], [0.5], [0.3], [-0.8], [0.4]])
    measured[3] += 2.0
    graph, place, bias = graph_of(("place", fg.Rn(2), 1), ("bias", fg.Rn(1), 1))
    graph.minimize(
        lambda p, b, z: ranges_to(p, b) - z, place, bias, graph.data("z", measured, each=True), sigma=0.1, robust=loss
    )
    graph.minimize(fg.prior, bias, [0.0], sigma=0.5)
    if equal:
        twin = graph.variables("twin", fg.Rn(2), 1)
        graph.constrain(fg.difference, place, twin, lower=0.0, upper=0.0)
    if constrained:
        graph.bound(place, lower=[-9.0, -9.0], upper=[9.0, 9.0])
    guess = {family: np.full((1, family.manifold.dim), 0.1) for family in graph.families.values()}
    guess[place] = truth[None] + 0.15
    if equal:
        guess[twin] = guess[place]
    return graph, guess, measured


@pytest.mark.parametrize("name", [*LEAST_SQUARES, *CONSTRAINED])
@pytest.mark.product(2)
def test_every_backend_finds_the_optimum_of_every_loss(name: str) -> None:
    for loss in [*LOSSES, Welsch()]:
        graph, guess, measured = beacons(loss, name in CONSTRAINED, name not in LEAST_SQUARES)
        rho = PUBLISHED.get(loss, lambda s, loss=loss: complex(loss.value(np.array([s.real]))[0]))

        def cost(w: Array, measured: Array = measured, rho: Callable[[complex], complex] = rho) -> float:
            off = (ranges_to(w[None, :2], w[2:]) - measured)[:, 0] / 0.1
            return 0.5 * sum(rho(complex(s)).real for s in off**2) + 0.5 * (float(w[2]) / 0.5) ** 2

        start = np.array([*guess[graph.families["place"]][0], 0.1])
        known = minimize(cost, start, method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-14, "maxiter": 2000})
        options = {"max_iterations": 300} if name != "penalty" else {"max_iterations": 300, "tolerance": 1e-5}
        solution = backend(name, **options).solve(graph, guess, check=True)
        assert solution.cost == pytest.approx(known.fun, rel=1e-6), (name, loss)
        found = np.concatenate([solution[graph.families["place"]][0], solution[graph.families["bias"]][0]])
        np.testing.assert_allclose(found, known.x, atol=2e-5, err_msg=f"{name} {loss}")


@pytest.mark.parametrize("name", ["ipm", "sqp", "alm"])
def test_a_loss_that_is_never_active_changes_no_step(name: str) -> None:
    runs = []
    for loss in (None, fg.Huber(1e6), fg.TruncatedLeastSquares(1e6), HALF):
        stated = Unicycle("straight", False, 12).formulation()
        if loss is not None:
            wide = fg.Reweighted(np.ones_like) if loss is HALF else loss
            stated.graph.terms[:] = [
                replace(term, robust=wide) if isinstance(term, Cost) else term for term in stated.graph.terms
            ]
        options = {} if name == "alm" else {"hessian": "exact"}
        runs.append(backend(name, **options).solve(stated.graph, stated.guess))
    for run in runs[1:]:
        assert run.iterations == runs[0].iterations
        np.testing.assert_allclose([row.cost for row in run.history], [row.cost for row in runs[0].history], rtol=1e-9)


@pytest.mark.parametrize(("loss", "alone"), [(fg.Tukey(3.0), True), (HALF, False), (Welsch(), False)])
def test_shipped_losses_leave_nothing_to_python(loss: Any, alone: bool) -> None:
    graph, _, _ = poses(loss, True)
    graph.bound(graph.families["shared"], upper=5.0)
    assert graph.compile().fully_compiled == alone


@pytest.mark.parametrize("loss", [*LOSSES, Welsch(), HALF])
def test_masks_come_and_go_with_data(loss: Any) -> None:
    """A factor switched off by data counts for nothing, whatever its loss, and comes back."""
    graph, x = graph_with(fg.Rn(1))
    on = graph.data("on", np.array([True, True]), each=True)
    graph.minimize(fg.prior, x, np.array([[0.0], [0.5]]), robust=loss, active=on)
    graph.bound(x, upper=9.0)
    run = InteriorPoint(tolerance=1e-9).prepare(graph)
    found = [run.solve({x: [[0.1]]}, data={on: np.array(mask)})[x][0, 0] for mask in ([1, 1], [1, 0], [0, 1])]
    both = run.solve({x: [[0.1]]})[x][0, 0]
    np.testing.assert_allclose(found, [both, 0.0, 0.5], atol=1e-7, err_msg=str(loss))
    assert 0.0 < both < 0.5
