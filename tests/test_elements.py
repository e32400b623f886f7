"""Constants in the place of group elements: off the manifold they are refused, nearly on it they are normalised."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import unifg as fg
from own_manifolds import S2, XYZW
from problems.graphs import drawn_to, graph_of, graph_with, smoother_with
from unifg.models.landmarks import bearing_range
from unifg.solvers import GaussNewton
from unifg.typing import Array, ArrayLike

UNIT = np.array([0.5, -0.5, 0.5, 0.5])
POSE = np.array([1.0, 2.0, 3.0, *UNIT])
STEP = fg.SE3.exp(np.array([0.1, 0.2, 0.3, 0.4, -0.5, 0.6]))
PAIR = fg.Product(pose=fg.SE3, bias=fg.Rn(2))


def scaled(pose: Array, by: float) -> Array:
    """A pose whose quaternion has norm ``by``."""
    return np.concatenate([pose[:-4], by * pose[-4:]])


def solved(manifold: fg.Manifold, value: ArrayLike, **options: Any) -> Array:
    graph, x = graph_with(manifold)
    graph.minimize(fg.prior, x, value, **options)
    return np.asarray(fg.solve(graph, {x: manifold.identity()[None]})[x][0])


@pytest.mark.parametrize("norm", [0.0, 0.5, 1.002, 0.998, np.nan, np.inf])
@pytest.mark.parametrize(
    ("manifold", "value"),
    [(fg.SO3, UNIT), (fg.SE3, POSE), (fg.SE23, np.concatenate([np.zeros(6), UNIT])), (PAIR, [*POSE, 0.1, 0.2])],
)
def test_an_element_off_its_manifold_is_refused(manifold: fg.Manifold, value: ArrayLike, norm: float) -> None:
    value = np.array(value)
    start = {"SO3": 0, "SE3": 3, "SE23": 6}.get(manifold.name, 3)
    value[start : start + 4] *= norm
    with pytest.raises(fg.GraphError, match=r"term 'level': argument 1.*row 0.*w first, norm 1") as raised:
        solved(manifold, value, name="level")
    assert raised.value.term == "level" and raised.value.index == 0


@pytest.mark.parametrize("norm", [1.0009, 0.9991])
@pytest.mark.parametrize(
    ("manifold", "value"), [(fg.SO3, UNIT), (fg.SE3, POSE), (PAIR, np.array([0.0, *POSE[1:], 0.1, 0.2]))]
)
def test_an_element_nearly_on_its_manifold_is_normalised(manifold: Any, value: Any, norm: float) -> None:
    near = value.copy()
    near[slice(0, 4) if manifold is fg.SO3 else slice(3, 7)] *= norm
    found = solved(manifold, near, sigma=0.1)
    np.testing.assert_allclose(manifold.local(value, found), 0.0, atol=1e-9)
    assert fg.SE3.is_valid(found[:7]) if manifold is not fg.SO3 else fg.SO3.is_valid(found)


def test_a_negative_quaternion_nearly_of_norm_one_is_normalised() -> None:
    np.testing.assert_allclose(fg.SO3.local(UNIT, solved(fg.SO3, -1.0005 * UNIT)), 0.0, atol=1e-9)


def test_a_refusal_names_the_row_and_leaves_the_graph_as_it_was() -> None:
    graph, x = graph_with(fg.SE3, 4)
    measured = np.tile(STEP, (3, 1))
    measured[2] = scaled(measured[2], 0.5)
    with pytest.raises(fg.GraphError, match=r"row 2.*family 'x'") as raised:
        graph.minimize(fg.between, x[:-1], x[1:], measured, name="odometry")
    assert (raised.value.term, raised.value.index) == ("odometry", 2)
    assert not graph.terms


def test_the_reference_of_a_joint_prior_is_checked_part_by_part() -> None:
    graph, x, b = graph_of(("x", fg.SE3, 1), ("b", fg.Rn(1), 1))
    joint = fg.joint_prior(fg.SE3, fg.Rn(1), offset=True)
    with pytest.raises(fg.GraphError, match=r"argument 2.*norm 1"):
        graph.minimize(joint, x, b, [*scaled(POSE, 0.9), 5.0, *np.zeros(7)])
    graph.minimize(joint, x, b, [*POSE, 5.0, *np.zeros(7)])


@pytest.mark.parametrize("manifold", [fg.SO2, fg.SE2, fg.Rn(2)])
@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_numbers_that_are_not_finite_are_refused(manifold: fg.Manifold, wrong: float) -> None:
    value = manifold.identity()
    value[-1] = wrong
    with pytest.raises(fg.GraphError, match=r"argument 1.*row 0.*not finite"):
        solved(manifold, value)


def test_a_placeholder_in_a_row_that_is_never_active_may_be_anything() -> None:
    graph, x = graph_with(fg.SE3, 2)
    graph.minimize(fg.prior, x, np.stack([POSE, np.zeros(7)]), active=[True, False])
    with pytest.raises(fg.GraphError, match="row 1"):
        graph.minimize(fg.prior, x, np.stack([POSE, np.zeros(7)]), active=[True, True])


def test_a_manifold_of_ones_own_is_asked_by_its_own_test() -> None:
    with pytest.raises(fg.GraphError, match=r"argument 1.*row 0.*SO3 xyzw"):
        solved(XYZW, 2.0 * XYZW.identity())
    turn = XYZW.exp([0.3, -0.2, 0.1])
    np.testing.assert_allclose(XYZW.local(turn, solved(XYZW, 1.0005 * turn)), 0.0, atol=1e-9)


def test_points_that_cannot_be_composed_are_asked_too() -> None:
    with pytest.raises(fg.GraphError, match=r"argument 1.*row 0.*S2"):
        solved(S2, [0.0, 0.0, 1.1])
    np.testing.assert_allclose(solved(S2, [0.0, 0.0, 1.0005]), [0.0, 0.0, 1.0], atol=1e-6)


def test_data_are_checked_at_statement_and_at_every_binding() -> None:
    graph, x = graph_with(fg.SE3)
    wrong = graph.data("wrong", scaled(POSE, 0.5))
    with pytest.raises(fg.GraphError, match=r"argument 1.*row 0.*w first, norm 1"):
        graph.minimize(fg.prior, x, wrong)
    goal = graph.data("goal", scaled(POSE, 1.0005))
    graph.minimize(fg.prior, x, goal, name="goal")
    solver = GaussNewton().prepare(graph)
    guess = {x: POSE[None]}
    np.testing.assert_allclose(solver.solve(guess)[x][0], POSE, atol=1e-9)
    with pytest.raises(fg.GraphError, match=r"term 'goal': argument 1.*row 0.*w first, norm 1"):
        solver.solve(guess, data={goal: scaled(POSE, 0.5)})
    moved = fg.SE3.compose(POSE, STEP)
    near = solver.solve(guess, data={goal: scaled(moved, 0.9995)})
    np.testing.assert_allclose(fg.SE3.local(moved, near[x][0]), 0.0, atol=1e-9)
    assert fg.SE3.is_valid(near[x]).all()
    np.testing.assert_allclose(fg.SE3.local(POSE, solver.solve(guess)[x][0]), 0.0, atol=1e-9)


@pytest.mark.parametrize(("group", "maker"), [(fg.SO3, "SO3"), (fg.SE3, "SE3"), (fg.lie.SE23, "SO3")])
def test_the_constructor_that_is_named_exists(group: Any, maker: str) -> None:
    graph, x = graph_with(group, 1)
    with pytest.raises(fg.GraphError, match=f"norm 1: {maker}.from_quaternion converts others"):
        graph.minimize(fg.prior, x, 1.1 * group.identity())
    assert hasattr(getattr(fg.lie, maker), "from_quaternion")


def test_a_fix_by_data_is_named_as_what_fixes() -> None:
    graph = fg.Graph()
    x, start = graph.variables("x", fg.SE3, 2), graph.data("start", fg.SE3.identity())
    graph.fix(x[1], start)
    graph.minimize(fg.between, x[0], x[1], fg.SE3.identity())
    prepared, poses = GaussNewton().prepare(graph), np.stack([fg.SE3.identity(), fg.SE3.identity()])
    with pytest.raises(fg.GraphError, match=r"the value that fixes x\[1\] is not on SE3"):
        prepared.solve({x: poses}, data={start: 1.1 * fg.SE3.identity()})
    with pytest.raises(fg.GraphError, match=r"the guess for x\[0\] is not on SE3"):
        prepared.solve({x: 1.1 * poses})


def test_inactive_rows_of_data_may_be_anything() -> None:
    graph, x = graph_with(fg.SE3, 2)
    goals = graph.data("goals", np.stack([POSE, np.zeros(7)]), each=True)
    used = graph.data("used", np.array([True, False]))
    graph.minimize(fg.prior, x, goals, active=used)
    graph.minimize(fg.prior, x, POSE, sigma=10.0)
    solver, guess = GaussNewton().prepare(graph), {x: np.stack([POSE, POSE])}
    assert solver.solve(guess).converged
    with pytest.raises(fg.GraphError, match="row 1"):
        solver.solve(guess, data={used: np.array([True, True])})


@pytest.mark.parametrize("smoother", [fg.Incremental, lambda: fg.FixedLag(9)])
@pytest.mark.product(1)
def test_smoothers_check_every_factor_alike(smoother: Callable[[], Any]) -> None:
    graph, x = smoother_with(smoother(), fg.SE3)
    poses = np.stack([POSE, fg.SE3.compose(POSE, STEP), fg.SE3.compose(fg.SE3.compose(POSE, STEP), STEP)])
    graph.minimize(fg.prior, x[0], scaled(POSE, 1.0005), sigma=0.1)
    for k in range(2):  # the second is laid out without being looked at, where it can be
        graph.minimize(fg.between, x[k], x[k + 1], scaled(STEP, 1.0 - 0.0005 * k), sigma=0.1)
    for wrong in (scaled(STEP, 0.5), scaled(STEP, np.nan), scaled(STEP, 0.0)):
        with pytest.raises(fg.GraphError, match=r"term 'between': argument 2.*row 0.*w first, norm 1"):
            graph.minimize(fg.between, x[1], x[2], wrong, sigma=0.1)
    graph.update({x: poses})
    np.testing.assert_allclose(graph.cost, 0.0, atol=1e-12)


def test_smoothers_ask_every_element_of_a_manifold_of_ones_own() -> None:
    graph, x = smoother_with(fg.Incremental(), S2)
    for _ in range(2):
        graph.minimize(fg.prior, x[0], np.array([0.0, 0.0, 1.0]), sigma=0.1)
    with pytest.raises(fg.GraphError, match=r"row 0.*S2"):
        graph.minimize(fg.prior, x[0], np.array([0.0, 0.0, 1.1]), sigma=0.1)


MASKED = np.ma.MaskedArray([1.0, 2.0], mask=[False, True])


@pytest.mark.parametrize(
    ("state", "message"),
    [
        (lambda g, x: g.minimize(fg.prior, x, MASKED), "masked"),
        (lambda g, x: g.minimize(lambda p, c: p - c, x, MASKED), "masked"),
        (lambda g, x: g.minimize(fg.prior, x, [0.0, 0.0], sigma=np.abs(MASKED)), "masked"),
        (lambda g, x: g.bound(x, lower=MASKED), "masked"),
        (lambda g, x: g.data("d", MASKED), "masked"),
        (lambda g, x: g.fix(x[0], MASKED), "masked"),
        (lambda g, x: fg.solve(g, {x: np.ma.MaskedArray(np.zeros((2, 2)))}), "masked"),
        (
            lambda g, x: g.minimize(fg.between, scaled(POSE, 2.0), g.variables("p", fg.SE3, 1), STEP),
            "argument 0.*w first, norm 1",
        ),
        (
            lambda g, x: g.minimize(bearing_range, g.variables("p", fg.SE2, 1), x[0], [0.1, np.nan]),
            "argument 2.*row 0.*not finite",
        ),
    ],
)
def test_masked_arrays_and_what_is_no_element_are_refused(state: Any, message: str) -> None:
    graph, x = drawn_to([0.0, 0.0], 2, name="origin")
    with pytest.raises(fg.GraphError, match=message):
        state(graph, x)


def test_smoothers_refuse_masked_arrays() -> None:
    graph, x = smoother_with(fg.Incremental(), fg.Rn(2))
    with pytest.raises(fg.GraphError, match="masked"):
        graph.minimize(fg.prior, x[0], MASKED)
    graph.minimize(fg.prior, x[0], np.zeros(2))
    with pytest.raises(fg.GraphError, match=r"family 'x'.*masked"):
        graph.update({x: MASKED})


@pytest.mark.parametrize("value", [[1.0, 2.0, 90.0], [[0.0, 0.0, 0.1], [0.0, 0.0, -7.0]]])
def test_a_prior_with_headings_beyond_a_turn_names_degrees(value: list[Any], caplog: pytest.LogCaptureFixture) -> None:
    graph, x = graph_with(fg.SE2, len(np.atleast_2d(value)))
    with caplog.at_level(logging.WARNING, "unifg"):
        graph.minimize(fg.prior, x, value, name=f"compass {np.ndim(value)}")
    assert f"term 'compass {np.ndim(value)}'" in caplog.text and "degrees" in caplog.text


def test_a_prior_with_headings_of_a_turn_says_nothing(caplog: pytest.LogCaptureFixture) -> None:
    graph, x, y = graph_of(("x", fg.SE2, 1), ("y", fg.SE2, 1))
    with caplog.at_level(logging.WARNING, "unifg"):
        graph.minimize(fg.prior, x, [100.0, -200.0, 2.0 * math.pi])
        graph.minimize(fg.between, x, y, [0.0, 0.0, 7.0])
    assert not caplog.text


def test_quaternions_spell_their_order() -> None:
    w, x, y, z = UNIT
    for scale in (1.0, 3.0):
        np.testing.assert_allclose(fg.SO3.from_quaternion(scale * UNIT, order="wxyz"), UNIT)
        np.testing.assert_allclose(fg.SO3.from_quaternion(scale * np.array([x, y, z, w]), order="xyzw"), UNIT)
    row = np.array([1.0, 2.0, 3.0, x, y, z, w])
    np.testing.assert_allclose(fg.SE3.from_quaternion(np.tile(row, (2, 1)), order="xyzw"), np.tile(POSE, (2, 1)))
    np.testing.assert_allclose(fg.SE3.from_quaternion(POSE, order="wxyz"), POSE)
    np.testing.assert_allclose(fg.SO3.to_quaternion(UNIT, order="xyzw"), [x, y, z, w])
    np.testing.assert_allclose(fg.SO3.to_quaternion(-UNIT, order="wxyz"), UNIT)
    np.testing.assert_allclose(fg.SE3.to_quaternion(POSE, order="xyzw"), row)
    with pytest.raises(fg.UnifgError, match=r"order.*'wxyz' or 'xyzw'"):
        fg.SO3.from_quaternion(UNIT, order="zyxw")  # type: ignore[arg-type]
    with pytest.raises(fg.UnifgError, match="names no rotation"):
        fg.SE3.from_quaternion(np.zeros(7), order="xyzw")
    with pytest.raises(fg.UnifgError, match="7"):
        fg.SE3.from_quaternion(UNIT, order="xyzw")
