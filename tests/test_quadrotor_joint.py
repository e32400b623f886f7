"""The quadrotor's joint graph: what the past says, how far the plan may pull it, and what a plan must keep.

One window, filled by a flight, serves most tests: several controllers solve it, none changes it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import unifg as fg
from benchmarks import quadrotor_pull
from calls import calls_of
from unifg.horizon import Plan
from unifg.lie import SO3
from unifg.models import quadrotor
from unifg.problem.compiled_problem import CompiledProblem
from unifg.scenarios.flight import Flight, FlightSettings
from unifg.scenarios.perception.belief import Belief
from unifg.scenarios.perception.tracks import Tracks
from unifg.scenarios.quadrotor.estimator import Estimator
from unifg.scenarios.quadrotor.flight_control import Controller
from unifg.scenarios.quadrotor.flight_joint import JointSettings, SharedFlight
from unifg.scenarios.quadrotor.flight_past import packed
from unifg.scenarios.quadrotor.flight_pilot import joint_controller, make_pilot
from unifg.scenarios.quadrotor.flight_settings import ControllerSettings
from unifg.scenarios.quadrotor.slots import FAR_AWAY
from unifg.scenarios.simulation.layouts import Layout
from unifg.solvers import InteriorPoint
from unifg.solvers.names import CONSTRAINED
from unifg.typing import Array

SEED = 1000  # of those open to tuning
FREE = JointSettings(np.inf)


def flown(flight: Flight, ticks: int) -> Iterator[Plan]:
    """Plans of a flight, tick by tick, each flown when the next is asked for."""
    control: Array | None = None
    for _ in range(ticks):
        plan = flight.pilot.tick(flight.world.sense(), control)
        control = plan.controls[0]
        yield plan
        flight.world.step(control, flight.settings.controller.dt)


class Past:
    """A window filled by a flight, up to a tick that has not been planned yet."""

    def __init__(self, ticks: int, settings: FlightSettings) -> None:
        flight = Flight(settings)
        control = [plan.controls[0] for plan in flown(flight, ticks)][-1]
        self.layout: Layout = flight.conditions.layout
        self.estimator: Estimator = flight.pilot.estimator
        self.belief: Belief = self.estimator.update(flight.world.sense(), control)

    def controller(self, joint: JointSettings, solver: str = "ipm", **changes: object) -> Controller:
        """A joint graph on this window."""
        settings = replace(ControllerSettings(), **changes)  # type: ignore[arg-type]
        return joint_controller(self.estimator, self.layout, solver, settings, joint)

    def pulled(self, believed: Belief) -> dict[str, Array]:
        """Deviation of a belief from that of the past, in standard deviations."""
        past = self.belief
        known = past.parameters_sigma > 0.0
        sigma = np.sqrt(np.diagonal(past.landmarks.covariances, axis1=1, axis2=2))
        return {
            "state": quadrotor.STATE.local(past.state[None], believed.state[None])[0] / past.sigma,
            "parameters": ((believed.parameters.packed - past.parameters.packed)[known] / past.parameters_sigma[known]),
            "landmarks": (believed.landmarks.positions - past.landmarks.positions) / sigma,
        }


@pytest.fixture(scope="module")
def past() -> Past:
    return Past(40, FlightSettings(seed=SEED))


@pytest.fixture
def compilations(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, ...]]:
    """Grows by one with every graph that is compiled."""
    return calls_of(monkeypatch, CompiledProblem, "__init__")


def latest(controller: Controller) -> Belief:
    """Belief of the last joint solve."""
    assert isinstance(controller.past, SharedFlight)
    return controller.belief


def alone(past: Past) -> tuple[Array, dict[str, Array]]:
    """Present state and constants by the past's terms in a graph of their own, solved to the end."""
    window = past.estimator.window
    solver = InteriorPoint(tolerance=1e-9)
    solution = solver.solve(window.run.program.graph, window.guess(), data=window.data())
    assert solution.status.converged
    values = {family.name: solution[family] for family in solution.values}
    return values["x"][-1], values


def defects(plan: Plan, parameters: quadrotor.Parameters, dt: float) -> Array:
    """(N, 9) of the implicit trapezoid, written out."""
    x, y, u = plan.states[:-1], plan.states[1:], plan.controls

    def acceleration(states: Array) -> Array:
        R = SO3.matrix(states[:, 3:7])
        along = np.einsum("nji,nj->ni", R, states[:, 7:])
        force = u[:, 3:] * R[:, :, 2] - np.einsum("nij,nj->ni", R, np.array(parameters.drag) * along)
        world = np.array([*parameters.wind, parameters.updraft - quadrotor.GRAVITY])
        return np.asarray(force / parameters.mass + world)

    turned = SO3.log(SO3.compose(SO3.inverse(x[:, 3:7]), y[:, 3:7]))
    moved = y[:, :3] - x[:, :3] - 0.5 * dt * (x[:, 7:] + y[:, 7:])
    hastened = y[:, 7:] - x[:, 7:] - 0.5 * dt * (acceleration(x) + acceleration(y))
    return np.concatenate([moved, turned - dt * u[:, :3], hastened], axis=1)


# ---------------------------------------------------------------- what the graph says


@pytest.mark.product(2, of="drives and flights")
def test_without_wishes_the_past_decides(past: Past) -> None:
    """A future that costs nothing leaves states, parameters and landmarks where the past alone puts them."""
    # With weights of 1e-9 rounding keeps one solve in forty above 1e-7.
    controller = past.controller(FREE, control_weight=1e-9, tolerance=1e-6)
    assert controller.plan(past.belief).status is fg.Status.CONVERGED
    present, constants = alone(past)
    marks = [past.estimator.atlas.slot_of(name) for name in past.belief.landmarks.ids.tolist()]
    believed = latest(controller)
    assert np.abs(quadrotor.STATE.local(present, believed.state)).max() < 1e-6
    assert np.abs(believed.landmarks.positions - constants["landmarks"][marks]).max() < 1e-6
    assert np.abs(believed.parameters.packed - packed(constants)).max() < 1e-6


def test_wishes_pull_on_what_is_shared(past: Past) -> None:
    """The bias of one graph without a bound: it grows with the weight of the future's costs, in all that is shared."""
    pulled = []
    for weight in (0.1, 1.0, 100.0):
        controller = past.controller(FREE, control_weight=weight)
        assert controller.plan(past.belief).source == "solved"
        pulled.append({name: float(np.abs(value).max()) for name, value in past.pulled(latest(controller)).items()})
    for name in ("state", "parameters", "landmarks"):
        weak, normal, strong = (row[name] for row in pulled)
        assert 2.0 * weak < normal < 0.2
        assert strong > 2.0 * normal
        assert strong > 0.1


@pytest.mark.parametrize("bound", [0.1, 0.5])
def test_the_pull_is_bounded(bound: float, past: Past) -> None:
    controller = past.controller(JointSettings(bound), control_weight=100.0)
    assert controller.plan(past.belief).status.converged
    found = np.concatenate([np.abs(value).ravel() for value in past.pulled(latest(controller)).values()])
    assert bound - 2e-3 < found.max() < bound + 2e-3


@pytest.mark.parametrize("solver", CONSTRAINED)
def test_a_plan_moves_as_the_shared_parameters_say_and_keeps_clear_of_the_shared_map(solver: str, past: Past) -> None:
    controller = past.controller(JointSettings(), solver, margin=0.9)  # so wide that the way does not keep it
    s, plan, believed = controller.settings, controller.plan(past.belief), latest(controller)
    assert plan.source == "solved"
    assert believed is not past.belief
    assert np.array_equal(plan.states[0], believed.state)
    assert np.abs(defects(plan, believed.parameters, s.dt)).max() < s.feasible
    cylinders = believed.landmarks.cylinders
    gaps = np.hypot(*np.moveaxis(plan.states[15:, None, :2] - cylinders.positions, 2, 0)) - cylinders.radii
    doubt = np.sqrt(np.linalg.eigvalsh(cylinders.covariances)[:, -1])
    spare = gaps - s.vehicle_radius - s.margin - np.minimum(s.sigmas * doubt, s.margin_limit)
    assert -5e-3 < spare.min() < 5e-3
    tilt = SO3.matrix(plan.states[1:, 3:7])[:, 2, :2]
    assert np.abs(tilt).max() < s.lean_limit + 1e-2
    assert np.all(np.abs(plan.controls[:, :3]) <= s.rate_limits)


def test_a_known_mass_stays_what_it_is() -> None:
    flight = FlightSettings(seed=SEED)
    window = replace(flight.estimator.window, estimated=("wind",))
    past = Past(12, replace(flight, estimator=replace(flight.estimator, window=window)))
    controller = past.controller(FREE, control_weight=10.0)
    assert controller.plan(past.belief).source == "solved"
    assert latest(controller).parameters.mass == past.belief.parameters.mass
    assert latest(controller).parameters.drag == past.belief.parameters.drag
    assert latest(controller).parameters.wind != past.belief.parameters.wind


def test_ta_s_costs_pull_on_the_map_too_and_are_bounded(past: Past) -> None:
    """1/d of the map's variables pushes cylinders off the plan, by many sigmas unless it is stopped."""
    found = []
    for joint in (FREE, JointSettings(0.5)):
        controller = past.controller(joint, avoidance="potential", potential_weight=100.0)
        plan = controller.plan(past.belief)
        assert plan.source == "solved"
        found.append(max(float(np.abs(value).max()) for value in past.pulled(latest(controller)).values()))
        before, after = past.belief.landmarks.cylinders, latest(controller).landmarks.cylinders
        away = before.positions - plan.states[1:, None, :2]
        near = int(np.argmin(np.hypot(*np.moveaxis(away, 2, 0)).min(axis=0) - before.radii))
        push = (away[:, near] / (away[:, near] ** 2).sum(axis=1, keepdims=True)).sum(axis=0)
        moved = after.positions[near] - before.positions[near]
        assert moved @ push > 0.0
    assert found[0] > 2.0
    assert 0.45 < found[1] < 0.51


@pytest.mark.product(2, of="drives and flights")
def test_no_wish_makes_drag_negative() -> None:
    """Ta's goal is far away: a vehicle that air pushes along would be there sooner, if there were one."""
    settings = FlightSettings(seed=SEED, coupling="joint")
    flight = Flight(settings)
    found, state = flight.conditions, flight.pilot.belief.state
    wishful = replace(settings.controller, avoidance="potential")
    pilot = make_pilot("joint", "ipm", found.layout, state, found.nominal, settings.estimator, wishful, FREE)
    flight.pilot, drag = pilot, []
    for plan in flown(flight, 25):
        assert plan.source == "solved"
        drag.append(pilot.belief.parameters.drag)
    assert -1e-6 < np.min(drag) < 1e-3


# ---------------------------------------------------------------- from tick to tick


def test_a_solve_that_bends_its_constraints_is_not_believed(past: Past, monkeypatch: pytest.MonkeyPatch) -> None:
    """A first step from far away says little; the vehicle brakes, and the estimate is that of the past."""
    controller = past.controller(JointSettings(0.5), control_weight=100.0)
    before = past.estimator.window.history.states.copy()
    loop = controller.loop
    monkeypatch.setattr(loop, "cold", InteriorPoint(max_iterations=1, barrier=1e-3).prepare(loop.cold.program.graph))
    plan = controller.plan(past.belief)
    assert plan.status is fg.Status.ITERATION_LIMIT
    assert plan.emergency
    assert latest(controller) is past.belief
    assert np.array_equal(past.estimator.window.history.states, before)


def test_multipliers_stay_with_what_they_belong_to(past: Past) -> None:
    controller = past.controller(JointSettings())
    controller.plan(past.belief)
    joint = controller.past
    assert isinstance(joint, SharedFlight)
    now = controller.loop.now(past.belief.state, controller.given(past.belief, Tracks.none()))
    guess = controller.loop.guess
    assert guess is not None
    given = {name: np.ones_like(value) for name, value in guess.multipliers.items()}
    others, held, slots = now.given.others, now.given.held, now.given.marks
    assert held.sum() == len(slots) >= 3
    assert np.all(others.centres[:, held] == FAR_AWAY)  # nothing is both data and variable
    gone = slots[0]
    joint.names[gone] = 99  # at the last solve the slot held something else
    kept = controller.carry(fg.Guess(guess.values, given), now).multipliers
    pairs = kept["landmarks"].reshape(controller.settings.horizon, -1)
    expected = np.zeros(pairs.shape[1])
    expected[slots[1:]] = 1.0
    assert np.array_equal(pairs, np.tile(expected, (len(pairs), 1)))
    assert not kept["pull of landmarks"][gone].any()
    assert kept["pull of landmarks"][slots[1:]].all()
    assert not kept["cylinders"][:, held].any()
    # The step that led to the present is the last one between past states now.
    assert controller.loop.solution is not None
    before = controller.loop.solution.multipliers["dynamics"]
    assert np.array_equal(guess.multipliers["dynamics"][:-1], before[1:])
    assert np.array_equal(guess.multipliers["dynamics"][-1:], before[-1:])


@pytest.mark.product(2, of="drives and flights")
def test_the_structure_is_compiled_once(compilations: list[Any]) -> None:
    """Landmarks come into view and leave the map of the window; nothing is compiled again."""
    settings = FlightSettings(seed=SEED, coupling="joint")
    window = replace(settings.estimator.window, landmarks=4, length=5)
    flight = Flight(replace(settings, estimator=replace(settings.estimator, window=window)))
    begun, known, retired = 0, [], 0
    for tick, plan in enumerate(flown(flight, 60)):
        begun = len(compilations) if tick == 0 else begun
        known.append(len(flight.pilot.belief.landmarks))
        retired = known[-1] - int(flight.pilot.estimator.atlas.used.sum())
        assert not plan.emergency
    assert known[-1] > known[0] and retired > 0
    assert len(compilations) == begun
    assert flight.world.collisions == 0


@pytest.mark.parametrize("association", ["known", "unknown"])
@pytest.mark.product(1)
def test_a_flight_believes_what_the_joint_graph_says(association: str) -> None:
    settings = FlightSettings(seed=SEED, coupling="joint")
    flight = Flight(replace(settings, estimator=replace(settings.estimator, association=association)))
    pilot, world = flight.pilot, flight.world
    errors, differences = [], []
    for _ in flown(flight, 50):
        past = pilot.estimator.belief()
        errors.append(np.linalg.norm(pilot.belief.state[:3] - world.state[:3]))
        step = quadrotor.STATE.local(past.state[None], pilot.belief.state[None])[0]
        differences.append(np.abs(step / past.sigma).max())
        assert np.array_equal(past.covariance, pilot.belief.covariance)  # of the past's terms alone
    assert world.collisions == 0 and set(pilot.controller.loop.sources) == {"solved"}
    assert world.state[0] > flight.conditions.layout.start[0] + 2.0
    assert max(errors) < 0.1
    assert 1e-3 < max(differences) < 0.51
    assert abs(pilot.belief.parameters.mass / flight.conditions.true.mass - 1.0) < 0.02


def test_the_window_goes_on_from_the_past_alone() -> None:
    past = Past(30, FlightSettings(seed=SEED))
    controller = past.controller(JointSettings(np.inf), control_weight=10.0)
    controller.plan(past.belief)
    assert np.abs(latest(controller).state - past.belief.state).max() > 1e-5
    assert np.array_equal(past.estimator.window.present, past.belief.state)
    assert past.estimator.parameters[0] != latest(controller).parameters.mass


# ---------------------------------------------------------------- what is measured


@pytest.mark.product(2, of="drives and flights")
def test_the_pull_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two short flights of the benchmark: without a bound, and with so small a weight that nothing pulls."""
    monkeypatch.setattr(quadrotor_pull, "SECONDS", 0.5)
    job = {"seed": SEED, **quadrotor_pull.PLAIN, "pull": np.inf}
    rows = {weight: {**job, **quadrotor_pull.fly(**{**job, "weight": weight})} for weight in (10.0, 1e-6)}
    assert rows[10.0]["mean"]["sigma"] > 0.5 > 1e-2 > rows[1e-6]["max"]["sigma"]
    groups: quadrotor_pull.Groups = {(str(weight),): [row] for weight, row in rows.items()}
    for text in (quadrotor_pull.pull_table(groups, ["weight"]), quadrotor_pull.error_table(groups, ["weight"])):
        assert len(text.splitlines()) == 4
        assert len({line.count("|") for line in text.splitlines()}) == 1
        assert "nan" not in text
