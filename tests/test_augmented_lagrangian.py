"""The augmented Lagrangian's scaling, its second derivatives, its rounding, and what it takes to the next solve."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal, TypeAlias

import numpy as np
import pytest

import unifg as fg
from judge import judge
from out_of_reach import goal_too_far
from problems.control import Driver, Unicycle
from problems.cylinders import flight
from problems.graphs import drawn_to, graph_of, graph_with, weighed_chain
from problems.known import STARTS, ecg2o, ecg2o_inequality, pose_beside_disc, short_drive
from unifg.models import obstacles, unicycle
from unifg.scenarios.manoeuvres import CASES, ManoeuvreSettings, state_problem
from unifg.solvers import SQP, AugmentedLagrangian, InteriorPoint
from unifg.solvers.augmented_objective import Primal
from unifg.solvers.augmented_step import model_step
from unifg.typing import Array
from units import drive


def beside_a_disc(scale: float) -> tuple[fg.Graph, dict[fg.Family, Array]]:
    """Points on a line that a disc is in the way of; the clearance is stated in units of 1 / ``scale`` metres."""
    graph, p = graph_with(fg.Rn(2), 5, "p")
    wishes = np.stack([np.linspace(-1.0, 1.0, 5), np.zeros(5)], axis=1)
    graph.minimize(fg.prior, p, wishes, sigma=0.5)
    graph.minimize(lambda a, b: b - a, p[:-1], p[1:], sigma=0.3)

    def clearance(x: Array) -> Array:
        distance: Array = np.linalg.norm(x - [0.1, -0.2], axis=1, keepdims=True)
        return scale * (distance - 0.5)

    graph.constrain(clearance, p, lower=0.0, name="clearance")
    graph.constrain(lambda x: x[:, :1] + x[:, 1:], p[0], lower=-1.0, upper=-1.0, name="start")
    return graph, {p: wishes + np.array([0.0, 0.3])}


def test_a_unit_of_a_constraint_changes_little() -> None:
    """Millimetres, metres or kilometres: nearly the same iterations, and multipliers in inverse units."""
    graph, guess = beside_a_disc(1.0)
    solver = AugmentedLagrangian(tolerance=1e-6)
    metres = solver.solve(graph, guess, check=True)
    assert np.abs(metres.dual("clearance")).max() > 0.1
    spent = {True: 0, False: 0}
    for scale in (1e-3, 1e3):
        graph, guess = beside_a_disc(scale)
        solution = solver.solve(graph, guess, check=True)
        # The tolerance of the violation has the unit too: of kilometres it is a loose one.
        assert solution.iterations <= metres.iterations + 4
        np.testing.assert_allclose(scale * solution.dual("clearance"), metres.dual("clearance"), rtol=5e-3, atol=1e-4)
        plain = replace(solver, scaling=False).solve(graph, guess)
        spent[True] += solution.iterations
        spent[False] += plain.iterations if plain.converged else solver.max_iterations
    assert spent[True] < 0.8 * spent[False], spent


def test_penalties_follow_the_scale_of_their_rows() -> None:
    graph, guess = beside_a_disc(1e3)
    solution = AugmentedLagrangian().solve(graph, guess, check=True)
    ratio = solution.penalties["start"] / solution.penalties["clearance"][:1]
    assert ratio.item() == pytest.approx((1e3 / 2.0) ** 2, rel=0.2)  # rows of length 1 stay, of 1000 come to 2
    plain = AugmentedLagrangian(scaling=False).solve(*short_drive(), check=True)
    assert len({value for rows in plain.penalties.values() for value in rows.ravel()}) == 1


def test_rows_without_slope_at_the_start_are_left_alone() -> None:
    graph, x = drawn_to([2.0])
    graph.constrain(lambda a: a**2, x, lower=1.0, upper=1.0, name="square")
    solution = AugmentedLagrangian(max_iterations=1).solve(graph, {x: np.zeros((1, 1))})
    assert np.isfinite(solution.penalties["square"]).all()
    assert AugmentedLagrangian().solve(graph, {x: np.zeros((1, 1))}).converged


def test_penalties_travel_with_multipliers() -> None:
    """A second solve begins where the first ended, and needs less than one with multipliers alone."""
    graph, guess = short_drive()
    x, u = graph.families["x"], graph.families["u"]
    run = AugmentedLagrangian().prepare(graph)
    cold = run.solve(guess, check=True)
    assert {name: rows.shape for name, rows in cold.penalties.items()} == {
        name: rows.shape for name, rows in cold.multipliers.items()
    }
    moved = cold.shifted(x, u)
    warm = run.solve(moved, check=True)
    without = run.solve(replace(moved, penalties={}), check=True)
    assert warm.history[1].details["penalty"] == cold.history[-1].details["penalty"]
    assert warm.iterations < without.iterations < cold.iterations
    np.testing.assert_array_equal(run.solve(moved)[u], warm[u], err_msg="a solve depends on its arguments alone")


def test_closed_loop_takes_fewer_iterations_with_its_penalties() -> None:
    problem = Unicycle("straight", True, 50)
    spent = {}
    for carried in (True, False):
        driver = Driver(problem.formulation(), AugmentedLagrangian(tolerance=1e-4), penalties=carried)
        pose, spent[carried] = problem.start, 0
        for index in range(30):
            control, _, iterations, status = driver.control(pose, index)
            assert status == "converged"
            spent[carried] += iterations if index else 0
            pose = problem.plant(pose, control, index)
    assert spent[True] < 0.9 * spent[False], spent
    assert spent[True] <= 150, spent


def test_given_penalties_are_taken_term_by_term() -> None:
    graph, guess = short_drive()
    wanted = {"dynamics": np.full((12, 3), 700.0), "limits": np.full((12, 2), 70.0)}
    solution = AugmentedLagrangian(max_iterations=1).solve(graph, fg.Guess(guess, {}, wanted))
    for name, rows in wanted.items():
        np.testing.assert_allclose(solution.penalties[name], rows)
    named = AugmentedLagrangian(penalty=3.0, scaling=False, max_iterations=1).solve(graph, fg.Guess(guess, {}, wanted))
    assert {value for rows in named.penalties.values() for value in rows.ravel()} == {3.0}, "an option is an order"


def test_penalties_are_checked_and_others_have_none() -> None:
    graph, guess = short_drive()
    assert SQP().solve(graph, guess).penalties == {}
    with pytest.raises(fg.GraphError, match="penalties given for 'nobody'"):
        AugmentedLagrangian().solve(graph, fg.Guess(guess, {}, {"nobody": np.ones((1, 1))}))
    with pytest.raises(fg.GraphError, match="penalties of 'dynamics' have shape"):
        AugmentedLagrangian().solve(graph, fg.Guess(guess, {}, {"dynamics": np.ones((1, 1))}))


def test_the_literal_loop_is_not_scaled() -> None:
    graph, guess = ecg2o((-0.2, -0.2))
    solution = AugmentedLagrangian(schedule="bazzana", penalty=10.0).solve(graph, guess)
    assert solution.penalties == {name: pytest.approx(10.0) for name in solution.multipliers}


@pytest.mark.parametrize("start", [(-2.0, -2.0), (2.0, 2.0)])
@pytest.mark.parametrize("penalty", [1e-3, 10.0, 1e6])
def test_the_literal_loop_may_run_away_and_says_so(start: tuple[float, float], penalty: float) -> None:
    """Full Gauss-Newton steps without a merit function; warnings are errors here."""
    solution = AugmentedLagrangian(schedule="bazzana", penalty=penalty).solve(*ecg2o(start))
    assert solution.status in (fg.Status.SINGULAR, fg.Status.NOT_FINITE, fg.Status.ITERATION_LIMIT)
    assert np.isfinite(solution.cost)


def test_second_derivatives_are_those_of_the_lagrangian() -> None:
    """Case study 2 of ecg2o, where residuals bend as much as the constraint, in eight steps on average."""
    counts = [AugmentedLagrangian().solve(*ecg2o(start), check=True).iterations for start in STARTS]
    assert np.mean(counts) <= 8.0, counts
    rough = [AugmentedLagrangian(hessian="gauss-newton").solve(*ecg2o(s), check=True).iterations for s in STARTS]
    assert np.mean(counts) < 0.8 * np.mean(rough), rough
    for build in (pose_beside_disc, ecg2o_inequality):
        graph, guess = build()
        solution = AugmentedLagrangian().solve(graph, guess, check=True)
        assert judge(graph, solution).worst() < 2e-6
        assert solution.iterations <= 12


def test_flights_among_cylinders() -> None:
    """Layouts where Gauss-Newton's Hessian crawled to the limit, and one that is easy."""
    stated = [flight(seed).formulation() for seed in (0, 5, 16)]
    crawled, easy, _ = (AugmentedLagrangian().solve(one.graph, one.guess, check=True) for one in stated)
    assert crawled.cost < 330.0 and easy.iterations <= 20


def past_discs(offset: float) -> tuple[fg.Graph, dict[fg.Family, Array]]:
    """A unicycle past three discs, ``offset`` metres east and north of the origin."""
    count, dt, origin = 30, 0.2, np.array([offset, offset])
    graph, x, u = graph_of(("x", fg.SE2, count + 1), ("u", fg.Rn(2), count))
    start, goal = np.array([*origin, 0.0]), np.array([offset + 4.5, offset + 0.3, 0.2])
    graph.fix(x[0], start)
    graph.minimize(unicycle.tracking, x[-1], goal, sigma=0.1)
    graph.minimize(fg.prior, u, [0.0, 0.0], sigma=2.0)
    graph.minimize(unicycle.rate, u[:-1], u[1:], sigma=1.0)
    graph.constrain(unicycle.dynamics, x[:-1], u, x[1:], dt, lower=0.0, upper=0.0, name="dynamics")
    graph.bound(u, lower=[-1.2, -1.5], upper=[1.2, 1.5], name="limits")
    centres, radii = np.array([[1.2, -0.1], [2.4, 0.35], [3.5, -0.15]]), np.array([0.4, 0.35, 0.4])
    graph.constrain(obstacles.disc_clearance, x[1:], centres + origin, radii, lower=0.0, name="discs")
    share = np.linspace(0.0, 1.0, count + 1)[:, None]
    return graph, {x: start + share * (goal - start), u: np.tile([0.75, 0.0], (count, 1))}


@pytest.mark.parametrize("hessian", ["exact", "gauss-newton"])
def test_map_coordinates_change_nothing(hessian: Literal["exact", "gauss-newton"]) -> None:
    """Rounding of a clearance at 5000 km is 1e-9 m, and rho makes 1e-3 of that: no multiplier may come from it."""
    solver = AugmentedLagrangian(hessian=hessian)
    near = solver.solve(*past_discs(0.0), check=True)
    for offset in (1e3, 1e5, 5e6):
        far = solver.solve(*past_discs(offset), check=True)
        assert abs(far.iterations - near.iterations) <= 2, offset
        assert far.cost == pytest.approx(near.cost, rel=1e-6)


@pytest.mark.parametrize("build", [lambda: ecg2o((1.0, 1.0)), lambda: short_drive(disc=True)], ids=["ecg2o", "drive"])
def test_the_literal_loop_is_that_of_the_paper(build: Callable[[], tuple[fg.Graph, dict[fg.Family, Array]]]) -> None:
    """Algorithm of Bazzana, section VI, with dense algebra and the form of Powell, Hestenes and Rockafellar."""
    graph, guess = build()
    rho, steps = 10.0, 8
    rows = AugmentedLagrangian(
        schedule="bazzana", penalty=rho, max_iterations=steps, keep_values=True, tolerance=1e-300
    ).solve(graph, guess)
    program = graph.compile()
    values, multipliers = program.values_from(guess), np.zeros(program.constraints.count)
    for k in range(steps + 1):
        kept = rows.history[k].values
        assert kept is not None
        for family, array in kept.items():
            np.testing.assert_allclose(values[family], array, rtol=1e-8, atol=1e-10)
        lin = program.linearize(values)
        jacobian = program.costs.matrix(lin.jacobian).toarray()
        slopes = program.constraints.matrix(lin.constraint_jacobian).toarray()

        def after(g: Array, old: Array = multipliers) -> Array:
            above = np.maximum(old + rho * (g - program.upper), 0.0)
            return np.where(np.isfinite(program.upper), above, 0.0) + np.where(
                np.isfinite(program.lower), np.minimum(old + rho * (g - program.lower), 0.0), 0.0
            )

        ahead = after(lin.constraints)
        active = slopes[program.equality | (ahead != 0.0)]
        gradient = jacobian.T @ lin.residual + slopes.T @ ahead
        step = -np.linalg.solve(jacobian.T @ jacobian + rho * active.T @ active, gradient)
        values = program.retract(values, step)
        multipliers = after(program.evaluate(values).constraints)


@pytest.mark.parametrize("penalty", [1.0, 10.0, 1e2, 1e3])
@pytest.mark.parametrize("start", STARTS)
def test_the_damped_loop_of_the_paper_takes_every_start(start: Any, penalty: float) -> None:
    """Undamped it runs away from two of the six starts of ecg2o's second study, whatever its penalty."""
    graph, guess = ecg2o(start)
    solution = AugmentedLagrangian(schedule="bazzana-damped", penalty=penalty).solve(graph, guess, check=True)
    assert judge(graph, solution).worst() < 2e-6
    assert {row.details["penalty"] for row in solution.history[1:]} == {penalty}


@pytest.mark.parametrize("penalty", [1.0, 3.0, 10.0, 1e3, 1e4])
def test_the_damped_loop_of_the_paper_does_not_run_away(penalty: float) -> None:
    """His manoeuvre: full steps diverge from a penalty of 1 to 3 on; damped ones converge where it is large enough."""
    graph, x, _, guess = state_problem(CASES["behind"], ManoeuvreSettings())
    solution = AugmentedLagrangian(schedule="bazzana-damped", penalty=penalty).solve(graph, guess)
    assert solution.converged == (penalty >= 1e3), solution.report()
    assert np.abs(solution[x][:, :2]).max() < 5.0
    assert solution.violation < 0.5
    if penalty >= 10.0:
        literal = AugmentedLagrangian(schedule="bazzana", penalty=penalty).solve(graph, guess)
        assert literal.history[-1].violation > 1e3
        assert literal.violation <= literal.history[0].violation  # handed back is the best of it


Schedule: TypeAlias = Literal["bcl", "bazzana", "bazzana-damped"]


@pytest.mark.parametrize(
    ("schedule", "penalty", "remedy"),
    [("bazzana-damped", 10.0, "a larger penalty"), ("bazzana", 10.0, "schedule='bazzana-damped'"),
     ("bazzana-damped", 1e4, None), ("bcl", 10.0, None)],
)  # fmt: skip
def test_a_constant_penalty_that_does_not_do_is_named_once(
    schedule: Schedule, penalty: float, remedy: str | None, caplog: pytest.LogCaptureFixture
) -> None:
    """The manoeuvre of the test above needs 1e3; after twenty steps without a lower violation the loop says so."""
    graph, _, _, guess = state_problem(CASES["behind"], ManoeuvreSettings())
    solution = AugmentedLagrangian(schedule=schedule, penalty=penalty).solve(graph, guess)
    assert solution.converged == (remedy is None)
    said = [record.getMessage() for record in caplog.records if "constant penalty" in record.getMessage()]
    assert len(said) == (remedy is not None)
    if remedy is not None:
        lowest = float(re.findall(r"below ([\d.e-]+)", said[0])[0])
        violations = [row.violation for row in solution.history]
        assert f"penalty {penalty:g} " in said[0] and f"; {remedy} may do" in said[0]
        assert re.search(r"of '(\w+)' \(factor \d+\)", said[0])[1] in {term.name for term in graph.terms}  # type: ignore[index]
        assert any(v == pytest.approx(lowest, rel=0.05) and min(violations[k : k + 21]) > 0.9 * lowest * 0.95
                   for k, v in enumerate(violations[:-20]))  # fmt: skip


def test_a_constant_penalty_that_does_is_not_named_for_rounding(caplog: pytest.LogCaptureFixture) -> None:
    """A guess that keeps the constraint is no lower violation to be reached again: what is left then is rounding."""
    graph, x = drawn_to([0.1])
    graph.constrain(lambda x: x**2 - 2.0, x, lower=0.0, upper=0.0)
    backend = AugmentedLagrangian(schedule="bazzana", penalty=1e3, tolerance=1e-300, max_iterations=100)
    solution = backend.solve(graph, {x: [[np.sqrt(2.0)]]})
    assert solution.iterations > 50 and solution.violation < 1e-9
    assert not [record for record in caplog.records if "constant penalty" in record.getMessage()]


def test_a_constant_penalty_that_does_is_not_named_after_a_guess_that_keeps_every_constraint(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """The violation jumps from nothing and falls from then on, here by a fourth a step."""
    graph, x = drawn_to([0.1])
    graph.bound(x, lower=1.0)
    backend = AugmentedLagrangian(schedule="bazzana-damped", penalty=0.3)
    solution = backend.solve(graph, {x: [[2.0]]})
    violations = np.array([row.violation for row in solution.history])
    assert solution.converged and solution.iterations > 25 and violations[0] == 0.0 and np.ptp(violations[1:]) > 0.1
    assert (np.diff(violations[1:]) < 0.0).all()
    assert not [record for record in caplog.records if "constant penalty" in record.getMessage()]


def test_the_damped_loop_that_cannot_move_says_so() -> None:
    graph, x = drawn_to([0.0])
    graph.constrain(fg.prior, x, [1.0], lower=0.0, upper=0.0, name="one")
    graph.constrain(fg.prior, x, [2.0], lower=0.0, upper=0.0, name="two")
    backend = AugmentedLagrangian(schedule="bazzana-damped", penalty=10.0, keep_values=True)
    solution = backend.solve(graph, {x: [[0.0]]})
    assert not solution.converged
    last = solution.history[-1].values
    assert last is not None and last[x].item() == pytest.approx(1.5, abs=1e-3)


UNITS = [("position", 1e6), ("position", 1e-6), ("angle", 1e4), ("control", 1e6), ("dynamics", 1e4), ("clearance", 1e4)]


@pytest.mark.parametrize(("what", "unit"), UNITS)
def test_units_of_variables_and_rows_are_free(what: str, unit: float) -> None:
    """Newton's steps and Marquardt's damping have no unit; the goals of a subproblem do, and cost iterations."""
    units: dict[str, Any] = {what: unit}
    solution = AugmentedLagrangian().solve(*drive(**units), check=True)
    assert solution.cost == pytest.approx(1.70, abs=0.01)
    assert solution.iterations <= 120


def test_a_large_penalty_does_not_multiply_the_rounding_of_the_rows() -> None:
    """Multipliers balance the gradient after one step from the answer, though 1e10 times the rounding of a row is 1e-6.

    Limits of one are where that shows; at zero there is nothing to round.
    """
    graph, p = graph_with(fg.Rn(2), 20, "p")
    graph.minimize(fg.between, p[:-1], p[1:], [0.3, 0.1])
    graph.minimize(fg.prior, p, [0.0, 0.0], sigma=3.0)
    graph.constrain(lambda v: (v**2).sum(axis=1, keepdims=True), p, lower=1.0, upper=1.0, name="rim")
    angles = np.linspace(0.0, 1.0, 20)
    guess = {p: np.stack([np.cos(angles), np.sin(angles)], axis=1)}
    solution = SQP(tolerance=1e-10, hessian="exact").solve(graph, guess)
    program = graph.compile()
    lin, primal = program.linearize(program.values_from(solution.values)), Primal(program)
    multipliers, penalty = solution.dual("rim").ravel() + 1e-7, np.full(20, 1e10)
    found = model_step(primal, lin, multipliers, penalty, 0.0, primal.bend(lin, multipliers))
    assert found is not None
    expected = primal.expected_multipliers(lin, found[0], multipliers, penalty, lin.constraints)
    assert primal.slope(lin, expected) < 1e-8
    np.testing.assert_allclose(expected, solution.dual("rim").ravel(), atol=1e-8)


def test_a_row_that_is_flat_at_the_start_gets_no_lasting_weight() -> None:
    """The square of a thrust that is hardly on says nothing of its scale, which shows near the limit."""
    graph, u = graph_with(fg.Rn(2), 10, "u")
    graph.minimize(fg.prior, u, [3.0, 1.0])
    graph.constrain(lambda v: (v**2).sum(axis=1, keepdims=True), u, upper=1.0, name="push")
    guess = {u: np.full((10, 2), 1e-3)}
    solution = AugmentedLagrangian().solve(graph, guess, check=True)
    plain = AugmentedLagrangian(scaling=False).solve(graph, guess, check=True)
    assert solution.iterations <= plain.iterations + 2
    assert solution.penalties["push"].max() <= 10.0 * plain.penalties["push"].max()


def test_no_steps_are_taken_at_what_rounding_leaves_of_a_gradient() -> None:
    """A goal 1 % too far: rho rises to 5e7 and the gradient it multiplies cannot reach the tolerance any more."""
    graph, guess = goal_too_far(0.01)
    solution = AugmentedLagrangian().solve(graph, guess)
    assert solution.status is fg.Status.LOCALLY_INFEASIBLE, solution.report()
    lengths = [row.step_norm for row in solution.history[1:]]
    assert sum(length < 1e-10 for length in lengths) <= 5, lengths
    assert solution.iterations <= 18


def test_a_trace_that_is_given_up_between_two_solves_is_left_to_python() -> None:
    factor = np.array([1.0])

    def own(v: Array) -> Array:
        if factor[0] > 2.0:
            return np.array([[factor[0] * float(row[0]) - 1.0] for row in v])
        return np.asarray(factor[0] * v[:, :1] - 1.0)

    graph, x = graph_with(fg.Rn(2))
    graph.minimize(own, x, name="own")
    graph.minimize(fg.prior, x, [0.0, 0.0])
    graph.constrain(lambda p: (p**2).sum(axis=1, keepdims=True), x, upper=4.0, name="disc")
    run = AugmentedLagrangian().prepare(graph)
    assert run.solve({x: [[1.0, 1.0]]}, check=True)[x][0, 0] == pytest.approx(0.5, abs=1e-6)
    factor[0] = 3.0
    assert run.solve({x: [[1.0, 1.0]]}, check=True)[x][0, 0] == pytest.approx(0.3, abs=1e-6)


def test_rows_that_become_equalities_are_so_for_the_compiled_steps() -> None:
    """A prepared solver that has seen other limits goes the way of one that has not, iterate by iterate."""

    def stated() -> tuple[fg.Graph, dict[fg.Family, Array], fg.Data]:
        graph, upper = fg.Graph(), 0.0
        p = graph.variables("p", fg.Rn(2), 5)
        top = graph.data("top", upper)
        graph.minimize(fg.prior, p, np.stack([np.linspace(-1.0, 1.0, 5), np.ones(5)], axis=1), sigma=0.5)
        graph.constrain(lambda x: x[:, 1:] - x[:, :1] ** 2, p, lower=0.0, upper=top, name="curve")
        return graph, {p: np.full((5, 2), 0.3)}, top

    graph, guess, top = stated()
    run = AugmentedLagrangian().prepare(graph)
    for limit in (0.0, np.inf, 0.0, 0.5):
        found = run.solve(guess, data={top: limit}, check=True)
        graph, again, other = stated()
        fresh = AugmentedLagrangian().prepare(graph).solve(again, data={other: limit}, check=True)
        assert [row.cost for row in found.history] == [row.cost for row in fresh.history]


def test_the_largest_penalty_is_that_of_the_costs() -> None:
    """With curvatures of 1e10 a penalty of 1e10 left violations of centimetres, and solves ended STALLED."""
    for seed in range(6):
        graph, guess = weighed_chain(seed, 1e-5)
        solution = AugmentedLagrangian().solve(graph, guess, check=True)
        best = InteriorPoint().solve(graph, guess, check=True).cost  # a violation of 1e-6 is worth 1e-5 of it
        assert solution.cost == pytest.approx(best, rel=1e-4)
