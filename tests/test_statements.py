"""Statements that are refused where they are made, and leave the graph as it was; terms listed, removed, replaced."""

from __future__ import annotations

import logging
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import unifg as fg
from problems.graphs import drawn_to, graph_of, graph_with, smoother_with
from problems.known import line, short_drive
from unifg.models import obstacles, unicycle
from unifg.solvers import SQP, GaussNewton, InteriorPoint, LevenbergMarquardt
from unifg.typing import Array

STATE = fg.Product(pose=fg.SE2, steer=fg.Rn(1), wheel=fg.SO2)
States = Callable[[Any, Any, Any], object]  # mistakes that a type checker would find


def stage() -> tuple[fg.Graph, fg.Family, fg.Family]:
    """Four poses and three controls with a term and a datum, so that there is something to spoil."""
    graph, x, u = graph_of(("x", fg.SE2, 4), ("u", fg.Rn(2), 3))
    graph.data("dt", 0.1)
    graph.minimize(fg.prior, x, [0.0, 0.0, 0.0], sigma=0.1, name="kept")
    graph.minimize(fg.prior, u, [0.0, 0.0])
    return graph, x, u


def stated(graph: fg.Graph) -> tuple[object, ...]:
    """All that a graph holds."""
    parts = str(graph), [vars(term).copy() for term in graph.terms], [vars(fix).copy() for fix in graph.fixes]
    return *parts, dict(graph.families), dict(graph._data), set(graph._names), graph.edition, graph.compiled


def weighed(**parts: Any) -> States:
    """A cost with a weight."""
    return lambda g, x, u: g.minimize(fg.prior, x, np.zeros(3), name="t", **parts)


def limited(**parts: Any) -> States:
    """A bound with limits."""
    return lambda g, x, u: g.bound(u, name="t", **parts)


def returning(found: object) -> States:
    """A constraint whose function returns what it is told to."""
    return lambda g, x, u: g.constrain(lambda p: found, x, lower=0.0, name="t")


SKEW = np.array([[1.0, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
INDEFINITE = np.tile(np.eye(3), (4, 1, 1))
INDEFINITE[2, 1, 1] = -4.0
HOSTILE: dict[str, tuple[States, str]] = {
    "sigma zero": (weighed(sigma=0.0), "positive and finite, found 0"),
    "sigma negative": (weighed(sigma=[0.1, -0.2, 0.1]), r"found -0.2 at \(1,\)"),
    "sigma nan": (weighed(sigma=np.full((4, 3), np.nan)), r"found nan at \(0, 0\)"),
    "sigma inf": (weighed(sigma=np.inf), "found inf"),
    "sigma length": (weighed(sigma=np.ones(2)), r"sigma has shape \(2,\), expected \(\), \(3,\) or \(4, 3\)"),
    "sigma of each factor": (weighed(sigma=np.ones(4)), r"sigma\[:, None\]"),
    "sigma ragged": (weighed(sigma=[[0.1], [0.1, 0.2]]), "cannot be read as an array"),
    "sigma text": (weighed(sigma="0.1"), "must be real numbers, found '0.1'"),
    "sigma complex": (weighed(sigma=np.array([0.1j] * 3)), "complex"),
    "sigma objects": (weighed(sigma=np.array([0.1, 0.1, 0.1], dtype=object)), "object"),
    "sigma with None": (weighed(sigma=[0.1, None, 0.1]), "object"),
    "sigma flags": (weighed(sigma=np.ones(3, dtype=bool)), "booleans"),
    "sigma a function": (weighed(sigma=np.ones), "must be real numbers"),
    "sigma data": (lambda g, x, u: weighed(sigma=g._data["s"])(g, x, u), "found -1 at"),
    "information shape": (weighed(information=np.eye(2)), r"information has shape \(2, 2\)"),
    "information skew": (weighed(information=SKEW), r"symmetric, found 0.5 at \(0, 1\) and 0.0 at \(1, 0\)"),
    "information indefinite": (weighed(information=INDEFINITE), "factor 2 has a negative eigenvalue, -4"),
    "information nan": (weighed(information=np.full((3, 3), np.nan)), "finite and symmetric, found nan"),
    "information data": (lambda g, x, u: weighed(information=g._data["s"])(g, x, u), r"information has shape \(3,\)"),
    "both": (weighed(sigma=1.0, information=np.eye(3)), "not both"),
    "loss is a class": (weighed(robust=fg.Huber), "must be a loss such as"),
    "loss is a number": (weighed(robust=1.0), "must be a loss such as"),
    "active numbers": (weighed(active=[0, 1, 1, 0]), "booleans, found numbers"),
    "active length": (weighed(active=[True, False]), "number of factors is unclear"),
    "active axes": (weighed(active=np.ones((4, 1), dtype=bool)), "active= must be"),
    "active scalar data": (lambda g, x, u: weighed(active=g._data["flag"])(g, x, u), "active= must be"),
    "crossed": (limited(lower=[0.0, 2.0], upper=1.0), "lower exceeds upper in factor 0, row 1: 2.0 > 1.0"),
    "limit nan": (limited(upper=[1.0, np.nan]), r"upper is NaN at \(1,\)"),
    "limit shape": (limited(upper=np.ones(4)), r"upper has shape \(4,\), expected"),
    "limit of each factor": (limited(upper=np.ones(3)), r"upper\[:, None\]"),
    "limit text": (limited(upper="1"), "real numbers"),
    "limit None": (limited(upper=None), "leave it out"),
    "nothing allowed": (limited(lower=np.inf), "which nothing satisfies"),
    "bound on a group": (lambda g, x, u: g.bound(x, upper=1.0, name="t"), "SE2 is not Rn"),
    "bound on an array": (lambda g, x, u: g.bound(np.zeros(3), upper=1.0, name="t"), "takes one family or selection"),
    "one axis": (returning(np.zeros(4)), r"\(4,\), expected \(n, m\) with n = 4; a number .* return r\[:, None\]"),
    "three axes": (returning(np.zeros((4, 1, 1))), "returned shape"),
    "batch length": (returning(np.zeros((3, 2))), r"returned shape \(3, 2\)"),
    "whole numbers": (returning(np.zeros((4, 1), dtype=int)), "returned int64, expected float64"),
    "single precision": (returning(np.zeros((4, 1), dtype=np.float32)), "returned float32"),
    "complex rows": (returning(np.zeros((4, 1), dtype=complex)), "returned complex128"),
    "nothing": (returning(None), "returned None: is there no return"),
    "a list": (returning([[0.0], [0.0], [0.0], [0.0, 1.0]]), "returned a list that is no array"),
    "scalar cost of two axes": (
        lambda g, x, u: g.minimize_scalar(lambda p: p[:, :1], x, name="t"), r"expected \(n,\) with n = 4",
    ),
    "no function": (lambda g, x, u: g.minimize(None, x, name="t"), "must be a function"),
    "family of another graph": (lambda g, x, u: weighed()(g, stage()[1], u), "another graph"),
    "data of another graph": (
        lambda g, x, u: g.minimize(fg.prior, x, fg.Graph().data("dt", np.zeros(3)), name="t"), "not of this graph",
    ),
    "weight of another graph": (weighed(sigma=fg.Graph().data("dt", 1.0)), "not of this graph"),
    "lengths": (lambda g, x, u: g.minimize(fg.between, x[:-1], x, np.zeros(3), name="t"), "unclear.*has 3.*has 4"),
    "parameters of more factors": (
        lambda g, x, u: g.minimize(fg.prior, x[0], np.zeros((4, 3)), name="t"),
        "speak of 4 factors, its variables of one",
    ),
    "parameters of fewer": (lambda g, x, u: g.minimize(fg.prior, x, np.zeros((3, 3)), name="t"), "speak of"),
    "parameter text": (lambda g, x, u: g.minimize(fg.prior, x, "origin", name="t"), "argument 1 of prior"),
    "no members": (lambda g, x, u: g.minimize(fg.prior, x[4:], np.zeros(3), name="t"), "is empty"),
    "too few arguments": (lambda g, x, u: g.constrain(unicycle.dynamics, x[:-1], u, name="t"), "takes 4 arguments"),
    "wrong manifold": (
        lambda g, x, u: g.constrain(unicycle.dynamics, x[:-1], u, u, 0.1, name="t"), "argument 2 of .* is SE2",
    ),
    "name taken": (lambda g, x, u: g.minimize(fg.prior, x, np.zeros(3), name="kept"), "'kept' is taken"),
    "name no text": (lambda g, x, u: g.minimize(fg.prior, x, np.zeros(3), name=7), "must be a text"),
    "family twice": (lambda g, x, u: g.variables("x", fg.SE2, 1), "exists already"),
    "half a member": (lambda g, x, u: g.variables("y", fg.SE2, 2.5), "whole number"),
    "a class for a manifold": (lambda g, x, u: g.variables("y", fg.Rn, 2), "needs a manifold"),
    "hidden component": (lambda g, x, u: g.variables("y", fg.Product(count=fg.SE2), 2), "could not be selected"),
    "data twice": (lambda g, x, u: g.data("dt", 1.0), "exists already"),
    "data text": (lambda g, x, u: g.data("d", "1.0"), "data 'd' must be real numbers"),
    "data complex": (lambda g, x, u: g.data("d", 1j), "data 'd' must be real numbers"),
    "data ragged": (lambda g, x, u: g.data("d", [[1.0], [1.0, 2.0]]), "data 'd' cannot be read"),
    "fixed twice": (lambda g, x, u: g.fix(x[[1, 1]], np.zeros(3)), r"x\[1\] is fixed twice"),
    "fixed to text": (lambda g, x, u: g.fix(x[1], "here"), "real numbers"),
    "fixed to data of another": (lambda g, x, u: g.fix(x[1], fg.Graph().data("p", np.zeros(3))), "not of this graph"),
}  # fmt: skip


@pytest.mark.parametrize("case", HOSTILE)
def test_a_refused_statement_leaves_the_graph_as_it_was(case: str) -> None:
    states, message = HOSTILE[case]
    graph, x, u = stage()
    graph.data("s", [-1.0, 1.0, 1.0])
    graph.data("flag", True)
    program = graph.compile()
    before = stated(graph)
    with pytest.raises(fg.GraphError, match=message) as caught:
        states(graph, x, u)
    assert stated(graph) == before and graph.compile() is program
    about = "name" not in case and not case.startswith(("data", "fix", "family t", "half", "a class", "hidden"))
    if about:
        assert caught.value.term == "t"
        assert case == "bound on an array" or caught.value.family in ("x", "u"), case
        assert any(word in str(caught.value) for word in ("'x'", "'u'", "of x", "argument", "takes one family")), case
        said = str(caught.value)
        assert "(family" not in said or f"'{caught.value.family}'" not in said.partition("(family")[0]  # said once
    graph.minimize(fg.prior, x, np.zeros(3), sigma=[1, 2, 3], name="t")
    graph.bound(u, lower=-1, upper=[1, np.inf], name="t 2")
    assert [term.name for term in graph.terms] == ["kept", "prior", "t", "t 2"]


def test_families_are_named_once_and_only_where_none_is() -> None:
    graph, x, u = stage()
    with pytest.raises(fg.GraphError) as caught:
        graph.minimize(lambda p, c: p[:, :2] - c, x[:3], u, sigma=0.0)
    assert str(caught.value).endswith("(family 'x', 'u')") and caught.value.family == "x"
    assert caught.value.term == "<lambda>"
    with pytest.raises(fg.GraphError) as caught:
        graph.minimize(lambda p, c: p[:, :2] - c, x[:3], u[:0])
    assert str(caught.value) == "term '<lambda>': the selection from family 'u' is empty"
    assert caught.value.family == "u"


def attached(*blocks: Any) -> fg.Residual:
    """A position with a Jacobian that returns what it is told to."""
    found = blocks if len(blocks) != 1 or not np.isscalar(blocks[0]) else blocks[0]
    return fg.residual(lambda p: p[:, :2], lambda p: found)  # type: ignore[arg-type, return-value]


def undefined(p: Array) -> list[Array]:
    """A Jacobian that does not exist at the origin."""
    raise ZeroDivisionError


@pytest.mark.parametrize(
    ("jacobian", "message"),
    [
        (attached(np.zeros((4, 2, 2))), r"returned shapes \[\(4, 2, 2\)\], expected \[\(4, 2, 3\)\]"),
        (attached(np.zeros((2, 3))), "returned shapes"),
        (attached(), "returned shapes"),
        (attached(np.zeros((4, 2, 3)), np.zeros((4, 2, 3))), None),  # of a constant, left out
        (attached(np.zeros((4, 2, 3), dtype=np.float32)), "attached Jacobian returned float32"),
        (attached(1.0), "returned float, expected one array for each variable"),
        (fg.residual(lambda p: p[:, :2], undefined), None),  # nothing can be said at identity elements
    ],
)  # fmt: skip
def test_an_attached_jacobian_of_the_wrong_shape_is_refused(jacobian: fg.Residual, message: str | None) -> None:
    graph, x, _ = stage()
    before = stated(graph)
    if message is None:
        assert graph.minimize(jacobian, x, name="t") == "t"
        return
    with pytest.raises(fg.GraphError, match=message) as caught:
        graph.minimize(jacobian, x, name="t")
    assert caught.value.term == "t" and caught.value.family == "x" and stated(graph) == before


@pytest.mark.parametrize("wrong", ["1.0", 1j, None, [[1.0], [1.0, 2.0]], np.array([None, 1.0]), [True, False]])
def test_data_and_guesses_that_are_no_numbers_are_refused(wrong: Any) -> None:
    graph, x = line(1)
    goal, on = graph.data("goal", [1.0, 2.0]), graph.data("on", [True], each=True)
    graph.minimize(fg.prior, x, goal, active=on)
    run = SQP().prepare(graph)
    with pytest.raises(fg.GraphError, match="data 'goal'"):
        run.solve({x: [[0.0, 0.0]]}, data={goal: wrong})
    if wrong is not None:
        with pytest.raises(fg.GraphError, match="guess for family 'x'"):
            run.solve({x: wrong})
    with pytest.raises(fg.GraphError, match="data 'on'"):
        run.solve({x: [[0.0, 0.0]]}, data={on: [2] if isinstance(wrong, list) else wrong})
    given: dict[fg.Data, Any] = {goal: [3, np.float32(4.0)], on: np.array([True])}
    assert run.solve({x: [[0, 0]]}, data=given)[x].tolist() == [[3.0, 4.0]]


def test_smoothers_refuse_the_same_and_go_on() -> None:
    smoother, x = smoother_with(fg.Incremental(), fg.Rn(2))
    for wrong, message in (("0.1", "real numbers"), (np.array([1j, 1j]), "complex"), ([0.1, -1.0], "found -1")):
        with pytest.raises(fg.GraphError, match=f"sigma.*{message}"):
            smoother.minimize(fg.prior, x[0], [1.0, 2.0], sigma=wrong, name="t")
    smoother.minimize(fg.prior, x[0], [1.0, 2.0], sigma=0.1, name="t")
    smoother.update({x: [[0.0, 0.0]]})
    np.testing.assert_allclose(smoother.estimate(x[0]), [[1.0, 2.0]])


def test_a_number_for_each_factor_that_is_no_column_is_remarked(caplog: pytest.LogCaptureFixture) -> None:
    graph, x, _ = stage()
    far = lambda p, z: np.linalg.norm(p, axis=1, keepdims=True) - z  # noqa: E731
    graph.minimize(far, x, np.ones((4, 1)), name="column")
    graph.minimize(far, x, fg.shared(np.ones(4)), name="meant")
    assert not caplog.records
    graph.minimize(far, x, np.ones(4), name="row")
    assert "term 'row': each of its 4 factors has 4 rows" in caplog.text and "z[:, None]" in caplog.text
    with pytest.raises(IndexError) as caught:
        graph.minimize(lambda p, z: p[:, :1] - z[:, 1:], x, np.ones(3), name="t")
    assert caught.value.__notes__[1].endswith("constant (3,); one axis is passed on as it is: write c[None] for a row, "
                                              "c[:, None] for a column")  # fmt: skip


def test_what_a_function_itself_raises_names_the_term_and_what_it_was_called_with() -> None:
    graph, x, _ = stage()
    before = stated(graph)
    with pytest.raises(ValueError, match="could not be broadcast") as caught:
        graph.minimize(lambda p, q: p - q, x, np.zeros((5, 3)), name="t")
    assert caught.value.__notes__ == [
        "raised by the function of term 't'",
        "it was called with <4 of x> as (4, 3), constant (5, 3)",
    ]
    assert stated(graph) == before


def test_what_a_function_reads_may_not_change_its_shape_after_the_statement() -> None:
    graph, x = line(2)
    rows = [1.0]
    graph.minimize(lambda p: p[:, :1] * np.array(rows), x, name="t")
    rows.append(2.0)
    with pytest.raises(fg.GraphError, match="'t': its function returns 2 rows now and returned 1"):
        graph.compile()


def test_numbers_that_lose_nothing_are_taken() -> None:
    graph, x, u = stage()
    weights: list[Any] = [1, np.float32(0.5), [1, 2, 3], np.arange(1, 13).reshape(4, 3), np.array(2)]
    for k, sigma in enumerate(weights):
        graph.minimize(fg.prior, x, np.zeros(3, dtype=int), sigma=sigma, name=f"t{k}")
    graph.minimize(fg.prior, x, np.zeros(3), information=np.diag([1, 2, 0]))
    graph.bound(u, lower=-np.inf, upper=np.array([[1], [2], [3]]))
    graph.constrain(obstacles.disc_clearance, x, np.zeros((0, 2)), np.zeros(0), lower=0, name="no discs yet")
    assert GaussNewton().constraints and graph.compile().constraints.count == 6


@pytest.mark.parametrize(
    ("asks", "message"),
    [
        (lambda s: s.stear, r"no component 'stear': its components are s.pose, s.steer, s.wheel \(of one"),
        (lambda s: s[1].stear, "its components are s.pose, s.steer, s.wheel"),
        (lambda s: s.pose.p, "'s.pose' has no attribute 'p': it is a component already"),
    ],
)  # fmt: skip
def test_a_component_that_is_not_there_names_those_that_are(asks: Callable[[Any], object], message: str) -> None:
    graph, s = graph_with(STATE, 3, "s")
    with pytest.raises(AttributeError, match=message):
        asks(s)
    assert not hasattr(s, "nothing") and s.steer.manifold == fg.Rn(1)
    with pytest.raises(AttributeError, match="elements of SE2, which is no product"):
        _ = graph.variables("x", fg.SE2, 1).steer


@pytest.mark.parametrize("index", ["steer", "stear", (0, 3), (slice(None), 3), 0.5, [[0], [1]], None, 3, [True]])
def test_a_wrong_index_says_how_members_and_components_are_selected(index: Any) -> None:
    _, s = graph_with(STATE, 3, "s")
    for selected in (s, s[:], s.pose):
        with pytest.raises(fg.GraphError, match="family 's'") as caught:
            selected[index]
        spelled = "s.pose, s.steer, s.wheel (of one member, s[0].pose)" in str(caught.value)
        assert spelled == isinstance(index, str | tuple), str(caught.value)


# ---------------------------------------------------------------- listing, removing, replacing


def test_a_graph_prints_as_a_table() -> None:
    graph, _ = short_drive()
    weight = graph.data("weight", np.ones(2))
    graph.minimize(lambda p: p[:, :2], graph.families["x"][1:-1], sigma=weight, robust=fg.Huber(1.0), name="own")
    text = str(graph)
    lines = {row.split("  ")[0]: row for row in text.splitlines() if row}
    assert lines["own"].endswith("known once it is compiled")
    for word in ("cost", "x[1:", "sigma data weight, Huber(threshold=1.0)", " weight "):
        assert word in lines["own"]
    assert "equality" in lines["dynamics"] and "= 0" in lines["dynamics"]
    assert "bound" in lines["limits"] and "the variable itself" in lines["limits"]
    assert lines["weight"].split() == ["weight", "(2,)", "own"]
    assert "x[0]" in lines["x fixed"]
    family = graph.families["x"]
    assert lines["x"].split() == ["x", str(len(family)), "SE2", "3", "3", str(3 * len(family) - 3)]
    graph.compile()
    assert "traced, its derivatives exact" in str(graph)
    assert graph._repr_html_().startswith("<pre>") and "&lt;" not in repr(graph)
    assert str(fg.Graph()) == "Graph of 0 families and 0 terms: 0 unknowns, 0 rows of costs, 0 of constraints"


def test_many_terms_that_are_alike_share_a_line() -> None:
    graph, x, landmarks = graph_of(("x", fg.SE2, 200), ("l", fg.Rn(2), 5))
    for k in range(199):
        graph.minimize(fg.between, x[k], x[k + 1], [1.0, 0.0, 0.0], name=f"step {k}")
    for k in range(50):
        graph.minimize(lambda p, q: p[:, :2] - q, x[4 * k], landmarks[k % 5], name=f"seen {k}")
    graph.minimize(fg.prior, x[0], np.zeros(3), name="origin")
    text = str(graph)
    assert len(text.splitlines()) < 12
    assert "step 0, ... (199 terms)  cost      199" in text and "seen 0, ... (50 terms)" in text and "origin" in text


def test_removed_terms_leave_with_their_data() -> None:
    graph, x = line(2)
    both, own = graph.data("both", [1.0, 2.0]), graph.data("own", [5.0, 6.0])
    declared = graph.data("declared", 1.0)
    graph.minimize(fg.prior, x, both, name="a")
    graph.minimize(fg.prior, x, own, name="b")
    graph.minimize(fg.prior, x, both, sigma=own, name="c")
    guess = {x: np.zeros((2, 2))}
    pulled = GaussNewton().solve(graph, guess)[x][0, 0]
    graph.remove("b", "c")
    assert [term.name for term in graph.terms] == ["a"] and graph._data == {"both": both, "declared": declared}
    left = GaussNewton().solve(graph, guess)[x]
    np.testing.assert_allclose(left, [[1.0, 2.0]] * 2)
    assert pulled > 1.5
    with pytest.raises(fg.GraphError, match="does not belong"):
        GaussNewton().solve(graph, guess, data={own: [0.0, 0.0]})
    with pytest.raises(fg.GraphError, match=r"data 'own' is not of this graph: .* left with the last term"):
        graph.minimize(fg.prior, x, own)
    before = stated(graph)
    with pytest.raises(fg.GraphError, match=r"no term is called 'b' \(there are: 'a'\)"):
        graph.remove("a", "b")
    assert stated(graph) == before
    again = graph.data("own", [7.0, 7.0])
    assert graph.minimize(fg.prior, x, again, name="b") == "b"
    graph.remove("a", "b")
    with pytest.raises(fg.GraphError, match=r"x\[0\] is in no cost"):
        graph.compile()


def test_fixes_are_removed_and_replaced_like_terms() -> None:
    graph, x = line(2)
    where = graph.data("where", [1.0, 1.0])
    graph.fix(x[0], where, name="anchor")
    graph.minimize(fg.difference, x[0], x[1])
    guess = {x: np.zeros((2, 2))}
    np.testing.assert_allclose(GaussNewton().solve(graph, guess)[x], 1.0)
    graph.replace("anchor", x[0], [2.0, 2.0])
    assert graph._data == {}
    np.testing.assert_allclose(GaussNewton().solve(graph, guess)[x], 2.0)
    with pytest.raises(fg.GraphError, match="is a fix, which has no sigma="):
        graph.replace("anchor", sigma=1.0)
    with pytest.raises(fg.GraphError, match="shape"):
        graph.replace("anchor", x[0], [2.0])
    graph.replace("anchor", x[1], [3.0, 3.0])
    np.testing.assert_allclose(GaussNewton().solve(graph, guess)[x], 3.0)
    graph.remove("anchor")
    assert graph.fixes == [] and GaussNewton().solve(graph, guess).status is fg.Status.UNDETERMINED


def test_a_replaced_term_keeps_its_place_and_what_is_not_given() -> None:
    graph, guess = short_drive()
    x, u = graph.families["x"], graph.families["u"]
    names = [term.name for term in graph.terms]
    graph.minimize(fg.prior, u, [0.5, 0.0], sigma=2.0, robust=fg.Huber(3.0), name="effort")
    before: Any = graph.term("effort")
    graph.replace("effort", sigma=0.5)
    after: Any = graph.term("effort")
    assert after is not before and graph.terms.index(after) == len(names)
    assert (after.sigma, after.robust, after.residual) == (0.5, before.robust, before.residual)
    graph.replace("effort", information=np.eye(2), robust=None)
    after = graph.term("effort")
    assert after.sigma is None and after.robust is None
    graph.replace("effort", lambda v, scale: v * scale, u[1:], 2.0)
    after = graph.term("effort")
    assert (after.count, after.size) == (len(u) - 1, 2)
    assert np.array_equal(after.information, np.eye(2))
    graph.replace("limits", lower=-0.1, upper=0.1)
    assert np.abs(SQP().solve(graph, guess)[u]).max() <= 0.1 + 1e-9
    graph.replace("limits", u[:1])
    graph.replace("dynamics", active=np.arange(len(u)) != 2)
    assert [term.name for term in graph.terms] == [*names, "effort"]
    unchanged = stated(graph)
    wrongs: list[Callable[[], object]] = [
        lambda: graph.replace("effort", sigma=-1.0),
        lambda: graph.replace("effort", lower=0.0),
        lambda: graph.replace("limits", lower=1.0),
        lambda: graph.replace("limits", x),
        lambda: graph.replace("limits", sigma=1.0),
        lambda: graph.replace("effort", lambda v, scale: v[:, 0]),
        lambda: graph.replace("nothing", sigma=1.0),
    ]
    for wrong in wrongs:
        with pytest.raises(fg.GraphError):
            wrong()
        assert stated(graph) == unchanged


def test_a_scalar_cost_is_replaced() -> None:
    graph, x = line(1)
    graph.minimize_scalar(lambda p: np.sum((p - 1.0) ** 2, axis=1), x, name="bowl")
    graph.replace("bowl", lambda p: np.sum((p - 2.0) ** 2, axis=1))
    np.testing.assert_allclose(SQP().solve(graph, {x: [[0.0, 0.0]]})[x], 2.0)


def test_prepared_solvers_and_solutions_keep_to_the_graph_that_they_were_made_of(caplog: Any) -> None:
    graph, x = line(2)
    target = graph.data("target", [1.0, 1.0])
    graph.minimize(fg.prior, x, target, name="a")
    graph.bound(x, upper=9.0, name="box")
    guess = {x: np.zeros((2, 2))}
    run = SQP().prepare(graph)
    solution = run.solve(guess)
    graph.minimize(fg.prior, x, [3.0, 3.0], name="b")
    graph.remove("a", "box")
    y = graph.variables("y", fg.Rn(1), 1)
    graph.minimize(fg.prior, y, [0.0])
    assert run.stale
    with caplog.at_level(logging.WARNING, "unifg"):
        np.testing.assert_allclose(run.solve(guess, data={target: [2.0, 2.0]})[x], 2.0, atol=1e-8)
        run.solve(guess)
    assert [record.message for record in caplog.records if "prepare it again" in record.message] == [
        "a prepared SQP solves the graph as it was when it was prepared, and the graph has changed since: "
        "prepare it again"
    ]
    fresh = SQP().prepare(graph)
    assert not fresh.stale
    np.testing.assert_allclose(fresh.solve({x: np.zeros((2, 2)), y: [[1.0]]})[x], 3.0, atol=1e-8)
    np.testing.assert_allclose(solution[x], 1.0, atol=1e-8)
    assert solution.dual("box").shape == (2, 2) and list(solution.residuals) == ["a", "box"]
    copy = pickle.loads(pickle.dumps(solution))
    assert list(copy.residuals) == ["a", "box"] and copy.marginals(copy._program.graph.families["x"]).shape == (2, 2, 2)
    again = pickle.loads(pickle.dumps(run))
    np.testing.assert_allclose(again.solve({again.program.graph.families["x"]: np.zeros((2, 2))}).cost, solution.cost)


def test_stating_a_graph_again_and_again_leaves_nothing_behind() -> None:
    graph, x = drawn_to([0.0, 0.0], 2)
    for k in range(5):
        goal = graph.data("goal", [float(k), 0.0])
        graph.minimize(fg.prior, x, goal, name="pull")
        answer = LevenbergMarquardt().solve(graph, {x: np.zeros((2, 2))})[x]
        np.testing.assert_allclose(answer[:, 0], k / 2.0, atol=1e-9)
        graph.remove("pull")
    assert len(graph.terms) == 1 and not graph._data and graph._names == {"prior"}


def test_check_takes_every_form_of_a_guess() -> None:
    graph, guess = short_drive()
    values: dict[fg.Family, Array] = {family: np.asarray(value) for family, value in guess.items()}
    assert graph.check(values) and graph.check(fg.Guess(values)) and graph.check(SQP().solve(graph, guess))
    for wrong in ([np.zeros(3)], None, "zero", np.zeros((3, 3))):
        with pytest.raises(fg.GraphError, match=r"a guess is {family: array"):
            graph.check(wrong)  # type: ignore[arg-type]
        with pytest.raises(fg.GraphError, match=r"a guess is {family: array"):
            SQP().solve(graph, wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize("given", [[1, 0, 1], [1.0, 0.0, 1.0], np.array([True, False, True])])
def test_zeros_and_ones_stand_for_booleans_in_data(given: object) -> None:
    graph = fg.Graph()
    on = graph.data("on", np.ones(3, dtype=bool), each=True)
    found = on.check(given)  # type: ignore[arg-type]
    assert found.dtype == bool
    np.testing.assert_array_equal(found, [True, False, True])
    for wrong in ([0, 1, 2], [0.5, 1.0, 0.0]):
        with pytest.raises(fg.GraphError, match=r"'on'.*0 and 1"):
            on.check(wrong)


def test_numbers_that_differ_by_rounding_are_told_as_they_are() -> None:
    graph, x = graph_with(fg.Rn(2))
    with pytest.raises(fg.GraphError, match=r"0\.30000000000000004 > 0\.3"):
        graph.bound(x, lower=0.1 + 0.2, upper=0.3)
    information = np.array([[1e7, 3e6 + 1.0], [3e6, 1e7]])
    with pytest.raises(fg.GraphError, match=r"3000001\.0 at .* 3000000\.0 at .*S\.T"):
        graph.minimize(fg.prior, x, np.zeros(2), information=information)


WEIGHTED = {
    "sigma": lambda graph, x, given: graph.minimize(fg.prior, x, np.zeros(3), sigma=given),
    "information": lambda graph, x, given: graph.minimize(fg.prior, x, np.zeros(3), information=given),
    "lower": lambda graph, x, given: graph.bound(x, lower=given),
    "soft": lambda graph, x, given: graph.bound(x, lower=5.0, soft=given),
    "fix": lambda graph, x, given: graph.fix(x, given),
    "active": lambda graph, x, given: graph.minimize(fg.prior, x, np.zeros(3), active=given),
}


@pytest.mark.parametrize("state", WEIGHTED.values(), ids=WEIGHTED)
def test_weights_and_limits_are_declared_to_have_a_row_for_each_factor(state: States) -> None:
    """Three factors of three rows: what belongs to the factors is not taken for what belongs to the rows."""
    row: Array = np.array([True, False, True]) if state is WEIGHTED["active"] else np.array([1.0, 2.0, 3.0])
    row = np.diag(row) if state is WEIGHTED["information"] else row
    full = row if row.dtype == bool else np.tile(row, (3,) + (1,) * row.ndim)

    def solved(declare: Callable[[fg.Graph, Array], Any], numbers: Array) -> Array:
        graph, x = graph_with(fg.Rn(3), 3)
        graph.minimize(fg.prior, x, 4.0 * np.ones(3))
        state(graph, x, declare(graph, numbers))
        return InteriorPoint(tolerance=1e-9).solve(graph, {x: np.full((3, 3), 4.5)})[x]

    def kept(graph: fg.Graph, numbers: Array) -> fg.Data:
        return graph.data("kept", numbers, each=True)

    wanted = solved(lambda _, numbers: numbers, full)
    for declare in (lambda _, numbers: fg.each(numbers), kept):
        np.testing.assert_array_equal(solved(declare, full), wanted)
        if full is not row:
            with pytest.raises(fg.GraphError, match="is declared to have a row for each factor, found shape"):
                solved(declare, row)
    if full is not row:
        np.testing.assert_allclose(solved(lambda _, numbers: fg.shared(numbers), row), wanted, atol=1e-9)
        with pytest.raises(fg.GraphError, match="is declared to be shared by all factors, found shape"):
            solved(lambda _, numbers: fg.shared(numbers), full)
