"""Decisions of the flying robot: whose multipliers it keeps, what it avoids, what it flies when there is no plan."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import unifg as fg
from test_quadrotor_controller import BOUNDS, TARGET, WALLS, belief, landmarks, state
from unifg.horizon import Context
from unifg.models import quadrotor
from unifg.scenarios.perception.belief import Landmarks
from unifg.scenarios.perception.tracks import Tracks
from unifg.scenarios.quadrotor.flight_control import KEPT, LEFT_BEHIND, PATIENCE, Controller, is_behind
from unifg.scenarios.quadrotor.flight_parts import FlightInput
from unifg.scenarios.quadrotor.flight_settings import ControllerSettings
from unifg.scenarios.quadrotor.guide import Reference
from unifg.scenarios.quadrotor.slots import Slots
from unifg.typing import Array

SETTINGS = ControllerSettings()


class Watched:
    """A prepared solver that keeps the guesses it is given."""

    def __init__(self, inner: fg.Prepared) -> None:
        self.inner = inner
        self.guesses: list[fg.Guess] = []

    def solve(self, guess: fg.Guess, **options: Any) -> fg.Solution:
        self.guesses.append(guess)
        return self.inner.solve(guess, **options)


def named(known: Landmarks, *names: int) -> Landmarks:
    """The same landmarks by other names."""
    return replace(known, ids=np.array(names))


# ---------------------------------------------------------------- multipliers


def test_multipliers_stay_with_their_obstacle_and_go_with_it() -> None:
    """A cylinder that takes another's slot does not inherit the force with which that one was kept off."""
    controller = Controller(TARGET, WALLS, settings=replace(SETTINGS, margin=0.6), bounds=BOUNDS)
    here = state(1.0, velocity=(1.5, 0.0, 0.0))
    two = named(landmarks((3.0, 0.15, 0.5), (2.6, -1.9, 0.4)), 4, 7)
    controller.plan(belief(here, two))
    assert controller.loop.guess is not None
    left = controller.loop.guess.multipliers["cylinders"]
    slots = controller.slots._names.tolist()
    kept, gone = slots.index(4), slots.index(7)
    assert np.abs(left[:, kept]).max() > 1.0 and left[:, gone].all()
    watched = Watched(controller.loop.warm)
    controller.loop.warm = watched  # type: ignore[assignment]
    other = named(landmarks((3.0, 0.15, 0.5), (9.0, 1.0, 0.4)), 4, 8)
    movers = Tracks.of_movers(np.array([[8.0, -2.0]]), np.array([[0.0, 0.3]]), np.array([0.4]))
    plan = controller.plan(belief(here, other), movers)
    assert plan.source == "solved"
    assert controller.slots._names.tolist()[gone] == 8
    given = watched.guesses[0].multipliers
    assert np.array_equal(given["cylinders"][:, kept], left[:, kept])
    assert not given["cylinders"][:, gone].any()
    assert not given["cylinders"][:, SETTINGS.cylinders :].any()  # nothing says that the mover is the same


def test_a_slot_says_whether_it_holds_something_else() -> None:
    slots = Slots(replace(SETTINGS, cylinders=3, movers=1), WALLS)
    positions = np.linspace([1.0, 0.0, 1.5], [3.0, 0.0, 1.5], SETTINGS.horizon + 1)

    def fill(known: Landmarks) -> list[bool]:
        changed: list[bool] = slots.fill(state(1.0), positions, known, Tracks.none()).changed.tolist()
        return changed

    near, far = landmarks((3.0, 1.0, 0.3)), landmarks((3.0, 1.0, 0.3), (4.0, -1.0, 0.3))
    assert fill(near) == [True, False, False, True]  # an empty slot stays one; nobody follows movers
    assert fill(near) == [False, False, False, True]
    assert fill(far) == [False, True, False, True]
    assert fill(Landmarks.none()) == [True, True, False, True]


# ---------------------------------------------------------------- limits


def test_what_is_kept_clear_of() -> None:
    """Hull and margin; more where a landmark is uncertain, up to a limit; more with time where something moves."""
    s = replace(SETTINGS, cylinders=2, movers=2)
    here = state(1.0)
    positions = np.tile(here[:3], (s.horizon + 1, 1))
    doubt = 0.03
    known = replace(
        landmarks((9.0, 2.0, 0.3), (9.0, -2.0, 0.3)),
        covariances=np.stack([np.diag([doubt**2, (0.5 * doubt) ** 2]), 9.0 * np.eye(2)]),
    )
    movers = Tracks.of_movers(
        np.array([[11.0, 1.0], [11.0, -1.0], [12.0, 3.0]]),
        np.array([[0.5, 0.2], [-0.5, 0.0], [0.0, 0.0]]),
        np.array([0.4, 0.4, 0.3]),
    )
    obstacles = Slots(s, WALLS).fill(here, positions, known, movers)
    least = s.vehicle_radius + s.margin
    slots = {name: obstacles.names.tolist().index(name) for name in (0, 1)}
    assert obstacles.limits[:, slots[0]] == pytest.approx(least + s.sigmas * doubt)
    assert obstacles.limits[:, slots[1]] == pytest.approx(least + s.margin_limit)
    times = s.dt * np.arange(1.0, s.horizon + 1)
    for slot, row in ((s.cylinders, 0), (s.cylinders + 1, 1)):  # the two nearest ones, in their order
        assert obstacles.radii[slot] == movers.radius[row]
        assert obstacles.limits[:, slot] == pytest.approx(least + s.mover_margin + s.mover_growth * times)
    line = here[:2] - movers.centre[0]
    line /= np.hypot(*line)
    aside = np.array([-line[1], line[0]])
    moved = obstacles.centres[-1, s.cylinders] - movers.centre[0]
    assert moved @ line == pytest.approx(0.0, abs=1e-12)  # it goes away: it may turn round
    assert moved @ aside == pytest.approx(times[-1] * movers.velocity[0] @ aside)
    closing = obstacles.centres[-1, s.cylinders + 1] - movers.centre[1]
    assert closing == pytest.approx(times[-1] * movers.velocity[1])  # it comes: that is believed in full
    assert np.all(obstacles.wall_limits == least)


def test_the_nearest_movers_are_those_whose_hulls_are_nearest() -> None:
    """More movers than slots: the large one farther off is nearer than the small one beside it."""
    s = replace(SETTINGS, cylinders=1, movers=1)
    here = state(9.0, y=2.0)
    positions = np.tile(here[:3], (s.horizon + 1, 1))
    movers = Tracks.of_movers(
        np.array([[9.0, 0.8], [9.0, 3.5], [0.5, 0.0]]), np.zeros((3, 2)), np.array([0.2, 0.9, 0.3])
    )
    obstacles = Slots(s, WALLS).fill(here, positions, Landmarks.none(), movers)
    assert obstacles.radii[1] == 0.9
    assert np.all(obstacles.centres[:, 1] == [9.0, 3.5])


def test_the_control_that_is_flown_is_what_the_next_one_changes_from() -> None:
    controller, here = Controller(TARGET, WALLS, settings=SETTINGS, bounds=BOUNDS), belief(state(1.0))
    hover = quadrotor.hover(here.parameters)
    lasts, inner = [], controller.loop.data

    def data(now: Context[FlightInput]) -> Any:
        lasts.append(now.last)
        return inner(now)

    controller.loop.data = data  # type: ignore[method-assign]
    plans = [controller.plan(here), controller.plan(here)]
    controller.forget()
    controller.plan(here)
    assert not np.allclose(plans[0].controls[0], hover)
    for last, expected in zip(lasts, (hover, plans[0].controls[0], hover), strict=True):
        assert np.array_equal(last, expected)


def test_the_first_control_does_not_leap_from_the_last() -> None:
    """Two vehicles in the same state, one of which has just been pushed up harder."""
    thrust = []
    for more in (0.0, 4.0):
        controller, here = Controller(TARGET, WALLS, settings=SETTINGS, bounds=BOUNDS), belief(state(1.0))
        controller.plan(here)
        controller.loop.forget()
        controller.loop.applied = quadrotor.hover(here.parameters) + np.array([0.0, 0.0, 0.0, more])
        thrust.append(controller.plan(here).controls[0, 3])
    assert thrust[1] > thrust[0] + 0.1


def test_limits_of_the_controls_are_the_solver_s_business_not_the_clipping_s() -> None:
    """A vehicle that sinks fast wants more thrust than there is; the plan knows that it does not get it."""
    s = replace(SETTINGS, thrust_limits=(2.0, 12.0))
    controller = Controller(TARGET, WALLS, settings=s, bounds=BOUNDS)
    plan = controller.plan(belief(state(1.0, z=3.0, velocity=(1.0, 0.0, -2.5))))
    assert plan.source == "solved" and plan.controls[:, 3].max() > 12.0 - 1e-3
    forces = controller.loop.guess.multipliers["control limits"]  # type: ignore[union-attr]
    assert forces[:, 3].max() > 0.01
    flown = quadrotor.rollout(plan.states[0], plan.controls, s.dt, quadrotor.Parameters())
    assert np.abs(flown[:, 2] - plan.states[:, 2]).max() < 0.02


# ---------------------------------------------------------------- plans that may not be flown


SHIFTED = fg.Guess({})


class Told:
    """A controller's judgement alone: answers of the solver are replaced by given controls."""

    def __init__(self, **changes: Any) -> None:
        self.controller = Controller(TARGET, WALLS, settings=replace(SETTINGS, **changes), bounds=BOUNDS)

    def judge(self, controls: Array, present: Array, *, defect: float = 0.0, discs: Landmarks | None = None) -> Any:
        """Decision on such an answer of the solver, whose states are off by ``defect`` [m] at the end."""
        c, s = self.controller, self.controller.settings
        states = quadrotor.rollout(present, controls, s.dt, quadrotor.Parameters())
        states[-1, 0] += defect
        believed = belief(present, discs)
        now = c.loop.now(present, c.given(believed, Tracks.none()))

        class Answer:
            def __getitem__(self, variable: Any) -> Array:
                return controls if variable is c.loop.u else states

            def shifted(self, *families: Any) -> fg.Guess:
                return SHIFTED

        choice = c.loop.decide(Answer(), now)  # type: ignore[arg-type]
        return choice.controls, choice.states, choice.source


HOVER = quadrotor.hover(quadrotor.Parameters())
REST = np.tile(HOVER, (SETTINGS.horizon, 1))


def test_a_sound_plan_is_flown_within_the_limits_and_starts_the_next() -> None:
    told = Told()
    wild = REST.copy()
    wild[3, 3] = SETTINGS.thrust_limits[1] + 1e-3  # within the solver's tolerance
    controls, _, source = told.judge(wild, state(1.0))
    assert source == "solved" and controls[3, 3] == SETTINGS.thrust_limits[1]
    assert told.controller.loop.guess is SHIFTED
    assert told.controller.loop.sources == {"solved": 1}


def test_old_plans_are_flown_for_some_ticks_and_then_it_brakes() -> None:
    """Each tick one stage later, ending in hover; after that nothing old is left to fly."""
    told = Told()
    rising = REST.copy()
    rising[:, 3] += 0.05 * np.cos(np.arange(SETTINGS.horizon))
    told.judge(rising, state(1.0))
    for age in range(1, KEPT + 3):
        controls, states, source = told.judge(rising, state(1.0), defect=1.0)
        if age <= KEPT:
            assert source == "kept"
            assert np.array_equal(controls, np.concatenate([rising[age:], np.tile(HOVER, (age, 1))]))
            assert np.array_equal(states, quadrotor.rollout(state(1.0), controls, SETTINGS.dt, quadrotor.Parameters()))
        else:
            assert source == "braking"
        guess = told.controller.loop.guess  # one stage later, from what is flown
        assert guess is not None
        assert np.array_equal(guess.values[told.controller.loop.u][:-1], controls[1:])
        assert np.array_equal(guess.values[told.controller.loop.x.family][:-1], states[1:])
    assert told.controller.loop.sources == {"solved": 1, "kept": KEPT, "braking": 2}


def test_without_an_old_plan_it_brakes() -> None:
    told = Told()
    controls, _, source = told.judge(REST, state(1.0, velocity=(1.0, 0.0, 0.0)), defect=1.0)
    assert source == "braking"
    loop = told.controller.loop
    assert np.all(controls >= loop.kept.least) and np.all(controls <= loop.kept.most)
    told.controller.forget()
    assert not len(loop.kept.left()) and loop.guess is None


SWERVE, STRAIGHT = REST.copy(), REST.copy()
SWERVE[:10, 0], SWERVE[10:20, 0] = 2.0, -2.0  # leans to the right, and back
SWERVE[:20, 3] += 4.0
FAST = state(1.0, velocity=(2.0, 0.0, 0.0))
BEFORE = landmarks((1.8, 0.0, 0.5))  # 5 cm ahead of the hull


def test_a_plan_that_comes_too_near_is_flown_where_all_else_comes_nearer() -> None:
    """Before a cylinder that has just been seen: an old plan runs into it, braking too, a swerve comes less near."""
    for old in (False, True):
        told = Told()
        if old:
            assert told.judge(STRAIGHT, FAST)[2] == "solved"
        _, _, source = told.judge(SWERVE, FAST, discs=BEFORE)
        assert source == "violating"
        assert told.controller.loop.sources == ({"solved": 1} if old else {}) | {"violating": 1}
    # The same controls with states that do not follow from them say nothing, nor do what is not a number.
    assert Told().judge(SWERVE, FAST, discs=BEFORE, defect=1.0)[2] == "braking"
    assert Told().judge(SWERVE, FAST, discs=BEFORE, defect=np.nan)[2] == "braking"


def test_what_keeps_off_best_is_flown() -> None:
    """Beside what an old plan passes there is no need to brake; where it would run into something there is."""
    aside, inside = landmarks((3.0, 2.0, 0.5)), landmarks((2.6, 0.0, 0.5))
    for discs, source in ((aside, "kept"), (inside, "braking")):
        told = Told()
        told.judge(STRAIGHT, FAST)
        assert told.judge(STRAIGHT, FAST, defect=1.0, discs=discs)[2] == source


@pytest.mark.parametrize(
    ("changes", "solved"), [({}, False), ({"give": 2.0}, True), ({"avoidance": "potential"}, True)]
)
def test_clearances_may_be_missed_by_as_much_as_is_given_away(changes: Any, solved: bool) -> None:
    """The plan comes 0.5 m too near at the end of its horizon; with Ta's potential nothing has to be kept clear of."""
    disc = landmarks((3.6, 0.0, 0.5))
    assert (Told(**changes).judge(STRAIGHT, FAST, discs=disc)[2] == "solved") == solved


def test_plans_that_stay_behind_are_started_over() -> None:
    told = Told()
    way = np.tile([1.0, 0.0, 1.5], (SETTINGS.horizon + 1, 1))
    reference = Reference(way, np.zeros_like(way), way[:, :2], True)
    behind, near = (np.tile(state(1.0 - share * LEFT_BEHIND), (2, 1)) for share in (1.01, 0.99))
    loop, (is_far, is_near) = told.controller.loop, (is_behind(plan, reference) for plan in (behind, near))
    given = [loop.stays_behind(is_far) for _ in range(2 * PATIENCE)]
    assert given == ([False] * (PATIENCE - 1) + [True]) * 2
    for _ in range(PATIENCE - 1):
        loop.stays_behind(is_far)
    assert not loop.stays_behind(is_near)
    assert not loop.stays_behind(is_far)
    assert loop.lagging == 1
    told.controller.forget()
    assert loop.lagging == 0
