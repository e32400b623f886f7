"""Changes between solves of what a function closes over; kernels that are shared, kept and carried."""

import copy
import pickle
from typing import Any

import numpy as np
import pytest

import unifg as fg
from problems.graphs import graph_with
from test_traced_terms import GAIN, TARGETS, Function, N, stated
from unifg.factors.autodiff.captured import captured_by
from unifg.factors.autodiff.derived import derived
from unifg.factors.autodiff.rows import Each, Shared
from unifg.factors.autodiff.symbols import TraceError
from unifg.problem.hessian import lagrangian_hessian
from unifg.problem.term import CHANGES
from unifg.solvers import GaussNewton, InteriorPoint
from unifg.typing import Array

# ---------------------------------------------------------------- what a function closes over may change


@pytest.mark.parametrize("rows", [3, N])
def test_arrays_that_a_function_closes_over_are_parameters(rows: int) -> None:
    """One row for each factor, or one array for all; nothing is compiled when they change."""
    target = np.zeros((rows, 3)) if rows == N else np.zeros(3)
    graph, x = stated(lambda x: x - target)
    prepared = GaussNewton().prepare(graph)
    kernel = prepared.program.terms[0].kernel
    for k in range(CHANGES + 3):
        target[:] = k + np.arange(3)
        np.testing.assert_allclose(prepared.solve({x: np.zeros((N, 3))})[x], target + np.zeros((N, 3)), atol=1e-9)
    assert prepared.program.terms[0].kernel is kernel and kernel is not None


def test_another_array_under_the_same_name_is_seen() -> None:
    target: Array = np.zeros((N, 3))

    def function(x: Array) -> Array:
        return np.asarray(x - target)

    graph, x = stated(function)
    prepared = GaussNewton().prepare(graph)
    for k in range(CHANGES + 3):
        target = TARGETS * k
        np.testing.assert_allclose(prepared.solve({x: np.zeros((N, 3))})[x], target, atol=1e-9)
    assert prepared.program.terms[0].route.startswith("traced")
    target = np.ones(3)
    np.testing.assert_allclose(prepared.solve({x: np.zeros((N, 3))})[x], 1.0, atol=1e-9)
    assert "changed its shape" in prepared.program.terms[0].route


def test_what_is_compiled_in_is_looked_at_before_each_solve() -> None:
    target = (np.zeros(3), 1.0)
    graph, x = stated(lambda x: x * target[1] - target[0])
    prepared = GaussNewton().prepare(graph)
    for k in range(CHANGES + 3):
        target[0][:] = k
        np.testing.assert_allclose(prepared.solve({x: np.zeros((N, 3))})[x], k, atol=1e-9)
    assert "keeps changing" in graph.compile().terms[0].route


def test_a_straight_function_may_become_a_bent_one() -> None:
    power = 1.0

    def function(x: Array) -> Array:
        return np.asarray(x**power - 2.0)

    graph, x = graph_with(fg.Rn(1), 2)
    graph.constrain(function, x, lower=0.0, upper=0.0)
    graph.minimize(lambda x: x, x)
    prepared = InteriorPoint().prepare(graph)
    for power in (1.0, 2.0):
        solution = prepared.solve({x: np.ones((2, 1))})
        np.testing.assert_allclose(solution[x], 2.0 ** (1.0 / power), atol=1e-6)
    program, lin = prepared.program, solution._lin
    hessian = lagrangian_hessian(program, lin, np.ones(2))
    np.testing.assert_allclose(hessian, 1.0 + 2.0, atol=1e-12)


# ---------------------------------------------------------------- kernels are shared, kept and carried


def test_functions_that_compute_the_same_share_a_kernel() -> None:
    def offset(by: float) -> Function:
        return lambda x: x - by

    def kernel(function: Function) -> Any:
        return derived(function, (fg.Rn(2),), captured_by(function))

    one, same, other = kernel(offset(1.0)), kernel(offset(1.0)), kernel(offset(2.0))
    assert one is same and one is not other
    assert kernel(lambda x: 0.0 * x) is not kernel(lambda x: -0.0 * x)


def test_what_cannot_be_told_apart_is_not_shared() -> None:
    function = lambda x: x * (0.0 if DRAW is None else 2.0)  # noqa: E731
    assert derived(function, (fg.Rn(2),), captured_by(function)) is not derived(
        function, (fg.Rn(2),), captured_by(function)
    )


DRAW = np.random.default_rng(1)


def test_a_kernel_is_pickled_with_its_tape() -> None:
    function = lambda x, t: np.sin(x) * t  # noqa: E731
    kernel = derived(function, (fg.Rn(2), Each((2,))), captured_by(function))
    before = kernel.address
    copy = pickle.loads(pickle.dumps(kernel))
    assert "address" not in copy.__dict__
    x, t = TARGETS[:, :2], TARGETS[:, 1:]
    np.testing.assert_array_equal(copy(x, t), kernel(x, t))
    np.testing.assert_array_equal(copy.jacobian(x, t)[0], kernel.jacobian(x, t)[0])
    assert copy.address != before


OFFSET = np.arange(3.0)


def from_offset(x: Array) -> Array:
    return x - GAIN * OFFSET


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda thing: pickle.loads(pickle.dumps(thing))])
def test_programs_with_traces_are_copied(copied: Function, monkeypatch: pytest.MonkeyPatch) -> None:
    """Names watched by a program are watched by its copies too; a copy in another process finds its own names."""
    graph, x = stated(from_offset)
    prepared = GaussNewton().prepare(graph)
    solution = prepared.solve({x: np.zeros((N, 3))})
    twin = copied((prepared, solution, x))
    assert twin[1].cost == solution.cost
    np.testing.assert_array_equal(twin[0].solve({twin[2]: np.zeros((N, 3))})[twin[2]], solution[x])
    assert twin[0].program.terms[0].route.startswith("traced")
    np.testing.assert_allclose(solution[x], np.tile(GAIN * OFFSET, (N, 1)), atol=1e-9)
    monkeypatch.setitem(globals(), "GAIN", 3.0)
    np.testing.assert_allclose(twin[0].solve({twin[2]: np.zeros((N, 3))})[twin[2]][0], 3.0 * OFFSET, atol=1e-9)


def test_second_derivatives_wait_until_somebody_asks() -> None:
    graph, x = stated(lambda x: np.sin(x))
    program = GaussNewton().prepare(graph).program
    kernel = program.terms[0].kernel
    assert kernel is not None and "second_address" not in kernel.__dict__
    graph.constrain(lambda x: np.cos(x), x, upper=1.0)
    program = InteriorPoint().prepare(graph).program
    assert all(term.kernel is not None and "second_address" in term.kernel.__dict__ for term in program.terms)


def test_straight_rows_have_no_second_derivatives() -> None:
    function = lambda x, t: 3.0 * x - x[:, ::-1] * t  # noqa: E731
    assert derived(function, (fg.Rn(2), Shared(())), captured_by(function)).linear
    assert not derived(lambda x: x**2, (fg.Rn(2),), captured_by(lambda x: x**2)).linear


def test_a_function_that_would_take_seconds_to_compile_is_left_alone() -> None:
    def long(x: Array) -> Array:
        for _ in range(3000):
            x = np.sin(x) + x
        return x

    with pytest.raises(TraceError, match="numbers for one factor"):
        derived(long, (fg.Rn(1),), captured_by(long))
