"""Smoothers take what a graph takes: every residual, weight and loss, against a batch solve of the same graph."""

from __future__ import annotations

import copy
from collections.abc import Callable
from functools import cache
from typing import Any

import numba
import numpy as np
import pytest

import unifg as fg
from dense import seen_once
from own_manifolds import Sphere
from problems.graphs import smoother_with
from unifg.errors import GraphError
from unifg.models.avoidance import landmark_clearance
from unifg.smoothing import FixedLag, Incremental
from unifg.solvers import LevenbergMarquardt
from unifg.typing import Array

COUNT = 8
STEP = np.array([0.5, 0.05, 0.2])


class Everyday:
    """A loss of a user's own: rho(s) = 2 (sqrt(1 + s) - 1)."""

    held = False

    def value(self, squared: Array) -> Array:
        return 2.0 * (np.sqrt(1.0 + squared) - 1.0)

    def weight(self, squared: Array) -> Array:
        return 1.0 / np.sqrt(1.0 + squared)


def seen(pose: Array, point: Array, measured: Any) -> Array:
    """A point in the frame of the pose, batched."""
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    dx, dy = point[:, 0] - pose[:, 0], point[:, 1] - pose[:, 1]
    return np.asarray(np.stack([c * dx + s * dy, c * dy - s * dx], axis=1) - measured)


def seen_jacobian(pose: Array, point: Array, measured: Any) -> list[Array]:
    r = seen(pose, point, 0.0)
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    by_pose = np.zeros((len(r), 2, 3))
    by_pose[:, 0, 0] = by_pose[:, 1, 1] = -1.0
    by_pose[:, 0, 2], by_pose[:, 1, 2] = r[:, 1], -r[:, 0]
    return [by_pose, np.stack([np.stack([c, s], axis=1), np.stack([-s, c], axis=1)], axis=1)]


@numba.njit  # type: ignore[untyped-decorator]
def seen_once_jacobian(pose: Array, point: Array, measured: Array, by_pose: Array, by_point: Array) -> None:
    c, s = np.cos(pose[2]), np.sin(pose[2])
    dx, dy = point[0] - pose[0], point[1] - pose[1]
    by_pose[:] = 0.0
    by_pose[0, 0] = by_pose[1, 1] = -1.0
    by_pose[0, 2], by_pose[1, 2] = c * dy - s * dx, -(c * dx + s * dy)
    by_point[0, 0], by_point[0, 1], by_point[1, 0], by_point[1, 1] = c, s, -s, c


RESIDUALS: dict[str, Any] = {
    "numpy": seen,
    "numpy with derivatives": fg.residual(seen, seen_jacobian),
    "njit": fg.residual(seen_once, rows=2),
    "njit with derivatives": fg.residual(seen_once, seen_once_jacobian, rows=2),
}
LOSSES: dict[str, Any] = {
    "none": None,
    "Huber": fg.Huber(1.0),
    "Cauchy": fg.Cauchy(1.5),
    "Tukey": fg.Tukey(6.0),
    "DCS": fg.DCS(2.0),
    "GemanMcClure": fg.GemanMcClure(3.0),
    "TruncatedLeastSquares": fg.TruncatedLeastSquares(4.0, 0.5),
    "Reweighted": fg.Reweighted(lambda s: 1.0 / (1.0 + 0.1 * s)),
    "a user's own": Everyday(),
}
rng = np.random.default_rng(5)
POINTS = rng.uniform(-2.0, 2.0, (3, 2))
POSES = np.cumsum(np.tile(STEP, (COUNT, 1)), axis=0)
NOISE = 0.05 * rng.standard_normal((COUNT, 3))
SIGHTINGS = np.concatenate([seen(np.repeat(POSES[k : k + 1], 3, axis=0), POINTS, 0.0) for k in range(COUNT)])
SIGHTINGS += 0.05 * rng.standard_normal(SIGHTINGS.shape)
SIGHTINGS[4] += 0.2  # some of them doubtful
SIGHTINGS[16] -= 0.25
ROOT = rng.uniform(-5.0, 5.0, (COUNT * 3, 2, 2))
WEIGHTS: dict[str, Callable[[slice], dict[str, Any]]] = {
    "scalar sigma": lambda own: {"sigma": 0.1},
    "sigma of rows": lambda own: {"sigma": [0.1, 0.2]},
    "sigma of factors": lambda own: {"sigma": 0.1 + 0.01 * np.abs(SIGHTINGS[own])},
    "information": lambda own: {"information": np.array([[80.0, 20.0], [20.0, 60.0]])},
    "information of factors": lambda own: {"information": 40.0 * np.eye(2) + ROOT[own] @ ROOT[own].transpose(0, 2, 1)},
    "singular information": lambda own: {"information": np.array([[50.0, 50.0], [50.0, 50.0]])},
    "nothing": lambda own: {},
}


def state_pose(statement: Any, x: Any, points: Any, k: int, residual: Any, weights: Any, robust: Any) -> None:
    """State the terms that arrive with one pose: odometry, and sightings of three points."""
    if k == 0:
        statement.minimize(fg.prior, x[0], POSES[0], sigma=0.01)
        statement.minimize(fg.prior, points[np.arange(3)], POINTS, sigma=0.5)
    else:
        moved = fg.SE2.compose(fg.SE2.between(POSES[k - 1], POSES[k]), fg.SE2.exp(NOISE[k]))
        statement.minimize(fg.between, x[k - 1], x[k], moved, sigma=[0.05, 0.05, 0.03])
    own = slice(3 * k, 3 * k + 3)
    statement.minimize(residual, x[k], points[np.arange(3)], SIGHTINGS[own], robust=robust, **WEIGHTS[weights](own))


@cache
def batch(weights: str, loss: str) -> tuple[Array, Array, float]:
    """Poses, points and cost of the optimum; all kinds of the residual have the same."""
    graph, residual, robust = fg.Graph(), RESIDUALS["numpy with derivatives"], LOSSES[loss]
    x, points = graph.variables("x", fg.SE2, COUNT), graph.variables("points", fg.Rn(2), 3)
    for k in range(COUNT):
        state_pose(graph, x, points, k, residual, weights, robust)
    guess = {x: POSES, points: POINTS}
    solution = LevenbergMarquardt(tolerance=1e-13, max_iterations=300).solve(graph, guess)
    return solution[x], solution[points], solution.cost


def smoothed(smoother: Any, residual: Any, weights: str, robust: Any) -> tuple[Array, Array, float]:
    """The same, pose by pose."""
    x, points = smoother.variables("x", fg.SE2), smoother.variables("points", fg.Rn(2))
    for k in range(COUNT):
        state_pose(smoother, x, points, k, residual, weights, robust)
        smoother.update({x: POSES[k], points: POINTS} if k == 0 else {x: POSES[k]})
    smoother.update(iterations=40)
    return smoother.estimate(x), smoother.estimate(points), smoother.cost


def make(kind: str) -> Any:
    if kind == "incremental":
        return Incremental(relinearize=0.0, wildfire=0.0)
    return FixedLag(COUNT, relinearize=0.0, wildfire=0.0)


def agree(kind: str, residual: str, weights: str, loss: str) -> None:
    poses, points, cost = batch(weights, loss)
    found = smoothed(make(kind), RESIDUALS[residual], weights, LOSSES[loss])
    np.testing.assert_allclose(found[0], poses, atol=1e-8)
    np.testing.assert_allclose(found[1], points, atol=1e-8)
    assert found[2] == pytest.approx(cost, rel=1e-8)


@pytest.mark.parametrize("kind", ["incremental", "fixed lag"])
@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("residual", RESIDUALS)
@pytest.mark.product(8)
def test_every_residual_with_every_loss(kind: str, residual: str, loss: str) -> None:
    agree(kind, residual, "information of factors", loss)


@pytest.mark.product(10)
@pytest.mark.parametrize("kind", ["incremental", "fixed lag"])
@pytest.mark.parametrize("weights", WEIGHTS)
@pytest.mark.parametrize("residual", ["numpy", "njit"])
def test_every_weight(kind: str, residual: str, weights: str) -> None:
    agree(kind, residual, weights, "Cauchy" if residual == "njit" else "none")


BODY = fg.Product(pose=fg.SE2, velocity=fg.Rn(2))


def advance(pose: Array, velocity: Array, after: Array, dt: float) -> Array:
    """Deviation of the next pose from the one reached with a velocity of the body."""
    step = np.concatenate([dt * velocity, np.zeros((len(velocity), 1))], axis=1)
    return fg.SE2.local(fg.SE2.compose(pose, fg.SE2.exp(step)), after)


@numba.njit  # type: ignore[untyped-decorator]
def steady(velocity: Array, body: Array, later: Array, r: Array) -> None:
    """A component, the whole it belongs to, and another whole in one factor."""
    r[0] = later[3] - velocity[0] + 0.1 * body[3]
    r[1] = later[4] - velocity[1] + 0.1 * body[2]


def total(*numbers: Array) -> Array:
    return np.asarray(sum(numbers)) - 1.0


def several(statement: Any, x: Any, y: Any, each: Any) -> None:
    """Components, wholes beside them, constants in the place of variables, a member twice, twenty variables, data."""
    steps = np.arange(COUNT - 1)
    statement.minimize(fg.prior, x[0].pose, POSES[0], sigma=0.1)
    statement.minimize(fg.prior, x.velocity[np.arange(COUNT)], [0.5, 0.1], sigma=0.4)
    statement.minimize(advance, x[steps].pose, x[steps].velocity, x[steps + 1].pose, 0.9, sigma=[0.1, 0.2, 0.3])
    statement.minimize(fg.residual(steady, rows=2), x[steps].velocity, x[steps], x[steps + 1], sigma=0.2)
    statement.minimize(fg.between, POSES[2] + 0.1, x[5].pose, STEP, sigma=0.3)
    statement.minimize(fg.difference, x[3].velocity, x[3].velocity, sigma=0.1)
    statement.minimize(total, y[0], y[0], y[1], sigma=0.5, name="a member twice")
    statement.minimize(total, *[y[k] for k in range(20)], sigma=0.5, robust=fg.Huber(1.0), name="twenty")
    statement.minimize(lambda v, m: v - m, y[np.arange(20)], each, sigma=1.0, name="data", active=np.arange(20) != 7)
    statement.minimize(fg.prior, y[7], [0.3], sigma=2.0)


@pytest.mark.parametrize("kind", ["incremental", "fixed lag"])
def test_components_constants_repetitions_and_many_variables(kind: str) -> None:
    values = np.concatenate([POSES, np.ones((COUNT, 2))], axis=1)
    numbers = np.linspace(-1.0, 1.0, 20)[:, None]
    graph, smoother = fg.Graph(), make(kind) if kind == "incremental" else FixedLag(20, relinearize=0.0, wildfire=0.0)
    x, y = graph.variables("x", BODY, COUNT), graph.variables("y", fg.Rn(1), 20)
    several(graph, x, y, graph.data("each", numbers, each=True))
    solution = LevenbergMarquardt(tolerance=1e-13, max_iterations=200).solve(graph, {x: values, y: numbers})
    u, v = smoother.variables("x", BODY), smoother.variables("y", fg.Rn(1))
    smoother.minimize(fg.prior, u[np.arange(COUNT)], values, sigma=1e9)  # names the members: slices have none yet
    smoother.minimize(fg.prior, v[np.arange(20)], numbers, sigma=1e9)
    smoother.update({u: values, v: numbers})
    several(smoother, u, v, smoother.data("each", numbers, each=True))
    smoother.update(iterations=30)
    np.testing.assert_allclose(smoother.estimate(u), solution[x], atol=1e-8)
    np.testing.assert_allclose(smoother.estimate(v), solution[y], atol=1e-8)
    assert smoother.cost == pytest.approx(solution.cost, rel=1e-8)
    np.testing.assert_allclose(smoother.covariance(u[3].velocity), solution.covariance(x[3].velocity), rtol=1e-6)


@pytest.mark.parametrize("kind", ["incremental", "fixed lag"])
@pytest.mark.product(1, of="studies")
def test_a_manifold_that_only_numpy_moves(kind: str) -> None:
    sphere, generator = Sphere(), np.random.default_rng(2)
    truth = sphere.retract(np.array([0.6, 0.0, 0.8]), 0.3 * generator.standard_normal((COUNT, 2)))
    measured = sphere.retract(truth, 0.05 * generator.standard_normal((COUNT, 2)))
    guess = sphere.retract(truth, 0.4 * generator.standard_normal((COUNT, 2)))

    def turned(first: Array, second: Array, difference: Array) -> Array:
        return second - first - difference

    graph, smoother = fg.Graph(), make(kind)
    x, y = graph.variables("x", sphere, COUNT), smoother.variables("x", sphere)
    for k in range(COUNT):
        for statement, family in ((graph, x), (smoother, y)):
            statement.minimize(fg.prior, family[k], measured[k], sigma=0.1)
            if k:
                statement.minimize(turned, family[k - 1], family[k], truth[k] - truth[k - 1], sigma=0.02)
        smoother.update({y: guess[k]})
    smoother.update(iterations=30)
    solution = LevenbergMarquardt(tolerance=1e-13, max_iterations=200).solve(graph, {x: guess})
    np.testing.assert_allclose(smoother.estimate(y), solution[x], atol=1e-8)
    assert smoother.cost == pytest.approx(solution.cost, rel=1e-8)


def drive_window(smoother: Any, residual: Any, robust: Any, manifold: Any = fg.SE2) -> tuple[Array, int]:
    """Twice as many poses as the window holds, poor first guesses, loops within it; what is left at the end."""
    generator = np.random.default_rng(3)
    x = smoother.variables("x", manifold)
    for k in range(30):
        smoother.minimize(fg.prior, x[k], np.append(STEP[:2] * k, 0.0), sigma=0.3 if k else 0.01)
        for other in [o for o in (k - 1, k - 4) if o >= 0]:
            noise = 0.02 * generator.standard_normal(2)
            smoother.minimize(residual, x[other], x[k], noise + STEP[:2] * (k - other), sigma=0.1, robust=robust)
        smoother.update({x: np.append(STEP[:2] * k, 0.0) + 0.3 * generator.standard_normal(3)}, iterations=2)
    smoother.update(iterations=3)
    return smoother.estimate(smoother.window(x)), len(smoother._batches._held)


def place_from(pose: Array, other: Array, measured: Any) -> Array:
    return seen(pose, other[:, :2], measured)


@numba.njit  # type: ignore[untyped-decorator]
def place_from_once(pose: Array, other: Array, measured: Array, r: Array) -> None:
    seen_once(pose, other, measured, r)


class Plain(fg.Manifold):
    """SE2 without compiled functions."""

    name, storage, dim = "plain SE2", 3, 3
    identity, retract, local = (staticmethod(getattr(fg.SE2, name)) for name in ("identity", "retract", "local"))
    random, is_valid = staticmethod(fg.SE2.random), staticmethod(fg.SE2.is_valid)


@pytest.mark.parametrize("fixed_points", [False, True])
@pytest.mark.product(1, of="studies")
def test_windows_forget_alike_whoever_evaluates(fixed_points: bool) -> None:
    """Marginalised factors of NumPy functions, losses of a user's own and manifolds that NumPy moves count the same."""

    def window() -> FixedLag:
        return FixedLag(9, relinearize=0.0, wildfire=0.0, fixed_points=fixed_points)

    for compiled, by_python in ((None, fg.Reweighted(np.ones_like)), (fg.Cauchy(2.0), fg.Cauchy(2.0))):
        wanted, none = drive_window(window(), fg.residual(place_from_once, rows=2), compiled)
        found, held = drive_window(window(), fg.residual(place_from, derivatives="differences"), by_python)
        np.testing.assert_allclose(found, wanted, atol=1e-8)
        assert none == 0 and 0 < held < 90
        found, held = drive_window(window(), fg.residual(place_from), compiled)
        np.testing.assert_allclose(found, wanted, atol=1e-8)
        assert held == 0, "a traced function is a kernel"
        found, _ = drive_window(window(), fg.residual(place_from), by_python, Plain())
        np.testing.assert_allclose(found, wanted, atol=1e-7)


@pytest.mark.parametrize("alone", [False, True])
def test_known_elements_of_shipped_residuals_are_parameters(alone: bool) -> None:
    """Python evaluates nothing where a landmark is known, and it is estimated as from an unknown one there."""
    places, ranges = np.array([[2.0, 0.5], [-1.0, 2.0], [1.0, -3.0]]), np.array([2.0, 2.4, 3.0])
    found = []
    for known in (True, False):
        smoother = Incremental(relinearize=0.0)
        p, y = smoother.variables("p", fg.Rn(3)), smoother.variables("y", fg.Rn(2))
        smoother.minimize(fg.prior, p[0], np.zeros(3), sigma=1.0)
        smoother.minimize(fg.prior, y[np.arange(3)], fg.each(places), sigma=1e-7)
        for k in range(3) if alone else [np.arange(3)]:
            near = places[k] if alone else fg.each(places)
            length = ranges[k] if alone else fg.each(ranges)
            smoother.minimize(landmark_clearance, p[0], near if known else y[k], length, sigma=0.1)
        smoother.update({p: np.zeros((1, 3)), y: places}, iterations=9)
        assert len(smoother._batches._held) == 0
        found.append(smoother.estimate(p))
    np.testing.assert_allclose(found[0], found[1], atol=1e-6)


@pytest.mark.parametrize("kind", ["compiled", "traced", "differenced", "between"])
def test_one_variable_is_seen_by_all_factors_of_a_statement(kind: str) -> None:
    """Constants alone tell how many factors there are; each of them counts, but for one that is not active."""
    generator, truth = np.random.default_rng(6), np.array([[0.3, -0.2, 0.4]])
    seen_from = generator.standard_normal((4, 3))
    ahead = fg.SE2.between(seen_from, truth) + 0.05 * generator.standard_normal((4, 3))
    points = seen_from[:, :2]
    measured = seen(truth, points, 0.0) + 0.05 * generator.standard_normal((4, 2))
    function: Any = {"compiled": fg.residual(seen_once, rows=2), "traced": seen, "between": fg.between}.get(
        kind, fg.residual(seen, derivatives="differences")
    )
    found: list[Array] = []
    for made in (fg.Graph(), Incremental(relinearize=0.0)):
        x: Any = made.variables("x", fg.SE2, 1) if isinstance(made, fg.Graph) else made.variables("x", fg.SE2)
        made.minimize(fg.prior, x[0], np.zeros(3), sigma=1.0)
        arguments: tuple[Any, ...] = (x[0], fg.each(points), fg.each(measured))
        if kind == "between":
            arguments = (fg.each(seen_from), x[0], fg.each(ahead))
        made.minimize(function, *arguments, sigma=0.5, active=np.arange(4) != 2)
        if isinstance(made, fg.Graph):
            solution = LevenbergMarquardt(tolerance=1e-12).solve(made, {x: np.zeros((1, 3))})
            found += [solution[x], np.array(solution.cost)]
        else:
            made.update({x: np.zeros((1, 3))}, iterations=20)
            found += [made.estimate(x), np.array(made.cost)]
    np.testing.assert_allclose(found[2], found[0], atol=1e-7)
    np.testing.assert_allclose(found[3], found[1], atol=1e-7)


def test_a_statement_without_active_factors_states_nothing() -> None:
    smoother, x = smoother_with(Incremental(), fg.Rn(2))
    smoother.minimize(fg.prior, x[np.arange(2)], fg.each(np.eye(2)), sigma=fg.each(np.ones((2, 2))))
    for limit in (None, 3.0):
        smoother.minimize(fg.prior, x[np.arange(2)], np.ones(2), active=np.zeros(2, dtype=bool), revocable=limit)
    smoother.update({x: np.zeros((2, 2))})
    np.testing.assert_allclose(smoother.estimate(x), np.eye(2), atol=1e-12)


def test_a_function_that_fails_loses_nothing() -> None:
    smoother, calls = Incremental(relinearize=0.0), [0]

    def moody(value: Array) -> Array:
        calls[0] += 1
        if value[0, 0] > 5.0 and calls[0] < 10**6:
            raise ValueError("not today")
        return value - 6.0

    y = smoother.variables("y", fg.Rn(1))
    smoother.minimize(fg.prior, y[0], [1.0], sigma=1.0)
    smoother.update({y: [1.0]})
    smoother.minimize(moody, y[1], sigma=1.0)
    smoother.minimize(fg.between, y[0], y[1], [5.0], sigma=1.0)
    with pytest.raises(ValueError, match="not today") as caught:
        smoother.update({y: [7.0]})
    assert "at factor 0, whose first variable is y[1]" in caught.value.__notes__
    with pytest.raises(GraphError, match="last update failed"):
        smoother.covariance(y)
    calls[0] = 10**6
    smoother.update()
    np.testing.assert_allclose(smoother.estimate(y), [[1.0], [6.0]], atol=1e-9)
    twin = copy.deepcopy(smoother)
    twin.minimize(fg.prior, twin.families["y"][0], [4.0], sigma=1.0)
    twin.update()
    assert twin.estimate(twin.families["y"])[0, 0] > 1.5 and smoother.estimate(y)[0, 0] == pytest.approx(1.0)


@pytest.mark.parametrize("late", [True, False])
def test_a_function_in_python_that_reads_something_else_later_is_named(
    late: bool, caplog: pytest.LogCaptureFixture
) -> None:
    smoother, name, truth = Incremental(relinearize=0.0), f"ranges {late}", np.array([1.0, 2.0])
    x = smoother.variables("x", fg.Rn(2))
    smoother.minimize(fg.prior, x[0], [0.2, 0.5], sigma=5.0)
    smoother.update({x: [0.2, 0.5]})
    now: dict[str, Any] = {}

    def measured(point: Array) -> Array:
        a, seen = now["anchor"], now["seen"]
        return np.array([[float(one[0] - a[0]) ** 2 + float(one[1] - a[1]) ** 2 - seen] for one in point])

    def given(point: Array, a: Array, seen: Array) -> Array:
        return np.array([[float(one[0] - a[0]) ** 2 + float(one[1] - a[1]) ** 2 - seen[0]] for one in point])

    for anchor in ([4.0, 0.0], [0.0, 5.0], [-3.0, -1.0]):
        now.update(anchor=anchor, seen=float(((truth - anchor) ** 2).sum()))
        if late:
            smoother.minimize(measured, x[0], sigma=0.01, name=name)
        else:
            smoother.minimize(given, x[0], anchor, [now["seen"]], sigma=0.01, name=name)
        smoother.update(iterations=5)
    said = [record.message for record in caplog.records if "has changed since a factor was stated" in record.message]
    assert len(said) == late and all(f"term '{name}'" in message for message in said)
    assert (np.abs(smoother.estimate(x[0]) - truth).max() < 1e-3) is not late


@pytest.mark.parametrize("method", ["constrain", "bound", "fix", "minimize_scalar"])
def test_what_is_no_least_squares_is_refused(method: str) -> None:
    smoother, x = smoother_with(FixedLag(3), fg.Rn(1))
    with pytest.raises(GraphError, match=rf"FixedLag\.{method}: .* or solve the whole as a fg\.Graph"):
        getattr(smoother, method)(x[0])


def kinds() -> dict[str, tuple[Any, tuple[Any, ...], dict[str, Any]]]:
    """Statements of a single factor: function, numbers of its arguments, options."""
    full = np.diag([4.0, 9.0, 25.0]) + 0.5
    return {
        "information": (fg.between, (STEP,), {"information": full}),
        "turned information": (fg.between, (STEP,), {"information": np.asfortranarray(full)}),
        "one sigma": (fg.between, (STEP,), {"sigma": 0.1}),
        "three sigmas": (fg.between, (STEP,), {"sigma": np.array([0.1, 0.2, 0.3])}),
        "neither": (fg.between, (STEP,), {}),
        "loss": (fg.between, (STEP,), {"sigma": 0.1, "robust": fg.Huber(1.0), "name": "own"}),
        "traced": (lambda a, b, z: (b - a) - z, (STEP,), {"sigma": 0.1}),
        "traced with a constant": (lambda a, b, z, k: k * (b - a) - z, (STEP, np.array([2.0])), {"sigma": 0.1}),
        "by Python": (lambda a, b, z: np.vectorize(float)(b - a) - z, (STEP,), {"sigma": 0.1}),
    }


@pytest.mark.parametrize("kind", kinds())
def test_the_second_of_a_kind_says_what_the_first_would_have_said(kind: str) -> None:
    """Stated one by one, or each by a smoother that sees its kind for the first time: the same numbers."""
    function, numbers, options = kinds()[kind]
    rng, staged = np.random.default_rng(0), []
    smoother, x = smoother_with(Incremental(), fg.SE2)
    for k in range(3):
        given = tuple(number + 0.1 * rng.standard_normal(number.shape) for number in numbers)
        weight = {
            name: value * (1.0 + k) if name in ("sigma", "information") else value for name, value in options.items()
        }
        fresh, y = smoother_with(Incremental(), fg.SE2)
        smoother.minimize(function, x[k], x[k + 1], *given, **weight)
        fresh.minimize(function, y[k], y[k + 1], *given, **weight)
        staged.append((smoother._staged[-1], fresh._staged[-1]))
    for ours, theirs in staged:
        assert (ours.kind, ours.members, ours.name) == (theirs.kind, theirs.members, theirs.name)
        np.testing.assert_array_equal(ours.data, theirs.data)
        assert (ours.term is None) == (theirs.term is None)
    assert bool(smoother._types._kinds) == (kind != "by Python")


@pytest.mark.parametrize(
    ("numbers", "options", "words"),
    [
        ((np.array([1.0, np.nan, 0.0]),), {"sigma": 0.1}, "not finite"),
        ((np.array([1.0, 0.0]),), {"sigma": 0.1}, "shape"),
        ((STEP,), {"sigma": -0.1}, "must be positive"),
        ((STEP,), {"sigma": np.inf}, "must be positive"),
        ((STEP,), {"sigma": np.array([0.1, 0.0, 0.1])}, "must be positive"),
        ((STEP,), {"sigma": np.array([0.1, 0.1])}, "sigma has shape"),
        ((STEP,), {"sigma": np.array([0.1, np.nan, 0.1])}, "must be positive"),
        ((STEP,), {"information": np.triu(np.ones((3, 3)))}, "symmetric"),
        ((STEP,), {"information": -np.eye(3)}, "negative eigenvalue"),
        ((STEP,), {"information": np.eye(2)}, "information has shape"),
        ((STEP,), {"information": np.eye(3), "sigma": 0.1}, "not both"),
    ],
)
def test_the_second_of_a_kind_is_refused_as_the_first(
    numbers: tuple[Any, ...], options: dict[str, Any], words: str
) -> None:
    smoother, x = smoother_with(Incremental(), fg.SE2)
    for weight in ({"sigma": 0.1}, {"sigma": np.full(3, 0.1)}, {"information": np.eye(3)}):
        for k in range(2):
            smoother.minimize(fg.between, x[k], x[k + 1], STEP, **weight)
    with pytest.raises(GraphError, match=words):
        smoother.minimize(fg.between, x[2], x[3], *numbers, **options)
    assert len(smoother._staged) == 6


def test_singular_information_counts_also_the_second_time() -> None:
    smoother, x = smoother_with(Incremental(), fg.SE2)
    for information in (np.eye(3), np.diag([1.0, 0.0, 1.0])):
        smoother.minimize(fg.between, x[0], x[1], STEP, information=information)
    np.testing.assert_allclose(smoother._staged[1].data[0, 3:].reshape(3, 3) ** 2, np.diag([1.0, 0.0, 1.0]), atol=1e-15)


def test_kinds_differ_by_family_component_and_what_a_function_reaches() -> None:
    """Nothing is taken for a kind that it only resembles; and what a function reads from outside counts as it is."""
    smoother = Incremental()
    x, y = smoother.variables("x", fg.SE2), smoother.variables("y", fg.SE2)
    pair = smoother.variables("pair", fg.Product(a=fg.SE2, b=fg.SE2))
    reached = np.array([1.0, 2.0, 3.0])

    def own(a: Array, b: Array) -> Array:
        return np.asarray(b - a - reached)

    for _ in range(2):
        for ends in ((x[0], x[1]), (x[0], y[1]), (pair[0].a, pair[1].a), (pair[0].a, pair[1].b)):
            smoother.minimize(fg.between, *ends, STEP, sigma=0.1)
    first = smoother._staged[:4]
    for one, again in zip(first, smoother._staged[4:], strict=True):
        assert (one.kind, one.families, one.members) == (again.kind, again.families, again.members)
    assert len({(item.kind, *[family.name for family in item.families]) for item in first}) == 4
    smoother.minimize(own, x[0], x[1], sigma=0.1)
    reached[:] = 0.7
    smoother.minimize(own, x[0], x[1], sigma=0.1)
    smoother.minimize(fg.prior, x[0], np.zeros(3), sigma=0.1)
    smoother.minimize(fg.prior, x[1], np.ones(3), sigma=1e3)
    smoother.minimize(own, x[0], x[1], sigma=1e-3)
    smoother._staged = smoother._staged[8:9] + smoother._staged[9:]  # the first says 1, 2, 3; the others 0.7
    smoother.update({x: np.zeros((2, 3))}, iterations=8)
    np.testing.assert_allclose(smoother.estimate(x[1])[0], 0.7, atol=1e-2)


def test_a_copy_states_its_own_factors() -> None:
    smoother, x = smoother_with(Incremental(), fg.SE2)
    smoother.minimize(fg.prior, x[0], np.zeros(3), sigma=0.1)
    smoother.minimize(fg.between, x[0], x[1], STEP, sigma=0.1)
    smoother.update({x: np.zeros((2, 3))})
    other = copy.deepcopy(smoother)
    for one in (smoother, other):
        own = one.families["x"]
        one.minimize(fg.between, own[1], own[2], STEP, sigma=0.1)
        one.update({own: np.zeros(3)})
    np.testing.assert_allclose(other.estimate(other.families["x"]), smoother.estimate(x), atol=1e-12)
    assert len(smoother) == len(other) == 3


def test_finite_measurements_whose_sum_is_none_are_taken() -> None:
    smoother, x = smoother_with(fg.Incremental(), fg.Rn(2))
    for _ in range(2):
        smoother.minimize(fg.prior, x[0], np.array([1e308, 1.5e308]), sigma=1e300)
    smoother.minimize(fg.prior, x[0], np.zeros(2), sigma=1e300)
    with pytest.raises(GraphError, match="argument 1 of prior, row 0, is not finite"):
        smoother.minimize(fg.prior, x[0], np.array([1.0, np.nan]), sigma=1.0)
