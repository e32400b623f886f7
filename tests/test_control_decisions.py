"""Decisions of the driving robot: which past it believes, when it rests for others, how it gets past what stands."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import maps
import unifg as fg
from episodes import room
from unifg.models.distance_map import DistanceMap, SmoothField
from unifg.models.unicycle import followed
from unifg.scenarios.ground import drive_control
from unifg.scenarios.ground.drive_control import LEFT_BEHIND, OFF_WALLS, PATIENCE, Controller, is_behind
from unifg.scenarios.ground.drive_parts import along, disc_limits, in_world, predicted, wall_limits
from unifg.scenarios.ground.drive_past import Smoother
from unifg.scenarios.ground.drive_settings import ControllerSettings
from unifg.scenarios.ground.stopping import evasions, stopped
from unifg.scenarios.perception.readings import Scan
from unifg.scenarios.perception.tracks import Tracks
from unifg.scenarios.planning.follow import PathFollower
from unifg.scenarios.planning.polyline import polyline_distance
from unifg.scenarios.simulation.plane import World
from unifg.solvers import SQP
from unifg.typing import Array

SETTINGS = ControllerSettings()
HULL = SETTINGS.robot_radius
OPEN = np.array([1.5, 1.0, 0.0])  # far from walls and pillar


@pytest.fixture(scope="module")
def field() -> DistanceMap:
    return maps.field(room())


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


def ahead(pose: Array = OPEN, way: Array | None = None) -> Array:
    """A straight reference from a pose."""
    way = SETTINGS.stations if way is None else way
    heading = pose[2]
    return np.column_stack(
        [pose[0] + way * np.cos(heading), pose[1] + way * np.sin(heading), np.full(len(way), heading)]
    )


# ---------------------------------------------------------------- whom it makes way for


@pytest.mark.parametrize("speed", [0.3, 0.6, 1.0])
@pytest.mark.parametrize("slant", [0.0, 0.1])
@pytest.mark.product(2, of="drives and flights")
def test_the_robot_makes_way_for_one_who_does_not_wait(controller: Controller, speed: float, slant: float) -> None:
    """Somebody walks straight into a robot that has nothing to do; it is not run over, and comes back."""
    s, pose, begin = SETTINGS, OPEN.copy(), np.array([OPEN[0] + 2.5, OPEN[1] + slant])
    least, aside = np.inf, 0.0
    for tick in range(round((3.5 / speed + 2.5) / s.dt)):
        at = begin - np.array([speed * s.dt * tick, 0.0])
        others = tracks((at[0], at[1], 0.2), velocity=(-speed, 0.0), mover=True)
        before = controller.loop.applied
        plan = controller.plan(pose, np.tile(OPEN, (s.horizon + 1, 1)), others if at[0] > -0.5 else tracks())
        assert np.all(np.abs(plan.control - before) <= s.most + 1e-9)
        pose = followed(pose, before, plan.control[None], s.dt)[1]
        gap = float(np.hypot(*(pose[:2] - at + np.array([speed * s.dt, 0.0])))) - 0.2 - HULL
        least, aside = min(least, gap), max(aside, float(np.hypot(*(pose - OPEN)[:2])))
    assert least > 0.02
    assert aside > 0.1
    assert np.hypot(*(pose - OPEN)[:2]) < 0.2


def test_the_way_out_is_rest_unless_somebody_comes_into_it(controller: Controller) -> None:
    """Obstacles that come on give cause to leave; those that pass at a distance, stand, or never moved do not."""
    s, reference = SETTINGS, np.tile(OPEN, (SETTINGS.horizon + 1, 1))
    coming = tracks((OPEN[0] + 0.9, OPEN[1], 0.2), velocity=(-0.6, 0.0), mover=True)
    for others, evades in (
        (tracks(), False),
        (tracks((OPEN[0] + 0.9, OPEN[1], 0.2), velocity=(-0.6, 0.0)), False),
        (tracks((OPEN[0] + 0.9, OPEN[1], 0.2), mover=True), False),
        (tracks((OPEN[0] + 0.9, OPEN[1] + 0.8, 0.2), velocity=(-0.6, 0.0), mover=True), False),
        (coming, True),
    ):
        way = controller.given(OPEN, reference, others).evasive
        assert way.evades == evades
        assert way.states.shape == (s.horizon + 1, 3)
        assert np.all(np.abs(np.diff(way.controls, axis=0, prepend=0.0, append=0.0)) <= s.most + 1e-9)
        np.testing.assert_allclose(way.states, followed(OPEN, np.zeros(2), way.controls, s.dt))
        if not evades:
            assert not way.controls.any()
    places = coming.centre + s.dt * np.arange(1.0, s.horizon + 1)[:, None] * coming.velocity
    assert (np.hypot(*(way.states[1:, :2] - places).T) - 0.2).min() > HULL
    assert controller.field.distance(way.states[:, :2]).min() > HULL


@pytest.mark.parametrize(
    ("pose", "bearing", "distance", "speed"),
    [
        ((3.62, -0.59, -0.3), 1.40, 0.56, 0.3),
        ((2.42, -0.58, -0.3), 0.84, 0.69, 0.6),
        ((0.52, -0.44, 0.3), 1.14, 0.7, 0.6),
    ],
)
def test_nobody_is_evaded_into_a_wall(
    controller: Controller, pose: tuple[float, ...], bearing: float, distance: float, speed: float
) -> None:
    """Robots pressed towards a wall take the way that leaves it, even where another would leave a little more room."""
    towards = np.array([np.cos(bearing), np.sin(bearing)])
    place = np.array(pose[:2]) + distance * towards
    others = tracks((place[0], place[1], 0.2), velocity=tuple(-speed * towards), mover=True)
    controller.loop.applied = np.array([0.6, 0.0])
    way = controller._evasion_from(np.array(pose), others)
    assert way.evades
    assert controller.field.distance(way.states[1:, :2]).min() - HULL >= OFF_WALLS
    centres = predicted(SETTINGS, np.array(pose), others)
    ways = evasions(controller.loop.applied, SETTINGS.most, SETTINGS.box[1], SETTINGS.horizon, SETTINGS.dt)
    states = [followed(np.array(pose), controller.loop.applied, one, SETTINGS.dt) for one in ways]
    roomy = max(states, key=lambda s: min(controller._room(s, centres, others.radius), controller._off_walls(s)))
    assert controller.field.distance(roomy[1:, :2]).min() < HULL, "room alone would have led into the wall"


def test_an_evasion_is_kept_until_another_is_much_better(
    controller: Controller, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Forwards or back from somebody who comes from the side, seen a little ahead and a little behind by turns."""

    def senses() -> list[float]:
        controller.forget()
        controller.loop.applied = np.zeros(2)
        found = []
        for tick in range(8):
            ahead = 0.01 if tick % 2 else -0.01
            others = tracks((OPEN[0] + ahead, OPEN[1] + 0.8, 0.2), velocity=(0.0, -0.4), mover=True)
            way = controller._evasion_from(np.array([OPEN[0], OPEN[1], 0.0]), others)
            assert way.evades
            found.append(float(np.sign(way.controls[5, 0])))
        return found

    assert len(set(senses())) == 1
    before, here = senses()[-1], np.array([OPEN[0], OPEN[1], 0.0])
    across = tracks((OPEN[0] + 0.3 * before, OPEN[1] + 0.8, 0.2), velocity=(0.0, -0.4), mover=True)
    assert np.sign(controller._evasion_from(here, across).controls[5, 0]) == -before, "another is much better"
    assert not controller._evasion_from(here, tracks()).evades
    monkeypatch.setattr(drive_control, "COMMITTED", 0.0)
    assert set(senses()) == {-1.0, 1.0}, "without that it would turn back and forth"


# ---------------------------------------------------------------- how near it may come


def test_a_robot_beside_a_standing_disc_may_come_a_little_nearer() -> None:
    """It may squeeze past what stands, by so much and no more, and never past what moves."""
    s, gap = SETTINGS, 0.05  # less than the clearance that is kept from discs
    place = (OPEN[0] + HULL + gap + 0.2, OPEN[1], 0.2)
    for mover in (False, True):
        limits = limits_of(tracks(place, mover=mover))
        assert limits == pytest.approx(HULL + (gap if mover else gap - 0.02))  # not nearer than 3 cm
    assert limits_of(tracks((OPEN[0] + 1.0, OPEN[1], 0.2))) == pytest.approx(HULL + s.disc_clearance)


RESTING = np.tile(OPEN, (SETTINGS.horizon + 1, 1))


def limits_of(others: Tracks, evasive: Array = RESTING, spread: Array | None = None) -> Array:
    """(N,) least distances to one disc, of a robot at a place known to a spread (2, 2)."""
    centres = predicted(SETTINGS, OPEN, others)
    limits = disc_limits(SETTINGS, OPEN, centres, others, evasive, np.zeros((2, 2)) if spread is None else spread)
    assert limits.shape == (SETTINGS.horizon, 1, 1)
    return limits[:, 0, 0]


def test_clearances_widen_along_the_normal_with_what_the_estimate_may_be_off(field: DistanceMap) -> None:
    """Two standard deviations towards a wall or a disc; what lies across costs nothing."""
    s, smooth = SETTINGS, SmoothField(field)
    place = np.array([0.0, 0.0, 0.7])
    body = np.diag([0.05**2, 0.01**2, 0.3])  # uncertain ahead and certain aside
    cosine, sine = np.cos(0.7), np.sin(0.7)
    spread = in_world(place, body)
    assert along(spread, np.array([cosine, sine])) == pytest.approx(0.05)
    assert along(spread, np.array([[-sine, cosine], [-2.0 * sine, 2.0 * cosine]])) == pytest.approx([0.01, 0.01])
    level = np.diag([0.05**2, 0.01**2])
    near_wall = np.array([1.5, -0.3, 0.0])  # the wall is below
    reference = np.tile(near_wall, (s.horizon + 1, 1))
    for given, extra in ((level, 0.01), (level[::-1, ::-1], 0.05), (np.zeros((2, 2)), 0.0)):
        found = wall_limits(s, smooth, reference, reference, given)
        assert found == pytest.approx(HULL + s.wall_clearance + s.sigmas * extra, abs=1e-6)
    for disc, extra in (((OPEN[0] + 1.0, OPEN[1], 0.2), 0.05), ((OPEN[0], OPEN[1] + 1.0, 0.2), 0.01)):
        found = limits_of(tracks(disc), spread=level)
        assert found == pytest.approx(HULL + s.disc_clearance + s.sigmas * extra)


def test_limits_are_no_stricter_than_the_way_out(field: DistanceMap) -> None:
    """A robot that cannot stop in time may come as near as it comes when it brakes at once, and no nearer."""
    s, last = SETTINGS, np.array([1.0, 0.0])
    controls = stopped(last, np.zeros((0, 2)), s.most, s.horizon)
    braking = followed(OPEN, last, controls, s.dt)
    reach = braking[-1, 0] - OPEN[0]
    assert reach == pytest.approx(1.0 / (2.0 * s.accelerations[0]))
    others = tracks((OPEN[0] + HULL + 0.2 + reach + 0.01, OPEN[1], 0.2), mover=True)
    kept = others.centre[0, 0] - braking[1:, 0] - 0.2
    np.testing.assert_allclose(limits_of(others, braking), np.minimum(kept, limits_of(others, RESTING)))
    assert limits_of(others, braking)[-1] == pytest.approx(HULL + 0.01)
    wall = np.array([1.5, -0.8 + HULL + 0.01, -np.pi / 2])
    towards = followed(wall + np.array([0.0, reach, 0.0]), last, controls, s.dt)
    found = wall_limits(s, SmoothField(field), towards, towards, np.zeros((2, 2)))
    assert np.all(np.diff(found[:, 0]) <= 1e-12)
    assert found[-1, 0] < HULL + s.wall_clearance < found[0, 0] + 1e-9


def driven_through(field: DistanceMap, place: float, heading: float, squeeze: float) -> tuple[float, float]:
    """Distance a robot covers in two seconds between two discs beside it, and the least gap on the way."""
    settings = replace(SETTINGS, squeeze=squeeze, discs=2)
    controller, pose = Controller(field, "sqp", settings), OPEN + np.array([0.0, 0.0, heading])
    aside, least = HULL + 0.2 + 0.045, np.inf  # 0.045 m on either side, where 0.06 m are to be kept
    others = tracks(*((OPEN[0] + place, OPEN[1] + side * aside, 0.2) for side in (-1.0, 1.0)))
    for _ in range(20):
        before = controller.loop.applied
        plan = controller.plan(pose, ahead(np.array([pose[0], OPEN[1], 0.0]), controller.stations()), others)
        pose = followed(pose, before, plan.control[None], settings.dt)[1]
        least = min(least, float(np.hypot(*(pose[:2] - others.centre).T).min()) - 0.2 - HULL)
    return float(pose[0] - OPEN[0]), least


@pytest.mark.parametrize("heading", [0.0, 0.2])
@pytest.mark.parametrize("place", [0.1, 0.15])
@pytest.mark.product(2, of="drives and flights")
def test_squeezing_lets_a_robot_out_of_a_gap_that_is_too_narrow(
    field: DistanceMap, place: float, heading: float
) -> None:
    """Robots already too near to two discs, by their tracks, may pass between them if squeezing; else must go back."""
    way, least = driven_through(field, place, heading, SETTINGS.squeeze)
    assert way > 1.2
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
            world.step(*plan.control.tolist(), dt=SETTINGS.dt)
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
    states, pending_prior = window.history.states.copy(), window.left.pending_prior
    assert window.history.full and pending_prior is not None
    for name in ("warm", "cold", "second"):
        setattr(controller.loop, name, Bent(getattr(controller.loop, name), **claims))
    plan = controller.plan(registered, ahead(OPEN), tracks())
    assert plan.emergency == (claims.get("violation", 0.0) > 0.0)
    moved = controller.loop.estimate - registered
    if believed:
        assert moved[0] == pytest.approx(1.0, abs=0.1)
    else:
        assert not moved.any()
    assert np.array_equal(window.history.states, states)
    assert window.left.pending_prior is pending_prior


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
    for name in ("warm", "cold", "second"):
        inner = getattr(controller.loop, name)
        setattr(controller.loop, name, Bent(inner, violation=1.0, status=fg.Status.LOCALLY_INFEASIBLE))


def test_braking_keeps_the_path_and_the_accelerations(controller: Controller) -> None:
    """From full speed, in a turn: as hard as the base can, along the path of the last plan, and then rest."""
    s, pose = SETTINGS, OPEN.copy()
    for _ in range(6):
        reference = followed(pose, controller.loop.applied, np.column_stack([s.pace, 0.6 * s.pace]), s.dt)
        before = controller.loop.applied
        plan = controller.plan(pose, reference, tracks())
        assert not plan.emergency
        pose = followed(pose, before, plan.control[None], s.dt)[1]
    assert before[0] > 0.8 and abs(before[1]) > 0.3
    expected, speeds = plan.states, [plan.control]
    failing(controller)
    while np.any(speeds[-1]):
        plan = controller.plan(pose, reference, tracks())
        assert plan.emergency and plan.source == "braking"
        np.testing.assert_allclose(plan.states, followed(pose, speeds[-1], plan.controls, s.dt))
        pose = followed(pose, speeds[-1], plan.control[None], s.dt)[1]
        speeds.append(plan.control)
        assert polyline_distance(pose[None, :2], expected)[0] < 0.01
        assert len(speeds) < 20
    changes = np.abs(np.diff(speeds, axis=0))
    assert np.all(changes <= s.most + 1e-9)
    assert np.all(changes[:-2, 0] >= 0.9 * s.most[0])  # as hard as it can
    assert controller.plan(pose, reference, tracks()).states[-1] == pytest.approx(pose)


def test_the_reference_brakes_to_rest_at_the_end() -> None:
    s = replace(SETTINGS, accelerations=(1.0, 2.1), speed=0.8)
    assert np.all(s.pace[:23] == 0.8)
    assert -np.diff(s.pace[22:]) == pytest.approx(0.1) and s.pace[-1] == pytest.approx(0.1)
    assert np.diff(s.stations)[:23] == pytest.approx(0.08)
    assert s.stations[-1] == pytest.approx(0.1 * (23 * 0.8 + 0.05 * sum((15, 13, 11, 9, 7, 5, 3))))


@pytest.mark.parametrize("side", [-0.12, 0.12])
@pytest.mark.parametrize("heading", [0.7, -0.7])
def test_a_robot_beside_its_goal_does_not_put_off_what_it_has_to_do(
    controller: Controller, side: float, heading: float
) -> None:
    """The reference begins anew every tick; where it lets the robot stay for a while, the robot stays for ever."""
    goal = OPEN + np.array([0.0, 0.0, 0.1])
    pose = goal + np.array([0.1, side, heading])
    path = np.column_stack([np.linspace(-1.0, 0.0, 21) + OPEN[0], np.full(21, OPEN[1]), np.full(21, heading)])
    path[:, 1] += (path[:, 0] - OPEN[0]) * np.tan(heading)
    path[-1] = goal
    follower, reached = PathFollower(path), 0.0
    for _ in range(60):
        reference, reached = follower.reference(pose, controller.stations(), reached)
        before = controller.loop.applied
        pose = followed(pose, before, controller.plan(pose, reference, tracks()).control[None], SETTINGS.dt)[1]
    assert np.hypot(*(pose - goal)[:2]) < 0.1 and abs(pose[2] - goal[2]) < 0.1


def test_after_a_failure_the_guess_is_the_way_out_until_it_is_forgotten(controller: Controller) -> None:
    loop = controller.loop
    controller.plan(OPEN, ahead(), tracks())
    now = loop.now(OPEN, controller.given(OPEN, ahead(), tracks()))
    assert loop.begin(now) == (loop.warm, loop.guess)
    good = (loop.warm, loop.cold)
    failing(controller)
    controller.plan(OPEN, ahead(), tracks())
    loop.warm, loop.cold = good
    now = loop.now(OPEN, controller.given(OPEN, ahead(), tracks()))
    run, guess = loop.begin(now)
    assert run is loop.warm
    for tail in loop.tree.paths:
        assert np.array_equal(guess.values[loop.u][tail[1:] - 1], now.given.evasive.controls)
        assert np.array_equal(guess.values[loop.x.family][tail], now.given.evasive.states)
    controller.forget()
    run, guess = loop.begin(now)
    assert run is loop.cold and not np.array_equal(guess.values[loop.u][loop.path[1:] - 1], now.given.evasive.controls)


def test_another_backend_is_asked_before_the_robot_brakes(controller: Controller) -> None:
    """A plan of the second is driven, counted, and goes on as a warm start; without one the robot brakes."""
    loop = controller.loop
    good = loop.second
    failing(controller)
    loop.second = good
    plan = controller.plan(OPEN, ahead(), tracks())
    assert plan.rescued and not plan.emergency and plan.control[0] > 0.1
    assert loop.rescues == 1 and loop.guess is not None and not loop.failed
    assert plan.status == fg.Status.CONVERGED or plan.status == fg.Status.STOP_RULE
    failing(controller)
    plan = controller.plan(OPEN, ahead(), tracks())
    assert plan.emergency and not plan.rescued and loop.rescues == 1


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


def test_a_mover_is_expected_to_walk_on_and_not_trusted_to_leave() -> None:
    s = SETTINGS
    towards = tracks((OPEN[0] + 1.5, OPEN[1], 0.2), velocity=(-0.5, 0.0), mover=True)
    stages = s.dt * np.arange(1, s.horizon + 1)
    assert predicted(SETTINGS, OPEN, towards)[:, 0, 0] == pytest.approx(OPEN[0] + 1.5 - 0.5 * stages)
    away = tracks((OPEN[0] + 1.5, OPEN[1], 0.2), velocity=(0.5, 0.2), mover=True)
    centres = predicted(SETTINGS, OPEN, away)[:, 0]
    assert np.all(centres[:, 0] == OPEN[0] + 1.5)
    assert centres[-1, 1] == pytest.approx(OPEN[1] + 0.2 * s.dt * s.horizon)


def test_a_mover_is_kept_off_by_what_it_walks_until_the_robot_can_be_at_rest() -> None:
    """Seen and decided in a tick, then braked from full speed: a base that brakes softly needs more room."""
    assert SETTINGS.mover_surprise == 0.5
    assert replace(SETTINGS, accelerations=(1.0, 2.1)).mover_surprise == pytest.approx(1.1)
    assert replace(SETTINGS, speed=0.5).mover_surprise == pytest.approx(0.3)


@pytest.mark.parametrize("speed", [0.0, 0.9])
def test_the_gap_to_a_mover_is_a_barrier(speed: float) -> None:
    """It is kept off by what it can walk, at the speed it has shown, and the rest of the gap shrinks at a rate."""
    s = SETTINGS
    others = tracks((OPEN[0] + 2.0, OPEN[1], 0.2), velocity=(speed, 0.0), mover=True)
    limits = limits_of(others)
    stages = np.arange(1, s.horizon + 1)
    travel = max(s.mover_speed, speed) * np.minimum(s.dt * stages, s.mover_surprise)
    least = HULL + s.disc_clearance + travel
    expected = least + (1.8 - least) * 0.88**stages  # an eighth of it in a tenth of a second
    np.testing.assert_allclose(limits, np.minimum(expected, 1.8))
    standing = limits_of(tracks((OPEN[0] + 2.0, OPEN[1], 0.2)))
    assert standing == pytest.approx(HULL + s.disc_clearance)


def test_a_robot_too_near_a_wall_may_stay_and_not_come_nearer(field: DistanceMap) -> None:
    s, smooth, sure = SETTINGS, SmoothField(field), np.zeros((2, 2))
    assert wall_limits(SETTINGS, smooth, RESTING, RESTING, sure) == pytest.approx(HULL + s.wall_clearance)
    close = np.array([1.5, -0.8 + HULL + 0.01, 0.0])
    now = float(smooth.distance(close[None, :2])[0])
    assert now < HULL + s.wall_clearance
    staying = np.tile(close, (s.horizon + 1, 1))
    assert wall_limits(SETTINGS, smooth, staying, staying, sure) == pytest.approx(now)


def test_a_scan_without_returns_changes_nothing(field: DistanceMap) -> None:
    smoother = Smoother(field, OPEN, [0.1, 0.1, 0.1], 72, SETTINGS.dt, length=2)
    angles = np.linspace(-np.pi, np.pi, 72, endpoint=False)
    smoother.update(Scan(angles, np.full(72, np.nan)), None, SETTINGS.dt)
    assert np.abs(smoother.pose - OPEN).max() < 1e-9


@pytest.mark.parametrize("name", ["sqp", "alm"])
def test_backends_take_the_settings_tolerances(name: str) -> None:
    from unifg.scenarios.ground.drive_settings import backend

    warm, cold = (backend(name, SETTINGS, patience) for patience in (1, 3))
    assert cold.max_iterations == 3 * warm.max_iterations
    assert warm.tolerance == SETTINGS.tolerance
    assert isinstance(warm, SQP) == (name == "sqp")
