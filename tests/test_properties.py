"""Properties that hold for every graph and every backend, on random small graphs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import Phase, assume, given, settings
from hypothesis import strategies as st
from numpy.random import Generator

import unifg as fg
from judge import judge
from problems.graphs import graph_of
from unifg.solvers import KKT, SQP, InteriorPoint
from unifg.solvers.names import backends
from unifg.typing import Array, IntArray

Guess = dict[fg.Family, Array]

CONSTRAINED: dict[str, fg.Solver] = {
    **backends("alm", "penalty", "sqp"),
    "sqp-exact": SQP(hessian="exact"),
    **backends("ipm"),
}
UNCONSTRAINED = backends("gn", "lm")
SEEDS = st.integers(0, 10_000)
PHASES = (Phase.explicit, Phase.generate)  # a seed has no simpler form to shrink to
FEW, MORE = settings(max_examples=6, phases=PHASES), settings(max_examples=12, phases=PHASES)


# ------------------------------------------------------------------- random graphs


def curved(x: Array, a: Array, b: Array) -> Array:
    """A smooth residual of one variable: sin of a linear form, and another linear form."""
    return np.stack([np.sin(x @ a), x @ b], axis=1)


def wild(seed: int) -> tuple[fg.Graph, Guess]:
    """A graph of points, poses and attitudes with random costs and constraints, which may have no answer at all."""
    rng = np.random.default_rng(seed)
    graph, points, poses = graph_of(("points", fg.Rn(2), 3), ("poses", fg.SE2, 3))
    turn = graph.variables("turn", fg.SO3, 2)
    graph.minimize(fg.prior, points, rng.standard_normal((3, 2)), sigma=rng.uniform(0.5, 2.0))
    graph.minimize(curved, points[:2], *rng.standard_normal((2, 2)), name="curved")
    graph.minimize(fg.prior, poses[0], 0.3 * rng.standard_normal(3), sigma=0.5)
    graph.minimize(fg.between, poses[:-1], poses[1:], [1.0, 0.0, rng.uniform(-0.5, 0.5)], robust=_loss(rng))
    graph.minimize(fg.prior, turn, fg.SO3.exp(0.8 * rng.standard_normal((2, 3))), name="attitudes")
    # A corner of the box may bring a point and a pose together, where a distance has no derivative.
    graph.minimize(lambda p, x: np.hypot(0.1, np.hypot(*(p - x[:, :2]).T))[:, None] - 1.0, points, poses, name="ranges")
    if rng.random() < 0.7:
        low = rng.uniform(-1.0, 0.5, 2)
        graph.bound(points, lower=low, upper=low + rng.uniform(0.0, 1.5, 2), name="box")
    if rng.random() < 0.6:
        graph.constrain(
            lambda x: (x[:, :2] ** 2).sum(axis=1, keepdims=True), poses[2], upper=rng.uniform(0.2, 4.0), name="disc"
        )
    if rng.random() < 0.5:
        graph.constrain(lambda p, x: p - x[:, :2], points[0], poses[1], lower=0.0, upper=0.0, name="meet")
    if rng.random() < 0.5:
        axis = rng.standard_normal(3)
        axis /= np.linalg.norm(axis)
        graph.constrain(
            lambda r: fg.SO3.act(r, np.broadcast_to(axis, (len(r), 3)))[:, 2:], turn, lower=rng.uniform(-0.5, 0.9)
        )
    if rng.random() < 0.2:
        graph.constrain(lambda p: (p**2).sum(axis=1, keepdims=True), points[0], upper=-0.1, name="impossible")
    guess = {
        points: rng.standard_normal((3, 2)),
        poses: rng.standard_normal((3, 3)),
        turn: fg.SO3.exp(rng.standard_normal((2, 3))),
    }
    return graph, guess


def _loss(rng: Generator) -> fg.Loss | None:
    return [None, fg.Huber(0.5), fg.Cauchy(1.0)][rng.integers(3)]


def linear(matrix: Array) -> fg.Residual:
    """(n, m) residual sum of A_k x_k with its Jacobian, for points of the plane; ``matrix`` is (m, 2 k)."""
    blocks = np.split(matrix, matrix.shape[1] // 2, axis=1)

    def function(*x: Array) -> Array:
        return np.asarray(sum(p @ block.T for p, block in zip(x, blocks, strict=True)))

    def jacobian(*x: Array) -> list[Array]:
        return [np.broadcast_to(block, (len(x[0]), *block.shape)) for block in blocks]

    return fg.residual(function, jacobian)


class Convex:
    """A strictly convex quadratic program over points of the plane, to be stated in any order.

    Attributes:
        names: of the points.
        terms: each the kind, the points it touches, the matrix, and target or limits.
    """

    def __init__(self, seed: int) -> None:
        """Draw it around a point that satisfies the constraints."""
        rng = np.random.default_rng(seed)
        self.names = ["a", "b", "c", "d"]
        inside = {name: rng.standard_normal(2) for name in self.names}
        self.guess = {name: rng.standard_normal((1, 2)) for name in self.names}
        self.terms: list[tuple[str, list[str], Array, Array, Array]] = []
        for name in self.names:
            self.terms.append(("cost", [name], np.eye(2), 3.0 * rng.standard_normal(2), np.zeros(0)))
        for kind in ("cost", "cost", "equal", "limit", "limit", "limit"):
            touched = [str(name) for name in rng.choice(self.names, 2, replace=False)]
            matrix = rng.standard_normal((1, 4))
            here = matrix @ np.concatenate([inside[name] for name in touched])
            width = np.zeros(1) if kind == "equal" else rng.uniform(0.1, 1.0, 1)
            self.terms.append((kind, touched, matrix, here - width, here + width))

    def state(self, terms: IntArray, names: IntArray, scale: float = 1.0) -> tuple[fg.Graph, Guess]:
        """The graph with its terms and families in a given order; ``scale`` multiplies the rows of constraints."""
        graph = fg.Graph()
        families = {self.names[k]: graph.variables(self.names[k], fg.Rn(2), 1) for k in names}
        for k in terms:
            kind, touched, matrix, low, high = self.terms[k]
            points = [families[name] for name in touched]
            if kind == "cost":
                offset = low
                own = linear(matrix)
                shifted = fg.residual(lambda *x, f=own.function, z=offset: f(*x) - z, own.jacobian)
                graph.minimize(shifted, *points, name=f"term {k}")
            else:
                graph.constrain(
                    linear(scale * matrix), *points, lower=scale * low, upper=scale * high, name=f"term {k}"
                )
        return graph, {family: self.guess[name] for name, family in families.items()}

    def solve(self, solver: fg.Solver, terms: IntArray, names: IntArray, scale: float = 1.0) -> fg.Solution:
        """Its solution, judged."""
        graph, guess = self.state(terms, names, scale)
        solution = solver.solve(graph, guess, check=True)
        assert judge(graph, solution).worst() < 1e-6
        return solution

    @property
    def order(self) -> tuple[IntArray, IntArray]:
        """As drawn."""
        return np.arange(len(self.terms)), np.arange(len(self.names))

    def rows(self, solution: fg.Solution) -> tuple[Array, Array]:
        """Multipliers of the inequalities, and how far each is from its nearer limit."""
        duals, slacks = [], []
        for k, (kind, touched, matrix, low, high) in enumerate(self.terms):
            if kind == "limit":
                value = matrix @ np.concatenate([_values(solution)[name] for name in touched])
                duals.append(solution.dual(f"term {k}")[0, 0])
                slacks.append(min(value - low, high - value)[0])
        return np.array(duals), np.array(slacks)


def _values(solution: fg.Solution) -> dict[str, Array]:
    return {family.name: array[0] for family, array in solution.values.items()}


def snapshot(graph: fg.Graph, guess: Guess) -> Any:
    """Copies of what a solve must not change."""
    limits = [(term.name, term.count, repr(getattr(term, "lower", None))) for term in graph.terms]
    return limits, list(graph.families), {family: array.copy() for family, array in guess.items()}


# ------------------------------------------------------------------- properties


@pytest.mark.parametrize("name", CONSTRAINED)
@given(seed=SEEDS)
@MORE
@pytest.mark.product(1)
def test_every_claim_is_true(name: str, seed: int) -> None:
    graph, guess = wild(seed)
    terms, families, before = snapshot(graph, guess)
    solution = CONSTRAINED[name].solve(graph, guess)
    assert snapshot(graph, guess)[:2] == (terms, families)
    for family, array in before.items():
        np.testing.assert_array_equal(guess[family], array)
    if solution.converged:
        assert judge(graph, solution).worst() < 5e-6
    if solution.status is fg.Status.LOCALLY_INFEASIBLE:
        program = graph.compile()
        values = program.values_from(solution.values)
        here = program.violation(program.evaluate(values).constraints)
        assert np.abs(here).max() > 1e-6
        rng = np.random.default_rng(seed)
        for _ in range(20):
            moved = program.within_bounds(program.retract(values, 1e-3 * rng.standard_normal(program.size)))
            there = program.violation(program.evaluate(moved).constraints)
            assert there @ there >= here @ here - 1e-5
    for family, array in solution.values.items():
        assert family.manifold.is_valid(array).all()


@given(seed=SEEDS)
@MORE
def test_the_interior_point_decides_random_graphs(seed: int) -> None:
    """An answer, or the place where the constraints cannot be met; it never gives up on these."""
    graph, guess = wild(seed)
    solution = InteriorPoint().solve(graph, guess)
    assert solution.status in (fg.Status.CONVERGED, fg.Status.LOCALLY_INFEASIBLE), solution.report()


EXACT = {**backends("alm", "ipm", tolerance=1e-9), "sqp": SQP(tolerance=1e-9, qp="graph")}


@pytest.mark.product(1)
@pytest.mark.parametrize("name", EXACT)
@given(seed=SEEDS)
@FEW
def test_order_does_not_matter(name: str, seed: int) -> None:
    problem, rng = Convex(seed), np.random.default_rng(seed + 1)
    first = problem.solve(EXACT[name], *problem.order)
    duals, slacks = problem.rows(first)
    assume(
        np.maximum(np.abs(duals), slacks).min() > 1e-2
    )  # near a change of the active rows x is worth sqrt(tolerance)
    second = problem.solve(EXACT[name], rng.permutation(problem.order[0]), rng.permutation(problem.order[1]))
    for point, value in _values(first).items():
        np.testing.assert_allclose(_values(second)[point], value, atol=1e-8)
    np.testing.assert_allclose(problem.rows(second)[0], duals, atol=1e-7)


@pytest.mark.product(1)
@pytest.mark.parametrize("name", EXACT)
@given(seed=SEEDS, scale=st.sampled_from([0.02, 0.3, 7.0, 50.0]))
@FEW
def test_scaling_a_constraint_scales_its_multipliers(name: str, seed: int, scale: float) -> None:
    problem, solver = Convex(seed), replace(EXACT[name], tolerance=1e-8)
    one = problem.solve(solver, *problem.order)
    assume(np.maximum(np.abs(problem.rows(one)[0]), problem.rows(one)[1]).min() > 1e-2)
    other = problem.solve(solver, *problem.order, scale)
    for term, dual in one.multipliers.items():
        np.testing.assert_allclose(scale * other.dual(term), dual, rtol=1e-4, atol=1e-5)


@pytest.mark.product(3)
@pytest.mark.parametrize("name", [*CONSTRAINED, *UNCONSTRAINED, "kkt"])
@given(seed=SEEDS)
@FEW
def test_started_at_the_answer_nothing_happens(name: str, seed: int) -> None:
    if name in UNCONSTRAINED:
        problem = Convex(seed)
        costs = np.array([k for k, term in enumerate(problem.terms) if term[0] == "cost"])
        solver, (graph, guess) = UNCONSTRAINED[name], problem.state(costs, problem.order[1])
    elif name == "kkt":
        problem = Convex(seed)
        equalities = np.array([k for k, term in enumerate(problem.terms) if term[0] != "limit"])
        solver, (graph, guess) = KKT(), problem.state(equalities, problem.order[1])
    else:
        solver, (graph, guess) = CONSTRAINED[name], wild(seed)
    first = solver.solve(graph, guess)
    assume(first.converged)
    again = solver.solve(graph, first)
    assert again.converged and again.iterations == 0
    assert again.cost == first.cost
    for family, array in first.values.items():
        np.testing.assert_array_equal(again[family], array)
