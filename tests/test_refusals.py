"""Bad input is refused before the first iteration, and ``graph.check`` finds what a solve would stumble over."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest

import unifg as fg
from problems.graphs import drawn_to, graph_with
from problems.known import line
from unifg.models import barriers, rkmk
from unifg.models.avoidance import cylinder_clearance, inverse_distance, inverse_distance_root, sphere_clearance
from unifg.models.detours import detours, headed
from unifg.models.distance_map import DistanceMap
from unifg.models.footprint import Body
from unifg.models.inertial import InertialMeasurements
from unifg.models.interpolation import cubic
from unifg.models.landmarks import observe, tilt
from unifg.models.lidar import endpoint_loss
from unifg.models.matching import Gates
from unifg.models.obstacles import disc_clearance
from unifg.models.planar import ackermann
from unifg.models.potential import potential
from unifg.models.preintegration import ImuNoise
from unifg.models.quadrotor import STATE
from unifg.models.space_landmarks import bearing_3d, bearing_range_3d, observe_3d
from unifg.models.spline import SplineCurve, SplineField
from unifg.models.stamped import StampedMeasurements
from unifg.models.tableau import Tableau
from unifg.models.terminal import brakeable
from unifg.models.trajectory import CubicTrajectory
from unifg.pose_graphs import manhattan, sphere
from unifg.pose_graphs.residuals import chart_between
from unifg.solvers import (
    KKT,
    SQP,
    AugmentedLagrangian,
    GaussNewton,
    GraduatedNonConvexity,
    InteriorPoint,
    LevenbergMarquardt,
    Penalty,
    names,
)
from unifg.typing import Array

Breaks = Callable[[fg.Graph, fg.Family], object]
WITHOUT_SPEEDS = fg.Product(pose=fg.SE3, velocity=fg.Rn(3))
AT_POINTS = fg.Product(p=fg.Rn(3), R=fg.SO3)

ATTACHED = fg.residual(lambda p: p[:, :1], lambda p: [np.ones((len(p), 1, 3))], "attached")

REFUSALS: list[tuple[str, Breaks, str]] = [
    ("no members", lambda g, x: g.variables("y", fg.Rn(1), 0), "at least one"),
    ("no variable", lambda g, x: g.minimize(fg.prior, np.zeros(2), [0.0, 0.0]), "no variable"),
    ("bound without limits", lambda g, x: g.bound(x, name="a"), "term 'a': a bound without limits says nothing: give"),
    ("constraint without limits", lambda g, x: g.constrain(fg.prior, x, [0, 0]), "a constraint without limits"),
    (
        "numbers that are no column",
        lambda g, x: g.minimize(fg.prior, g.variables("n", fg.Rn(1), 4), np.zeros(4)),
        r"expected \(1,\).*a number for each of 4 factors is a column, \(4, 1\): z\[:, None\]",
    ),
    ("fixed twice", lambda g, x: (g.fix(x[0], [0.0, 0.0]), g.fix(x[:2], [0.0, 0.0])), r"x\[0\] is fixed"),
    ("fix shape", lambda g, x: g.fix(x[0], [0.0, 0.0, 0.0]), "shape"),
    ("fix nan", lambda g, x: g.fix(x[1], [0.0, np.nan]), r"x\[1\]"),
    ("out of range", lambda g, x: x[7], "family 'x' has 4"),
    ("data nan", lambda g, x: g.data("z", [np.nan]), "NaN"),
    (
        "untouched",
        lambda g, x: (g.minimize(fg.prior, x[:2], [0.0, 0.0]), g.compile()),
        r"x\[2\] is in no cost",
    ),
]


@pytest.mark.parametrize(("breaks", "message"), [r[1:] for r in REFUSALS], ids=[r[0] for r in REFUSALS])
def test_bad_statement_is_refused(breaks: Breaks, message: str) -> None:
    graph, x = line()
    with pytest.raises(fg.GraphError, match=message):
        breaks(graph, x)


GUESSES: list[tuple[str, Callable[[fg.Family], dict[fg.Family, Array]], str]] = [
    ("missing", lambda x: {}, "no values for family 'x'"),
    ("shape", lambda x: {x: np.zeros((3, 2))}, r"shape \(3, 2\), expected \(4, 2\)"),
    ("nan", lambda x: {x: np.array([[0, 0], [0, 0], [np.nan, 0], [0, 0.0]])}, r"x\[2\]"),
    ("stranger", lambda x: {x: np.zeros((4, 2)), line()[1]: np.zeros((4, 2))}, "no family of this graph"),
]


@pytest.mark.parametrize(("guess", "message"), [g[1:] for g in GUESSES], ids=[g[0] for g in GUESSES])
@pytest.mark.parametrize("solver", [GaussNewton(), SQP(), AugmentedLagrangian()], ids=["gn", "sqp", "alm"])
def test_bad_guess_is_refused(
    solver: fg.Solver, guess: Callable[[fg.Family], dict[fg.Family, Array]], message: str
) -> None:
    graph, x = drawn_to([0.0, 0.0], 4)
    with pytest.raises(fg.GraphError, match=message) as caught:
        solver.solve(graph, guess(x))
    assert caught.value.family in ("x", None)


def test_bad_data_and_duals_are_refused() -> None:
    graph, x = line()
    target = graph.data("target", [0.0, 0.0])
    low = graph.data("low", -1.0)
    graph.minimize(fg.prior, x, target)
    graph.bound(x, lower=low, upper=1.0, name="box")
    run = SQP().prepare(graph)
    guess = {x: np.zeros((4, 2))}
    refused: list[tuple[dict[str, Any], str]] = [
        ({"data": {target: [0.0, 0.0, 0.0]}}, r"data 'target' has shape \(3,\)"),
        ({"data": {target: [0.0, np.nan]}}, "data 'target' contains NaN"),
        ({"data": {low: 2.0}}, "'box': lower exceeds upper in factor 0"),
        ({"data": {fg.Graph().data("t", [0.0]): [1.0]}}, "does not belong"),
        ({"duals": {"bax": np.zeros((4, 2))}}, "which is no constraint"),
        ({"duals": {"box": np.zeros(4)}}, "multipliers of 'box' have shape"),
        ({"duals": {5: np.zeros(4)}}, "multipliers given for '5', which is no constraint"),
        ({"duals": 5}, "duals must be of the class Mapping, found 5"),
        ({"callback": 5}, "callback must be a function, found 5"),
    ]
    for given, message in refused:
        with pytest.raises(fg.UnifgError, match=message):
            run.solve(guess, **given)
    for wrong in (5, {"values": {}, "multipliers": 5}):
        with pytest.raises(fg.GraphError, match="must be of the class Mapping, found 5"):
            fg.Guess(**wrong) if isinstance(wrong, dict) else fg.Guess(wrong)  # type: ignore[arg-type]
    with pytest.raises(fg.GraphError, match="name the variables"):
        run.solve(guess).information(["prior"])
    assert run.solve(guess).converged, "a refused solve leaves the prepared solver usable"


@pytest.mark.parametrize("solver", [GaussNewton(), SQP(qp="graph"), InteriorPoint()], ids=lambda s: s.name)
def test_not_finite_at_the_guess_names_the_factor(solver: fg.Solver) -> None:
    graph, x = drawn_to([1.0, 1.0], 4)
    graph.minimize(lambda p: np.log(p), x, name="logarithm")
    guess = np.ones((4, 2))
    guess[2, 1] = -1.0
    with pytest.raises(fg.GraphError, match=r"'logarithm'.*factor 2.*x\[2\]") as caught:
        solver.solve(graph, {x: guess})
    assert (caught.value.term, caught.value.family, caught.value.index) == ("logarithm", "x", 2)


# ------------------------------------------------------------------ graph.check


def test_check_finds_what_nothing_determines() -> None:
    graph, x = graph_with(fg.SE2, 4)
    graph.minimize(fg.between, x[:-1], x[1:], [1.0, 0.0, 0.0])
    report = graph.check({x: np.zeros((4, 3))})
    assert [(f.kind, f.family, f.index) for f in report.findings] == [("undetermined", "x", 0)]
    assert "x[0], x[1], x[2], ... (4 members)" in str(report)
    assert GaussNewton().solve(graph, {x: np.zeros((4, 3))}).status is fg.Status.SINGULAR
    graph, y = line(3)
    graph.minimize(fg.prior, y[:2], [0.0, 0.0])
    graph.minimize(lambda p: p[:, :1], y[2])
    found = graph.check({y: np.zeros((3, 2))}).findings
    assert [(f.kind, f.family, f.index) for f in found] == [("undetermined", "x", 2)]


def test_check_finds_dependent_constraints_and_bad_residuals() -> None:
    graph, x = drawn_to([0.0, 0.0], 2)
    graph.constrain(lambda p: p[:, :1], x[0], lower=1.0, upper=1.0, name="once")
    graph.constrain(lambda p: 2.0 * p[:, :1], x[0], lower=2.0, upper=2.0, name="twice")
    found = graph.check({x: np.zeros((2, 2))}).findings
    assert {(f.kind, f.term) for f in found} == {
        ("dependent constraints", "once"),
        ("dependent constraints", "twice"),
    }
    graph.minimize(lambda p: 1.0 / p[:, :1], x, name="inverse")
    with np.errstate(all="ignore"):
        found = graph.check({x: np.array([[1.0, 1.0], [0.0, 1.0]])}).findings
    assert [(f.kind, f.term, f.index) for f in found] == [("not finite", "inverse", 1)]


def test_a_constant_that_is_not_finite_is_named_and_not_the_guess() -> None:
    graph, x = line(2)
    graph.minimize(lambda p, z: p - z, x, np.array([[1.0, 1.0], [np.nan, 1.0]]), name="seen")
    guess = {x: np.zeros((2, 2))}
    words = "argument 1, a constant, is .nan  1.. there: leave such factors out"
    assert words.replace(".nan", "[nan").replace("1..", "1.]") in graph.check(guess).findings[0].message
    with pytest.raises(fg.GraphError, match=f"residual of factor 1 is not finite .*{words}"):
        fg.solve(graph, guess)


def test_names_do_not_take_the_place_of_families() -> None:
    graph, x = drawn_to([0.0, 0.0], 4)
    guess = np.zeros((len(x), 2))
    with pytest.raises(fg.GraphError, match="contains 'x', which is no family of this graph: take the family itself"):
        GaussNewton().solve(graph, {"x": guess})  # type: ignore[dict-item]
    with pytest.raises(fg.GraphError, match=r"contains 'y', which is no family of this graph$"):
        GaussNewton().solve(graph, {"y": guess})  # type: ignore[dict-item]
    solution = GaussNewton().solve(graph, {x: guess})
    np.testing.assert_array_equal(solution["x"], solution[x])


def test_a_limit_may_be_infinite_if_it_is_given() -> None:
    graph, x = drawn_to([0.0, 0.0], 4)
    graph.bound(x, lower=-np.inf, upper=np.inf)
    assert AugmentedLagrangian().solve(graph, {x: np.ones((len(x), 2))}).converged


OPTIONS: list[tuple[Callable[[fg.Graph, fg.Family, Any], object], Any, str]] = [
    (lambda g, x, bad: SQP(time_limit=bad), "a", "SQP: time_limit must be a number, found 'a'"),
    (lambda g, x, bad: GaussNewton(tolerance=bad), None, "tolerance must be a number, found None"),
    (lambda g, x, bad: SQP(max_iterations=bad), 1.5, "max_iterations must be a whole number, found 1.5"),
    (lambda g, x, bad: AugmentedLagrangian(penalty=bad), "a", "penalty must be a number or None"),
    (lambda g, x, bad: fg.Huber(bad), "a", "Huber: .* must be a number"),
    (lambda g, x, bad: fg.Incremental(every=bad), 1.5, "Incremental: every must be a whole number"),
    (lambda g, x, bad: fg.FixedLag(bad), "a", "FixedLag: lag must be a whole number"),
    (lambda g, x, bad: fg.solve(g, guess_of(x), starts=bad), len, "starts must be a whole number"),
    (lambda g, x, bad: fg.solve(g, guess_of(x), starts=bad), 0, "starts must be 1, the guess alone"),
    (lambda g, x, bad: GaussNewton().solve(g, guess_of(x), data=bad), 3, "data of a solve are"),
    (lambda g, x, bad: GaussNewton().solve(bad, guess_of(x)), {}, "takes a graph, as fg.Graph"),
    (lambda g, x, bad: fg.solve(bad, guess_of(x)), fg.Graph, "takes a graph, as fg.Graph"),
    (lambda g, x, bad: fg.best_guess(g, guess_of(x), along=bad), "x", "along= is a family"),
    (lambda g, x, bad: Gates(match=bad), "a", "gates: match must be a number, found 'a'"),
    (lambda g, x, bad: Gates(new=bad), None, "gates: new must be a number, found None"),
    (lambda g, x, bad: ackermann(bad), "a", "a bicycle: wheelbase must be a number, found 'a'"),
    (lambda g, x, bad: ackermann(rate=bad), None, "a bicycle: rate must be a number, found None"),
    (lambda g, x, bad: SplineCurve(bad), "a", "spline: values must be real numbers, found 'a'"),
    (lambda g, x, bad: SplineCurve(np.zeros(5), start=bad), None, "spline: start must be a number, found None"),
    (lambda g, x, bad: SplineCurve(np.zeros(5), spacing=bad), np.inf, "spline: spacing must be positive and finite"),
    (lambda g, x, bad: SplineField(bad, 1.0), [["a"] * 4] * 4, "spline: values must be real numbers, found text"),
    (lambda g, x, bad: SplineField(bad, 1.0), [], "spline: values .0,. must be a finite .H, W. grid"),
    (lambda g, x, bad: SplineField(np.zeros((5, 5)), bad), "a", "spline: resolution must be a number, found 'a'"),
    (lambda g, x, bad: DistanceMap(bad, 1.0, [0.0] * 3), None, "distance map: values must be real numbers, found None"),
    (lambda g, x, bad: DistanceMap(np.zeros((2, 2)), 1.0, bad), "a", "distance map: origin must be real numbers"),
    (lambda g, x, bad: DistanceMap(np.zeros((2, 2)), bad, [0.0] * 3), np.inf, "distance map: resolution inf must be"),
    (lambda g, x, bad: grown(bad), np.array([[-1.0, 100.0]]), "distance map: occupied, float64 .* bool grid"),
    (lambda g, x, bad: grown(resolution=bad), "a", "distance map: resolution must be a number, found 'a'"),
    (lambda g, x, bad: grown(cap=bad), "a", "distance map: cap must be a number or None, found 'a'"),
    (lambda g, x, bad: CubicTrajectory(bad), "SE2", "trajectory: group must be of the class LieGroup, found 'SE2'"),
    (lambda g, x, bad: CubicTrajectory(fg.SE2, spacing=bad), "a", "trajectory: spacing must be a number, found 'a'"),
    (lambda g, x, bad: CubicTrajectory(fg.SE2).controls(bad), None, "trajectory: end must be a number, found None"),
    (lambda g, x, bad: CubicTrajectory(fg.SE2).places(bad, 4), "a", "trajectory: moments must be real numbers"),
    (lambda g, x, bad: CubicTrajectory(fg.SE2).at(bad, 0.5), np.zeros((4, 2)), "poses are .N, 3., found .4, 2."),
    (lambda g, x, bad: seen(size=bad), "a", "'stamped': size must be a whole number"),
    (lambda g, x, bad: seen(error=bad), None, "'stamped': error must be a function"),
    (lambda g, x, bad: seen(between=bad), 3, "'stamped': between must be a function or None, found 3"),
    (lambda g, x, bad: seen(constants=bad), 3, "'stamped': constants must be of the class Sequence, found 3"),
    (lambda g, x, bad: seen(offset=bad), 0.1, "'stamped': offset must be of the class str or None, found 0.1"),
    (lambda g, x, bad: Body.disc(bad), "a", "discs of a body must be real numbers"),
    (lambda g, x, bad: GaussNewton(tolerance=bad), np.inf, "GaussNewton: tolerance must be positive and finite"),
    (lambda g, x, bad: inverse_distance_root(sphere_clearance, bad), "a", "1/d: nearest must be a number, found 'a'"),
    (lambda g, x, bad: barriers.inverse(lambda x, t: x, bad), None, "safe must be a number, found None"),
    (lambda g, x, bad: barriers.decay(lambda x, t: x, bad), "a", "a barrier: alpha must be a number, found 'a'"),
    (lambda g, x, bad: brakeable(lambda x, t: x, 1.0, bad), "a", "brakeable: deceleration must be a number"),
    (lambda g, x, bad: endpoint_loss(0.1, bad), "a", "end-points: resolution must be a number, found 'a'"),
    (lambda g, x, bad: potential(bad), None, "potential: distance must be of the class Residual, found None"),
    (lambda g, x, bad: potential(disc_clearance, vortex=bad), np.nan, "the vortex finite .* vortex = nan"),
    (lambda g, x, bad: InertialMeasurements(bad), 0.1, "'imu': noise must be of the class ImuNoise, found 0.1"),
    (lambda g, x, bad: InertialMeasurements(ImuNoise(), gap=bad), "a", "'imu': gap must be a number, found 'a'"),
    (lambda g, x, bad: InertialMeasurements(ImuNoise(), body=bad), 3, "'imu': body must be of the class str or None"),
    (lambda g, x, bad: passing(radii=bad), -0.5, "radii .M,., not negative.* -0.5"),
    (lambda g, x, bad: passing(radii=bad), np.nan, "radii .M,., not negative.* nan"),
    (lambda g, x, bad: passing(start=bad), "a", "detours: start and goal"),
    (lambda g, x, bad: passing(start=bad), [np.nan, 0.0], "detours: .* all finite; got ..nan, 0.0., .3.0"),
    (lambda g, x, bad: passing(centres=bad), [[1.5, np.nan]], "detours: .* for centres .M, 2., all finite"),
    (lambda g, x, bad: passing(most=bad), -1, "detours: most must be positive, found -1"),
    (lambda g, x, bad: passing(steps=bad), -1, "detours: steps must be positive, found -1"),
    (lambda g, x, bad: headed([[0.0, 0.0], [1.0, 0.0]], bad), "a", "headed: heading must be a number, found 'a'"),
]


def passing(
    start: Any = (0.0, 0.0), radii: Any = 0.5, steps: Any = 4, centres: Any = ((1.5, 0.0),), most: Any = 2
) -> list[Array]:
    return detours(start, [3.0, 0.0], centres, radii, steps, 0.5, most)


def grown(occupied: Any = ((True, False),), resolution: Any = 1.0, cap: Any = None) -> DistanceMap:
    return DistanceMap.from_occupancy(occupied, resolution, [0.0, 0.0, 0.0], cap)


def seen(error: Any = lambda x, z: x - z, size: int = 1, **options: Any) -> StampedMeasurements:
    return StampedMeasurements(error, size, capacity=1, sigma=1.0, **options)


def guess_of(x: fg.Family) -> dict[fg.Family, Array]:
    return {x: np.zeros((4, 2))}


@pytest.mark.parametrize(("make", "bad", "message"), OPTIONS, ids=[message for *_, message in OPTIONS])
def test_options_of_another_kind_are_refused(make: Any, bad: Any, message: str) -> None:
    graph, x = drawn_to([0.0, 0.0], 4)
    with pytest.raises(fg.UnifgError, match=message):
        make(graph, x, bad)


MADE: list[tuple[type[fg.UnifgError], Callable[[], object], str]] = [
    (fg.BackendError, lambda: AugmentedLagrangian(hessian="bfgs"), "must be 'exact' or 'gauss-newton', found 'bfgs'"),  # type: ignore[arg-type]
    (fg.BackendError, lambda: SQP(hessian="newton"), "'newton'"),  # type: ignore[arg-type]
    (fg.BackendError, lambda: KKT(globalization="filter"), "must be 'line-search' or 'levenberg-marquardt'"),  # type: ignore[arg-type]
    (fg.BackendError, lambda: KKT(full_steps=True, globalization="levenberg-marquardt"), "choose one"),
    (fg.BackendError, lambda: Penalty(penalty=0.0), "penalty must be positive"),
    (fg.BackendError, lambda: Penalty(penalty_growth=1.0), "penalty_growth must be above 1"),
    (fg.BackendError, lambda: AugmentedLagrangian(penalty_growth=-3.0), "penalty_growth must be above 1"),
    # This one never ended, and the other went nowhere.
    (fg.BackendError, lambda: Penalty(inner_iterations=0), "inner_iterations must be positive, found 0"),
    (fg.BackendError, lambda: AugmentedLagrangian(inner_iterations=0), "inner_iterations must be positive, found 0"),
    (fg.ModelError, lambda: manhattan(2.5), "manhattan: count must be a whole number"),  # type: ignore[arg-type]
    (fg.ModelError, lambda: manhattan(50, -1), "seed -1 not negative"),
    (fg.ModelError, lambda: sphere(3, 6, radius=np.inf), "a finite radius inf > 0"),
    (fg.ModelError, lambda: Tableau("mine", 1, (np.nan,), ((),)), "weights sum to nan"),
    (fg.BackendError, lambda: GraduatedNonConvexity(growth=1.0), "growth"),
    (fg.BackendError, lambda: GraduatedNonConvexity(solver=1), "solver must be of the class Solver, found 1"),  # type: ignore[arg-type]
    (fg.BackendError, lambda: GraduatedNonConvexity(stage_iterations=0), "stage_iterations"),
    (fg.BackendError, lambda: GaussNewton(search_iterations=-1), "search_iterations must not be negative, found -1"),
    (fg.BackendError, lambda: names.backend("newton"), "unknown backend 'newton': choose one of gn, lm, dogleg, kkt"),
    (fg.BackendError, lambda: names.backend("penalty", hessian="exact"), "Penalty has no option 'hessian'"),
    (fg.GraphError, fg.joint_prior, "at least one variable"),
    (fg.GraphError, lambda: fg.residual(lambda x: x, derivatives="exact"), "'trace' or 'differences'"),  # type: ignore[arg-type]
    (fg.GraphError, lambda: fg.each(1.0), "found a scalar"),
    (fg.GraphError, lambda: fg.shared(["a"]), "must be real numbers"),
    (fg.GraphError, lambda: chart_between.on(fg.Rn(2)), "needs poses in SE2 or SE3, found Rn"),
    (fg.GraphError, lambda: observe(STATE.identity(), np.zeros((3, 3))), "argument 1 has shape"),
    (fg.GraphError, lambda: observe(np.zeros(9), np.zeros((3, 2))), "argument 0 has shape"),
    (fg.GraphError, lambda: tilt(fg.SO3.identity(), np.zeros(2)), "argument 1 has shape"),
    (fg.UnifgError, lambda: fg.Product(), "no components"),
    (fg.UnifgError, lambda: fg.Product(p=3), "'p' of Product is 3: give a manifold"),  # type: ignore[call-overload]
    (fg.UnifgError, lambda: fg.Product(p=fg.Rn), r"'p' of Product is .*Rn.*: give a manifold"),  # type: ignore[call-overload]
    (fg.UnifgError, lambda: fg.Product(_p=fg.SE2), "underscore"),
    (fg.UnifgError, lambda: fg.Rn(0), r"Rn\(0\)"),
    *((fg.ModelError, partial(cubic, m), "cubic needs velocities") for m in (fg.SE3, WITHOUT_SPEEDS, AT_POINTS)),
    *(
        (fg.ModelError, partial(bearing_range_3d, m), "needs a position and an orientation")
        for m in (fg.SE2, fg.Product(p=fg.Rn(3)), fg.Product(pose=fg.SE2))
    ),
    *(
        (fg.ModelError, partial(bearing_3d, fg.SE3, place), "must be an element of SE3")
        for place in (np.zeros(7), np.zeros(6), [np.nan] * 7)
    ),
    # Three places in the plane are no two in space.
    (fg.ModelError, lambda: observe_3d(fg.SE3.identity(), np.zeros((3, 2))), "observe_3d: a state .7,., places .M, 3."),
    (fg.ModelError, lambda: observe_3d(fg.SE3.identity()[None], np.zeros((3, 3))), "observe_3d: a state .7,., places"),
    (fg.ModelError, lambda: rkmk.integrator(fg.SE2, len, "half"), "'simplified trapezoid'.*found 'half'"),  # type: ignore[arg-type]
    (fg.ModelError, lambda: inverse_distance_root(cylinder_clearance, 0.0), "1/d: nearest must be positive"),
    (fg.ModelError, lambda: inverse_distance(cylinder_clearance, np.nan), "1/d: nearest must be positive"),
    (fg.ModelError, lambda: inverse_distance_root(ATTACHED), "plain function, found 'attached'"),
    (fg.ModelError, lambda: potential(disc_clearance, near=0.9), r"0 < near < far, found near = 0\.9"),
    (fg.ModelError, lambda: potential(disc_clearance, vortex=-1.0, sense="aside"), "found 'aside', -1"),
    (fg.ModelError, lambda: potential(fg.residual(lambda x: x[:, :1])), "has no attached Jacobian"),
    (fg.ModelError, lambda: DistanceMap(np.array([[np.nan]]), 0.1, [0.0] * 3), "finite"),
    (fg.ModelError, lambda: DistanceMap(np.zeros((2, 2)), -0.1, [0.0] * 3), "resolution"),
    (fg.ModelError, lambda: DistanceMap(np.zeros((2, 2)), 0.1, [0.0, np.nan, 0.0]), "origin"),
    (fg.ModelError, lambda: grown(resolution=-0.1), "resolution .* must be positive"),  # which is no matter of the cap
    (fg.ModelError, lambda: grown(resolution=np.nan), "resolution .* must be positive"),
    (fg.ModelError, lambda: grown(cap=-1.0), "cap"),
    (fg.ModelError, lambda: grown(np.zeros(3, dtype=bool)), "grid"),
    (fg.BackendError, lambda: LevenbergMarquardt(damping=np.nan), "damping must not be negative, found nan"),
    (fg.BackendError, lambda: AugmentedLagrangian(damping=-5.0), "damping must not be negative, found -5"),
]


@pytest.mark.parametrize(("kind", "make", "message"), MADE, ids=[message for *_, message in MADE])
def test_what_cannot_be_made_is_refused(kind: type[fg.UnifgError], make: Any, message: str) -> None:
    with pytest.raises(kind, match=message):
        make()


def test_questions_of_another_kind_are_refused() -> None:
    graph, x = line()
    wish = graph.data("wish", [0.0, 0.0])
    graph.minimize(fg.prior, x, wish, name="wish")
    prepared = GaussNewton(max_iterations=np.int32(5), time_limit=np.array(60)).prepare(graph)  # type: ignore[arg-type]
    solution = prepared.solve({x: np.zeros((4, 2))})
    asked: list[tuple[Any, str]] = [
        (lambda: solution.shifted(3), "shifted takes whole families"),  # type: ignore[arg-type]
        (lambda: solution.shifted([x]), "shifted takes whole families"),  # type: ignore[arg-type]
        (lambda: solution.shifted(x, by=1.5), "by must be a whole number"),  # type: ignore[arg-type]
        (lambda: solution.sensitivity(3, wish), "expected a family"),  # type: ignore[arg-type]
        (lambda: solution.sensitivity(x, 3), "no data or variable"),  # type: ignore[arg-type]
        (lambda: solution.gradient(3, wish), "gradient of what"),  # type: ignore[arg-type]
        (lambda: solution.verify("a"), "tolerance must be a number"),  # type: ignore[arg-type]
        (lambda: prepared.solve_many(solution, data={"wish": np.zeros((2, 2))}), "many instances are"),  # type: ignore[dict-item]
        (lambda: prepared.solve_many(solution, data={wish: np.zeros((2, 2))}, threads=0), "threads must be at least 1"),
        (lambda: solution.information("goal", x), "no cost is called 'goal'"),
        (lambda: solution.dual("limit"), "no constraint, bound or fix is called 'limit'"),
        (solution.covariance, r"covariance\(\) of what"),
        (lambda: solution["y"], r"no family is called 'y' \(there are: x\)"),
        (lambda: solution[3], "expected a family of variables, or some of its members, found 3"),  # type: ignore[index]
    ]
    for ask, message in asked:
        with pytest.raises(fg.GraphError, match=message):
            ask()
    assert np.array_equal(solution.information("wish", x), np.eye(8))  # one name
