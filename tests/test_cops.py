"""Costs that are no squares, and problems in other units of their cost."""

from typing import Any

import numpy as np
import pytest

import unifg as fg
from problems.control import Unicycle
from problems.cops import PROBLEMS, electrons
from problems.graphs import drawn_to, graph_of, graph_with
from problems.parkings import least_time
from problems.scaled import Units, scaled
from unifg.problem import units as measures
from unifg.solvers import SQP, AugmentedLagrangian, InteriorPoint
from unifg.solvers.interior_point.barrier import STUCK

NAMED = {problem.name: problem for problem in PROBLEMS}
TIMES = ("robot", "steering", "brachistochrone, squared")
OTHERS = ("chain", "catalyst", "orbit", "electrons", "cam", "rocket", "surface")


@pytest.mark.parametrize("name", (*TIMES, *OTHERS, "glider"))
def test_costs_without_squares_reach_the_literatures_optimum(name: str) -> None:
    problem = NAMED[name]
    graph, guess = problem.build()
    solution = InteriorPoint(tolerance=1e-8).solve(graph, guess, check=True)
    assert solution.cost == pytest.approx(problem.best, rel=1e-4)
    assert solution.iterations <= (600 if name == "glider" else 100)  # where IPOPT takes 633


CHANGES = {
    "cost x 1e-6": Units(cost=1e-6), "cost x 1e6": Units(cost=1e6), "rows x 1e-6": Units(rows=1e-6),
    "rows x 1e6": Units(rows=1e6), "unknowns x 1e-6": Units(unknowns=1e-6), "unknowns x 1e6": Units(unknowns=1e6),
    "terms reversed": Units(backwards=True), "offset": Units(offset=5e6),
}  # fmt: skip
CHAOTIC = ("glider", "catalyst")  # singular arcs, where rounding decides about the path
ROUNDED = ("pinene", "marine", "robot", "gas oil", "methanol")  # rows multiply the 1e-9 to which 5e6 is stored


@pytest.mark.product(14, of="changes of units")
@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("name", [name for name in NAMED if name not in CHAOTIC])
def test_units_change_neither_verdict_nor_path(name: str, change: str) -> None:
    units = CHANGES[change]
    plain, other = (
        InteriorPoint(feasibility_tolerance=1e-6 * u.rows).solve(*scaled(*NAMED[name].build(), u))
        for u in (Units(), units)
    )
    assert plain.converged
    assert other.cost / units.cost == pytest.approx(
        plain.cost, rel=1e-4 if units.offset or name in ("bearing", "rocket") else 1e-5
    )
    if units.offset and name in ROUNDED:
        assert other.converged or other.status is fg.Status.IMPRECISE
        assert other.iterations <= plain.iterations + 5 * STUCK, "the last digits are not waited for"
        return
    assert other.status is plain.status
    allowed = 10 if (name, change) == ("pinene", "terms reversed") else 0.2 * plain.iterations + 3
    assert abs(other.iterations - plain.iterations) <= allowed


def test_digits_that_are_not_there_are_not_waited_for() -> None:
    """Near 5e6 m a step is rounded to 1e-9: the solve repeated itself until its limit of a thousand iterations."""
    plain, far = (InteriorPoint().solve(*scaled(*NAMED["gas oil"].build(), Units(offset=o))) for o in (0.0, 5e6))
    assert plain.iterations <= 20 and far.iterations <= plain.iterations + 2 * STUCK
    assert far.status in (fg.Status.CONVERGED, fg.Status.IMPRECISE)
    assert far.cost == pytest.approx(plain.cost, rel=1e-4)


def test_a_long_way_to_a_root_is_gone_to_its_end() -> None:
    """Newton's steps of length one along an exponential: no cost changes on the way, the violation does."""
    graph, x = graph_with(fg.Rn(1))
    graph.constrain(lambda p: 1e20 * (np.exp(p) - np.exp(-60.0)), x, lower=0.0, upper=0.0, name="root")
    found = InteriorPoint().solve(graph, {x: [[0.0]]}, check=True)
    assert found.iterations > 1.5 * STUCK and found[x].item() == pytest.approx(-60.0)


@pytest.mark.parametrize("name", ["marine", "orbit"])  # with rows far apart, and without
def test_units_follow_what_a_graph_is_written_in(name: str) -> None:
    def found(units: Units) -> measures.Units:
        graph, guess = scaled(*NAMED[name].build(), units)
        program = graph.compile()
        lin = program.linearize(program.values_from(guess))
        memory = program.unit_memory()
        derivatives = lin.hessian, lin.concavity, lin.gradient, lin.jacobian, lin.constraints, lin.constraint_jacobian
        measures.find_units(program.arrays, memory, units.rows, *derivatives)
        return memory

    plain = found(Units())
    assert (np.ptp(plain.unknowns) > 0.0) == (name == "marine")
    for units in (Units(cost=1e5), Units(rows=1e5), Units(unknowns=1e5)):
        other = found(units)
        np.testing.assert_allclose(other.unknowns, units.unknowns * plain.unknowns, rtol=1e-9)
        ratio = other.rows / plain.rows
        assert np.isclose(ratio, units.rows, rtol=1e-9).sum() >= 0.4 * len(ratio)
        assert np.isin(np.round(ratio, 6), (units.rows, units.unknowns)).all(), "bounds have the units of unknowns"


def test_finer_mesh_takes_no_more_iterations() -> None:
    counts = []
    for steps in (200, 2000):
        finer: dict[str, Any] = {
            "dt": 5.0 / steps, "stage": Unicycle.stage * 50 / steps, "effort": Unicycle.effort * 50 / steps,
        }  # fmt: skip
        stated = type("Finer", (Unicycle,), finer)("straight", True, steps).formulation()
        solution = InteriorPoint().solve(stated.graph, stated.guess, check=True)
        counts.append(solution.iterations)
    assert counts[1] <= 1.2 * counts[0] + 3


def test_size_of_a_cost_is_a_mean_of_its_curvatures() -> None:
    free, places, ones = np.arange(3), np.arange(3), np.ones(3)

    def size(hessian: list[float], gradient: list[float], units: Any = ones, rest: Any = ()) -> float:
        known = measures.Units(places, free, places, ones, ones, np.ones((5, 3)), ones, units)
        return float(measures.cost_unit(known, np.array(hessian), np.array(rest), np.array(gradient)))

    assert size([1.0, 100.0, 0.0], [0.0, 0.0, 0.0]) == pytest.approx(10.0)
    assert size([1e-12, 1.0, 1.0], [0.0, 0.0, 0.0]) == pytest.approx(1e-4)  # a tiny regularisation
    assert size([1.0, 1.0, 1.0], [0.0, 1e6, 0.0]) == pytest.approx(1e3)
    assert size([0.0, 0.0, 0.0], [0.0, -3.0, 1.0]) == pytest.approx(12.0**0.5)
    assert size([0.0, 0.0, 0.0], [0.0, 0.0, 0.0]) == 1.0
    assert size([1.0, 100.0, 0.0], [0.0, 0.0, 0.0], np.array([1.0, 0.1, 1.0])) == pytest.approx(1.0)
    assert size([5.0, 100.0, 0.0], [0.0, 0.0, 0.0], rest=[-6.0, 0.0, 0.0]) == pytest.approx(10.0)
    assert size([3e200, 5e200, 4e200], [0.0, 0.0, 0.0]) == pytest.approx(60.0 ** (1 / 3) * 1e200)


def test_large_constant_weight_keeps_an_active_multiplier_below_the_penalty() -> None:
    graph, x = graph_with(fg.Rn(2))
    graph.minimize(lambda p: p[:, :1], x, sigma=1e3, name="faint")
    graph.minimize_scalar(lambda p: p[:, 1], x, name="height")
    graph.bound(x, lower=[-1.0, 0.0], name="box")
    solution = InteriorPoint().solve(graph, {x: [[0.5, 2.0]]}, check=True)
    np.testing.assert_allclose(solution[x], [[0.0, 0.0]], atol=1e-3)


def test_a_cost_of_rounding_at_the_start_is_no_measure() -> None:
    """A guess on the reference costs nothing, or what rounding leaves."""
    counts = []
    for offset in (0.0, 1e-14):
        graph, x, u = graph_of(("x", fg.Rn(2), 21), ("u", fg.Rn(2), 20))
        graph.minimize(fg.prior, u, np.full(2, 0.5 + offset), name="effort")
        graph.constrain(lambda a, u, b: b - a - 0.1 * u, x[:-1], u, x[1:], lower=0.0, upper=0.0, name="motion")
        graph.constrain(lambda a: ((a - [0.5, 0.55]) ** 2).sum(axis=1, keepdims=True), x[1:], lower=0.04, name="disc")
        graph.fix(x[0], np.zeros(2))
        line = 0.05 * np.arange(21.0)
        solution = InteriorPoint().solve(
            graph, {x: np.column_stack([line, line]), u: np.full((20, 2), 0.5)}, check=True
        )
        counts.append(solution.iterations)
    assert abs(counts[0] - counts[1]) <= 2


def test_augmented_lagrangian_begins_where_nothing_is_curved() -> None:
    graph, x = graph_with(fg.Rn(2))
    graph.minimize_scalar(lambda p: -p[:, 0], x, name="range")
    graph.constrain(lambda p: (p**2).sum(axis=1, keepdims=True), x, upper=1.0, name="disc")
    solution = AugmentedLagrangian().solve(graph, {x: [[0.0, 0.1]]}, check=True)
    np.testing.assert_allclose(solution[x], [[1.0, 0.0]], atol=1e-4)


@pytest.mark.parametrize("function", [np.exp, lambda x: x**3])
def test_interior_point_names_an_equality_that_loses_its_slope(function: Any) -> None:
    graph, x = drawn_to([-1.0])
    graph.constrain(function, x, lower=0.0, upper=0.0, name="flat")
    assert InteriorPoint().solve(graph, {x: [[1.0]]}).status is fg.Status.DEGENERATE


@pytest.mark.parametrize("callback", [None, lambda row: None])
def test_hessian_of_an_answer_is_that_of_gauss_newton(callback: Any) -> None:
    """The loop does without the convex part of each factor where nothing needs it; an answer has it."""
    graph, guess = electrons(6)
    found = InteriorPoint(tolerance=1e-8).solve(graph, guess, callback=callback)
    fresh = found._program.linearize(found.values)
    np.testing.assert_allclose(found._lin.hessian, fresh.hessian, atol=1e-10)
    np.testing.assert_allclose(found._lin.concavity, fresh.concavity, atol=1e-10)
    assert np.abs(fresh.concavity).max() > 0.1 and found.iterations <= 60


def test_steps_of_restoration_are_counted() -> None:
    """Two rows that contradict each other: the descent on the violation is no secret of the solver's."""
    graph, x = drawn_to([0.0, 0.0], sigma=1.0)
    graph.constrain(lambda x: (x**2).sum(axis=1, keepdims=True), x, upper=1.0, name="near")
    graph.constrain(lambda x: np.exp(x[:, :1]) - x[:, 1:], x, upper=-3.0, name="far")
    for solver in (InteriorPoint(), SQP()):
        found = solver.solve(graph, {x: [[3.0, 4.0]]})
        assert found.status is fg.Status.LOCALLY_INFEASIBLE
        assert found.restoration_steps > 0 and f"and {found.restoration_steps} steps of restoration" in found.report()
    assert "restoration" not in InteriorPoint().solve(*electrons(6)).report()


@pytest.mark.parametrize("name", ["orbit", "catalyst"])
def test_first_penalties_follow_slopes_of_scalar_costs(name: str) -> None:
    """Their values say nothing: a constant may be added to them."""
    found = []
    for constant in (0.0, 1e3):
        graph, guess = NAMED[name].build()
        graph.minimize_scalar(lambda v, c=constant: 0.0 * v[:, 0] + c, next(iter(guess))[0], name="constant")
        found.append(AugmentedLagrangian().solve(graph, guess, check=True))
        assert found[-1].cost - constant == pytest.approx(NAMED[name].best, rel=1e-4)
    assert found[0].iterations == found[1].iterations <= 70


def test_a_feasible_point_is_looked_for_before_equalities_become_elastic() -> None:
    """A cost that is a time has no other curvature than that of the constraints."""
    taken = {True: 0, False: 0}
    for seed in range(6):
        for restoration in taken:
            taken[restoration] += InteriorPoint(restoration=restoration).solve(*least_time(seed), check=True).iterations
    assert taken[True] < 0.5 * taken[False], taken


@pytest.mark.parametrize("hessian", ["auto", "exact"])
@pytest.mark.parametrize("cost", [1e-8, 1e-3, 1e3])
def test_the_unit_of_a_time_does_not_decide_over_sqp_on_the_graph(cost: float, hessian: str) -> None:
    solver = SQP(qp="graph", hessian=hessian)  # type: ignore[arg-type]  # one of its words
    found = [solver.solve(*least_time(seed, cost)) for seed in range(7)]
    assert all(solution.converged for solution in found), [solution.status for solution in found]


def test_squares_make_equalities_elastic_at_once() -> None:
    """A feasible point knows nothing of the cost: from there three of these drives end at more than twice the best."""
    case = Unicycle("straight", True, 50)
    stated = case.formulation()
    prepared = InteriorPoint(tolerance=1e-4).prepare(stated.graph)
    for states, controls in case.starts(20):
        solution = prepared.solve({stated.x: states, stated.u: controls}, check=True)
        assert solution.restoration_steps == 0 and solution.cost < 14.0
