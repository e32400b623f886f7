"""The quadrotor's controller: ways, references, plans judged without the graph, short flights, and when plans fail."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import unifg as fg
from unifg.horizon import Constant, Term
from unifg.lie import SO3
from unifg.models import avoidance, quadrotor
from unifg.scenarios.perception.belief import Belief, Landmarks
from unifg.scenarios.perception.tracks import Tracks
from unifg.scenarios.quadrotor.braking import brake, stopping_path
from unifg.scenarios.quadrotor.flight_control import Controller
from unifg.scenarios.quadrotor.flight_joint import SharedMotion
from unifg.scenarios.quadrotor.flight_parts import GivenFlight
from unifg.scenarios.quadrotor.flight_past import MANIFOLDS
from unifg.scenarios.quadrotor.flight_settings import ControllerSettings
from unifg.scenarios.quadrotor.guide import Guide, GuideSettings
from unifg.scenarios.quadrotor.slots import FAR_AWAY, SlotObstacles, Slots
from unifg.solvers.names import CONSTRAINED
from unifg.typing import Array

WALLS = np.array([[[0.0, -4.0], [30.0, -4.0]], [[0.0, 4.0], [30.0, 4.0]]])
BOUNDS = np.array([[0.0, -4.0], [30.0, 4.0]])
TARGET = np.array([12.0, 0.0, 1.5])
HEAVY = quadrotor.Parameters(1.2, (0.1, 0.1, 0.2), (0.5, -0.3), 0.1)
HULL = 0.25


def landmarks(*discs: tuple[float, float, float], sigma: float = 0.0) -> Landmarks:
    rows = np.array(discs, dtype=np.float64).reshape(-1, 3)
    count = len(rows)
    covariances = np.tile(sigma**2 * np.eye(2), (count, 1, 1))
    return Landmarks(np.arange(count), rows[:, :2], covariances, rows[:, 2], np.zeros(count, dtype=np.intp))


def state(x: float, y: float = 0.0, z: float = 1.5, velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Array:
    return np.array([x, y, z, 1.0, 0.0, 0.0, 0.0, *velocity])


def belief(present: Array, known: Landmarks | None = None, parameters: quadrotor.Parameters | None = None) -> Belief:
    return Belief(
        present, 1e-4 * np.eye(9), parameters or quadrotor.Parameters(), np.zeros(7), known or Landmarks.none()
    )


def gaps(positions: Array, known: Landmarks) -> Array:
    """(n, K) from the vehicle's centre to surfaces."""
    return np.asarray(np.hypot(*np.moveaxis(positions[:, None, :2] - known.positions, 2, 0)) - known.radii)


# ---------------------------------------------------------------- ways and references


def test_a_way_leads_around_the_nearer_side_and_keeps_its_clearance() -> None:
    known = landmarks((5.0, 0.3, 0.6), (8.0, -1.0, 0.5))
    reference = Guide(TARGET, WALLS, bounds=BOUNDS).reference(state(1.0), known, 31, 0.05)
    assert reference.open
    assert gaps(reference.way, known).min() > 0.6 - 0.03  # its corners are rounded
    assert reference.way[np.argmin(np.abs(reference.way[:, 0] - 5.0)), 1] < -0.25
    assert np.allclose(reference.way[0], [1.0, 0.0]) and np.allclose(reference.way[-1], TARGET[:2])
    shortest = np.hypot(*np.diff(reference.way, axis=0).T).sum()
    assert 11.0 < shortest < 11.4


def test_the_widest_clearance_that_leaves_a_way_is_used() -> None:
    fence = landmarks(*((5.0, y, 0.5) for y in np.arange(-4.0, 4.1, 1.86)))  # gaps of 0.86 m
    guide = Guide(TARGET, WALLS, GuideSettings(clearances=(0.6, 0.5, 0.42)), BOUNDS)
    reference = guide.reference(state(1.0), fence, 31, 0.05)
    assert reference.open and 0.42 - 0.03 < gaps(reference.way, fence).min() < 0.44


def test_without_a_way_the_reference_stays() -> None:
    fence = landmarks(*((5.0, y, 0.5) for y in np.arange(-4.0, 4.1, 1.0)))
    reference = Guide(TARGET, WALLS, bounds=BOUNDS).reference(state(1.0), fence, 31, 0.05)
    assert not reference.open
    assert np.all(reference.positions == [1.0, 0.0, 1.5]) and not reference.velocities.any()


def test_a_wall_is_gone_around() -> None:
    walls = np.array([[[4.0, -3.0], [4.0, 1.0]]])
    way = Guide(np.array([8.0, 0.0, 1.5]), walls).reference(state(0.0), Landmarks.none(), 31, 0.05).way
    crossing = way[np.argmin(np.abs(way[:, 0] - 4.0)), 1]
    assert 1.55 < crossing < 1.75


def test_a_way_survives_small_corrections_of_the_map_and_not_large_ones() -> None:
    guide = Guide(TARGET, WALLS, bounds=BOUNDS)
    first = guide.reference(state(1.0), landmarks((5.0, 0.03, 0.6)), 31, 0.05).way
    second = guide.reference(state(1.2), landmarks((5.0, -0.03, 0.6)), 31, 0.05).way  # the other side is shorter now
    assert second is first
    third = guide.reference(state(1.2), landmarks((5.0, -0.8, 0.6)), 31, 0.05).way
    assert third[np.argmin(np.abs(third[:, 0] - 5.0)), 1] > 0.3


def test_a_reference_can_be_flown() -> None:
    """Velocities are those of the positions, speeds grow and fall no faster than they may, and it ends at rest."""
    settings, dt = GuideSettings(), 0.05
    reference = Guide(TARGET, WALLS, settings, BOUNDS).reference(state(1.0, z=1.0), landmarks((5.0, 0.3, 0.6)), 241, dt)
    middle = 0.5 * (reference.velocities[1:] + reference.velocities[:-1])
    assert np.allclose(np.diff(reference.positions, axis=0)[:, :2], dt * middle[:, :2], atol=4e-3)
    speed = np.hypot(*reference.velocities[:, :2].T)
    assert speed.max() <= settings.speed + 1e-9 and speed[0] < 0.5
    assert np.abs(np.diff(speed)).max() < 1.2 * dt * settings.acceleration
    assert np.allclose(reference.positions[-1], TARGET, atol=1e-6) and speed[-1] < 0.05


# ---------------------------------------------------------------- single plans


@pytest.fixture(scope="module")
def controllers() -> dict[str, Controller]:
    return {name: Controller(TARGET, WALLS, name, bounds=BOUNDS) for name in CONSTRAINED}


AHEAD = landmarks((3.5, 0.1, 0.5), (5.0, 1.2, 0.4))
MOVING = belief(state(2.0, velocity=(1.8, 0.0, 0.0)), AHEAD, HEAVY)


@pytest.mark.parametrize("name", CONSTRAINED)
def test_a_plan_moves_as_the_vehicle_does_and_keeps_every_limit(name: str, controllers: dict[str, Controller]) -> None:
    controller, s = controllers[name], controllers[name].settings
    controller.forget()
    plan = controller.plan(MOVING)
    assert plan.source == "solved" and not plan.emergency and plan.milliseconds > 0.0
    assert plan.controls.shape == (s.horizon, 4) and plan.states.shape == (s.horizon + 1, 10)
    assert np.array_equal(plan.states[0], MOVING.state)
    flown = quadrotor.rollout(MOVING.state, plan.controls, s.dt, HEAVY)
    assert np.abs(quadrotor.STATE.local(flown, plan.states)).max() < 2e-2
    assert gaps(flown[1:], AHEAD).min() > HULL + s.margin - 2e-3
    assert np.all(np.abs(plan.controls[:, :3]) <= s.rate_limits)
    assert plan.controls[:, 3].min() >= s.thrust_limits[0] and plan.controls[:, 3].max() <= s.thrust_limits[1]
    vertical = SO3.matrix(flown[1:, 3:7])[:, 2, :2]
    assert np.abs(vertical).max() <= s.lean_limit + 1e-2
    assert flown[-1, 0] > 4.0  # it goes on


def test_backends_make_the_same_plan(controllers: dict[str, Controller]) -> None:
    plans = []
    for controller in controllers.values():
        controller.forget()
        plans.append(controller.plan(MOVING).states[:, :3])
    assert all(np.abs(plans[0] - plan).max() < 2e-2 for plan in plans[1:])


def test_the_believed_mass_and_wind_are_flown_with() -> None:
    controller = Controller(TARGET, WALLS, bounds=BOUNDS)
    level = quadrotor.hover_attitude(HEAVY)
    there = np.concatenate([TARGET, level, np.zeros(3)])
    plan = controller.plan(belief(there, parameters=HEAVY))
    assert np.allclose(plan.controls, quadrotor.hover(HEAVY), atol=2e-3)


def test_a_start_on_the_ground_without_walls_climbs() -> None:
    plan = Controller(TARGET, np.zeros((0, 2, 2))).plan(belief(state(1.0, z=0.0)))
    assert plan.source == "solved" and plan.status.converged
    assert plan.states[:, 2].min() > -0.02 and plan.states[-1, 2] > 0.6


def test_a_doubtful_landmark_is_given_more_room(controllers: dict[str, Controller]) -> None:
    controller, s = controllers["ipm"], controllers["ipm"].settings
    near = []
    for sigma in (0.0, 0.06):
        controller.forget()
        known = landmarks((3.5, 0.1, 0.5), sigma=sigma)
        plan = controller.plan(belief(state(2.0, velocity=(1.8, 0.0, 0.0)), known))
        assert gaps(plan.states[1:], known).min() > HULL + s.margin + s.sigmas * sigma - 2e-3
        near.append(gaps(plan.states[1:], known).min())
    assert near[1] > near[0] + 0.02


def test_terms_of_the_estimate_can_be_replaced() -> None:
    """Parameters and landmarks as variables, as in a joint graph: fixed where they were given, they change nothing."""

    values = np.split(HEAVY.packed, [1, 4, 6])
    constants = [
        Constant(name, kind, value, 0.0) for (name, kind), value in zip(MANIFOLDS.items(), values, strict=True)
    ]

    class Places(Term):
        def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
            least, places = HULL + ControllerSettings().margin, graph.families["places"]
            for k, radius in enumerate(AHEAD.radii.tolist()):
                graph.constrain(
                    avoidance.landmark_clearance, x.p[1:], places[k], radius, lower=least, name=f"landmark {k}"
                )

    class Shared(GivenFlight):
        def __init__(self, settings: ControllerSettings) -> None:
            super().__init__(settings)
            places = Constant("places", fg.Rn(2), AHEAD.positions, 0.0)
            self.robot = replace(self.robot, constants=(*constants, places))

        def motion(self) -> list[Term]:
            return [SharedMotion(self.settings, drag=False)]

        def apart(self) -> list[Term]:
            return [Places()]

        def split(self, obstacles: SlotObstacles) -> tuple[SlotObstacles, Any, list[int]]:
            nowhere = replace(obstacles, centres=np.full_like(obstacles.centres, FAR_AWAY))
            return nowhere, np.ones(len(obstacles.names), dtype=bool), []

    usual = Controller(TARGET, WALLS, bounds=BOUNDS).plan(MOVING)
    past = Shared(ControllerSettings())
    shared = Controller(TARGET, WALLS, bounds=BOUNDS, past=past).plan(MOVING)
    assert shared.source == "solved"
    assert np.abs(shared.states[:, :3] - usual.states[:, :3]).max() < 5e-3


def test_the_potential_keeps_off() -> None:
    settings = ControllerSettings(avoidance="potential", tolerance=1e-6, horizon=20)
    plan = Controller(TARGET, WALLS, settings=settings, bounds=BOUNDS).plan(
        belief(state(2.0, velocity=(1.0, 0.0, 0.0)), AHEAD)
    )
    assert plan.status.converged
    assert plan.states[-1, 1] < -0.05  # the cylinder ahead stands a little to the left


def test_unknown_words_are_refused() -> None:
    with pytest.raises(fg.BackendError, match="penalty, alm, sqp, ipm"):
        Controller(TARGET, WALLS, "simplex")
    with pytest.raises(fg.ScenarioError, match="avoidance"):
        Controller(TARGET, WALLS, settings=ControllerSettings(avoidance="hope"))  # type: ignore[arg-type]


# ---------------------------------------------------------------- slots


def test_an_obstacle_keeps_its_slot() -> None:
    settings = ControllerSettings(cylinders=2, movers=0)
    slots = Slots(settings, WALLS)
    known = landmarks((3.0, 1.0, 0.3), (6.0, 1.0, 0.3), (9.0, 1.0, 0.3))
    names = []
    for x in (1.0, 5.5, 9.0):
        positions = np.linspace([x, 0.0, 1.5], [x + 2.0, 0.0, 1.5], settings.horizon + 1)
        names.append(slots.fill(state(x), positions, known, Tracks.none()).names.tolist())
    assert names == [[0, 1], [2, 1], [2, 1]]


def test_limits_leave_time_to_dodge_what_stands_close() -> None:
    """Braking keeps those of the first nodes, whatever stands there; in the end they are those of the settings."""
    settings = ControllerSettings()
    fast = state(1.0, velocity=(2.0, 0.0, 0.0))
    known = landmarks((2.2, 0.0, 0.5))
    positions = np.tile(fast[:3], (settings.horizon + 1, 1))
    obstacles = Slots(settings, WALLS).fill(fast, positions, known, Tracks.none())
    _, states = brake(fast, quadrotor.Parameters(), settings.horizon, settings.dt, *limits(settings))
    kept = obstacles.limits[:, obstacles.names.tolist().index(0)]
    assert np.all(gaps(states[1:8], known)[:, 0] >= kept[:7] - 0.01)
    assert kept[6] < 0.2 and np.allclose(kept[20:], HULL + settings.margin)


# ---------------------------------------------------------------- flights


@pytest.mark.parametrize("aware", [True, False])
def test_a_mover_that_crosses_is_avoided_by_those_who_know(aware: bool) -> None:
    controller, dt = Controller(TARGET, WALLS, bounds=BOUNDS), 0.05
    here, centre, velocity, radius = (
        state(1.0, velocity=(2.0, 0.0, 0.0)),
        np.array([5.0, -1.6]),
        np.array([0.0, 0.8]),
        0.4,
    )
    least = np.inf
    for _ in range(60):
        movers = Tracks.of_movers(centre[None], velocity[None], np.array([radius])) if aware else Tracks.none()
        plan = controller.plan(belief(here), movers)
        here = quadrotor.fly(here, plan.controls[0], dt, quadrotor.Parameters())
        centre = centre + dt * velocity
        least = min(least, float(np.hypot(*(here[:2] - centre))) - radius - HULL)
    assert (least > 0.0) == aware


# ---------------------------------------------------------------- when there is no plan


def limits(settings: ControllerSettings) -> tuple[Array, Array]:
    rates = np.array(settings.rate_limits)
    return np.append(-rates, settings.thrust_limits[0]), np.append(rates, settings.thrust_limits[1])


def test_braking_stops_and_hovers() -> None:
    settings = ControllerSettings()
    fast = state(0.0, velocity=(2.0, -1.0, -0.5))
    least, most = limits(settings)
    controls, states = brake(fast, HEAVY, 60, settings.dt, least, most)
    assert np.all(controls >= least) and np.all(controls <= most)
    assert np.linalg.norm(states[-1, 7:]) < 0.05
    assert np.allclose(states[1:], quadrotor.rollout(fast, controls, settings.dt, HEAVY)[1:])
    path = stopping_path(fast[:3], fast[7:], settings.dt * np.arange(1.0, 61.0))
    assert np.hypot(*(path[-1] - states[-1, :2])) < 0.35


def test_plans_that_may_not_be_flown_are_replaced() -> None:
    """First by what is left of the last good one, in the end by braking; never by an exception."""
    settings = ControllerSettings()
    controller = Controller(TARGET, WALLS, settings=settings, bounds=BOUNDS)
    here = state(1.0, velocity=(1.5, 0.0, 0.0))
    good = controller.plan(belief(here))
    controller.settings = replace(settings, feasible=0.0)  # from now on nothing is good enough
    here = quadrotor.fly(here, good.controls[0], settings.dt, quadrotor.Parameters())
    plan = controller.plan(belief(here))
    assert plan.emergency and plan.source == "kept"
    assert np.allclose(plan.controls[:-1], good.controls[1:])
    sources = []
    for _ in range(60):
        here = quadrotor.fly(here, plan.controls[0], settings.dt, quadrotor.Parameters())
        plan = controller.plan(belief(here))
        sources.append(plan.source)
    assert sources[-1] == "braking" and controller.loop.sources["braking"] == sources.count("braking")
    assert np.linalg.norm(here[7:]) < 0.1
    controller.settings = settings
    assert controller.plan(belief(here)).source == "solved"


def test_a_cylinder_that_appears_right_ahead_raises_nothing() -> None:
    controller = Controller(TARGET, WALLS, bounds=BOUNDS)
    here = state(1.0, velocity=(2.0, 0.0, 0.0))
    known = landmarks((2.0, 0.0, 0.6), (2.0, 1.3, 0.6), (2.0, -1.3, 0.6))  # 0.15 m ahead of the hull
    for _ in range(10):
        plan = controller.plan(belief(here, known))
        assert np.isfinite(plan.controls).all() and np.isfinite(plan.states).all()
        here = quadrotor.fly(here, plan.controls[0], 0.05, quadrotor.Parameters())
