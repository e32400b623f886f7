"""The quadrotor's sliding window: its prior, its covariances, its landmarks, and what it learns of the vehicle."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.linalg import null_space

import unifg as fg
from unifg.horizon.past import without
from unifg.lie import SO3
from unifg.models import quadrotor
from unifg.models.matching import DOUBTFUL, NEW, Gates, nearest
from unifg.scenarios.perception.belief import Belief, Landmarks
from unifg.scenarios.perception.readings import Reading
from unifg.scenarios.quadrotor.arrival import arrival, seen_from_the_vehicle
from unifg.scenarios.quadrotor.estimator import DeadReckoning, Dynamics, Estimator, EstimatorSettings
from unifg.scenarios.quadrotor.flight_past import WindowSettings
from unifg.scenarios.simulation.air import QuadrotorWorld
from unifg.scenarios.simulation.layouts import Layout
from unifg.solution.solver import Prepared
from unifg.solvers import KKT
from unifg.typing import Array

DT = 0.05
TRUE = quadrotor.Parameters(1.0, (0.25, 0.25, 0.15), (0.3, -0.2))
Log = list[tuple[Reading, Array | None, Array]]


def alley(seed: int, movers: int = 0) -> QuadrotorWorld:
    """Cylinders on both sides of a free lane."""
    rng = np.random.default_rng(seed)
    side = rng.choice([-1.0, 1.0], 10) * rng.uniform(2.2, 3.4, 10)
    cylinders = np.column_stack([rng.uniform(2.0, 28.0, 10), side, rng.uniform(0.3, 0.6, 10)])
    walls = np.array([[[0.0, y], [30.0, y]] for y in (4.0, -4.0)])
    start, target = np.array([1.0, 0.0, 1.5]), np.array([29.0, 0.0, 1.5])
    layout = Layout(start, target, cylinders, walls, np.array([[0.0, -4.0], [30.0, 4.0]]), f"alley {seed}")
    return QuadrotorWorld(layout, seed, TRUE, movers)


def steer(state: Array, time: float) -> Array:
    """A proportional-derivative law along a winding lane, 2 m/s."""
    ramp, way = min(time / 1.5, 1.0), 2.0 * (time - 0.75) if time > 1.5 else time**2 / 1.5
    wave, heave = 0.8 * time, 0.9 * time
    place = np.array([1.0 + way, 0.8 * ramp * np.sin(wave), 1.5 + 0.3 * ramp * np.sin(heave)])
    speed = ramp * np.array([2.0, 0.64 * np.cos(wave), 0.27 * np.cos(heave)])
    force = 2.5 * (place - state[:3]) + 2.5 * (speed - state[7:]) + np.array([0.0, 0.0, 9.81])
    z = force / np.linalg.norm(force)
    y = np.cross(z, [1.0, 0.0, 0.0])
    y /= np.linalg.norm(y)
    wanted = SO3.from_matrix(np.column_stack([np.cross(y, z), y, z]))
    rates = np.clip(6.0 * SO3.local(state[3:7], wanted), -4.0, 4.0)
    return np.append(rates, np.clip(force @ SO3.matrix(state[3:7])[:, 2], 0.0, 25.0))


@cache
def flight(seed: int, ticks: int = 101, movers: int = 0) -> Log:
    """Readings, controls applied before them, and true states of a flight that does not depend on an estimate."""
    world, log = alley(seed, movers), Log()
    control = None
    for k in range(ticks):
        log.append((world.sense(), control, world.state))
        control = steer(world.state, k * DT)
        world.step(control, DT)
    assert world.collisions == 0
    return log


def begin(seed: int, model: type[Dynamics] = Dynamics, settings: EstimatorSettings | None = None) -> Estimator:
    """An estimator with a wrong start and a mass that is 5 % off."""
    settings = settings or EstimatorSettings()
    off = settings.state_sigma * np.random.default_rng([7, seed]).normal(size=9)
    start = quadrotor.STATE.retract(flight(seed)[0][2], off)
    nominal = quadrotor.Parameters(1.05 if seed % 2 else 0.95, (0.2, 0.2, 0.2))
    return Estimator(start, nominal, settings, model=model(nominal))


def beliefs(estimator: Estimator, log: Log) -> list[Belief]:
    return [estimator.update(reading, control) for reading, control, _ in log]


def stored(count: int, rng: np.random.Generator) -> Array:
    """A state that leans a little, parameters and landmarks."""
    attitude = SO3.from_rpy(*(rng.normal(size=3) * [0.3, 0.3, 1.5]))
    return np.concatenate([rng.normal(size=3), attitude, rng.normal(size=3), rng.normal(size=7 + 2 * count)])


# ---------------------------------------------------------------- the prior


def test_derivatives_of_the_arrival(rng: np.random.Generator) -> None:
    manifolds = (quadrotor.STATE, quadrotor.MASS, quadrotor.DRAG, quadrotor.WIND, quadrotor.UPDRAFT, fg.Rn(2), fg.Rn(2))
    graph, x = fg.Graph(), stored(2, rng)
    families = [graph.variables(f"v{k}", manifold, 1) for k, manifold in enumerate(manifolds)]
    graph.minimize(arrival(2), *families, np.append(stored(2, rng), rng.normal(size=20)), sigma=1.0)
    parts = np.split(x, np.cumsum([manifold.storage for manifold in manifolds])[:-1])
    assert not graph.check({f: part[None] for f, part in zip(families, parts, strict=True)}).findings


def test_a_turn_of_everything_changes_the_heading_alone(rng: np.random.Generator) -> None:
    x, turn = stored(3, rng), 0.7
    c, s = np.cos(turn), np.sin(turn)
    R = np.array([[c, -s], [s, c]])
    y = x.copy()
    y[3:7] = SO3.compose(SO3.from_rpy(0.0, 0.0, turn), x[3:7])
    for at in (0, 7, 14, 17, 19, 21):
        y[at : at + 2] = R @ x[at : at + 2] + ([0.4, -2.0] if at in (0, 17, 19, 21) else [0.0, 0.0])
    split = [10, 11, 14, 16, 17, 19, 21]
    r = arrival(3)(*(part[None] for part in np.split(y, split)), np.append(x, np.zeros(22)))[0]
    assert r[3] == pytest.approx(turn)
    np.testing.assert_allclose(np.delete(r, [0, 1, 3]), 0.0, atol=1e-12)


def test_the_prior_keeps_its_lowest_point_and_curvature(rng: np.random.Generator) -> None:
    """Expressed from the vehicle, the quadratic is the same to second order about where it is frozen."""
    here = stored(2, rng)
    A = rng.normal(size=(20, 20))
    information, step = A @ A.T, 1e-4 * rng.normal(size=20)
    reference, seen = seen_from_the_vehicle(here, step, information)
    for _ in range(5):
        d = 1e-4 * rng.normal(size=20)
        point = np.concatenate([quadrotor.STATE.retract(here[:10], d[:9]), here[10:] + d[9:]])
        r = arrival(2)(*(part[None] for part in np.split(point, [10, 11, 14, 16, 17, 19])), reference)[0]
        assert r @ seen @ r == pytest.approx((d - step) @ information @ (d - step), rel=5e-3)


def test_marginalised_columns_leave_what_they_knew(rng: np.random.Generator) -> None:
    A = rng.normal(size=(6, 6))
    information = A @ A.T
    kept = without(information, np.array([1, 4]))
    rest = [0, 2, 3, 5]
    np.testing.assert_allclose(np.linalg.inv(kept[np.ix_(rest, rest)]), np.linalg.inv(information)[np.ix_(rest, rest)])
    assert np.abs(kept[[1, 4]]).max() == 0.0


@pytest.mark.product(1, of="estimated flights")
def test_the_window_equals_the_batch() -> None:
    """After 5 s, to a small part of the uncertainty: twenty states and a prior against all hundred at once."""
    seed, log = 3, flight(3)  # a prior in the world's coordinates is off by 0.6 standard deviations here
    short = begin(seed)
    whole = begin(seed, settings=EstimatorSettings(window=WindowSettings(length=102), iterations=8))
    a, b = beliefs(short, log)[-1], beliefs(whole, log)[-1]
    assert np.abs(quadrotor.STATE.local(b.state, a.state) / b.sigma).max() < 0.05
    np.testing.assert_allclose(a.sigma, b.sigma, rtol=0.01)
    estimated = slice(0, 6)
    difference = (a.parameters.packed - b.parameters.packed)[estimated]
    assert np.abs(difference / b.parameters_sigma[estimated]).max() < 0.05
    np.testing.assert_allclose(a.parameters_sigma, b.parameters_sigma, rtol=0.01)
    np.testing.assert_array_equal(a.landmarks.ids, b.landmarks.ids)
    np.testing.assert_allclose(a.landmarks.positions, b.landmarks.positions, atol=0.02)


# ---------------------------------------------------------------- what it believes


def test_the_covariance_is_that_of_the_terms() -> None:
    """Against the inverse of the information on the null space of the constraints, dense."""
    estimator = begin(1)
    belief = beliefs(estimator, flight(1)[:40])[-1]
    solution = estimator.window.solution
    assert solution is not None
    program = estimator.window.run.program
    lin = program.linearize(solution.values)
    families = {family.name: family for family in solution.values}
    present = families["x"][-1]
    A = program.constraints.matrix(lin.constraint_jacobian).toarray()
    J = program.costs.matrix(lin.jacobian).toarray()
    Z = null_space(A)
    dense = Z @ np.linalg.solve(Z.T @ J.T @ J @ Z, Z.T)
    columns = program.columns.unknown[program.columns.of(present).ravel()]
    scale = np.outer(belief.sigma, belief.sigma)
    np.testing.assert_allclose(dense[np.ix_(columns, columns)] / scale, belief.covariance / scale, atol=2e-3)
    every = [present, *(families[name][:] for name in ("mass", "drag", "wind", "landmarks"))]
    own = program.columns.unknown[np.concatenate([program.columns.of(selection).ravel() for selection in every])]
    scale = np.sqrt(np.outer(dense.diagonal()[own], dense.diagonal()[own]))
    block = solution.covariance(*every)
    np.testing.assert_allclose(block / scale, dense[np.ix_(own, own)] / scale, atol=1e-8)


@pytest.mark.product(2, of="drives and flights")
def test_the_window_is_a_problem_for_newton_too() -> None:
    """Hard dynamics with noise on some rows, metres beside kilograms and radians: full steps, no line search."""
    estimator = begin(1)
    run = Prepared(KKT(full_steps=True), estimator.window.run.program)
    for reading, control, _ in flight(1):
        estimator.predict(reading, control)
        estimator.see(reading)
        window = estimator.window
        solution = run.solve(window.guess(), data=window.data(), check=True)
        assert solution.iterations <= 6
        estimator.estimate()


@pytest.mark.product(1, of="estimated flights")
def test_the_mass_is_known_soon() -> None:
    """Wrong by 5 % at the start; after 5 s better than 1 %, and within two standard deviations."""
    errors, covered, consistent, ticks = [], [], 0.0, 0
    for seed in range(3):
        log = flight(seed)
        found = beliefs(begin(seed), log)
        errors.append(abs(found[-1].parameters.mass - TRUE.mass))
        sigma = found[-1].parameters_sigma[:6]
        covered.append(np.abs(found[-1].parameters.packed - TRUE.packed)[:6] < 2.0 * sigma)
        for belief, (_, _, state) in zip(found[20:], log[20:], strict=True):
            error = quadrotor.STATE.local(belief.state, state)
            consistent += float(error @ np.linalg.solve(belief.covariance, error))
            ticks += 1
        assert np.linalg.norm(found[-1].state[7:] - log[-1][2][7:]) < 0.2
    assert np.median(errors) < 0.005
    assert max(errors) < 0.01
    assert np.mean(covered) >= 0.9
    assert 4.0 < consistent / ticks < 14.0  # nine degrees of freedom, one realisation of a heading each


@pytest.mark.product(1, of="estimated flights")
def test_without_dynamics_nothing_is_learnt() -> None:
    log = flight(2)
    estimator = begin(2, DeadReckoning)
    found = beliefs(estimator, log)
    assert found[-1].parameters == estimator.model.nominal
    assert np.abs(found[-1].parameters_sigma).max() == 0.0
    informed = beliefs(begin(2), log)

    def rms(those: list[Belief]) -> float:
        square = [np.square(b.state[7:] - state[7:]).sum() for b, (_, _, state) in zip(those, log, strict=True)]
        return float(np.sqrt(np.mean(square)))

    assert rms(informed) < 0.6 * rms(found) < 0.3
    felt = begin(2, DeadReckoning, EstimatorSettings(window=WindowSettings(force_sigma=0.15)))
    assert rms(beliefs(felt, log)) < 0.5 * rms(found)  # what is felt takes the place of dynamics


def test_what_is_not_estimated_stays() -> None:
    settings = EstimatorSettings(window=WindowSettings(estimated=("mass",)))
    found = beliefs(begin(1, settings=settings), flight(1)[:30])[-1]
    assert found.parameters.drag == (0.2, 0.2, 0.2)
    assert found.parameters.wind == (0.0, 0.0)
    assert found.parameters_sigma[0] > 0.0
    assert np.abs(found.parameters_sigma[1:]).max() == 0.0


def test_one_structure_serves_a_whole_flight() -> None:
    estimator = begin(1)
    program = estimator.window.run.program
    structure = program.systems.structure(program.equality)
    beliefs(estimator, flight(1)[:30])
    assert estimator.window.run.program is program
    assert program.systems.structure(program.equality) is structure


# ---------------------------------------------------------------- landmarks


@pytest.mark.product(1, of="estimated flights")
def test_gating_without_names_makes_no_mistake() -> None:
    """Every landmark found by gating is one thing of the world; nearly every sighting is used."""
    settings = EstimatorSettings(association="unknown")
    wrong = used = seen = 0
    for seed in range(2):
        estimator = begin(seed, settings=settings)
        truth: dict[int, int] = {}
        for reading, control, _ in flight(seed):
            belief = estimator.update(reading, control)
            sightings, atlas = estimator.window.history.recorded("sightings")[0][-1], estimator.atlas
            seen += len(reading.ids)
            for slot in np.flatnonzero(sightings[:, 2]).tolist():
                row = int(np.argmin(np.abs(reading.ranges - sightings[slot, 1])))
                used += 1
                wrong += truth.setdefault(int(atlas.names[slot]), int(reading.ids[row])) != int(reading.ids[row])
        assert len(set(truth.values())) == len(truth) == len(belief.landmarks)
    assert wrong == 0
    assert used > 0.99 * seen


def test_gates() -> None:
    forecast = np.array([[0.0, 5.0], [0.5, 5.0], [np.pi - 0.01, 3.0]])
    innovation = np.tile(np.diag([0.01**2, 0.05**2]), (3, 1, 1))
    seen = np.array([[0.005, 5.02], [0.05, 5.0], [1.0, 5.0], [-np.pi + 0.01, 3.0], [0.001, 5.0]])
    possible = np.ones((5, 3), dtype=bool)
    found = nearest(seen, forecast, innovation, possible, Gates())
    assert found.tolist() == [DOUBTFUL, DOUBTFUL, NEW, 2, 0]  # the last is nearer to landmark 0 than the first
    possible[4, 0] = False
    assert nearest(seen, forecast, innovation, possible, Gates()).tolist() == [0, DOUBTFUL, NEW, 2, NEW]
    assert nearest(seen, forecast[:0], innovation[:0], possible[:, :0], Gates()).tolist() == [NEW] * 5
    seen[2, 1] = np.nan  # one sensor that fails makes no new landmarks of what the others see
    assert nearest(seen, forecast, innovation, possible, Gates()).tolist() == [0, DOUBTFUL, DOUBTFUL, 2, NEW]


def test_landmarks_come_with_the_covariance_of_their_sighting() -> None:
    reading, control, state = flight(4)[0]
    estimator = begin(4)
    belief = estimator.update(reading, control)
    np.testing.assert_array_equal(belief.landmarks.ids, reading.ids)
    np.testing.assert_array_equal(belief.landmarks.radii, reading.radii)
    np.testing.assert_array_equal(belief.landmarks.kinds, reading.kinds)
    for position, covariance, distance in zip(
        belief.landmarks.positions, belief.landmarks.covariances, reading.ranges, strict=True
    ):
        along = (position - belief.state[:2]) / np.linalg.norm(position - belief.state[:2])
        across = np.array([-along[1], along[0]])
        assert along @ covariance @ along == pytest.approx(0.05**2 + 0.05**2, rel=0.02)
        heading = belief.covariance[5, 5] + 0.01**2
        assert across @ covariance @ across == pytest.approx(0.05**2 + distance**2 * heading, rel=0.05)
    assert np.linalg.norm(belief.state[:2] - state[:2]) < 0.2


@pytest.mark.product(1, of="estimated flights")
def test_landmarks_give_way_when_slots_run_out() -> None:
    """Seven slots for fourteen things: what left a slot stays on the map, near where it is."""
    settings = EstimatorSettings(window=WindowSettings(landmarks=7))
    log = flight(5, 121)
    estimator = begin(5, settings=settings)
    last = beliefs(estimator, log)[-1]
    assert estimator.atlas.used.sum() == 7
    assert 7 < len(last.landmarks) <= 14
    assert len(set(last.landmarks.ids.tolist())) == len(last.landmarks)
    things = alley(5).things()
    error = np.linalg.norm(last.landmarks.positions - things[last.landmarks.ids, :2], axis=1)
    sigma = np.sqrt(np.trace(last.landmarks.covariances, axis1=1, axis2=2))
    assert (error < 3.5 * sigma).all()
    assert np.linalg.norm(last.state[7:] - log[-1][2][7:]) < 0.2


def test_what_moves_is_left_out() -> None:
    log = flight(6)[:30]
    mover = int(log[0][0].ids[0])
    log = [(replace(reading, moving=reading.ids == mover), control, state) for reading, control, state in log]
    last = beliefs(begin(6), log)[-1]
    assert mover not in last.landmarks.ids
    assert len(last.landmarks) > 2


@pytest.mark.parametrize(
    ("settings", "wrong", "words"),
    [
        (WindowSettings, {"length": 1}, "length: '1' is not a whole number of at least 2"),
        (WindowSettings, {"landmarks": 0}, "landmarks: '0' is not a whole number of at least 1"),
        (WindowSettings, {"estimated": ("weight",)}, "'weight' is no parameter"),
        (EstimatorSettings, {"association": "guessed"}, "choose known, unknown"),
    ],
)
def test_settings_are_checked(settings: Any, wrong: dict[str, Any], words: str) -> None:
    with pytest.raises(fg.ScenarioError, match=words):
        settings(**wrong)


def test_an_empty_map() -> None:
    none = Landmarks.none()
    assert len(none) == len(none.cylinders) == 0
    assert none.covariances.shape == (0, 2, 2)
