"""Every error of the library is one of its own and says where; Python's exceptions only where Python asks for them."""

from __future__ import annotations

import ast
import builtins
import pickle
import re
from collections.abc import Callable, Iterator

import numpy as np
import pytest

import unifg as fg
from own_manifolds import S2
from problems.graphs import graph_with
from problems.known import short_drive
from test_house import LIBRARY, name_of, text_of, tree_of
from unifg.elimination.factorization import Factorization
from unifg.elimination.symmetric import Symmetric
from unifg.files.ros_map import OccupancyMap
from unifg.modeling.factors import ManifoldResidual
from unifg.models import quadrotor
from unifg.models.distance_map import DistanceMap
from unifg.models.rkmk import integrator
from unifg.models.tableau import Tableau
from unifg.pose_graphs.generate import manhattan
from unifg.pose_graphs.residuals import chart_between, sighting
from unifg.solvers import SQP, GaussNewton
from unifg.typing import Array

EXCEPTIONS = {
    name for name, kind in vars(builtins).items() if isinstance(kind, type) and issubclass(kind, BaseException)
}


def plain(source: str) -> list[str]:
    """List where a source raises one of Python's own exceptions though Python does not ask for it."""

    def walk(node: ast.AST, function: str, handled: str) -> Iterator[str]:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            function = node.name
        if isinstance(node, ast.ExceptHandler):
            handled = ast.unparse(node.type) if node.type else ""
        if isinstance(node, ast.Raise) and node.exc is not None:
            called = node.exc.func if isinstance(node.exc, ast.Call) else node.exc
            name = called.id if isinstance(called, ast.Name) else ""
            asked = (
                name in ("NotImplementedError", "KeyboardInterrupt")
                or (name == "AttributeError" and function == "__getattr__")
                or (name == "TypeError" and function == "__reduce__")
                or (name == "ImportError" and handled == "ImportError")
            )
            if name in EXCEPTIONS and not asked:
                yield f"line {node.lineno}: {name} in {function or 'the module'}"
        for child in ast.iter_child_nodes(node):
            yield from walk(child, function, handled)

    return list(walk(tree_of(source), "", ""))


def test_no_plain_exception_is_raised() -> None:
    own = re.compile(rf"\braise ({'|'.join(EXCEPTIONS)})\b")
    raised = {name_of(path): plain(text_of(path)) for _, path in LIBRARY if own.search(text_of(path))}
    assert {name: found for name, found in raised.items() if found} == {}


@pytest.mark.parametrize(
    ("source", "count"),
    [
        ("def f(x):\n    raise ValueError(x)", 1),
        ("raise TypeError", 1),
        ("try:\n    f()\nexcept KeyError as error:\n    raise RuntimeError('no') from error", 1),
        ("def f(self, name):\n    raise AttributeError(name)", 1),
        ("def __getattr__(self, name):\n    raise AttributeError(name)", 0),
        ("try:\n    import yaml\nexcept ImportError as error:\n    raise ImportError('pip install') from error", 0),
        ("raise ImportError('no such backend')", 1),
        ("try:\n    f()\nexcept KeyError:\n    raise", 0),
        ("raise GraphError('x', term='dynamics')", 0),
    ],
)
def test_plain_exceptions_are_found(source: str, count: int) -> None:
    assert len(plain(source)) == count


def test_every_error_is_one_of_unifg_and_says_where() -> None:
    public = [getattr(fg, name) for name in fg.__all__]
    errors = [kind for kind in public if isinstance(kind, type) and issubclass(kind, Exception)]
    assert len(errors) >= 7
    for kind in errors:
        assert issubclass(kind, fg.UnifgError)
        if kind is not fg.NotConverged:
            error = kind("what", term="t", family="x", index=3)
            again = pickle.loads(pickle.dumps(error))
            assert (str(again), again.term, again.family, again.index) == ("what", "t", "x", 3)


def test_not_converged_is_an_error_of_unifg_and_names_the_worst_factor() -> None:
    graph, guess = short_drive()
    with pytest.raises(fg.UnifgError) as caught:
        SQP(max_iterations=1).solve(graph, guess, check=True)
    error = caught.value
    assert isinstance(error, fg.NotConverged) and isinstance(error, RuntimeError)
    assert error.solution.violation > 0.0 and error.solution.status is fg.Status.ITERATION_LIMIT
    assert (error.term, error.index) == error.solution.worst
    again = pickle.loads(pickle.dumps(error))
    assert (again.term, again.index, str(again)) == (error.term, error.index, str(error))


def test_not_converged_names_nothing_where_nothing_is_violated() -> None:
    graph, x = graph_with(fg.Rn(1))
    graph.minimize(lambda p: np.cosh(p - 3.0), x)
    graph.bound(x, lower=-1.0)
    with pytest.raises(fg.NotConverged) as caught:
        SQP(max_iterations=1).solve(graph, {x: [[0.0]]}, check=True)
    assert (caught.value.term, caught.value.index) == (None, None)


ON_VECTORS: list[tuple[ManifoldResidual, str]] = [
    (fg.between, "between needs a Lie group, found S2; use difference"),
    (chart_between, "chart_between needs poses in SE2 or SE3, found"),
    (sighting, "sighting needs poses in SE2 or SE3, found"),
]


@pytest.mark.parametrize(("function", "message"), ON_VECTORS, ids=[f.name for f, _ in ON_VECTORS])
def test_a_residual_on_the_wrong_manifold_names_term_and_family(function: ManifoldResidual, message: str) -> None:
    graph, x = graph_with(S2 if function is fg.between else fg.Rn(3), 2, "corner")
    with pytest.raises(fg.GraphError, match=f"'odometry': {message}.*'corner'") as caught:
        graph.minimize(function, x[0], x[1], np.zeros(3), name="odometry")
    assert (caught.value.term, caught.value.family) == ("odometry", "corner")


REFUSED: list[tuple[str, Callable[[], object], type[fg.UnifgError], str]] = [
    ("mass", lambda: quadrotor.Parameters(mass=-1.0), fg.ModelError, "mass"),
    ("grid", lambda: DistanceMap(np.zeros(3), 0.1, (0.0, 0.0, 0.0)), fg.ModelError, "grid"),
    ("method", lambda: integrator(fg.SE2, lambda x, u: u, "rk5"), fg.ModelError, "rk5"),  # type: ignore[arg-type]
    ("weights", lambda: Tableau("mine", 1, (0.5,), ((),)), fg.ModelError, "sum to 0.5"),
    ("walk", lambda: manhattan(1), fg.ModelError, "at least 2"),
    (
        "map",
        lambda: OccupancyMap(np.ones((2, 2), bool), np.ones((2, 2), bool), 0.1, (0.0, 0.0, 0.0)),
        fg.ModelError,
        "both occupied and free",
    ),
    ("factor", lambda: Factorization(Symmetric(2, [])).solve(np.ones(2)), fg.UnifgError, "successful factor"),
]  # fmt: skip


@pytest.mark.parametrize(("breaks", "kind", "message"), [r[1:] for r in REFUSED], ids=[r[0] for r in REFUSED])
def test_models_maps_and_methods_refuse_with_an_error_of_unifg(
    breaks: Callable[[], object], kind: type[fg.UnifgError], message: str
) -> None:
    with pytest.raises(kind, match=message):
        breaks()


def test_an_error_inside_a_residual_names_its_term() -> None:
    """Whoever raises it: a model that is given the wrong numbers, or the user's own code."""
    graph, x = graph_with(fg.Rn(3), 2)
    with pytest.raises(fg.ModelError, match=r"^term 'flight': a quadrotor's states have shape") as caught:
        graph.minimize(lambda p: quadrotor.step(p, p, 0.1, quadrotor.Parameters()), x, name="flight")
    assert caught.value.term == "flight"
    graph, x = graph_with(fg.Rn(3), 2)
    with pytest.raises(ValueError) as other:
        graph.minimize(lambda p: p @ np.ones(2), x, name="mine")
    assert other.value.__notes__[0] == "raised by the function of term 'mine'"


def test_an_error_of_a_function_says_where_and_keeps_what_was_reached() -> None:
    graph, x = graph_with(fg.Rn(1), 5)

    def fragile(p: Array, z: Array) -> Array:
        if np.any(np.abs(p - 2.8) < 0.1):  # where the second step leads
            raise ZeroDivisionError("beyond what I know")
        return np.asarray(np.exp(0.5 * p) - z)

    goals = graph.data("goals", np.exp([[0.1], [0.2], [0.3], [1.4], [0.5]]), each=True)
    graph.minimize(fg.residual(fragile, derivatives="differences"), x, goals, name="fragile")
    with pytest.raises(ZeroDivisionError, match="beyond what I know") as raised:
        GaussNewton(tolerance=1e-14).solve(graph, {x: np.zeros((5, 1))})
    notes = raised.value.__notes__
    assert notes[0] == "raised by the function of term 'fragile'"
    assert notes[1] == "at factor 3, whose first variable is x[3]"
    reached = raised.value.reached  # type: ignore[attr-defined]
    assert "`reached`" in notes[2] and reached.status is fg.Status.INTERRUPTED and reached.iterations >= 1
    assert reached["x"][3, 0] > 2.9
