"""Functions that assert something, raise exceptions or assign by masks, traced: the user's guarantee is kept."""

import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

import unifg as fg
from asserting import below, decides, edge, nested, newton, perhaps, spread
from problems.graphs import drawn_to, graph_with, smoother_with
from test_derive import curved, evaluated
from unifg.factors.autodiff.expression import Expression
from unifg.factors.autodiff.rates import rate
from unifg.factors.autodiff.rows import traced
from unifg.factors.autodiff.stated import StatedKernel
from unifg.factors.autodiff.symbols import TraceError
from unifg.lie import Rn
from unifg.solvers import SQP, AugmentedLagrangian, GaussNewton, InteriorPoint, LevenbergMarquardt
from unifg.typing import Array

Function = Callable[..., Any]
RNG = np.random.default_rng(11)
N = 3


# ---------------------------------------------------------------- masks


def ramps(x: Array) -> Any:
    y = np.zeros(x.shape)
    y[x > 0.0] = 1.0
    y[x < -1.0] = np.sqrt(-x[x < -1.0]) * 2.0 - np.array(0.5)
    y[x > 1.0] *= 3.0
    return y * x


def rows(x: Array) -> Any:
    y = 0.5 * x
    far = x[:, 0] > 0.5
    y[far] = [3.0, 4.0, 5.0]
    y[~far, 1] = 7.0
    y[far, 1:] += x[far, :2]
    y[(x[:, 1] < 0.0) & far, :2] = 0.0
    return y * x[:, :1]


def truths(x: Array) -> Any:
    near = np.zeros(x.shape, dtype=bool)
    near = near | (x < 0.3)
    near[x < -0.3] = False
    copied = x[near]
    x = x * 1.0
    x[:] = 2.0 * x
    y = np.ones(x.shape)
    y[near] = copied
    return y


MASKS = {"entries": ramps, "rows": rows, "truth values": truths}


@pytest.mark.parametrize("name", MASKS)
def test_masks_choose_as_numpy_does(name: str) -> None:
    function = MASKS[name]
    expression, nothing = traced(function, [Rn(3)]), np.zeros((1, 0))
    points = np.vstack([RNG.uniform(-2.0, 2.0, (200, 3)), [[0.0, -1.0, 1.0], [0.5, 0.0, -0.3]]])
    found, slopes = evaluated(expression, points, nothing)
    np.testing.assert_allclose(found, function(points), rtol=1e-14, atol=1e-15)
    h, generic, weights = 1e-6, slice(0, 200), RNG.normal(size=found.shape)
    bends = curved(expression, points, nothing, weights)
    for k, step in enumerate(h * np.eye(3)):
        numeric = (function(points + step) - function(points - step)) / (2.0 * h)
        np.testing.assert_allclose(slopes[generic, :, k], numeric[generic], atol=1e-6)
        ahead, behind = (evaluated(expression, points + sign * step, nothing)[1] for sign in (1, -1))
        bent = np.einsum("nm,nmd->nd", weights, (ahead - behind) / (2.0 * h))
        np.testing.assert_allclose(bends[generic, k], bent[generic], atol=1e-6)


def by_two(x: Array) -> Any:
    y = np.zeros(x.shape)
    y[x > 0.0] = x[x > 1.0]
    return y


def summed(x: Array) -> Any:
    return x - x[x > 0.0].sum()


def placed(x: Array) -> Any:
    y = np.zeros(x.shape)
    y[x > 0.0] = np.ones((4, 2))
    return y


def strange(x: Array) -> Any:
    y = np.zeros((len(x), 5))
    y[x > 0.0] = 1.0
    return y


@pytest.mark.parametrize(
    ("function", "words"),
    [
        (by_two, "brings entries together that two masks chose"),
        (summed, "asks the entries of a mask for sum; their number is not known yet"),
        (placed, "puts an array where a mask holds"),
        (strange, r"uses a mask of shape \(1, 3\) for an array of shape \(1, 5\)"),
        (lambda x: x[x > 0.0][0] + x, "takes some of the entries of a mask"),
        (lambda x: x + len(x[x > 0.0]), "asks how many entries a mask has"),
        (lambda x: np.sum(x[x > 0.0]) + x, "on the entries of a mask"),
        (lambda x: x[x > 0.0] + x, "computes with the entries of a mask and another array"),
        (lambda x: x[x > 0.0, [0, 1]], "uses a mask beside other indices than numbers and slices"),
        (lambda x: x[x[:, 0] > 0.0, x[0] > 0.0], "uses two masks at once"),
    ],
)
def test_masks_that_are_not_traced_are_named(function: Function, words: str) -> None:
    with pytest.raises(TraceError, match=words):
        traced(function, [Rn(3)])


# ---------------------------------------------------------------- assertions


def pulled(function: Any, count: int = N) -> tuple[fg.Graph, fg.Family, fg.Data]:
    graph, x = graph_with(fg.Rn(1), count)
    target = graph.data("target", np.zeros((count, 1)))
    graph.minimize(fg.prior, x, target, sigma=1.0, name="pull")
    graph.minimize(function, x, sigma=1.0, name="own")
    return graph, x, target


SOLVERS = [GaussNewton(), LevenbergMarquardt(), InteriorPoint(), SQP(), AugmentedLagrangian()]


@pytest.mark.parametrize("solver", SOLVERS, ids=lambda s: s.name)
def test_an_assertion_that_fails_at_an_answer_is_passed_on(solver: fg.Solver) -> None:
    """In whichever solve it does, verified or not; the trace stays, and the next answer is none the worse for it."""
    graph, x, target = pulled(below)
    run, guess = solver.prepare(graph), {x: np.full((N, 1), 0.1)}
    assert graph.check(guess).routes["own"] == "traced, its derivatives exact"
    for solves in range(12):
        assert run.solve(guess, data={target: np.full((N, 1), 1.9)}).converged
        if solves not in (0, 2, 5, 11):
            continue
        with pytest.raises(AssertionError, match="too far") as caught:
            run.solve(guess, data={target: [[0.0], [0.0], [4.0]]})
        told = "; ".join(caught.value.__notes__)
        assert "term 'own'" in told and "factor 2, whose first variable is x[2]" in told and "at the answer" in told
        reached = caught.value.reached  # type: ignore[attr-defined]
        assert not reached.converged and reached.status is fg.Status.INTERRUPTED
        np.testing.assert_allclose(reached[x].ravel(), [0.0, 0.0, 2.0], atol=1e-5)
        with pytest.raises(ValueError, match=r"far below: -20\.00"):
            run.solve(guess, data={target: [[-40.0], [0.0], [0.0]]})
    assert not run.program.left_to_python


def test_python_says_the_same() -> None:
    """Without a trace the exception comes from within the solve."""
    graph, x, target = pulled(fg.residual(below, derivatives="differences"))
    with pytest.raises(AssertionError, match="too far") as caught:
        GaussNewton().solve(graph, {x: np.full((N, 1), 0.1)}, data={target: [[0.0], [0.0], [4.0]]})
    assert "factor 2, whose first variable is x[2]" in "; ".join(caught.value.__notes__)


def test_a_factor_that_is_switched_off_asserts_too() -> None:
    """As in Python, where the function is called for the whole batch."""
    graph, x = drawn_to([1.9], N, sigma=1.0, name="pull")
    active = graph.data("active", np.ones(N, dtype=bool), each=True)
    graph.minimize(below, x, active=active, sigma=1.0, name="own")
    run = GaussNewton().prepare(graph)
    assert run.solve({x: np.zeros((N, 1))}).converged
    with pytest.raises(AssertionError, match="too far"):
        run.solve({x: np.zeros((N, 1))}, data={active: np.array([True, True, False])})


def test_an_answer_at_the_edge_of_an_assertion_stands() -> None:
    """Beside it the function raises, where verification would call it."""

    graph, x = graph_with(fg.Rn(1), N)
    graph.minimize(edge, x, name="own", sigma=1.0)
    graph.minimize(fg.prior, x, [5.0], sigma=1.0, name="pull")
    graph.bound(x, upper=1.0, name="bound")
    solution = SQP().solve(graph, {x: np.ones((N, 1))})
    assert solution.converged and solution.checked and not solution.mistraced
    np.testing.assert_allclose(solution[x], 1.0, atol=1e-9)


def test_a_demand_about_data_is_kept() -> None:
    def scaled(x: Array, gain: Any) -> Any:
        if np.any(gain <= 0.0):
            raise ValueError("gains must be positive")
        return x * gain

    graph, x = drawn_to([1.0], N, sigma=1.0, name="pull")
    gain = graph.data("gain", np.ones(1))
    graph.minimize(scaled, x, gain, sigma=1.0, name="own")
    run, guess = GaussNewton().prepare(graph), {x: np.zeros((N, 1))}
    assert graph.check(guess).routes["own"].startswith("traced") and run.solve(guess, data={gain: [2.0]}).converged
    with pytest.raises(ValueError, match="gains must be positive"):
        run.solve(guess, data={gain: [-2.0]})


def test_a_table_that_refuses_points_outside_is_traced_and_refuses_them_still() -> None:
    table = RegularGridInterpolator((np.linspace(-1.0, 1.0, 5),), np.linspace(-1.0, 1.0, 5) ** 3)
    graph, x, target = pulled(lambda x: table(x)[:, None] - x**3)
    run, guess = LevenbergMarquardt().prepare(graph), {x: np.zeros((N, 1))}
    assert graph.check(guess).routes["own"].startswith("traced")
    assert run.solve(guess, data={target: np.full((N, 1), 1.0)}).converged
    with pytest.raises(ValueError, match="out of bounds in dimension 0") as caught:
        run.solve(guess, data={target: [[0.0], [9.0], [0.0]]})
    assert "at factor 1, whose first variable is x[1]" in caught.value.__notes__


def test_every_assertion_is_about_the_row_it_is_about() -> None:
    expression = traced(nested, [Rn(2)])
    requirements = expression.requirements
    assert requirements is not None
    points = RNG.uniform(-4.0, 4.0, (300, 2))
    held, _ = evaluated(requirements, points, np.zeros((1, 0)))

    def stands(point: Array) -> bool:
        try:
            nested(point[None])
        except (ValueError, AssertionError):
            return False
        return True

    expected = np.array([stands(point) for point in points])
    assert 50 < expected.sum() < 250
    np.testing.assert_array_equal(held.all(axis=1), expected)


@pytest.mark.parametrize(
    ("function", "words"),
    [
        (decides, r"asserting\.py:LINE: asks whether a number holds"),
        (newton, "asks whether a number holds"),
        (perhaps, "asks whether a number holds"),
        (lambda x: below(np.full(x.shape, 9.0)), "AssertionError: too far"),
    ],
)
def test_decisions_are_no_assertions(function: Function, words: str) -> None:
    line = function.__code__.co_firstlineno + 2
    with pytest.raises(TraceError, match=words.replace("LINE", str(line))):
        traced(function, [Rn(2)])


def test_what_is_asserted_of_the_batch_as_a_whole_is_left_to_python() -> None:
    graph, x, _ = pulled(spread)
    route = graph.check({x: np.zeros((N, 1))}).routes["own"]
    assert route.startswith("evaluated by Python") and "asserts something about several factors together" in route


@pytest.mark.product(1, of="studies")
def test_smoothers_leave_functions_that_assert_to_python() -> None:
    smoother, x = smoother_with(fg.Incremental(), fg.Rn(1))
    smoother.minimize(below, x[0], sigma=1.0, name="own")
    smoother.minimize(fg.prior, x[0], [4.0], sigma=0.1, name="pull")
    with pytest.raises(AssertionError, match="too far"):
        for guess in ({x: [[0.0]]}, {}, {}, {}):  # it is called where the last update has led
            smoother.update(guess)


def test_a_kernel_that_asserts_is_refused() -> None:
    """Nothing calls it at an answer."""
    kernel = StatedKernel(below, (Rn(1),), rows=1, name="own")
    with pytest.raises(TraceError, match="the kernel 'own' asserts something"):
        _ = kernel.expression


def test_a_rate_is_refused_where_its_path_is() -> None:
    table = RegularGridInterpolator((np.linspace(-1.0, 1.0, 5),), np.linspace(-1.0, 1.0, 5))
    np.testing.assert_allclose(rate(lambda s, x: table(s + x), np.array([[0.3]])), 1.0)
    with pytest.raises(ValueError, match="out of bounds"):
        rate(lambda s, x: table(s + x), np.array([[1.3]]))


def test_a_trace_keeps_its_demands_when_it_is_copied() -> None:
    expression = traced(below, [Rn(1)])
    copied: Expression = pickle.loads(pickle.dumps(expression))
    assert copied.required == expression.required and copied.requirements is not None
    held, _ = evaluated(copied.requirements, np.array([[0.5], [1.5], [-7.0], [np.nan]]), np.zeros((1, 0)))
    np.testing.assert_array_equal(held.all(axis=1), [True, False, False, False])
