"""Ta's primal and dual linear graphs, and the elimination that solves them, against the engine."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

import unifg as fg
from problems.graphs import drawn_to, graph_of, graph_with, program_of
from problems.known import PROBLEMS, Guess, ecg2o, ecg2o_inequality, three_variable_qp
from test_sqp_exact import two_rotations
from unifg.models import unicycle
from unifg.problem.compiled_problem import CompiledProblem
from unifg.solvers import SQP
from unifg.solvers.quadratic_programs.exact_hessian import ExactHessian
from unifg.solvers.quadratic_programs.graph_route import GraphRoute
from unifg.solvers.quadratic_programs.scaling import Scaling
from unifg.solvers.quadratic_programs.subproblem import subproblem
from unifg.solvers.ta.elimination import Contradiction, LinearFactor, QuadraticFactor, Undetermined
from unifg.solvers.ta.linear_graphs import EliminationRoute, LinearGraph, LinearGraphs, dual_graph, primal_graph

DAMPING = 1e-6


def drive_to_a_pose() -> tuple[fg.Graph, Guess]:
    """Eight steps of a unicycle from one pose to another, both given; kernels, fixed variables, a robust cost."""
    count = 8
    graph, x, u = graph_of(("x", fg.SE2, count + 1), ("u", fg.Rn(2), count))
    graph.fix(x[0], [0.0, 0.0, 0.0])
    graph.minimize(fg.prior, u, [0.5, 0.0], sigma=[0.4, 0.7], name="effort")
    graph.minimize(unicycle.rate, u[:-1], u[1:], sigma=0.3, name="rate")
    graph.minimize(fg.prior, x[4], [0.6, 0.4, 0.2], sigma=0.2, robust=fg.Huber(0.5), name="waypoint")
    graph.constrain(unicycle.dynamics, x[:-1], u, x[1:], 0.2, lower=0.0, upper=0.0, name="dynamics")
    graph.constrain(lambda p: p[:, :2], x[-1], lower=[1.2, 0.3], upper=[1.2, 0.3], name="arrival")
    ahead = np.linspace(0.0, 1.2, count + 1)
    return graph, {x: np.stack([ahead, 0.2 * ahead, 0.1 + 0.0 * ahead], axis=1), u: np.tile([0.7, 0.1], (count, 1))}


def repulsion() -> tuple[fg.Graph, Guess]:
    """Ta's obstacle cost 1/d, on a line."""
    graph, x = drawn_to([1.0, 0.0], 2, sigma=0.4, name="goal")
    graph.minimize_scalar(lambda p: 1.0 / np.hypot(p[:, 0], p[:, 1] - 0.1), x, name="push")
    graph.constrain(lambda p, q: p[:, :1] * q[:, 1:] - 0.1, x[0], x[1], lower=0.0, upper=0.0, name="product")
    return graph, {x: np.array([[0.9, 0.4], [1.1, 0.3]])}


def _equalities_only(build: Callable[[], tuple[fg.Graph, Guess]]) -> bool:
    program = program_of(build()[0])
    return bool(program.equality.all())


BUILD: dict[str, Callable[[], tuple[fg.Graph, Guess]]] = {
    **{problem.name: problem.build for problem in PROBLEMS if _equalities_only(problem.build)},
    "drive to a pose": drive_to_a_pose,
    "repulsion": repulsion,
    "two rotations": two_rotations,
}
INDEFINITE = ("anchored square", "pinned ends, SE(3)", "anchored chain, SE(3)")  # exact Hessians at these guesses
# NumPy residuals, the same differences on both sides:
SMOOTH = [name for name in BUILD if name != "drive to a pose" and name not in INDEFINITE]


def test_there_are_problems_enough() -> None:
    assert len(BUILD) >= 13


def prepared(name: str) -> tuple[CompiledProblem, Guess]:
    graph, guess = BUILD[name]()
    program = program_of(graph)
    return program, guess


@pytest.mark.parametrize("name", BUILD)
def test_step_and_multipliers_are_those_of_the_engine(name: str, rng: np.random.Generator) -> None:
    program, guess = prepared(name)
    route, engine = EliminationRoute(program), GraphRoute(program)
    values = program.values_from(guess)
    for _ in range(4):
        lin = program.linearize(values)
        qp = subproblem(program, lin, DAMPING)
        mine = route.solve(qp, np.zeros(program.constraints.count), 1e-12)
        theirs = engine.solve(qp, np.zeros(program.constraints.count), 1e-13)
        scale = max(1.0, float(np.abs(theirs.step).max()))
        assert np.abs(mine.step - theirs.step).max() < 1e-9 * scale
        size = max(1.0, float(np.abs(theirs.multipliers).max(initial=0.0)))
        assert np.abs(mine.multipliers - theirs.multipliers).max(initial=0.0) < 1e-9 * size
        assert mine.error < 1e-9 * max(scale, size)
        values = program.retract(values, 0.1 * rng.standard_normal(program.size))


@pytest.mark.parametrize("name", SMOOTH)
def test_the_same_with_the_exact_hessian(name: str, rng: np.random.Generator) -> None:
    """Curvature factors, one for each constraint with a multiplier, against the engine's one matrix."""
    program, guess = prepared(name)
    route, engine, exact = EliminationRoute(program), GraphRoute(program), ExactHessian(program)
    lin = program.linearize(program.values_from(guess))
    curved = 0
    for scale in (0.02, 0.1, 0.3):
        multipliers = scale * rng.standard_normal(program.constraints.count)
        qp = exact.subproblem(lin, multipliers, DAMPING, Scaling.none(program))
        mine = route.solve(qp, multipliers, 1e-12)
        theirs = engine.solve(qp.convex(), multipliers, 1e-13)
        curved += qp.curved_by is not None
        length = max(1.0, float(np.abs(theirs.step).max()))
        assert np.abs(mine.step - theirs.step).max() < 1e-8 * length
        size = max(1.0, float(np.abs(theirs.multipliers).max(initial=0.0)))
        assert np.abs(mine.multipliers - theirs.multipliers).max(initial=0.0) < 1e-8 * size
    assert curved, "the Hessian was exact at least once"


@pytest.mark.parametrize("hessian", ["gauss-newton", "exact"])
@pytest.mark.parametrize("name", BUILD)
@pytest.mark.product(10)
def test_a_solve_by_elimination_alone(name: str, hessian: str) -> None:
    graph, guess = BUILD[name]()
    mine = SQP(qp="elimination", fallback=None, hessian=hessian, tolerance=1e-8).solve(graph, guess, check=True)  # type: ignore[arg-type]
    assert {row.details["qp"] for row in mine.history[1:]} == {"elimination"}
    theirs = SQP(qp="graph", hessian=hessian, tolerance=1e-8).solve(graph, guess, check=True)  # type: ignore[arg-type]
    for family in guess:
        assert np.abs(family.manifold.local(mine[family], theirs[family])).max() < 1e-4 if name == "hs48" else 1e-6
    for term, dual in theirs.multipliers.items():
        np.testing.assert_allclose(mine.dual(term), dual, atol=1e-5 * max(1.0, float(np.abs(dual).max())))


@pytest.mark.parametrize("name", ["drive to a pose", "two rotations", "three-variable qp", "repulsion"])
def test_any_order_gives_the_same(name: str, rng: np.random.Generator) -> None:
    graph, guess = BUILD[name]()
    both = LinearGraphs.at(graph, guess)
    for _ in range(5):
        order = rng.permutation(list(both.primal.variables)).tolist()
        step = both.primal.eliminate(order).solve()
        for variable, value in both.step.items():
            np.testing.assert_allclose(step[variable], value, atol=1e-8)
        order = rng.permutation(list(both.dual.variables)).tolist()
        multipliers = both.dual.eliminate(order).solve()
        for factor, expected in both.multipliers.items():
            np.testing.assert_allclose(multipliers[factor], expected, atol=1e-7)


def test_dense_least_squares_with_constraints(rng: np.random.Generator) -> None:
    """Against the KKT matrix, written down and inverted."""
    sizes = {"a[0]": 3, "a[1]": 2, "b[0]": 4}
    rows = [rng.standard_normal((5, 9)), rng.standard_normal((6, 9))]
    constraint = rng.standard_normal((4, 9))
    right = [rng.standard_normal(5), rng.standard_normal(6)]
    bound = rng.standard_normal(4)
    cut = {"a[0]": slice(0, 3), "a[1]": slice(3, 5), "b[0]": slice(5, 9)}

    def blocks(matrix: np.ndarray) -> dict[str, np.ndarray]:
        return {name: matrix[:, part] for name, part in cut.items()}

    curvature = rng.standard_normal((9, 9))
    curvature = 0.2 * (curvature + curvature.T)
    graph = LinearGraph(
        "dense",
        sizes,
        (
            *(
                LinearFactor(f"r[{k}]", "cost", blocks(A), b, 1.0)
                for k, (A, b) in enumerate(zip(rows, right, strict=True))
            ),
            QuadraticFactor("q[0]", "curvature", sizes, curvature, np.zeros(9)),
            LinearFactor("c[0]", "constraint", blocks(constraint), bound, 1.0),
        ),
    )
    hessian = sum(A.T @ A for A in rows) + curvature
    gradient = -sum(A.T @ b for A, b in zip(rows, right, strict=True))
    kkt = np.block([[hessian, constraint.T], [constraint, np.zeros((4, 4))]])
    expected = np.linalg.solve(kkt, np.concatenate([-gradient, bound]))
    step = graph.eliminate().solve()
    np.testing.assert_allclose(np.concatenate([step[name] for name in sizes]), expected[:9], atol=1e-10)
    np.testing.assert_allclose(dual_graph(graph, step).eliminate().solve()["c[0]"], expected[9:], atol=1e-9)


def test_the_dual_graph_has_the_sign_of_the_lagrangian() -> None:
    """Ta's eq. 19 lacks the minus: read literally it would send the multiplier of this problem to +1."""
    graph = ecg2o((-0.2, -0.2))[0]
    x = graph.families["x"]
    both = LinearGraphs.at(graph, {x: np.zeros((1, 2))})
    assert both.multipliers["curve[0]"] == pytest.approx(-1.0, abs=1e-9)
    balance = both.dual.factor("x[0]")
    assert isinstance(balance, LinearFactor)
    np.testing.assert_allclose(balance.right, [-1.0, -1.0], atol=1e-9)  # minus the gradient of the cost
    np.testing.assert_allclose(balance.blocks["curve[0]"].ravel(), [1.0, 1.0], atol=1e-9)


def test_graphs_can_be_read() -> None:
    graph, guess = drive_to_a_pose()
    both = LinearGraphs.at(graph, guess)
    assert "x[0]" not in both.primal.variables, "it is fixed"
    assert {f.name for f in both.primal.constraints} == {*(f"dynamics[{k}]" for k in range(8)), "arrival[0]"}
    assert both.primal.factor("dynamics[0]").variables == ("u[0]", "x[1]")
    assert {f.name for f in both.primal.factors_of("x[4]")} == {"waypoint[0]", "dynamics[3]", "dynamics[4]"}
    assert set(both.dual.variables) == {f.name for f in both.primal.constraints}
    assert both.dual.factor("x[3]").variables == ("dynamics[2]", "dynamics[3]")
    text = str(both.primal)
    assert "dynamics[2]: constraint, 3 rows: A (x[2], u[2], x[3]) = b" in text
    assert "rate[0]: cost, 2 rows: A (u[0], u[1]) ~ b" in text
    assert "x[3]: balance" in str(both.dual)
    net = str(both.primal.eliminate(["u[0]", *[v for v in both.primal.variables if v != "u[0]"]]))
    assert net.splitlines()[0].startswith("u[0] | ")
    assert "2 of 2 coordinates from constraints" in net
    with pytest.raises(fg.GraphError, match="no factor is called 'x\\[0\\]'"):
        both.dual.factor("x[0]")


def test_constraints_hold_while_variables_are_eliminated() -> None:
    """As many coordinates are determined by constraints as there are independent constraint rows."""
    graph, guess = drive_to_a_pose()
    elimination = LinearGraphs.at(graph, guess).primal.eliminate()
    assert sum(conditional.held for conditional in elimination.conditionals) == 8 * 3 + 2
    assert sum(conditional.size for conditional in elimination.conditionals) == 8 * 5


def test_curvature_factors_come_with_multipliers() -> None:
    graph, guess = drive_to_a_pose()
    cold = LinearGraphs.at(graph, guess, hessian="exact")
    assert not any(f.kind == "curvature" and f.name.startswith("dynamics") for f in cold.primal.factors)
    multipliers = {"dynamics": 0.1 * np.ones((8, 3))}
    warm = LinearGraphs.at(graph, fg.Guess(guess, multipliers), hessian="exact")
    curved = [f for f in warm.primal.factors if f.kind == "curvature" and f.name.startswith("dynamics")]
    assert len(curved) == 8
    assert not any(f.kind == "curvature" for f in LinearGraphs.at(graph, fg.Guess(guess, multipliers)).primal.factors)
    with pytest.raises(fg.GraphError, match="'dynamics' have shape"):
        LinearGraphs.at(graph, fg.Guess(guess, {"dynamics": np.zeros(3)}), hessian="exact")
    with pytest.raises(fg.BackendError, match="'newton'"):
        LinearGraphs.at(graph, guess, hessian="newton")  # type: ignore[arg-type]


def test_inequalities_are_refused_by_name() -> None:
    graph, guess = ecg2o_inequality()
    with pytest.raises(fg.BackendError, match=r"elimination.*'ellipse'"):
        SQP(qp="elimination").solve(graph, guess)
    with pytest.raises(fg.BackendError, match="'ellipse'"):
        LinearGraphs.at(graph, guess)
    # What data turn into an inequality is refused when it becomes one.
    graph, x = drawn_to([1.0])
    upper = graph.data("upper", np.zeros(1))
    graph.constrain(lambda p: p, x, lower=0.0, upper=upper, name="wall")
    run = SQP(qp="elimination").prepare(graph)
    assert run.solve({x: np.ones((1, 1))}).converged
    with pytest.raises(fg.BackendError, match="'wall'"):
        run.solve({x: 0.5 * np.ones((1, 1))}, data={upper: np.ones(1)})


def test_contradictions_and_missing_information() -> None:
    graph, guess = three_variable_qp()
    y, z = graph.families["y"], graph.families["z"]
    graph.constrain(lambda a, b: 2.0 * (a + b), y, z, lower=7.0, upper=7.0, name="other")
    with pytest.raises(Contradiction, match=r"other\[0\]"):
        LinearGraphs.at(graph, guess)
    answer = SQP(qp="elimination", fallback=None).solve(graph, guess)
    assert not answer.converged

    graph, x = graph_with(fg.Rn(3))
    graph.minimize(lambda p: p[:, :1], x, name="first")
    graph.constrain(lambda p: p[:, 1:2], x, lower=0.0, upper=0.0, name="second")
    with pytest.raises(Undetermined, match=r"1 coordinates of x\[0\]"):
        LinearGraphs.at(graph, {x: np.ones((1, 3))})


def test_dependent_constraints_have_some_multipliers() -> None:
    """Stated twice, they share the force; only the sum is determined, and the other reads zero."""
    graph, guess = three_variable_qp()
    y, z = graph.families["y"], graph.families["z"]
    graph.constrain(lambda a, b: a + b, y, z, lower=3.0, upper=3.0, name="again")
    both = LinearGraphs.at(graph, guess)
    np.testing.assert_allclose(both.step["x[0]"], 15.0, atol=1e-8)
    total = both.multipliers["first[0]"] + both.multipliers["again[0]"]
    np.testing.assert_allclose(total, 69.0, atol=1e-6)
    np.testing.assert_allclose(both.multipliers["second[0]"], -26.0, atol=1e-6)


def test_orders_and_names_are_checked() -> None:
    graph, guess = three_variable_qp()
    both = LinearGraphs.at(graph, guess)
    with pytest.raises(fg.GraphError, match="3 variables once"):
        both.primal.eliminate(["x[0]", "y[0]"])
    with pytest.raises(fg.GraphError, match="no variable 'w'"):
        LinearGraph("odd", {"v": 1}, (LinearFactor("f", "cost", {"w": np.eye(1)}, np.zeros(1), 1.0),))


def test_damping_is_a_factor_of_its_own() -> None:
    program, guess = prepared("three-variable qp")
    qp = subproblem(program, program.linearize(program.values_from(guess)), 0.25)
    graph = primal_graph(qp)
    damping = graph.factor("damping of x[0]")
    assert isinstance(damping, LinearFactor)
    np.testing.assert_allclose(damping.blocks["x[0]"], [[0.5]])
    assert primal_graph(subproblem(program, qp.lin, 0.0)).factors_of("x[0]")[-1].kind == "constraint"


def test_switched_off_factors_are_left_out() -> None:
    graph, x = drawn_to([1.0, 2.0], 3, name="prior")
    graph.minimize(fg.prior, x, [5.0, 5.0], active=np.array([True, False, False]), name="some")
    graph.constrain(lambda p: p[:, :1], x, lower=0.0, upper=0.0, active=np.array([False, True, False]), name="wall")
    both = LinearGraphs.at(graph, {x: np.zeros((3, 2))})
    assert [f.name for f in both.primal.factors if f.name.startswith("some")] == ["some[0]"]
    assert [f.name for f in both.primal.constraints] == ["wall[1]"]
    np.testing.assert_allclose(
        [both.step[f"x[{k}]"] for k in range(3)], [[3.0, 3.5], [0.0, 2.0], [1.0, 2.0]], atol=1e-9
    )


def test_drawing() -> None:
    figure = pytest.importorskip("matplotlib.figure")
    graph, guess = drive_to_a_pose()
    both = LinearGraphs.at(graph, fg.Guess(guess, {"dynamics": 0.1 * np.ones((8, 3))}), hessian="exact")
    axes = figure.Figure().subplots(2)
    both.primal.draw(axes[0])
    both.dual.draw(axes[1])
    labels = {text.get_text() for text in axes[0].texts}
    assert labels == set(both.primal.variables)
    edges = sum(len(f.variables) for f in both.primal.factors)
    assert len(axes[0].lines) == edges
    assert any(line.get_linestyle() == "--" for line in axes[0].lines), "curvature hangs on dashed lines"
    assert {text.get_text() for text in axes[1].texts} == set(both.dual.variables)
    axes[0].figure.canvas.draw()
