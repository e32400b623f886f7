"""Convergence of least squares: the same verdict in every unit of cost, and none where the costs determine nothing."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import unifg as fg
from calls import calls_of
from problems.graphs import drawn_to, graph_of, graph_with, program_of
from unifg.elimination.factorization import Factorization
from unifg.files.g2o import read_g2o
from unifg.lie import LieGroup
from unifg.pose_graphs import manhattan, sphere
from unifg.problem.compiled_problem import CompiledProblem
from unifg.problem.linearization import Linearization
from unifg.solution.relative_offset import relative_offset
from unifg.solvers import (
    KKT,
    SQP,
    AugmentedLagrangian,
    DogLeg,
    GaussNewton,
    InteriorPoint,
    LevenbergMarquardt,
    Penalty,
)
from unifg.typing import Array

Made = tuple[fg.Graph, dict[fg.Family, Array]]

BACKENDS = [GaussNewton(), LevenbergMarquardt(), DogLeg(), InteriorPoint(), SQP(), KKT(), AugmentedLagrangian()]
BACKENDS += [Penalty()]
DAMPED = [LevenbergMarquardt(), InteriorPoint(), SQP(), KKT(), AugmentedLagrangian(), Penalty()]


def decay(times: float, noise: float = 0.05) -> Made:
    """An exponential through noisy points, its information multiplied by ``times``."""
    rng = np.random.default_rng(3)
    t = np.linspace(0.0, 4.0, 40)[:, None]
    y = 2.0 * np.exp(-0.7 * t) + 0.5 + noise * rng.standard_normal(t.shape)
    graph, p = graph_with(fg.Rn(3), 1, "p")

    def misfit(p: Array, t: Array, y: Array) -> Array:
        return p[:, :1] * np.exp(-p[:, 1:2] * t) + p[:, 2:] - y

    points = graph.data("t", t, each=True), graph.data("y", y, each=True)
    graph.minimize(misfit, p, *points, sigma=0.05 / times**0.5)
    return graph, {p: np.array([[1.0, 1.0, 0.0]])}


def city(times: float) -> Made:
    """A planar pose graph."""
    pose_graph = manhattan(60, seed=1).pose_graph
    pose_graph.edges.information[:] *= times
    graph, _, guess = pose_graph.graph()
    return graph, guess


def robust(loss: Callable[[float], fg.Loss]) -> Callable[[float], Made]:
    """Points with outliers; thresholds are in units of the residual, and scale with it."""

    def make(times: float) -> Made:
        z = np.random.default_rng(5).standard_normal((30, 2))
        z[:6] += 8.0
        graph, x = graph_with(fg.Rn(2))

        def misfit(x: Array, z: Array) -> Array:
            return np.concatenate([np.sin(x[:, :1]) + x[:, 1:], x[:, 1:]], axis=1) - z

        graph.minimize(misfit, x, graph.data("z", z, each=True), sigma=times**-0.5, robust=loss(times**0.5))
        return graph, {x: np.array([[1.0, 2.0]])}

    return make


PROBLEMS = {
    "decay": decay,
    "exact decay": lambda times: decay(times, noise=0.0),
    "city": city,
    "Huber": robust(lambda unit: fg.Huber(1.3 * unit)),
    "Tukey": robust(lambda unit: fg.Tukey(5.0 * unit)),
}


@pytest.mark.parametrize("problem", PROBLEMS)
@pytest.mark.parametrize("solver", BACKENDS, ids=lambda s: s.name)
@pytest.mark.product(16)
def test_the_unit_of_cost_changes_nothing(solver: fg.Solver, problem: str) -> None:
    """Information times 1e6 used to end at the iteration limit, times 1e-6 was called converged far from the end."""
    graph, guess = PROBLEMS[problem](1.0)
    reference = solver.solve(graph, guess, check=True)
    assert reference.stationarity <= 1e-6
    # Quadratic programs are solved to an absolute accuracy: SQP answers for fewer orders of magnitude.
    for times in (1e-6, 1e6) if isinstance(solver, SQP) else (1e-12, 1e-6, 1e6, 1e12):
        graph, guess = PROBLEMS[problem](times)
        solution = solver.solve(graph, guess, check=True)
        assert abs(solution.iterations - reference.iterations) <= (3 if isinstance(solver, SQP) else 1)
        assert solution.cost / times == pytest.approx(reference.cost, rel=1e-11, abs=1e-24)


@pytest.mark.parametrize("solver", BACKENDS, ids=lambda s: s.name)
def test_the_answer_is_within_the_tolerance_of_the_best_cost(solver: fg.Solver) -> None:
    """Cost left to gain is the tolerance squared, as a share."""
    graph, guess = decay(1e-6)
    best = GaussNewton(tolerance=1e-9).solve(graph, guess, check=True).cost
    for tolerance in (1e-2, 1e-4, 1e-6):
        solver = type(solver)(tolerance=tolerance)
        solution = solver.solve(graph, guess, check=True)
        assert solution.cost <= best * (1.0 + 2.0 * tolerance**2 + 1e-14)


def dense_offset(program: CompiledProblem, lin: Linearization) -> float:
    """|P r| / |r| by dense QR."""
    jacobian = program.costs.matrix(lin.jacobian).toarray()
    q, _ = np.linalg.qr(jacobian)
    return float(np.linalg.norm(q.T @ lin.residual) / np.linalg.norm(lin.residual))


@pytest.mark.parametrize("problem", ["decay", "city", "Huber", "Tukey"])
def test_the_offset_is_that_of_a_dense_projection(problem: str) -> None:
    """At the guess, on the way with a factor that is one step old, damped or not, and at the end."""
    graph, guess = PROBLEMS[problem](1e3)
    program = program_of(graph)
    for solver in (GaussNewton, LevenbergMarquardt):
        for k in range(6):
            solution = solver(max_iterations=k).solve(graph, guess)
            lin = program.linearize(solution.values)
            exact = dense_offset(program, lin)
            measured = relative_offset(program, lin)
            assert measured.determined and measured.finite
            assert measured.value == pytest.approx(exact, rel=1e-6, abs=1e-13)
            bound = relative_offset(program, lin, enough=1e-6).value
            assert bound <= exact * (1.0 + 1e-6) and (bound <= 1e-6) == (exact <= 1e-6)
            assert solution.stationarity <= exact * (1.0 + 1e-4)
            assert solution.converged == (exact <= 1e-6)


def test_backends_that_lend_their_factor_take_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    made = calls_of(monkeypatch, Factorization, "factor")
    for graph, _, guess in (manhattan(200, seed=4).pose_graph.graph(), sphere(5, 10).pose_graph.graph()):
        for solver in (GaussNewton(), DogLeg(), LevenbergMarquardt()):
            made.clear()
            solution = solver.solve(graph, guess, check=True)
            assert len(made) == solution.iterations


def free_city(times: float = 1.0) -> Made:
    """A pose graph that nothing ties to the world."""
    pose_graph = manhattan(60, seed=1).pose_graph
    graph, x = graph_with(fg.SE2, len(pose_graph.poses))
    edges = pose_graph.edges
    graph.minimize(fg.between, x[edges.first], x[edges.second], edges.measured, information=times * edges.information)
    return graph, {x: pose_graph.poses}


@pytest.mark.parametrize("solver", BACKENDS, ids=lambda s: s.name)
@pytest.mark.parametrize("known", [0, 2])
def test_no_information_is_no_solution(solver: fg.Solver, known: int) -> None:
    """Information that data make zero, of all or of one of three, used to be CONVERGED without a word."""
    graph, x = graph_with(fg.Rn(2), 3)
    information = np.zeros((3, 2, 2))
    information[:known] = np.eye(2)
    omega = graph.data("omega", np.tile(np.eye(2), (3, 1, 1)), each=True)
    graph.minimize(fg.prior, x, [1.0, 2.0], information=omega)
    run, guess = solver.prepare(graph), {x: np.tile([1.0, 2.0], (3, 1))}
    solution = run.solve(guess, data={omega: information})
    assert solution.status is fg.Status.UNDETERMINED
    assert not solution.converged
    assert "do not determine every unknown" in solution.report()
    with pytest.raises(fg.NotConverged):
        run.solve(guess, data={omega: information}, check=True)
    assert run.solve({x: np.ones((3, 2))}).converged


@pytest.mark.parametrize("solver", DAMPED, ids=lambda s: s.name)
@pytest.mark.parametrize("times", [1e-6, 1.0, 1e6])
def test_a_graph_that_floats_is_undetermined(solver: fg.Solver, times: float) -> None:
    """Damping finds a stationary point, which is one of many."""
    graph, guess = free_city(times)
    solution = solver.solve(graph, guess)
    assert solution.status is fg.Status.UNDETERMINED, solution.report()
    assert solution.stationarity <= 1e-6
    tied, _, start = manhattan(60, seed=1).pose_graph.graph()
    assert solution.cost == pytest.approx(times * GaussNewton().solve(tied, start, check=True).cost, rel=1e-10)
    assert GaussNewton().solve(graph, solution).status is fg.Status.UNDETERMINED


@pytest.mark.parametrize("solver", [LevenbergMarquardt(), InteriorPoint(), SQP()], ids=lambda s: s.name)
@pytest.mark.parametrize("seed", range(4))
def test_a_graph_that_floats_and_fits_exactly_is_undetermined(solver: fg.Solver, seed: int) -> None:
    rng, graph = np.random.default_rng(seed), fg.Graph()
    x, near = graph.variables("x", fg.SE2, 10), np.cumsum(np.full((10, 3), [1.0, 0.2, 0.3]), axis=0)
    first = np.array([0, 1, 2, 3, 5, 6, 7, 8])  # two parts, of which one is tied to the world
    graph.minimize(fg.between, x[first], x[first + 1], [1.0, 0.1, 0.3] + 0.02 * rng.standard_normal((8, 3)), sigma=0.1)
    graph.minimize(fg.prior, x[0], [0.0, 0.0, 0.0], sigma=0.01)
    solution = solver.solve(graph, {x: near + 0.05 * rng.standard_normal((10, 3))})
    assert (solution.status, solution.stationarity) == (fg.Status.UNDETERMINED, 0.0)


def test_a_landmark_whose_only_sighting_is_rejected_is_undetermined() -> None:
    """A truncated loss takes away in the last step what held the landmark in the one before."""
    graph, x = graph_with(fg.Rn(2), 2)
    graph.minimize(fg.prior, x[0], [1.0, 2.0], sigma=0.1)
    graph.minimize(fg.prior, x[1], [9.0, 2.0], sigma=0.1, robust=fg.TruncatedLeastSquares(3.0), name="sighting")
    solution = LevenbergMarquardt().solve(graph, {x: np.zeros((2, 2))})
    assert solution.status is fg.Status.UNDETERMINED
    LevenbergMarquardt().solve(graph, {x: np.array([[0.0, 0.0], [9.1, 2.0]])}, check=True)


@pytest.mark.parametrize("solver", DAMPED, ids=lambda s: s.name)
def test_what_is_switched_off_is_not_asked_for(solver: fg.Solver) -> None:
    """An unknown whose factors are all inactive keeps its guess; one with zero information is missing something."""
    graph, x = graph_with(fg.Rn(2), 3)
    on = graph.data("on", np.array([True, True, False]))
    graph.minimize(fg.prior, x, [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]], sigma=0.1, active=on)
    graph.minimize(lambda a: a**2, x[:2])
    run = solver.prepare(graph)
    solution = run.solve({x: np.ones((3, 2))}, check=True)
    np.testing.assert_array_equal(solution[x][2], [1.0, 1.0])
    assert run.solve({x: np.ones((3, 2))}, data={on: np.ones(3, dtype=bool)}).converged


def test_costs_between_fixed_variables_do_not_hide_the_rest() -> None:
    """They are constants: however large, they belong to no angle between residual and tangent space."""
    graph, guess = decay(1.0)
    anchor = graph.variables("anchor", fg.Rn(1), 2)
    graph.fix(anchor, [[0.0], [1.0]])
    graph.minimize(fg.prior, anchor, [1e9], name="constant")
    solution = GaussNewton().solve(graph, {**guess, anchor: np.zeros((2, 1))}, check=True)
    plain, start = decay(1.0)
    free = GaussNewton().solve(plain, start, check=True)
    assert solution.iterations == free.iterations
    assert solution.stationarity == pytest.approx(free.stationarity, rel=1e-9)


GROUPS: list[LieGroup] = [fg.Rn(2), fg.SE2, fg.SE3]


def exact(manifold: LieGroup, offset: float, sigma: float) -> Made:
    """A loop of poses whose measurements all agree, far from the origin."""
    rng = np.random.default_rng(11)
    count = 12
    truth = manifold.retract(np.tile(manifold.identity(), (count, 1)), rng.normal(size=(count, manifold.dim)))
    position = min(manifold.storage, 3 if manifold is fg.SE3 else 2)
    truth[:, :position] += offset
    graph, x = graph_with(manifold, count)
    i, j = np.arange(count), (np.arange(count) + 1) % count
    measured = manifold.compose(manifold.inverse(truth[i]), truth[j])
    graph.minimize(fg.between, x[i], x[j], measured, sigma=sigma)
    graph.minimize(fg.prior, x[0], truth[0], sigma=sigma)
    return graph, {x: manifold.retract(truth, 0.05 * rng.normal(size=(count, manifold.dim)))}


@pytest.mark.parametrize("offset", [0.0, 1e3, 5e6])
@pytest.mark.parametrize("sigma", [1.0, 1e-3])
@pytest.mark.parametrize("manifold", GROUPS, ids=lambda m: m.name)
@pytest.mark.parametrize("solver", [GaussNewton(), LevenbergMarquardt(), DogLeg(radius=1e3)])
def test_graphs_that_fit_exactly_end_at_rounding(solver: Any, manifold: LieGroup, sigma: float, offset: float) -> None:
    """Their residual is rounding, and so is every angle with it: the floor ends the solve, not the limit."""
    graph, guess = exact(manifold, offset, sigma)
    solution = solver.solve(graph, guess, check=True)
    assert solution.iterations <= 8
    assert solution.stationarity == 0.0 or solution.stationarity <= 1e-6
    rounding = 12 * 1e-15 * max(1.0, offset) / sigma
    assert solution.cost <= rounding**2 * 12


@pytest.mark.parametrize("solver", [GaussNewton(), LevenbergMarquardt(), DogLeg()])
def test_an_exact_answer_of_zero_takes_few_steps(solver: Any) -> None:
    graph, x = graph_with(fg.Rn(2), 3)
    graph.minimize(fg.prior, x[0], [0.0, 0.0], sigma=0.3)
    graph.minimize(lambda a, b: b - a + 0.1 * np.sin(b - a), x[:-1], x[1:], sigma=0.3)
    solution = solver.solve(graph, {x: np.arange(6.0).reshape(3, 2)}, check=True)
    assert solution.iterations <= 8


def test_scalar_costs_keep_the_gradient_and_constraints_the_kkt_test() -> None:
    """A cost that is not a square has no zero point: its stationarity is the gradient, in the user's units."""
    graph, x = drawn_to([2.0], sigma=1e-3)
    graph.minimize_scalar(lambda a: 5.0 + 0.0 * a[:, 0], x, name="constant")
    lin = graph.compile().linearize({x: np.array([[2.0 + 1e-9]])})
    assert fg.optimality(graph.compile(), lin, np.zeros(0)).stationarity == pytest.approx(1e-3, rel=1e-3)
    bounded, y = graph_with(fg.Rn(1), 1, "y")
    bounded.minimize(fg.prior, y, [2.0], sigma=1e-3)
    bounded.bound(y, upper=9.0)
    lin = bounded.compile().linearize({y: np.array([[2.0 + 1e-9]])})
    assert fg.optimality(bounded.compile(), lin, np.zeros(1)).stationarity == pytest.approx(1e-3, rel=1e-3)


def test_the_report_says_which_measure_it_is() -> None:
    graph, guess = decay(1.0)
    assert "relative offset" in GaussNewton().solve(graph, guess).report()
    p = next(iter(guess))
    graph.bound(p, upper=9.0)
    assert "relative offset" not in InteriorPoint().solve(graph, guess).report()


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "chi2", "most"),
    [
        ("M3500", 137.9148782, 7),
        ("intel", 45.0042331, 5),
        ("parking-garage", 1.2683848, 5),
        ("sphere2500", 1351.4019259, 8),
    ],
)
@pytest.mark.product(1)
def test_published_optima_in_other_units(shared_data: Path, name: str, chi2: float, most: int) -> None:
    pose_graph = read_g2o(shared_data / "pose_graphs" / f"{name}.g2o.gz")
    for times in (1.0, 1e-6, 1e6):
        pose_graph.edges.information[:] *= times
        graph, _, guess = pose_graph.graph()
        solution = GaussNewton().solve(graph, guess, check=True)
        assert 2.0 * solution.cost / times == pytest.approx(chi2, rel=1e-7)
        best = GaussNewton(tolerance=1e-9).solve(graph, solution).cost
        assert solution.cost <= best * (1.0 + 1e-9)
        assert solution.iterations <= most
        pose_graph.edges.information[:] /= times


def beside(size: float, linked: bool) -> tuple[fg.Graph, dict[fg.Family, Array], fg.Family]:
    """One nonlinear unknown, and priors that contradict each other by ``size`` sigma, linked to it or not."""
    graph, x, y = graph_of(("x", fg.Rn(1), 1), ("y", fg.Rn(1), 1))
    graph.minimize(fg.prior, x, [0.0], sigma=1.0, name="here")
    graph.minimize(fg.prior, x, [size], sigma=1.0, name="there")
    graph.minimize(lambda y: np.concatenate([y**2 - 9.0, 0.3 * (y - 4.0), np.exp(0.3 * y) - 2.7], axis=1), y)
    if linked:
        graph.minimize(lambda a, b: 0.01 * (b - a / size), x, y)
    return graph, {x: np.zeros((1, 1)), y: np.array([[3.5]])}, y


@pytest.mark.parametrize("solver", BACKENDS, ids=lambda s: s.name)
@pytest.mark.parametrize("linked", [False, True])
def test_gross_errors_hide_no_variable(solver: fg.Solver, linked: bool) -> None:
    """As a share of 1e16, the cost of the block is nothing: it used to be left wherever it was."""
    if isinstance(solver, DogLeg):
        solver = DogLeg(radius=1e15)  # one region holds both
    for size in (1e4, 1e6, 1e8, 1e12):
        graph, guess, y = beside(size, linked)
        solution = solver.solve(graph, guess, check=True)
        # The block alone, pulled to the mean of the priors if it is linked.
        alone, own = graph_with(fg.Rn(1), 1, "y")
        alone.minimize(lambda y: np.concatenate([y**2 - 9.0, 0.3 * (y - 4.0), np.exp(0.3 * y) - 2.7], axis=1), own)
        if linked:
            alone.minimize(lambda y: 0.01 * (y - 0.5), own)
        best = GaussNewton(tolerance=1e-9).solve(alone, {own: guess[y]}, check=True)
        assert abs(solution[y] - best[own]).item() < 2e-6, (size, solution.report())
        assert solution.iterations <= 30


def local_offset(program: CompiledProblem, lin: Linearization) -> float:
    """Largest sqrt(sum |J_f d|^2 / sum |r_f|^2) over the variables, by dense algebra."""
    jacobian = program.costs.matrix(lin.jacobian).toarray()
    moved = jacobian @ np.linalg.lstsq(jacobian, lin.residual, rcond=None)[0]
    worst, factors = 0.0, program.costs.factors
    for variable in np.unique(program.blocks):
        touched = np.unique(factors[np.abs(jacobian[:, program.blocks == variable]).max(axis=1) > 0.0])
        rows = np.isin(factors, touched)
        worst = max(worst, float(np.linalg.norm(moved[rows]) / np.linalg.norm(lin.residual[rows])))
    return worst


@pytest.mark.product(1)
@pytest.mark.parametrize("solver", [GaussNewton, LevenbergMarquardt, DogLeg, SQP])
def test_a_solve_ends_when_every_variable_has_converged(solver: type[fg.Solver]) -> None:
    """Not sooner and not later than dense algebra says, whatever factorisation the test is made with."""
    between = 0
    for seed in (1, 2, 3, 4):
        graph, _, guess = manhattan(60, seed).pose_graph.graph()
        program = program_of(graph)
        for k in range(7):
            solution = solver(max_iterations=k, tolerance=1e-5).solve(graph, guess)
            lin = program.linearize(solution.values)
            whole, worst = dense_offset(program, lin), local_offset(program, lin)
            assert solution.converged == (max(whole, worst) <= 1e-5), (seed, k, whole, worst, solution.report())
            between += whole <= 1e-5 < worst
    assert between > 0


def test_soft_modes_beside_gross_errors_converge() -> None:
    """The long bends of a chain have gradients of a thousandth of their error."""
    rng = np.random.default_rng(2)
    graph, x, z = graph_of(("x", fg.SE2, 1000), ("z", fg.Rn(1), 1))
    steps = np.tile([1.0, 0.0, 0.0], (999, 1)) + 0.02 * rng.standard_normal((999, 3))
    graph.fix(x[0], [0.0, 0.0, 0.0])
    graph.minimize(fg.between, x[:-1], x[1:], steps, sigma=0.02)
    graph.minimize(fg.prior, x[-1], [900.0, 300.0, 0.5], sigma=0.02)
    guess = {x: np.linspace([0.0, 0.0, 0.0], [900.0, 300.0, 0.5], 1000)}
    graph.minimize(fg.prior, z, [0.0], name="here")
    far = graph.data("far", [[0.0]])
    graph.minimize(fg.prior, z, far, name="there")
    run = LevenbergMarquardt().prepare(graph)
    start = {**guess, z: np.zeros((1, 1))}
    best = LevenbergMarquardt(tolerance=1e-9).solve(graph, start, check=True)
    gross = run.solve(start, data={far: np.array([[1e8]])}, check=True)
    assert np.abs(gross[x] - best[x]).max() < 1e-5


@pytest.mark.parametrize("solver", BACKENDS, ids=lambda s: s.name)
def test_a_leaf_without_residual_converges(solver: fg.Solver) -> None:
    """The end of a chain fits exactly: its residual is rounding, and so is what a step would change of it."""
    rng = np.random.default_rng(7)
    graph, x = graph_with(fg.SE2, 12)
    steps = np.tile([1.0, 0.1, 0.3], (11, 1))
    graph.minimize(fg.prior, x[0], [300.0, -200.0, 1.0], sigma=0.1)
    graph.minimize(fg.between, x[:-1], x[1:], steps, sigma=0.01)
    graph.minimize(fg.between, x[0], x[6], [4.0, 3.5, 1.5], sigma=0.02)  # a loop that contradicts; five leaves hang on
    guess = np.cumsum(steps, axis=0)
    start = np.concatenate([[[0.0, 0.0, 0.0]], guess]) + [300.0, -200.0, 1.0] + 0.1 * rng.standard_normal((12, 3))
    solution = solver.solve(graph, {x: start}, check=True)
    assert solution.iterations <= 40


@pytest.mark.parametrize("solver", DAMPED, ids=lambda s: s.name)
def test_undetermined_parts_are_moved_to_where_they_are_stationary(solver: fg.Solver) -> None:
    """Beside gross errors a floating graph was called UNDETERMINED where it began."""
    graph, guess = free_city()
    z = graph.variables("z", fg.Rn(1), 1)
    graph.minimize(fg.prior, z, [0.0], name="here")
    graph.minimize(fg.prior, z, [2e8], name="there")
    solution = solver.solve(graph, {**guess, z: np.full((1, 1), 1e8)})
    assert solution.status is fg.Status.UNDETERMINED, solution.report()
    tied, _, start = manhattan(60, seed=1).pose_graph.graph()
    best = GaussNewton().solve(tied, start, check=True).cost
    term = next(iter(solution.residuals))
    assert 0.5 * float((solution.residuals[term] ** 2).sum()) == pytest.approx(best, rel=1e-9)


def edged(height: float, far: float) -> Callable[[float], Made]:
    """The distance from 2, above or below ``height``, beside priors that contradict each other by ``far`` sigma."""

    def make(start: float) -> Made:
        graph, y, z = graph_of(("y", fg.Rn(1), 1), ("z", fg.Rn(1), 1))
        graph.minimize(lambda y: np.abs(y - 2.0) + height, y)
        graph.minimize(fg.prior, z, [0.0], name="here")
        graph.minimize(fg.prior, z, [far], name="there")
        return graph, {y: np.array([[start]]), z: np.full((1, 1), 0.5 * far)}

    return make


@pytest.mark.parametrize("far", [0.0, 2.0, 2e8])
@pytest.mark.parametrize("solver", BACKENDS, ids=lambda s: s.name)
@pytest.mark.parametrize(
    ("height", "status"), [(0.0, fg.Status.CONVERGED), (1.0, fg.Status.CONVERGED), (-1.0, fg.Status.STALLED)]
)
def test_a_kink_is_not_undetermined(height: float, status: Any, solver: fg.Solver, far: float) -> None:
    """The slope that NumPy gives an edge is zero; a little further it is one."""
    graph, guess = edged(height, far)(2.0)
    assert solver.solve(graph, guess).status is status, height


@pytest.mark.parametrize("far", [0.0, 2e8])
@pytest.mark.parametrize("solver", BACKENDS, ids=lambda s: s.name)
def test_a_maximum_is_not_undetermined(solver: fg.Solver, far: float) -> None:
    graph, y, z = graph_of(("y", fg.Rn(1), 1), ("z", fg.Rn(1), 1))
    graph.minimize(lambda y: y**2 - 4.0, y)
    graph.minimize(fg.prior, z, [far])
    graph.minimize(fg.prior, z, [0.0], name="other")
    solution = solver.solve(graph, {y: np.zeros((1, 1)), z: np.full((1, 1), 0.5 * far)})
    assert solution.status is fg.Status.STALLED, solution.report()
