"""Plain functions as users write them: traced where that is right, left alone where not, never wrong in silence."""

import copy
import functools
import logging
import math
import re
import types
from collections.abc import Callable
from typing import Any, NamedTuple

import numba
import numpy as np
import pytest

import unifg as fg
from problems.graphs import graph_of, graph_with
from unifg.errors import GraphError
from unifg.problem import term
from unifg.problem.hessian import lagrangian_hessian
from unifg.solvers import SQP, GaussNewton, InteriorPoint
from unifg.typing import Array

Function = Callable[..., Any]
N = 6
TARGETS = np.random.default_rng(0).normal(size=(N, 3))
GAIN = 2.0


def stated(function: Any, *arguments: Any, manifold: Any = None, count: int = N) -> tuple[fg.Graph, fg.Family]:
    """A graph of one cost of every variable."""
    graph, x = graph_with(manifold or fg.Rn(3), count)
    graph.minimize(function, x, *arguments, name="term")
    return graph, x


def solved(function: Any, *arguments: Any, **options: Any) -> tuple[str, Array]:
    """Route by which the one term was evaluated after a solve, and the answer."""
    graph, x = stated(function, *arguments, **options)
    start = np.tile(x.manifold.identity(), (x.count, 1))
    solution = GaussNewton().solve(graph, {x: x.manifold.retract(start, np.full((x.count, x.manifold.dim), 0.1))})
    return graph.compile().terms[0].route, solution[x]


# ---------------------------------------------------------------- arguments


@pytest.mark.parametrize("each", [True, False])
def test_constants_are_read_as_the_function_means_them(each: bool) -> None:
    """As many rows as factors may be a row for each, or one matrix for all."""
    square = np.random.default_rng(1).normal(size=(3, 3)) + 3.0 * np.eye(3)
    function: Function = (lambda x, t: x - t) if each else (lambda x, t: x @ t - 1.0)
    route, found = solved(function, square, count=3)
    assert route.startswith("traced")
    expected = square if each else np.tile(np.linalg.solve(square.T, np.ones(3)), (3, 1))
    np.testing.assert_allclose(found, expected, atol=1e-9)


@pytest.mark.parametrize(
    ("function", "arguments"),
    [
        (lambda x, t: x - t, (TARGETS,)),
        (lambda x, t: x - t[0], (TARGETS[:1],)),
        (lambda x, t: x - t, (TARGETS[0],)),
        (lambda x, t: x - t, (0.3,)),
        (lambda x, t: x - t, (3,)),
        (lambda x, k: x ** np.arange(1, k + 1) - 0.2, (3,)),
        (lambda x, t: x - t, ([0.1, 0.2, 0.3],)),
        (lambda x, which: x[:, which] - 1.0, (np.array([2, 0, 1]),)),
        (lambda x, which: x - (1.0 if which == "one" else 2.0), ("one",)),
        (lambda x, t, s: x * s[:, None] - t, (TARGETS, np.arange(1.0, N + 1))),
        (lambda x, R, t: np.einsum("nij,nj->ni", R, x) - t, (np.tile(2.0 * np.eye(3), (N, 1, 1)), 1.0)),
        (lambda x, t: list(x - t), (TARGETS,)),
        (functools.partial(lambda t, x: x - t, 0.5), ()),
        (lambda x, t=0.5: x - t, ()),
        (lambda x: GAIN * x - 1.0, ()),
        (lambda x: math.sqrt(2.0) * x - 1.0, ()),
    ],
)
def test_arguments_and_what_a_function_reaches_are_constants(function: Function, arguments: tuple[Any, ...]) -> None:
    route, found = solved(function, *arguments)
    assert route == "traced, its derivatives exact"
    residual = np.array(function(found, *arguments))
    assert np.abs(residual).max() < 1e-6


def test_an_element_of_a_group_may_be_a_constant() -> None:
    pose = np.array([1.0, 2.0, 0.3])
    route, found = solved(lambda x, y: fg.SE2.local(y, x), pose, manifold=fg.SE2)
    assert route.startswith("traced")
    np.testing.assert_allclose(found, np.tile(pose, (N, 1)), atol=1e-9)


@pytest.mark.parametrize(
    "length",
    [
        lambda x: np.linalg.norm(x, axis=1, keepdims=True),
        lambda x: np.sqrt((x**2).sum(axis=1, keepdims=True)),
        lambda x: np.hypot(np.hypot(x[:, :1], x[:, 1:2]), x[:, 2:]),
        lambda x: np.abs(x).sum(axis=1, keepdims=True),
    ],
)
def test_a_norm_is_flat_where_it_is_zero(length: Function) -> None:
    """Differences say so too; and guesses at rest are common."""
    graph, x = graph_with(fg.Rn(3), 2)
    graph.minimize(length, x)
    program = graph.compile()
    lin = program.linearize(program.values_from({x: np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 4.0]])}))
    assert program.terms[0].route.startswith("traced")
    expected = [1.0, 0.0, 1.0] if "abs" in length.__code__.co_names else [0.6, 0.0, 0.8]
    np.testing.assert_allclose(lin.jacobian.reshape(2, 3), [[0.0] * 3, expected], atol=1e-15)
    assert np.isfinite(lagrangian_hessian(program, lin, np.zeros(0))).all()


def test_derivatives_that_do_not_exist_at_the_guess_are_left_to_differences() -> None:
    graph, x = stated(lambda x: np.arctan2(x**3, np.abs(x) ** 3.5) * x)
    solution = GaussNewton().solve(graph, {x: np.zeros((N, 3))})
    assert "not finite at the guess (factor 0)" in graph.compile().terms[0].route and solution.cost == 0.0


def test_lambdas_made_in_a_loop_keep_what_they_mean() -> None:
    """All of them mean the last number, as anywhere in Python, unless it is a default."""
    graph, x = graph_with(fg.Rn(1), 3)
    for k in range(3):
        graph.minimize(lambda x, k=k: x - k, x[k])
        graph.minimize(lambda x: x - k, x[k])  # noqa: B023
    solution = GaussNewton().solve(graph, {x: np.zeros((3, 1))})
    np.testing.assert_allclose(solution[x].ravel(), [1.0, 1.5, 2.0], atol=1e-9)


def test_a_term_of_no_rows_says_nothing() -> None:
    graph, x = graph_with(fg.Rn(3), N)
    graph.minimize(lambda x: x - TARGETS, x)
    graph.minimize(lambda x: x[:, :0], x, name="no cost")
    graph.constrain(lambda x: x[:, :0], x, lower=0.0, name="no constraint")
    solution = InteriorPoint().solve(graph, {x: np.zeros((N, 3))}, check=True)
    np.testing.assert_allclose(solution[x], TARGETS, atol=1e-6)
    assert solution.dual("no constraint").shape == (N, 0)


def test_data_are_inputs_of_a_trace() -> None:
    graph, x = graph_with(fg.Rn(2), N)
    goal, rows = graph.data("goal", np.zeros(2)), graph.data("rows", np.zeros((N, 2)), each=True)
    switch = graph.data("switch", np.ones(N, dtype=bool), each=True)
    graph.minimize(lambda x, g, r, s: np.where(s[:, None], x - g - r, x), x, goal, rows, switch)
    prepared = GaussNewton().prepare(graph)
    address = prepared.program.terms[0].place.copy()
    for scale in (1.0, 2.0):
        given = {goal: np.full(2, scale), rows: scale * TARGETS[:, :2], switch: np.arange(N) % 2 == 0}
        found = prepared.solve({x: np.ones((N, 2))}, data=given)[x]
        np.testing.assert_allclose(found[::2], scale * (1.0 + TARGETS[::2, :2]), atol=1e-9)
        np.testing.assert_allclose(found[1::2], 0.0, atol=1e-9)
    np.testing.assert_array_equal(prepared.program.terms[0].place, address)


def test_a_decision_about_data_is_left_to_python() -> None:
    graph, x = graph_with(fg.Rn(1), 2)
    sign = graph.data("sign", 1.0)
    graph.minimize(lambda x, s: x - 1.0 if s > 0 else x + 1.0, x, sign)
    for value in (1.0, -1.0):
        solution = GaussNewton().solve(graph, {x: np.zeros((2, 1))}, data={sign: value})
        np.testing.assert_allclose(solution[x], value, atol=1e-9)
    assert "asks whether a number holds" in graph.compile().terms[0].route


# ---------------------------------------------------------------- functions of one factor, scalar costs


@numba.njit  # type: ignore[untyped-decorator]
def half_sine(a: float) -> float:
    return 0.5 * math.sin(a)


@numba.njit  # type: ignore[untyped-decorator]
def compiled(x: Array, target: Array, scale: float, r: Array) -> None:
    for k in range(3):
        r[k] = scale * (x[k] - target[k])
    r[0] += half_sine(x[0]) if x[0] > 0.0 else 0.5 * x[0]


@pytest.mark.parametrize("derivatives", [None, "differences"])
def test_functions_of_one_factor_are_traced_from_their_source(derivatives: Any) -> None:
    residual = fg.residual(compiled, rows=3, derivatives=derivatives)
    route, found = solved(residual, TARGETS, 2.0)
    assert route.startswith("compiled by Numba" if derivatives else "traced")
    r = np.empty(3)
    for x, target in zip(found, TARGETS, strict=True):
        compiled.py_func(x, target, 2.0, r)
        assert np.abs(r).max() < 1e-8


@numba.njit  # type: ignore[untyped-decorator]
def writing(x: Array, r: Array) -> None:
    x[0] = 1.0
    r[0] = x[0] - x[1]


@numba.njit  # type: ignore[untyped-decorator]
def forgetting(x: Array, r: Array) -> None:
    r[0] = x[0]


@numba.njit  # type: ignore[untyped-decorator]
def adding(x: Array, r: Array) -> None:
    r[0] += x[0]
    r[1] = x[1]


@pytest.mark.parametrize(
    ("function", "rows", "message"),
    [
        (writing, 1, "changes its argument 0"),
        (forgetting, 2, "does not write row 1 of factor 0"),
        (adding, 2, "does not write row 0 of factor 0"),
    ],
)
def test_functions_of_one_factor_are_refused_as_ever(function: Any, rows: int, message: str) -> None:
    with pytest.raises(GraphError, match=message):
        solved(fg.residual(function, rows=rows))


@pytest.mark.parametrize("derivatives", [None, "differences"])
def test_scalar_costs_have_exact_derivatives(derivatives: Any) -> None:
    graph, x = graph_with(fg.SE2, 3)
    top = graph.data("top", TARGETS[:3], each=True)
    graph.minimize_scalar(
        fg.residual(lambda x, top: np.cosh(fg.SE2.log(x) - top).sum(axis=1), derivatives=derivatives), x, top
    )
    prepared = SQP(hessian="exact", tolerance=1e-9).prepare(graph)
    for scale in (1.0, 0.5):
        solution = prepared.solve({x: np.zeros((3, 3))}, data={top: scale * TARGETS[:3]})
        if derivatives is None:
            np.testing.assert_allclose(fg.SE2.log(solution[x]), scale * TARGETS[:3], atol=1e-7)
            assert solution.rounding == 0.0 and solution.converged and solution.stationarity < 1e-9
        else:
            assert solution.rounding > 0.0
    assert prepared.program.terms[0].route.startswith("traced") == (derivatives is None)


# ---------------------------------------------------------------- what a trace cannot stand for


def branching(x: Array) -> Array:
    if x[0, 0] > 5.0:
        return x
    return 2.0 * x - 1.0


def printing(x: Array) -> Array:
    print("x")
    return x - 1.0


def trying(x: Array) -> Array:
    try:
        return np.asarray(np.sqrt(x) - 1.0)
    except ValueError:
        return x


def importing(x: Array) -> Array:
    import random

    return x - random.SystemRandom().choice([1.0])


class Model:
    """The usual way to write a robot: parameters in attributes, functions in methods."""

    gain = 2.0

    def __init__(self) -> None:
        self.mass, self.offset, self.options = 1.0, np.ones(3), {"scale": [1.0]}
        self.count, self.log, self.draw = 0, list[Any](), np.random.default_rng(0)

    @property
    def scale(self) -> float:
        return self.options["scale"][0]

    @staticmethod
    def scaled(x: Array, by: float) -> Array:
        r = np.zeros((len(x), 3))
        r[:, :] = by * x
        return r

    def residual(self, x: Array) -> Array:
        return self.scaled(x, self.gain * self.mass * self.scale) - self.offset

    def __call__(self, x: Array) -> Array:
        return self.residual(x)

    def counted(self, x: Array) -> Array:
        self.count += 1
        return x

    def logged(self, x: Array) -> Array:
        self.log.append(len(x))
        return x

    def overridden(self, x: Array) -> Array:
        return x - self.draw.normal()


SETTINGS = {"gain": 2.0}


def halved(self: Model, x: Array) -> Array:
    return 4.0 * x - self.offset


@pytest.mark.product(20)
@pytest.mark.parametrize("of", ["method", "call", "function"])
@pytest.mark.parametrize("derivatives", [None, "trace"])
@pytest.mark.parametrize(
    "change",
    [
        lambda m, patch: setattr(m, "mass", 2.0),
        lambda m, patch: m.offset.fill(0.5),
        lambda m, patch: setattr(m, "offset", np.full(3, 0.5)),
        lambda m, patch: m.options["scale"].__setitem__(0, 2.0),
        lambda m, patch: m.options.update(scale=[2.0]),
        lambda m, patch: patch.setattr(Model, "gain", 4.0),
        lambda m, patch: setattr(m, "gain", 4.0),
        lambda m, patch: patch.setattr(Model, "residual", halved),
        lambda m, patch: patch.setattr(Model, "scale", property(lambda self: 2.0)),
    ],
)
def test_attributes_are_watched(change: Function, derivatives: Any, of: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where a trace is asked for: nothing is frozen that the function reads."""
    model = Model()
    functions: dict[str, Function] = {"method": model.residual, "call": model, "function": lambda x: model.residual(x)}
    function = functions[of]
    graph, x = stated(fg.residual(function, derivatives=derivatives))
    prepared = GaussNewton().prepare(graph)
    np.testing.assert_allclose(prepared.solve({x: np.zeros((N, 3))})[x], 0.5, atol=1e-9)
    change(model, monkeypatch)
    found = prepared.solve({x: np.zeros((N, 3))})[x]
    if not (of == "method" and getattr(function, "__func__", None) is not Model.residual):  # a bound method is kept
        np.testing.assert_allclose(found, 0.25, atol=1e-9)
    assert prepared.program.terms[0].route == "traced, its derivatives exact"
    np.testing.assert_allclose(np.asarray(function(found)), 0.0, atol=1e-9)


def test_what_a_function_reaches_is_not_touched_by_its_trace() -> None:
    model = Model()
    assert "changes a list" in solved(model.logged)[0]
    assert all(isinstance(entry, int) for entry in model.log)


@pytest.mark.parametrize(
    ("function", "why"),
    [
        (branching, "test_traced_terms.py:"),
        (printing, "calls print()"),
        (trying, "handles exceptions"),
        (importing, "imports random"),
        (Model().counted, "it changes the attribute 'count'"),
        (Model().logged, "changes a list that it reaches"),
        (Model().overridden, "which may change"),
        (lambda x: x - np.random.normal(size=(1, 3)), "other numbers each time"),  # noqa: NPY002
        (lambda x: np.linalg.qr(np.eye(3) + 0.0 * x[:, None])[1][:, 0] + x, "np.linalg.qr"),
        (lambda x: x - np.arange(len(x))[:, None], "which factor they belong to"),
    ],
)
def test_what_is_not_traced_is_said(function: Function, why: str, caplog: pytest.LogCaptureFixture) -> None:
    term._told.clear()
    with caplog.at_level(logging.WARNING, "unifg"):
        for _ in range(2):
            route, _ = solved(function)
    assert route.startswith("evaluated by Python, its derivatives by differences: ") and why in route
    assert sum("term 'term' is evaluated by Python" in message for message in caplog.messages) == 1


@pytest.mark.parametrize("function", [branching, lambda x: x - np.arange(len(x))[:, None]])
def test_what_cannot_be_traced_is_an_error_when_asked(function: Function) -> None:
    with pytest.raises(GraphError, match="term 'term': cannot be traced: ") as raised:
        solved(fg.residual(function, derivatives="trace"))
    assert raised.value.term == "term"


def test_check_and_report_say_what_python_evaluates() -> None:
    graph, x = graph_with(fg.Rn(3), N)
    graph.minimize(branching, x, name="slow")
    graph.minimize(lambda x: x, x, name="fast")
    graph.minimize(fg.prior, x, np.zeros(3), name="shipped")
    report = graph.check({x: np.ones((N, 3))})
    assert report and str(report).splitlines()[0] == "nothing found"
    assert "term 'slow': evaluated by Python, its derivatives by differences: " in str(report)
    assert report.routes["fast"] == "traced, its derivatives exact"
    assert report.routes["shipped"].startswith("a kernel that ships")
    text = GaussNewton().solve(graph, {x: np.ones((N, 3))}).report()
    assert re.search(r" \d+ % of the time went into functions in Python: 'slow'\.", text), text
    graph, x = stated(lambda x: x)
    assert "in Python" not in GaussNewton().solve(graph, {x: np.ones((N, 3))}).report()


def test_differences_when_asked() -> None:
    route, _ = solved(fg.residual(lambda x: x - 1.0, derivatives="differences"))
    assert route == "evaluated by Python, its derivatives by differences: as it was asked to be"


@pytest.mark.parametrize(
    "function",
    [
        lambda x: x - x.mean(axis=0) + 0.1 * x,
        lambda x: 2.0 * x - x[0],
        lambda x: 2.0 * x - np.roll(x, 1, axis=0),
        lambda x: x / np.abs(x).max(),
    ],
)
def test_rows_that_depend_on_other_factors_are_an_error(function: Function) -> None:
    """Their derivatives were wrong however they were found."""
    with pytest.raises(GraphError, match=r"term 'term': the rows of factor \d change when") as raised:
        solved(function)
    assert raised.value.term == "term" and raised.value.index is not None


def test_the_first_row_of_a_shared_variable_is_everybody_s() -> None:
    graph, x, centre = graph_of(("x", fg.Rn(2), N), ("c", fg.Rn(2), 1))
    graph.minimize(lambda x, c: x - c[0] - TARGETS[0, :2], x, centre)
    graph.minimize(lambda c: c - 1.0, centre)
    solution = GaussNewton().solve(graph, {x: np.zeros((N, 2)), centre: np.zeros((1, 2))})
    np.testing.assert_allclose(solution[x] - TARGETS[0, :2], 1.0, atol=1e-9)
    assert all(term.route.startswith("traced") for term in graph.compile().terms)


def test_a_table_of_rows_that_matters_far_away_only_is_seen() -> None:
    """About the origin nothing is amiss: a table of the function's own begins elsewhere."""

    def far(x: Array) -> Array:
        return np.asarray(x - 100.0 + np.maximum(x - 50.0, 0.0) * np.arange(len(x))[:, None] * 0.01)

    graph, x = stated(far)
    assert "which factor they belong to" in graph.compile().terms[0].route
    solution = InteriorPoint().solve(graph, {x: np.full((N, 3), 90.0)})
    assert np.abs(far(solution[x])).max() < 1e-5
    with pytest.raises(GraphError, match="cannot be traced"):
        stated(fg.residual(far, derivatives="trace"))[0].compile()


@pytest.mark.parametrize("derivatives", [None, "trace", "differences"])
def test_arguments_belong_to_the_solver(derivatives: Any) -> None:
    def shifting(x: Array) -> Array:
        x -= 1.0
        return x

    with pytest.raises(GraphError, match="changes its argument 0"):
        solved(fg.residual(shifting, derivatives=derivatives))


@pytest.mark.parametrize("derivatives", [None, "trace"])
def test_coarse_numbers_are_refused_as_ever(derivatives: Any) -> None:
    with pytest.raises(GraphError, match="returned float32"):
        solved(fg.residual(lambda x: (x - 1.0).astype(np.float32), derivatives=derivatives))


# ---------------------------------------------------------------- the same answers as by differences


@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_derivatives_do_not_mind_where_the_origin_is(offset: float) -> None:
    beacons = np.array([[3.0, 4.0], [-2.0, 1.0], [0.5, -3.0]]) + offset
    ranges = np.array([5.0, 2.2, 3.1])
    graph, x = graph_with(fg.Rn(2), 3)
    graph.minimize(lambda x, b, r: np.linalg.norm(x - b, axis=1, keepdims=True) - r[:, None], x, beacons, ranges)
    graph.minimize(lambda x: x - offset, x, sigma=10.0)
    program = graph.compile()
    lin = program.linearize(program.values_from({x: np.full((3, 2), offset + 0.25)}))
    away = offset + 0.25 - beacons
    expected = away / np.linalg.norm(away, axis=1, keepdims=True)
    np.testing.assert_allclose(lin.jacobian[:6].reshape(3, 2), expected, rtol=1e-14)


@pytest.mark.parametrize("kind", ["data", "constant", "named"])
@pytest.mark.parametrize(
    ("function", "first"),
    [
        (lambda x, t: x - t, np.zeros(3)),
        (lambda x, t: t * (x - 1.0) + x, np.ones(3)),
        (lambda x, t: x @ t - 1.0, np.zeros((3, 3))),
        (lambda x, t: x - t, np.zeros((3, 3))),
        (lambda x, t: x - t[0], np.zeros((3, 3))),
        (lambda x, t: x - t.mean(axis=0), np.zeros((3, 3))),
    ],
)
def test_equal_rows_do_not_say_whether_they_belong_to_factors(function: Function, first: Array, kind: str) -> None:
    """As many as factors; what stands in them later does."""
    graph, array = fg.Graph(), first.copy()
    x = graph.variables("x", fg.Rn(3), 3)
    datum = graph.data("t", array)
    if kind == "named":
        graph.minimize(lambda x: function(x, array), x)
    else:
        graph.minimize(function, x, datum if kind == "data" else array)
    prepared = GaussNewton().prepare(graph)
    start = {x: np.zeros((3, 3))}
    prepared.solve(start)
    array[...] = np.random.default_rng(1).uniform(1.0, 2.0, first.shape)
    found = prepared.solve(start, data={datum: array})[x]
    again, y = graph_with(fg.Rn(3), 3)
    again.minimize(fg.residual(function, derivatives="differences"), y, array)
    np.testing.assert_allclose(found, GaussNewton().solve(again, {y: np.zeros((3, 3))})[y], atol=1e-6)


def test_equal_elements_of_a_group_stay_elements() -> None:
    """The logarithm of what is none is not what a trace computes."""
    same, group = np.tile(fg.SE3.identity(), (4, 1)), fg.SE3
    route, _ = solved(lambda x, t: group.log(group.compose(group.inverse(t), x)), same, manifold=group, count=4)
    assert route.startswith("traced")


class Gains(NamedTuple):
    """A record whose property is not its own."""

    gain: float = 1.0

    @property
    def present(self) -> float:
        """The present one."""
        return float(box.far)


def _late(x: Array) -> Array:
    """Asks a module for what the function that calls it does not."""
    return x * float(box.far)


def _early(x: Array) -> Array:
    return float(box.near) * _late(x) - 1.0


box = types.ModuleType("box")
GAINS = Gains()
COPIED = (list, dict, tuple, types.SimpleNamespace, np.ndarray)


def _again(x: Array, gain: float = 2.0) -> Array:
    return x * gain - 1.0


def _outer(x: Array) -> Array:
    return _again(x)


@pytest.mark.parametrize(
    ("function", "first", "change"),
    [
        (_early, None, lambda _: setattr(box, "far", 5.0)),
        (lambda x: SETTINGS["gain"] * x - 1.0, None, lambda _: SETTINGS.update(gain=5.0)),
        (lambda x: GAIN * x - 1.0, None, lambda _: globals().update(GAIN=5.0)),
        (lambda x, t: x * t - 1.0, np.full((N, 3), 2.0), lambda t: t.fill(5.0)),
        (lambda x: x * GAINS.present - 1.0, None, lambda _: setattr(box, "far", 5.0)),
        (lambda x: x * getattr(box, "far") - 1.0, None, lambda _: setattr(box, "far", 5.0)),  # noqa: B009
        (_outer, None, lambda _: setattr(_again, "__defaults__", (5.0,))),
        (lambda x, t: x * t[0] - 1.0, [2.0], lambda t: t.__setitem__(0, 5.0)),
        (lambda x, t: x * t["k"][0] - 1.0, {"k": [2.0]}, lambda t: t["k"].__setitem__(0, 5.0)),
        (lambda x, t: x * t[0] - 1.0, (np.array([2.0]),), lambda t: t[0].fill(5.0)),
        (lambda x, t: x * t.k - 1.0, types.SimpleNamespace(k=2.0), lambda t: setattr(t, "k", 5.0)),
        (lambda x, t: t(x) - 1.0, lambda x: x * box.far, lambda _: setattr(box, "far", 5.0)),
        (lambda x, t: x * t.present - 1.0, GAINS, lambda _: setattr(box, "far", 5.0)),
        (lambda x, t: x * t.far - 1.0, box, lambda _: setattr(box, "far", 5.0)),
    ],
)
def test_what_changes_between_solves_is_noticed(
    function: Function, first: Any, change: Function, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(box, "far", 2.0, raising=False)
    monkeypatch.setattr(box, "near", 1.0, raising=False)
    monkeypatch.setattr(_again, "__defaults__", (2.0,))
    monkeypatch.setitem(SETTINGS, "gain", 2.0)
    monkeypatch.setitem(globals(), "GAIN", 2.0)
    given = copy.deepcopy(first) if isinstance(first, COPIED) else first
    graph, x = stated(function, *(() if given is None else (given,)))
    prepared = GaussNewton().prepare(graph)
    np.testing.assert_allclose(prepared.solve({x: np.zeros((N, 3))})[x], 0.5, atol=1e-6)
    change(given)
    np.testing.assert_allclose(prepared.solve({x: np.zeros((N, 3))})[x], 0.2, atol=1e-6)


@pytest.mark.parametrize("off", [np.zeros(()), np.zeros(1), np.zeros((), dtype=bool)])
def test_what_is_switched_off_is_looked_at_too(off: Array) -> None:
    """A row of another factor that counts for nothing yet."""
    graph, x = graph_with(fg.Rn(3), N)
    gain, target = graph.data("gain", off), graph.data("target", TARGETS, each=True)
    graph.minimize(lambda x, s, t: x - np.where(s, t[0], t), x, gain, target)
    prepared = GaussNewton().prepare(graph)
    np.testing.assert_allclose(prepared.solve({x: np.zeros((N, 3))})[x], TARGETS, atol=1e-6)
    found = prepared.solve({x: np.zeros((N, 3))}, data={gain: np.ones_like(off)})[x]
    np.testing.assert_allclose(found, np.tile(TARGETS[0], (N, 1)), atol=1e-6)
