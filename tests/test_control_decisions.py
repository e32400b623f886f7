"""Decisions of the driving robot: which past it believes, when it rests for others, how it gets past what stands."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import unifg as fg
from episodes import room
from unifg.horizon import Plan
from unifg.models import unicycle
from unifg.models.distance_map import DistanceMap, SmoothField
from unifg.scenarios.driving.drive_control import BRAKING, LEFT_BEHIND, PATIENCE, Controller, is_behind
from unifg.scenarios.driving.drive_parts import disc_limits, predicted, wall_limits
from unifg.scenarios.driving.drive_past import Smoother
from unifg.scenarios.driving.drive_settings import ControllerSettings
from unifg.scenarios.seeing.readings import Scan
from unifg.scenarios.seeing.tracks import Tracks
from unifg.scenarios.worlds.plane import World
from unifg.solvers import SQP
from unifg.typing import Array

SETTINGS = ControllerSettings()
HULL = SETTINGS.robot_radius
OPEN = np.array([1.5, 1.0, 0.0])  # far from walls and pillar


@pytest.fixture(scope="module")
def field() -> DistanceMap:
    occupancy = room()
    return DistanceMap.from_occupancy(occupancy.occupied, occupancy.resolution, occupancy.origin)


@pytest.fixture
def controller(field: DistanceMap) -> Controller:
    return Controller(field, "sqp", SETTINGS)


def tracks(
    *discs: tuple[float, float, float], velocity: tuple[float, float] = (0.0, 0.0), mover: bool = False
) -> Tracks:
    """Discs (x, y, radius) that all move alike."""
    rows = np.array(discs, dtype=np.float64).reshape(-1, 3)
    count = len(rows)
    moving = np.full(count, mover)
    names = np.arange(count)
    return Tracks(rows[:, :2], np.tile(np.array(velocity), (count, 1)), rows[:, 2], names, np.zeros(count), moving)


def ahead(pose: Array = OPEN, speed: float = SETTINGS.speed) -> Array:
    """A straight reference from a pose."""
    way = speed * SETTINGS.dt * np.arange(SETTINGS.horizon + 1.0)
    heading = pose[2]
    return np.column_stack(
        [pose[0] + way * np.cos(heading), pose[1] + way * np.sin(heading), np.full(len(way), heading)]
    )


# ---------------------------------------------------------------- whom it yields to


GAP = SETTINGS.yield_distance - 0.05
BESIDE = (OPEN[0], OPEN[1] + HULL + GAP + 0.2, 0.2)  # not in the way: nothing else would stop the robot


@pytest.mark.parametrize(
    ("others", "rests"),
    [
        (tracks(BESIDE, velocity=(0.0, -0.3), mover=True), True),
        (tracks(BESIDE, velocity=(0.0, 0.3), mover=True), False),  # it goes away
        (tracks(BESIDE, velocity=(0.0, -0.04), mover=True), False),  # as good as at rest
        (tracks(BESIDE, velocity=(0.0, -0.3), mover=False), False),  # a velocity nobody trusts
        (tracks((OPEN[0], BESIDE[1] + 0.1, 0.2), velocity=(0.0, -0.3), mover=True), False),  # far enough
        (tracks((OPEN[0], BESIDE[1] + 0.1, 0.31), velocity=(0.0, -0.3), mover=True), True),  # its hull is near
        (tracks((5.0, 4.0, 0.2), BESIDE, velocity=(0.0, -0.3), mover=True), True),  # one of two
    ],
    ids=["closing in", "leaving", "creeping", "standing", "far", "large", "second"],
)
def test_the_robot_rests_for_a_mover_that_closes_in(controller: Controller, others: Tracks, rests: bool) -> None:
    plan = controller.plan(OPEN, ahead(), others)
    assert not plan.emergency and plan.excess < 1e-3
    assert (not plan.control.any()) == rests
    if rests:  # the next tick goes on from rest, as the first change of control is counted from there
        assert not controller.loop.applied.any()


# ---------------------------------------------------------------- how near it may come


def test_a_robot_beside_a_standing_disc_may_come_a_little_nearer() -> None:
    """It may squeeze past what stands, by so much and no more, and never past what moves."""
    s, gap = SETTINGS, 0.05  # less than the clearance that is kept from discs
    place = (OPEN[0] + HULL + gap + 0.2, OPEN[1], 0.2)
    for mover in (False, True):
        others = tracks(place, mover=mover)
        centres = np.tile(others.centre, (s.horizon, 1, 1))
        limits = disc_limits(SETTINGS, OPEN, centres, others.radius, others.mover)
        assert limits[:, 0] == pytest.approx(HULL + (gap if mover else gap - 0.02))  # not nearer than 3 cm
    roomy = disc_limits(
        SETTINGS, OPEN, np.tile([OPEN[0] + 1.0, OPEN[1]], (s.horizon, 1, 1)), np.array([0.2]), np.array([False])
    )
    assert roomy[:, 0] == pytest.approx(HULL + s.disc_clearance)


def driven_through(field: DistanceMap, place: float, heading: float, squeeze: float) -> tuple[float, float]:
    """How far a robot gets in two seconds between two discs it finds itself beside, and the least gap on the way."""
    settings = replace(SETTINGS, squeeze=squeeze, discs=2)
    controller, pose = Controller(field, "sqp", settings), OPEN + np.array([0.0, 0.0, heading])
    aside, least = HULL + 0.2 + 0.045, np.inf  # 0.045 m on either side, where 0.06 m are to be kept
    others = tracks(*((OPEN[0] + place, OPEN[1] + side * aside, 0.2) for side in (-1.0, 1.0)))
    for _ in range(20):
        plan = controller.plan(pose, ahead(np.array([pose[0], OPEN[1], 0.0])), others)
        pose = unicycle.step(pose[None], plan.control[None], settings.dt)[0]
        least = min(least, float(np.hypot(*(pose[:2] - others.centre).T).min()) - 0.2 - HULL)
    return float(pose[0] - OPEN[0]), least


@pytest.mark.parametrize("heading", [0.0, 0.2])
@pytest.mark.parametrize("place", [0.1, 0.15])
def test_squeezing_lets_a_robot_out_of_a_gap_that_is_too_narrow(
    field: DistanceMap, place: float, heading: float
) -> None:
    """Where tracks say that it stands too near to two discs already, it may pass between them; else it must go back."""
    way, least = driven_through(field, place, heading, SETTINGS.squeeze)
    assert way > 1.5
    assert least > SETTINGS.squeeze - 2e-3
    assert driven_through(field, place, heading, 0.0)[0] < 0.1


# ---------------------------------------------------------------- when plans fail, or lag


class Bent:
    """A prepared solver whose answers are moved by a metre, and say of themselves what they are told to say."""

    def __init__(self, inner: fg.Prepared, **claims: Any) -> None:
        self.inner, self.claims = inner, claims
        if claims.get("violation"):  # nor has it passed anything that could be driven
            claims["history"] = []

    def solve(self, guess: Any, **options: Any) -> Any:
        solution = self.inner.solve(guess, **options)
        claims = self.claims

        class Answer:
            def __getattr__(self, name: str) -> Any:
                return claims[name] if name in claims else getattr(solution, name)

            def __getitem__(self, variable: Any) -> Array:
                value = solution[variable]
                return value + np.array([1.0, 0.0, 0.0]) if value.shape[1] == 3 else value

        return Answer()


def believing(field: DistanceMap) -> tuple[Controller, Smoother]:
    """A joint controller whose window is full, at a tick that has been registered and not planned."""
    world = World(room(), OPEN, rng=np.random.default_rng(3))
    off, sigma = np.array([0.03, -0.02, 0.01]), [0.1, 0.1, 0.05]
    smoother = Smoother(field, OPEN + off, sigma, world.lidar.beams, SETTINGS.dt, length=2)
    settings = replace(SETTINGS, pull=(0.5, 0.5, 0.5), control_weight=30.0)
    controller = Controller(field, "sqp", settings, smoother.window)
    for tick in range(4):
        smoother.update(world.scan(), np.array(world.odometry()) if tick else None, SETTINGS.dt)
        if tick < 3:
            plan = controller.plan(smoother.pose, ahead(OPEN), tracks())
            world.step(float(plan.control[0]), float(plan.control[1]), SETTINGS.dt)
    return controller, smoother


@pytest.mark.parametrize(
    ("claims", "believed"),
    [
        ({}, True),
        ({"status": fg.Status.STOP_RULE}, True),
        ({"status": fg.Status.ITERATION_LIMIT}, False),
        ({"status": fg.Status.STALLED}, False),
        ({"violation": 1.0, "status": fg.Status.LOCALLY_INFEASIBLE}, False),
        ({"violation": 1.0, "status": fg.Status.STOP_RULE}, False),  # a stop test of its own, and no plan
    ],
    ids=["converged", "its own stop test", "limit", "stalled", "infeasible", "stopped while violating"],
)
def test_only_a_solve_that_ended_moves_the_pose(field: DistanceMap, claims: dict[str, Any], believed: bool) -> None:
    """A solve that fell short says nothing about where the robot is; what is marginalised is the past alone, always."""
    controller, smoother = believing(field)
    window, registered = smoother.window, smoother.pose
    states, departure = window.history.states.copy(), window.left.departure
    assert window.history.full and departure is not None
    for name in ("warm", "cold"):
        setattr(controller.loop, name, Bent(getattr(controller.loop, name), **claims))
    plan = controller.plan(registered, ahead(OPEN), tracks())
    assert plan.emergency == (claims.get("violation", 0.0) > 0.0)
    moved = controller.loop.estimate - registered
    if believed:
        assert moved[0] == pytest.approx(1.0, abs=0.1)
    else:
        assert not moved.any()
    assert np.array_equal(window.history.states, states)
    assert window.left.departure is departure


@pytest.mark.parametrize("off", [(0.35, -0.3, 0.1), (0.0, 0.45, 0.0)], ids=str)
def test_registering_goes_on_until_the_beams_are_found(field: DistanceMap, off: tuple[float, float, float]) -> None:
    """From half a metre away the beams that count change from round to round; at rest one round is enough."""
    world = World(room(), OPEN, rng=np.random.default_rng(3))
    spread = np.diag([0.3, 0.3, 0.1])
    smoother = Smoother(field, OPEN + np.array(off), spread, world.lidar.beams, SETTINGS.dt, length=2)
    window = smoother.window
    smoother.look(world.scan())
    solves: list[int] = []
    inner = window.run

    class Counted:
        def solve(self, guess: Any, **options: Any) -> fg.Solution:
            solution = inner.solve(guess, **options)
            solves.append(solution.iterations)
            return solution

    window.run = Counted()  # type: ignore[assignment]
    window.estimate()
    assert smoother.iterations == sum(solves)
    assert 1 < len(solves) < 8
    assert np.hypot(*(window.present - OPEN)[:2]) < 0.03
    rounds = len(solves)
    window.estimate()
    assert smoother.iterations == sum(solves[rounds:])
    assert len(solves) == rounds + 1


def test_a_guess_of_the_joint_solve_begins_at_the_estimate(field: DistanceMap) -> None:
    """The shifted plan begins where the last tick expected the robot; its first pose gives way to what is known now."""
    controller, smoother = believing(field)
    loop, pose = controller.loop, smoother.pose
    begun: list[Array] = []

    class Seen:
        def __init__(self, inner: fg.Prepared) -> None:
            self.inner = inner

        def solve(self, guess: fg.Guess, **options: Any) -> fg.Solution:
            begun.append(np.array(guess.values[loop.x.family])[loop.x.indices])
            return self.inner.solve(guess, **options)

    assert loop.guess is not None
    shifted = np.array(loop.guess.values[loop.x.family])[loop.x.indices]
    loop.warm = Seen(loop.warm)  # type: ignore[assignment]
    controller.plan(pose, ahead(OPEN), tracks())
    assert np.array_equal(begun[0][0], pose) and not np.array_equal(shifted[0], pose)
    assert np.array_equal(begun[0][1:], shifted[1:])


def failing(controller: Controller) -> None:
    """From now on no plan keeps its constraints."""
    for name in ("warm", "cold"):
        inner = getattr(controller.loop, name)
        setattr(controller.loop, name, Bent(inner, violation=1.0, status=fg.Status.LOCALLY_INFEASIBLE))


def test_braking_keeps_the_shape_of_the_last_plan_and_rests_in_time(controller: Controller) -> None:
    good = controller.plan(OPEN, ahead(), tracks())
    assert good.control[0] > 0.3
    stored = controller.loop.kept.controls.copy()
    failing(controller)
    plans: list[Plan] = [controller.plan(OPEN, ahead(), tracks()) for _ in range(BRAKING + 2)]
    assert all(plan.emergency for plan in plans)
    speeds = np.array([good.control[0], *(plan.control[0] for plan in plans)])
    assert np.all(np.diff(speeds) <= 1e-12) and speeds[1] > 0.0
    assert not speeds[BRAKING:].any()
    for age, plan in enumerate(plans[: BRAKING - 1], start=1):  # the same curvature, driven more slowly
        assert plan.control[0] <= stored[age, 0] * (1.0 - age / BRAKING) + 1e-12
        assert plan.control[1] * stored[age, 0] == pytest.approx(plan.control[0] * stored[age, 1])
    assert plans[-1].states[-1] == pytest.approx(OPEN)


def test_after_a_failure_the_guess_is_rest_until_it_is_forgotten(controller: Controller) -> None:
    loop = controller.loop
    now = loop.now(OPEN, controller.given(ahead(), tracks()))
    controller.plan(OPEN, ahead(), tracks())
    assert loop.begin(now) == (loop.warm, loop.guess)
    good = (loop.warm, loop.cold)
    failing(controller)
    controller.plan(OPEN, ahead(), tracks())
    loop.warm, loop.cold = good
    run, guess = loop.begin(now)
    assert run is loop.warm
    assert not guess.values[loop.u].any() and (guess.values[loop.x.family] == OPEN).all()
    controller.forget()
    run, guess = loop.begin(now)
    assert run is loop.cold and guess.values[loop.u].any()


def test_plans_that_stay_behind_are_started_over(controller: Controller) -> None:
    """A plan caught behind something is warm-started there for ever; after some ticks it starts from the reference."""
    states = ahead()
    behind = states.copy()
    behind[:, 0] -= 1.01 * LEFT_BEHIND
    near = states.copy()
    near[:, 0] -= 0.99 * LEFT_BEHIND
    loop, (is_far, is_near) = controller.loop, (is_behind(plan, states) for plan in (behind, near))
    given = [loop.stays_behind(is_far) for _ in range(2 * PATIENCE)]
    assert given == ([False] * (PATIENCE - 1) + [True]) * 2
    for _ in range(PATIENCE - 1):
        assert not loop.stays_behind(is_far)
    assert not loop.stays_behind(is_near)  # one tick beside the reference, and patience begins anew
    assert not loop.stays_behind(is_far)


def test_a_mover_waits_for_a_robot_at_rest_and_is_not_trusted_to_leave() -> None:
    s = SETTINGS
    towards = tracks((OPEN[0] + 1.5, OPEN[1], 0.2), velocity=(-0.5, 0.0), mover=True)
    gaps = predicted(SETTINGS, OPEN, towards)[:, 0, 0] - OPEN[0] - 0.2 - HULL
    assert gaps[0] == pytest.approx(1.5 - 0.05 - 0.2 - HULL)
    assert np.all(np.diff(gaps) <= 1e-12)
    assert s.courtesy <= gaps[-1] < s.courtesy + 0.05 + 1e-9  # the last stage before it has to wait
    away = tracks((OPEN[0] + 1.5, OPEN[1], 0.2), velocity=(0.5, 0.2), mover=True)
    centres = predicted(SETTINGS, OPEN, away)[:, 0]
    assert np.all(centres[:, 0] == OPEN[0] + 1.5)
    assert centres[-1, 1] == pytest.approx(OPEN[1] + 0.2 * s.dt * s.horizon)


def test_the_gap_to_a_mover_is_a_barrier() -> None:
    s = SETTINGS
    centres = np.tile([OPEN[0] + 2.0, OPEN[1]], (s.horizon, 1, 1))
    radius, mover = np.array([0.2]), np.array([True])
    limits = disc_limits(SETTINGS, OPEN, centres, radius, mover)[:, 0]
    stages = np.arange(1, s.horizon + 1)
    travel = np.minimum(s.mover_speed * s.dt * stages, s.mover_allowance)
    least = HULL + s.disc_clearance + travel
    expected = least + (1.8 - least) * 0.88**stages  # an eighth of it in a tenth of a second
    np.testing.assert_allclose(limits, np.minimum(expected, 1.8))
    standing = disc_limits(SETTINGS, OPEN, centres, radius, ~mover)[:, 0]
    assert standing == pytest.approx(HULL + s.disc_clearance)


def test_a_robot_too_near_a_wall_may_stay_and_not_come_nearer(field: DistanceMap) -> None:
    s, smooth = SETTINGS, SmoothField(field)
    assert wall_limits(SETTINGS, smooth, OPEN) == pytest.approx(HULL + s.wall_clearance)
    close = np.array([1.5, -0.8 + HULL + 0.01, 0.0])
    now = float(smooth.distance(close[None, :2])[0])
    assert now < HULL + s.wall_clearance
    assert wall_limits(SETTINGS, smooth, close) == pytest.approx(now)


def test_a_scan_without_returns_changes_nothing(field: DistanceMap) -> None:
    smoother = Smoother(field, OPEN, [0.1, 0.1, 0.1], 72, SETTINGS.dt, length=2)
    angles = np.linspace(-np.pi, np.pi, 72, endpoint=False)
    smoother.update(Scan(angles, np.full(72, np.nan)), None, SETTINGS.dt)
    assert np.abs(smoother.pose - OPEN).max() < 1e-9


def test_backends_take_the_settings_tolerances() -> None:
    from unifg.scenarios.driving.drive_settings import backend

    for name in ("sqp", "alm"):
        warm, cold = (backend(name, SETTINGS, patience) for patience in (1, 3))
        assert cold.max_iterations == 3 * warm.max_iterations
        assert warm.tolerance == SETTINGS.tolerance
        assert isinstance(warm, SQP) == (name == "sqp")
