"""Barriers: what they compute, how they are held, what they are worth between nodes, where a plan may end."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest

import unifg as fg
from judge import judge
from problems.graphs import graph_of, graph_with, smoother_with
from unifg.errors import GraphError, ModelError
from unifg.factors.autodiff.operations import Op
from unifg.factors.autodiff.rates import rate
from unifg.factors.autodiff.rows import traced
from unifg.factors.autodiff.stated import StatedKernel
from unifg.models import (
    avoidance,
    barriers,
    between_nodes,
    clearances,
    keeping,
    obstacles,
    quadrotor,
    terminal,
    unicycle,
    universal,
)
from unifg.models.distance_map import DistanceMap
from unifg.models.spline import SplineField
from unifg.solvers import SQP, InteriorPoint
from unifg.solvers.names import backends
from unifg.typing import Array

RNG = np.random.default_rng(5)
EXACT = "traced, its derivatives exact"
CENTRE, RADIUS = np.array([[0.0, 0.0, 0.0], [1.5, 0.2, 0.1]]), np.array([0.4, 0.3])


def spheres(p: Array) -> Array:
    return np.asarray(np.linalg.norm(p[:, None] - CENTRE, axis=2) - RADIUS)


# ---------------------------------------------------------------- rates inside functions


def test_a_rate_is_the_derivative_along_the_motion() -> None:
    p, v = RNG.normal(size=(6, 3)), RNG.normal(size=(6, 3))
    found = rate(lambda s, p, v: avoidance.sphere_clearance(p + s * v, CENTRE, RADIUS), p, v)
    to = p[:, None] - CENTRE
    np.testing.assert_allclose(found, np.einsum("nmi,ni->nm", to, v) / np.linalg.norm(to, axis=2), atol=1e-14)


def test_rates_of_rates_are_second_derivatives() -> None:
    p, v = RNG.normal(size=(4, 3)), RNG.normal(size=(4, 3))

    def distance(s: Any, p: Array) -> Array:
        return avoidance.sphere_clearance(p + s * v, CENTRE, RADIUS)

    def faster(s: Any, p: Array) -> Array:
        return np.asarray(rate(distance, p + s * v))

    to = p[:, None] - CENTRE
    length = np.linalg.norm(to, axis=2)
    along = np.einsum("nmi,ni->nm", to, v) / length
    np.testing.assert_allclose(rate(faster, p), ((v**2).sum(axis=1)[:, None] - along**2) / length, atol=1e-12)


def test_nothing_is_left_of_the_parameter_of_a_path() -> None:
    """It would be taken for one more tangent coordinate by whoever differentiates again."""

    def speed(p: Array) -> Array:
        return np.asarray(rate(lambda s, p: avoidance.sphere_clearance(p + s * 2.0, CENTRE, RADIUS), p))

    expression = traced(speed, (fg.Rn(3),))
    tape = expression.tape
    moving = {tape.a[i] for i in tape.live(expression.rows) if tape.op[i] == Op.TANGENT}
    assert moving == {0, 1, 2}
    assert all(0 <= j <= k < 3 for j, k in expression.curvature)


def test_a_rate_of_what_is_known_is_refused_in_a_trace() -> None:
    graph, p = graph_with(fg.Rn(3), 2, "p")
    wrong = fg.residual(lambda p: p + rate(lambda s, c: s * c, 2.0), derivatives="trace")
    graph.minimize(wrong, p)
    with pytest.raises(GraphError, match="depends on nothing unknown"):
        graph.compile()


def test_residuals_may_be_called_in_a_trace() -> None:
    """Stated as plain functions or compiled by hand, on one row for each factor or on several."""
    graph, x, u = graph_of(("x", fg.SE2, 4), ("u", fg.Rn(2), 3))
    shifted = fg.residual(lambda p: avoidance.sphere_clearance(p + 1.0, CENTRE, RADIUS))
    p = graph.variables("p", fg.Rn(3), 2)
    half = 0.5

    def both(x: Array, u: Array, y: Array) -> Array:
        return np.concatenate([half * unicycle.dynamics(x, u, y, 0.1), fg.SE2.local(x, y)], axis=1)

    def all_corners(x: Array) -> Array:  # three rows of arguments for each factor
        corners = np.concatenate([fg.SE2.compose(x, np.array([[a, 0.0, 0.0]])) for a in (-0.3, 0.0, 0.3)])
        away = obstacles.disc_clearance(corners, CENTRE[:, :2], RADIUS).reshape(3, -1, 2)
        return np.asarray(away.min(axis=(0, 2))[:, None])

    graph.minimize(both, x[:-1], u, x[1:], name="both")
    graph.minimize(shifted, p, name="shifted")
    graph.minimize(all_corners, x, name="corners")
    graph.minimize(fg.prior, x, [0.0, 0.0, 0.0])
    graph.minimize(fg.prior, u, [0.0, 0.0])
    graph.minimize(fg.prior, p, [0.0, 0.0, 0.0])
    guess = {x: fg.SE2.random(RNG, (4,)), u: RNG.normal(size=(3, 2)), p: RNG.normal(size=(2, 3))}
    found = graph.check(guess)
    assert found and {found.routes[name] for name in ("both", "shifted", "corners")} == {EXACT}, str(found)
    lin = graph.compile().linearize(guess).residual
    np.testing.assert_allclose(lin[:18].reshape(3, 6), both(guess[x][:-1], guess[u], guess[x][1:]), atol=1e-12)


def test_the_same_function_of_another_residual_is_another() -> None:
    """One closure over two clearances of the same shapes: neither is taken for the other."""

    def near(p: Array, centre: Array, radius: Array) -> Array:
        return np.asarray(np.abs(p[:, None] - centre).sum(axis=2) - radius)

    manhattan = fg.residual(StatedKernel(near, (fg.Rn(3), (2, 3), (2,)), 2))
    graph, p = graph_with(fg.Rn(3), 3, "p")
    both = [avoidance.sphere_clearance, manhattan]
    for number, clearance in enumerate(both):
        kept = barriers.decay(barriers.still(clearance), 1.0)
        graph.minimize(kept, p[:-1], p[1:], 0.0, 0.1, CENTRE, RADIUS, name=f"{number}")
    guess = {p: RNG.normal(size=(3, 3))}
    assert {graph.check(guess).routes[name] for name in "01"} == {EXACT}
    found = graph.compile().linearize(guess).residual.reshape(2, 2, 2)
    for rows, clearance in zip(found, both, strict=True):
        h = clearance(guess[p], CENTRE, RADIUS)
        np.testing.assert_allclose(rows, h[1:] - np.exp(-0.1) * h[:-1], atol=1e-12)


WALL = np.zeros((20, 30), dtype=bool)
WALL[8:12, 10:20] = True
FIELD = SplineField.of_map(DistanceMap.from_occupancy(WALL, 0.1, (-1.0, -1.0, 0.0)))
SEGMENTS = np.array([[[-1.0, 0.5], [1.0, 0.8]], [[0.3, -1.0], [0.3, -0.4]]])
CLEARANCES: dict[str, tuple[Any, fg.Manifold, tuple[Any, ...]]] = {
    "spheres": (avoidance.sphere_clearance, fg.Rn(3), (CENTRE, RADIUS)),
    "cylinders": (avoidance.cylinder_clearance, fg.Rn(3), (CENTRE[:, :2], RADIUS)),
    "segments": (avoidance.segment_clearance, fg.Rn(3), (SEGMENTS, np.full(2, 0.2))),
    "discs": (obstacles.disc_clearance, fg.SE2, (CENTRE[:, :2], RADIUS)),
    "fence": (clearances.inside_sphere, fg.Rn(3), (np.zeros(3), 2.0)),
    "planes": (clearances.polyhedron, fg.Rn(3), (np.eye(3), np.full(3, 1.5))),
    "map": (lambda p: FIELD(p[:, :2])[:, None] - 0.1, fg.Rn(3), ()),
    "one sphere": (clearances.to_point, fg.Rn(3), (CENTRE[1], 0.2)),
    "points of a body": (
        clearances.on_body(avoidance.sphere_clearance, [[0.2, 0.0, 0.0], [-0.2, 0.0, 0.1]]), quadrotor.STATE,
        (CENTRE, RADIUS),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", CLEARANCES)
def test_every_clearance_has_a_barrier_with_exact_derivatives(name: str) -> None:
    clearance, manifold, obstacle = CLEARANCES[name]
    x = manifold.random(RNG, (5,))
    h = barriers.still(clearance)
    graph, family, along = graph_of(("x", manifold, 5), ("u", fg.Rn(manifold.dim), 4))
    graph.minimize(fg.prior, family, x)
    graph.minimize(fg.prior, along, np.zeros(manifold.dim))
    graph.constrain(barriers.decay(h, 0.7), family[:-1], family[1:], 0.0, 0.1, *obstacle, lower=-1e3, name="decay")
    limit = barriers.condition(h, 0.7, manifold, lambda x, u: u)
    graph.constrain(limit, family[:-1], along, 0.0, *obstacle, lower=-1e3, name="condition")
    found = graph.check({family: x, along: RNG.normal(size=(4, manifold.dim))})
    assert {found.routes[name] for name in ("decay", "condition")} == {EXACT}
    assert found, str(found)
    values = clearance(x, *obstacle)
    kept = barriers.decay(h, 0.7)(x[:-1], x[1:], 0.0, 0.1, *obstacle)
    np.testing.assert_allclose(kept, values[1:] - np.exp(-0.07) * values[:-1], atol=1e-12)


# ---------------------------------------------------------------- formulas


def state(p: list[float], turn: float = 0.0, v: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Array:
    """State of a quadrotor that is turned about the vertical."""
    return np.concatenate([p, fg.SO3.exp(np.array([0.0, 0.0, turn])), v])


LINEAR, RESTING = barriers.still(lambda x: x), barriers.still(avoidance.sphere_clearance)
MOVING, FIRST = barriers.moving(avoidance.sphere_clearance), (CENTRE[:1], RADIUS[:1])
LEAVES_COMES = np.array([state([0.3, 0.0, 0.0], v=(1.0, 0.0, 0.0)), state([0.6, 0.0, 0.0], v=(-1.0, 0.0, 0.0))])
STAYS, FLEES = (CENTRE[:1], np.zeros((1, 3)), RADIUS[:1]), (CENTRE[:1], np.array([[1.0, 0.0, 0.0]]), RADIUS[:1])
INVERSE = barriers.inverse(barriers.still(clearances.to_point), 0.75)
AHEAD, NEARS = np.array([[2.0, 0.0, 0.0]]), np.array([[-0.5, 0.0, 0.0]])
FACING = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, np.pi / 2], [0.0, 0.0, np.pi / 4]])
POSE = np.array([[1.0, 2.0, 0.7]])
LEFT = terminal.brakeable(RESTING, 2.0, 3.0, p=slice(0, 3), v=slice(3, 6))
ON_BODY = clearances.on_body(avoidance.sphere_clearance, [[0.5, 0.0, 0.0], [0.0, 1.0, 0.0]])
VALUES: dict[str, tuple[Callable[..., Array], tuple[Any, ...], Any]] = {
    "inside a sphere it is positive": (
        clearances.inside_sphere, (np.array([[0.5, 0.0, 0.0], [2.5, 0.0, 0.0]]), np.zeros(3), 2.0), [[1.5], [-0.5]],
    ),
    "a cylinder has no height": (
        clearances.inside_sphere, (np.array([[0.5, 0.0, 9.0], [2.5, 0.0, 9.0]]), np.zeros(2), 2.0), [[1.5], [-0.5]],
    ),
    "points turn with the body": (
        ON_BODY, (state([3.0, 0.0, 0.0], np.pi / 2)[None], *FIRST), [[np.hypot(3.0, 0.5) - 0.4, 2.0 - 0.4]],
    ),
    "of a pose the first two axes count": (clearances.to_point, (POSE, np.array([[1.0, 3.0]]), 0.25), [[0.75]]),
    "as of a position in the plane": (clearances.to_point, (POSE[:, :2], np.array([1.0, 3.0]), 0.25), [[0.75]]),
    **{  # exponential for any step: with 1 - alpha dt a long one would ask for the other side
        f"decay {alpha} in {dt} s": (
            barriers.decay(LINEAR, alpha), (np.array([[2.0]]), np.array([[0.5]]), 0.0, dt),
            [[0.5 - 2.0 * np.exp(-alpha * dt)]],
        )
        for alpha, dt in ((0.0, 0.1), (3.0, 0.05), (3.0, 10.0), (1e9, 1.0), (3.0, 0.0))
    },
    "intervals differ": (
        barriers.decay(LINEAR, 2.0), (np.ones((2, 1)), np.ones((2, 1)), np.zeros(2), np.array([0.01, 0.05])),
        1.0 - np.exp([[-0.02], [-0.1]]),
    ),
    "what is thrown falls": (
        barriers.thrown(clearances.to_point),
        (np.zeros((1, 3)), 0.5, np.array([[1.0, 0.0, 2.0]]), np.array([[-1.0, 0.0, 1.0]]), 0.1),
        [[np.hypot(0.5, 2.0 + 0.5 - 0.125 * 9.81) - 0.1]],
    ),
    "the paper's 1/d": (
        INVERSE, (np.diag([0.75, 0.5, 2.0]), 0.0, np.zeros(3), 0.75),
        1 / 0.75 - 1 / np.array([[0.75], [0.5], [2.0]]),
    ),
    # {h_v >= 0} is no subset of {h >= 0}, nor the other way round: one recedes inside, one approaches outside
    "extended by velocity": (
        barriers.velocity_extended(MOVING, MOVING, 0.5), (LEAVES_COMES, 0.0, *STAYS), [[-0.1 + 0.5], [0.2 - 0.5]],
    ),
    "extended by nothing": (
        barriers.velocity_extended(MOVING, MOVING, 0.0), (LEAVES_COMES, 0.0, *STAYS), [[-0.1], [0.2]],
    ),
    "followed as fast": (
        barriers.velocity_extended(MOVING, MOVING, 0.5), (LEAVES_COMES, 0.0, *FLEES), [[-0.1], [0.2 - 1.0]],
    ),
    "condition": (
        barriers.condition(MOVING, 0.3, fg.Rn(3), lambda p, v: v), (AHEAD, NEARS, 0.0, *FLEES),
        [[-0.5 - 1.0 + 0.3 * 1.6]],
    ),
    "condition as published, the obstacle at rest": (
        barriers.condition(MOVING, 0.3, fg.Rn(3), lambda p, v: v, as_published=True), (AHEAD, NEARS, 0.0, *FLEES),
        [[-0.5 + 0.3 * 1.6]],
    ),
    "uncertain along the obstacle only": (
        barriers.uncertain(RESTING, 3.0), (AHEAD, 0.0, np.diag([0.1, 5.0, 5.0]), *FIRST), [[1.6 - 3.0 * 0.1]],
    ),
    "certain": (barriers.uncertain(RESTING, 0.0), (AHEAD, 0.0, np.diag([0.1, 5.0, 5.0]), *FIRST), [[1.6]]),
    "the covariance of a pose lies in its own axes": (
        barriers.uncertain(barriers.still(obstacles.disc_clearance), 3.0, fg.SE2),
        (FACING, 0.0, np.diag([0.2, 0.05, 0.3]), np.array([[2.0, 0.0]]), np.array([0.5])),
        [[1.5 - 0.6], [1.5 - 0.15], [1.5 - 3.0 * np.sqrt(0.5 * (0.2**2 + 0.05**2))]],
    ),
    "controls beyond their limits": (
        universal.excess, (np.array([[-2.0, 0.5, 3.0]]), np.full(3, -1.0), np.full(3, 1.0)), [[1.0, 0.0, 2.0]],
    ),
    "brakeable 0.6 and 0.25 m from spheres": (
        LEFT, (np.array([[1.0, 0.0, 0.0, 0.0, 0.0, 1.0]]), 0.0, CENTRE, RADIUS),
        [[0.2, 2.0 * (np.linalg.norm([0.5, 0.2, 0.1]) - 0.3) - 1.0, 0.5]],
    ),
    "a rate at the centre is a number": (
        partial(rate, lambda s, p: avoidance.sphere_clearance(p + s * 1.0, *FIRST)), (np.zeros((1, 3)),), [[0.0]],
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", VALUES)
def test_values_by_hand(name: str) -> None:
    function, arguments, expected = VALUES[name]
    np.testing.assert_allclose(function(*arguments), expected, rtol=1e-9, atol=1e-12)


def test_obstacles_move_with_the_time_at_each_end() -> None:
    h, velocity = barriers.moving(avoidance.sphere_clearance), np.array([[1.0, 0.0, 0.0], [0.0, -2.0, 0.0]])
    p, q, t, dt = RNG.normal(size=(3, 3)), RNG.normal(size=(3, 3)), np.array([0.0, 0.3, 0.7]), 0.1
    found = barriers.decay(h, 1.1)(p, q, t, dt, CENTRE, velocity, RADIUS)
    for k in range(3):
        now, then = CENTRE + t[k] * velocity, CENTRE + (t[k] + dt) * velocity
        expected = np.linalg.norm(q[k] - then, axis=1) - RADIUS
        expected = expected - np.exp(-0.11) * (np.linalg.norm(p[k] - now, axis=1) - RADIUS)
        np.testing.assert_allclose(found[k], expected, atol=1e-13)


def test_some_of_a_set_may_fall() -> None:
    h = barriers.accelerated(avoidance.sphere_clearance)
    velocity, fall = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]), np.array([[0.0, 0.0, -9.81], [0.0, 0.0, 0.0]])
    p, t = RNG.normal(size=(3, 3)), np.array([0.0, 0.2, 0.5])
    there = CENTRE + t[:, None, None] * velocity + 0.5 * (t**2)[:, None, None] * fall
    np.testing.assert_allclose(
        h(p, t, CENTRE, velocity, fall, RADIUS), np.linalg.norm(p[:, None] - there, axis=2) - RADIUS, atol=1e-13
    )


SHIFTS = np.array([[1.0, 0.0, 0.0], [0.0, -2.0, 0.5]])


@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_a_set_of_a_plain_function_moves_as_that_of_a_shipped_one(n: int) -> None:
    """Whoever writes a clearance says whether it is of many: as many centres as times is no hint."""

    def mine(p: Array, centre: Array, radius: Array) -> Array:
        return np.asarray(np.linalg.norm(p[:, None] - centre, axis=2) - radius)

    p, t = RNG.normal(size=(n, 3)), np.linspace(0.0, 0.7, n)
    for make in (barriers.moving, barriers.thrown):
        expected = make(avoidance.sphere_clearance)(p, t, CENTRE, SHIFTS, RADIUS)
        np.testing.assert_allclose(make(mine, many=True)(p, t, CENTRE, SHIFTS, RADIUS), expected, atol=1e-13)
        if n == 1:
            np.testing.assert_allclose(make(mine)(p, t, CENTRE, SHIFTS, RADIUS), expected, atol=1e-13)
            continue
        with pytest.raises(ModelError, match="say many=True"):
            make(mine)(p, t, CENTRE, SHIFTS, RADIUS)
        with pytest.raises(ModelError, match="say many=True"):
            make(mine)(p, t, np.tile(CENTRE, (n, 1, 1)), SHIFTS, RADIUS)
    np.testing.assert_allclose(  # one time for all is no question
        barriers.moving(mine)(p, 0.3, CENTRE, SHIFTS, RADIUS),
        barriers.moving(avoidance.sphere_clearance)(p, 0.3, CENTRE, SHIFTS, RADIUS), atol=1e-13,
    )  # fmt: skip


def test_a_single_one_of_many_points_may_be_as_many_as_times() -> None:
    """Rows that belong to points of a body, not to obstacles, are said to be of one."""
    corners = clearances.on_body(clearances.to_point, [[0.2, 0.0, 0.0], [-0.2, 0.0, 0.1]])
    x, t = quadrotor.STATE.random(RNG, (2,)), np.array([0.0, 0.4])
    place, velocity = RNG.normal(size=(2, 3)), np.array([1.0, 0.0, 0.0])
    found = barriers.moving(corners, many=False)(x, t, place, velocity, 0.1)
    np.testing.assert_allclose(found, corners(x, place + t[:, None] * velocity, 0.1), atol=1e-13)


def test_any_motion_is_a_function_of_the_time() -> None:
    """Round a circle: where it is at either end counts in a decay, how it moves in a condition."""

    def h(p: Array, t: Any, reach: float) -> Array:
        turn = np.reshape(2.0 * t, (-1, 1))
        there = reach * np.concatenate([np.cos(turn), np.sin(turn), 0.0 * turn], axis=1)
        return clearances.to_point(p, there, 0.3)

    p, u, t = RNG.normal(size=(4, 3)), RNG.normal(size=(4, 3)), np.array([0.0, 0.4, 1.0, 3.0])
    step = 1e-6
    whole = barriers.decay(h, 1.0)(p, p + step * u, t, step, 1.5) / step
    np.testing.assert_allclose(barriers.condition(h, 1.0, fg.Rn(3), lambda p, u: u)(p, u, t, 1.5), whole, atol=1e-4)
    graph, x = graph_with(fg.Rn(3), 5, "p")
    graph.minimize(fg.prior, x, np.array([0.0, 1.5, 0.0]))
    times = 0.2 * np.arange(4)
    kept = keeping.keep(graph, barriers.decay(h, 1.0), x[:-1], x[1:], times, 0.2, 1.5, obstacles=["moon"])
    guess = {x: np.tile([0.0, 1.4, 0.1], (5, 1)), **kept.guess()}
    assert graph.check(guess).routes["barrier"] == EXACT
    found = InteriorPoint().solve(graph, guess)
    away = h(found[x], np.append(times, 0.8), 1.5)
    assert found.converged and (away[1:] >= np.exp(-0.2) * away[:-1] - 1e-4).all() and away.min() > -1e-4


@pytest.mark.parametrize("value", [-1.0, np.inf, np.nan])
def test_gains_that_mean_nothing_are_refused(value: float) -> None:
    h = barriers.still(avoidance.sphere_clearance)
    makers: dict[str, Callable[[], Any]] = {
        "alpha": lambda: barriers.decay(h, value),
        "alpha of a barrier": lambda: barriers.condition(h, value, fg.Rn(3), lambda p, v: v),
        "gamma": lambda: barriers.velocity_extended(h, h, value),
        "k": lambda: barriers.uncertain(h, value),
        "d_safe": lambda: barriers.inverse(h, value),
        "travel": lambda: between_nodes.sag(value, 1.0),
        "deceleration": lambda: terminal.brakeable(h, 1.0, value),
    }
    for name, make in makers.items():
        with pytest.raises(ModelError, match=name):
            make()
    with pytest.raises(ModelError, match="use the distance itself"):
        barriers.inverse(h, 0.0)


# ---------------------------------------------------------------- small problems, every backend, judged from outside


def push(
    form: keeping.Form, start: Array, centre: Array, radius: Array, alpha: float = 2.0, dt: Any = 0.1, **more: Any
) -> Any:
    """A point that wants to be at (3, 0.1, 0), six steps, no faster than 5 m/s; spheres in between."""
    graph, p = graph_with(fg.Rn(3), 7, "p")
    graph.fix(p[0], start)
    graph.minimize(fg.prior, p[1:], np.array([3.0, 0.1, 0.0]), sigma=1.0, name="goal")
    graph.minimize(fg.difference, p[:-1], p[1:], sigma=0.2, name="slow")
    graph.constrain(lambda x, y: y - x, p[:-1], p[1:], lower=-0.5, upper=0.5, name="speed")
    h = barriers.still(avoidance.sphere_clearance)
    kept = keeping.keep(
        graph,
        barriers.decay(h, alpha),
        p[:-1],
        p[1:],
        0.0,
        dt,
        centre,
        radius,
        obstacles=len(radius),
        form=form,
        **more,
    )
    way = np.linspace(0.0, 1.0, 7)[:, None]
    guess = {p: start + way * (np.array([3.0, 0.6, 0.3]) - start), **kept.guess()}
    return graph, p, kept, guess


INEQUALITIES: dict[str, fg.Solver] = {**backends("ipm", "alm", "sqp"), "sqp, exact": SQP(hessian="exact")}
FAR = np.array([-1.0, 0.0, 0.0])
SETTINGS = {
    "outside": (FAR, CENTRE, RADIUS, 2.0, 0.1),
    "inside": (np.array([0.2, 0.05, 0.1]), CENTRE, RADIUS, 2.0, 0.1),
    "touching spheres": (FAR, np.array([[0.0, -0.4, 0.0], [0.0, 0.4, 0.0]]), np.full(2, 0.4), 2.0, 0.1),
    "a point": (FAR, CENTRE, np.zeros(2), 2.0, 0.1),
    "no decay at all": (FAR, CENTRE, RADIUS, 0.0, 0.1),
    "all of it at once": (FAR, CENTRE, RADIUS, 1e6, 0.1),
    "steps of no time": (FAR, CENTRE, RADIUS, 2.0, 0.0),
    "one in the other": (FAR, CENTRE[:1].repeat(2, axis=0), RADIUS, 2.0, 0.1),
}  # fmt: skip


@pytest.mark.parametrize("where", SETTINGS)
@pytest.mark.parametrize("name", INEQUALITIES)
@pytest.mark.product(6)
def test_backends_answer_barriers(name: str, where: str) -> None:
    solver = INEQUALITIES[name]
    start, centre, radius, alpha, dt = SETTINGS[where]
    for form in ("hinge", "hard", "slack"):
        weight = None if form == "hard" else 1e3
        graph, p, _, guess = push(form, start, centre, radius, alpha, dt, weight=weight)
        found = solver.solve(graph, guess, check=True)
        assert judge(graph, found).worst() < 1e-4, form
        assert np.isfinite(found[p]).all()


def test_gauss_newton_creeps_past_a_sphere_and_sqp_turns_to_the_exact_hessian() -> None:
    """A sphere bends as much as what it is weighed against: Gauss-Newton's steps shrink by a few percent each."""
    graph, _, _, guess = push("slack", FAR, CENTRE, RADIUS)
    slow = SQP(hessian="gauss-newton").solve(graph, guess)
    assert slow.status is fg.Status.ITERATION_LIMIT and slow.iterations == 200
    found = SQP().solve(graph, guess)
    assert found.converged and found.iterations < 40
    kinds = [row.details.get("hessian") for row in found.history[1:]]
    turned = kinds.index("exact")
    assert turned >= 20 and all(kind is None for kind in kinds[:turned]) and None not in kinds[turned:]
    assert SQP(time_limit=60.0).solve(graph, guess).iterations == found.iterations


def test_a_start_at_the_very_centre_is_left() -> None:
    """The norm has no direction there; the plan finds one, and the slack says which sphere it was."""
    graph, p, _, guess = push("slack", np.zeros(3), CENTRE, RADIUS, 5.0, 0.1)
    found = InteriorPoint().solve(graph, guess, check=True)
    assert spheres(found[p])[-1].min() > -0.05


def test_the_slack_names_the_obstacle() -> None:
    """A wall of speed that is too low to get out of the way of what comes: only the first of two is hit."""
    graph, p = graph_with(fg.Rn(3), 6, "p")
    start = np.array([0.0, 0.05, 0.0])
    graph.fix(p[0], start)
    graph.minimize(fg.prior, p[1:], start, sigma=1.0)
    graph.constrain(lambda x, y: y - x, p[:-1], p[1:], lower=-0.02, upper=0.02)
    centre, velocity = np.array([[1.0, 0.0, 0.0], [0.0, 5.0, 0.0]]), np.array([[-4.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    times = 0.1 * np.arange(5)
    barrier = barriers.decay(barriers.moving(avoidance.sphere_clearance), 1.0)
    arguments = p[:-1], p[1:], times, 0.1, centre, velocity, np.array([0.3, 0.3])
    kept = keeping.keep(graph, barrier, *arguments, obstacles=("lorry", "tree"))
    found = InteriorPoint().solve(graph, {p: np.tile(start, (6, 1)), **kept.guess()}, check=True)
    used = kept.used(found)
    assert [use.obstacle for use in used] == ["lorry"]
    assert 0.1 < used[0].amount and used[0].interval <= 2
    assert kept.used(found, beyond=10.0) == []
    hard = keeping.keep(graph, barrier, *arguments, obstacles=2, form="hard", name="hard")
    assert not InteriorPoint().solve(graph, {p: np.tile(start, (6, 1)), **kept.guess()}).converged
    assert hard.used(found) == [] and hard.guess() == {} and hard.obstacles == ("hard 0", "hard 1")


def test_uses_are_told_the_most_first_from_where_they_begin() -> None:
    graph, p = graph_with(fg.Rn(3), 3, "p")
    kept = keeping.keep(graph, avoidance.sphere_clearance, p, CENTRE, RADIUS, obstacles=("near", "far"))
    assert kept.slack is not None
    amounts = {kept.slack: np.array([[0.0, 0.1], [0.2, 0.0], [0.3, 1e-4]])}
    assert kept.used(amounts) == [keeping.Use("near", 1, 0.3), keeping.Use("far", 0, 0.1)]
    assert kept.used(amounts, beyond=0.25) == [keeping.Use("near", 2, 0.3)]
    assert kept.used({kept.slack: np.zeros((3, 2))}) == []


def test_a_slack_that_is_not_needed_costs_a_millimetre_or_nothing() -> None:
    """Squared, it is its multiplier over the weight; priced as it is, zero where the price exceeds the multiplier."""
    arguments = np.array([-1.0, 0.0, 0.0]), CENTRE, RADIUS, 2.0, 0.1
    tight = InteriorPoint(tolerance=1e-9)
    graph, _, _, guess = push("hard", *arguments)
    hard = tight.solve(graph, guess)
    multiplier = -hard.dual("barrier").min()
    assert hard.converged and multiplier > 1.0
    graph, _, kept, guess = push("slack", *arguments)
    soft = tight.solve(graph, guess)
    np.testing.assert_allclose(soft[kept.slack], -soft.dual("barrier") / 1e6, atol=1e-9)
    assert soft[kept.slack].max() == pytest.approx(multiplier / 1e6, rel=1e-2)
    for price, least, most in ((10.0 * multiplier, 0.0, 1e-6), (0.1 * multiplier, 1e-3, 1.0)):
        graph, _, kept, guess = push("exact slack", *arguments, weight=price)
        priced = tight.solve(graph, guess)
        assert priced.converged and least <= priced[kept.slack].max() <= most


def test_what_cannot_be_held_is_refused_by_name() -> None:
    graph, p = graph_with(fg.Rn(3), 2, "p")
    with pytest.raises(ModelError, match="found 'soft'"):
        keeping.keep(graph, spheres, p, obstacles=2, form="soft")  # type: ignore[arg-type]
    with pytest.raises(ModelError, match="no obstacle"):
        keeping.keep(graph, avoidance.sphere_clearance, p, CENTRE, RADIUS, obstacles=())
    for weight in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ModelError, match="weight"):
            keeping.keep(graph, avoidance.sphere_clearance, p, CENTRE, RADIUS, obstacles=2, weight=weight)
    centres = graph.data("where the spheres are", CENTRE)
    keeping.keep(graph, avoidance.sphere_clearance, p, centres, RADIUS, obstacles=2)
    run = InteriorPoint().prepare(graph)
    with pytest.raises(GraphError, match=r"where the spheres are.*NaN"):
        run.solve({p: np.ones((2, 3))}, data={centres: np.full((2, 3), np.nan)})


@pytest.mark.parametrize("form", ["hinge", "hard", "slack", "exact slack"])
def test_as_many_obstacles_are_named_as_the_barrier_has(form: keeping.Form) -> None:
    """One slack for two obstacles is another problem than it says; a refused barrier leaves nothing behind."""
    graph, p = graph_with(fg.Rn(3), 2, "p")
    for named in (1, 3, ("lorry",), ("lorry", "tree", "ball")):
        with pytest.raises(ModelError, match="'spheres': the barrier says something of 2 obstacles, found"):
            keeping.keep(
                graph, avoidance.sphere_clearance, p, CENTRE, RADIUS, obstacles=named, form=form, name="spheres"
            )
    graph.minimize(fg.prior, p, np.zeros(3), name="spheres")  # the name is taken
    before = str(graph)
    with pytest.raises(GraphError, match="'spheres'"):
        keeping.keep(graph, avoidance.sphere_clearance, p, CENTRE, RADIUS, obstacles=2, form=form, name="spheres")
    assert str(graph) == before
    graph.remove("spheres")
    assert keeping.keep(
        graph, avoidance.sphere_clearance, p, CENTRE, RADIUS, obstacles=2, form=form, name="spheres"
    ).obstacles == ("spheres 0", "spheres 1")


def test_inactive_intervals_are_not_held() -> None:
    graph, p = graph_with(fg.Rn(3), 2, "p")
    graph.minimize(fg.prior, p, np.array([0.1, 0.0, 0.0]))
    kept = keeping.keep(
        graph, avoidance.sphere_clearance, p, CENTRE, RADIUS, obstacles=2, active=np.array([True, False])
    )
    found = InteriorPoint().solve(graph, {p: np.full((2, 3), 0.7), **kept.guess()}, check=True)
    reached = spheres(found[p])[:, 0]
    assert reached[0] > -1e-3 and reached[1] == pytest.approx(-0.3, abs=1e-4)


@pytest.mark.parametrize(
    ("count", "tick", "node"), [(0, 0.01, 0.05), (3, 0.0, 0.05), (3, 0.1, 0.05), (3, 0.01, np.inf), (3, np.nan, 0.1)]
)
def test_the_first_interval_is_a_tick(count: int, tick: Any, node: Any) -> None:
    begins, lengths = keeping.grid(4, 0.01, 0.05)
    np.testing.assert_allclose(lengths, [0.01, 0.05, 0.05, 0.05])
    np.testing.assert_allclose(begins, [0.0, 0.01, 0.06, 0.11])
    with pytest.raises(ModelError, match="grid"):
        keeping.grid(count, tick, node)


def past_two(form: keeping.Form, unit: float, offset: float, flat: bool) -> tuple[Any, Any, Any, Any]:
    """A unicycle, or a point in space, past two obstacles; lengths in units of ``unit`` metres, far from the origin."""
    n, dt, graph = 10, 0.1, fg.Graph()
    centre = unit * np.array([[0.8, 0.05, 0.0], [1.5, -0.3, 0.1]]) + offset
    radius = unit * np.array([0.3, 0.2])
    weight = None if form == "hard" else {"exact slack": 1e4 / unit, "hinge": 1e4 / unit**2}.get(form, 1e6 / unit**2)
    ahead = unit * 0.15 * np.arange(n + 1)[:, None]
    if flat:
        x, u = graph.variables("x", fg.SE2, n + 1), graph.variables("u", fg.Rn(2), n)
        start = np.array([offset, offset, 0.0])
        graph.constrain(unicycle.dynamics, x[:-1], u, x[1:], dt, lower=0.0, upper=0.0)
        graph.bound(u, lower=[0.0, -2.0], upper=[2.0 * unit, 2.0])
        graph.minimize(fg.prior, u, [1.5 * unit, 0.0], sigma=[unit, 1.0])
        given: tuple[Any, ...] = obstacles.disc_clearance, centre[:, :2], radius
        guess: dict[Any, Any] = {x: start + ahead * [1.0, 0.0, 0.0], u: np.tile([1.5 * unit, 0.0], (n, 1))}
    else:
        x, start = graph.variables("x", fg.Rn(3), n + 1), np.full(3, float(offset))
        graph.minimize(lambda p, q: (q - p) / (unit * dt) - [1.5, 0.0, 0.0], x[:-1], x[1:])
        given, guess = (avoidance.sphere_clearance, centre, radius), {x: start + ahead * [1.0, 0.0, 0.0]}
    graph.fix(x[0], start)
    barrier = barriers.decay(barriers.still(given[0]), 2.0)
    kept = keeping.keep(graph, barrier, x[:-1], x[1:], 0.0, dt, *given[1:], obstacles=2, form=form, weight=weight)

    def least(found: Any) -> float:
        return float(barrier(found[x][:-1], found[x][1:], 0.0, dt, *given[1:]).min()) / unit

    return graph, {**guess, **kept.guess()}, least, (x, start)


@pytest.mark.parametrize("form", ["hinge", "hard", "slack", "exact slack"])
@pytest.mark.parametrize("name", INEQUALITIES)
@pytest.mark.product(8)
def test_neither_units_nor_offsets_nor_the_robot_matter(name: str, form: keeping.Form) -> None:
    for unit, offset, flat in ((1.0, 0.0, False), (1.0, 1e6, False), (1e3, 0.0, False), (1.0, 1e6, True)):
        graph, guess, least, (x, start) = past_two(form, unit, offset, flat)
        if (form, flat) == ("hinge", True):
            continue  # beside hard dynamics, a hinge of such a weight is for the interior point
        found = INEQUALITIES[name].solve(graph, guess, check=True)
        assert least(found) > (-5e-3 if form == "hinge" else -1e-4), (unit, offset, flat)
        assert found[x][-1, 0] - start[0] > 0.5 * unit, (unit, offset, flat)  # it is no way out to stay


# ---------------------------------------------------------------- where the graph grows


def test_a_slack_in_a_smoother_is_refused_with_what_to_say_instead() -> None:
    smoother, p = smoother_with(fg.Incremental(), fg.Rn(3), "p")
    with pytest.raises(ModelError, match=r"Incremental is no graph.*keeping.hinge"):
        keeping.keep(smoother, avoidance.sphere_clearance, p[0], CENTRE, RADIUS, obstacles=2)  # type: ignore[arg-type]


# ---------------------------------------------------------------- robot and obstacle estimated in the graph of the plan


def catch_sight(k: float, seed: int, sightings: int = 8) -> tuple[Array, Array]:
    """A ball thrown at a vehicle that would rather stay, seen from the past; the plan, and where the ball will be.

    Position and velocity of the ball and the vehicle's own place are unknowns of the one graph; what is known of the
    difference of both at each node, from the last solve, says how far to keep off.
    """
    rng = np.random.default_rng(seed)
    dt, n, radius, sigma = 0.05, 10, 0.3, 0.04
    down = np.array([0.0, 0.0, -0.5 * 9.81])
    place, speed = np.array([3.0, 0.05, 0.3]), np.array([-6.0, 0.0, 2.0])  # of now; in half a second it is here
    before = -dt * np.arange(sightings)[:, None]
    seen = place + before * speed + before**2 * down + sigma * rng.normal(size=(sightings, 3))
    ahead = dt * np.arange(n + 1)
    graph, p = graph_with(fg.Rn(3), n + 1, "p")
    ball, throw = graph.variables("ball", fg.Rn(3), 1), graph.variables("throw", fg.Rn(3), 1)
    graph.minimize(fg.prior, p[0], np.zeros(3), sigma=0.02, name="where we are")

    def sighting(p: Array, c: Array, v: Array, s: Array, z: Array) -> Array:
        return np.asarray(c + s * v + s**2 * down - p - z)

    here = p[np.zeros(sightings, dtype=int)]
    graph.minimize(sighting, here, ball, throw, before, seen, sigma=sigma, name="seen")
    graph.minimize(fg.prior, p[1:], np.zeros(3), sigma=1.0, name="stay")
    graph.constrain(lambda p, q: q - p, p[:-1], p[1:], lower=-0.15, upper=0.15, name="speed")
    roots = graph.data("roots", np.zeros((n, 3, 3)), each=True)
    h = barriers.uncertain(barriers.thrown(clearances.to_point), k)
    kept = keeping.keep(graph, h, p[1:], ahead[1:], roots, ball, throw, radius, obstacles=["ball"])
    aside = 0.01 * np.arange(n + 1)[:, None] * [0.0, -1.0, 0.2]
    guess = {p: aside, ball: place[None], throw: speed[None], **kept.guess()}
    run = InteriorPoint().prepare(graph)
    found = run.solve(guess, check=True)
    joint = found.covariance(p[0], ball[0], throw[0])
    spread = []
    for t in ahead[1:]:
        J = np.concatenate([-np.eye(3), np.eye(3), t * np.eye(3)], axis=1)
        spread.append(np.linalg.cholesky(J @ joint @ J.T + 1e-12 * np.eye(3)))
    found = run.solve(found, data={roots: np.array(spread)}, check=True)
    assert np.linalg.norm(found[throw][0] - speed) < 1.5
    s = ahead[1:, None]
    return found[p][1:], np.linalg.norm(found[p][1:] - place - s * speed - s**2 * down, axis=1) - radius


def test_three_standard_deviations_keep_off_a_ball_that_is_estimated() -> None:
    """Without them every throw touches: by the noise, and by a plan that would rather believe the ball elsewhere."""
    bold, careful = ([catch_sight(k, seed)[1].min() for seed in range(4)] for k in (0.0, 3.0))
    assert max(bold) < 0.0
    assert 0.0 < min(careful) and max(careful) < 0.5  # and no farther than the spread asks for
