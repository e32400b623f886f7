"""Robots of one file each: their equations against mechanics worked out otherwise, and a control problem for each."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest

import unifg as fg
from judge import judge
from problems.graphs import graph_of
from unifg.models import bicycle, cart_pole, manipulator, quadrotor, rkmk, unicycle
from unifg.models.bicycle import Bicycle
from unifg.models.cart_pole import CartPole
from unifg.models.detours import headed
from unifg.models.lidar import endpoint_loss
from unifg.models.manipulator import Arm
from unifg.models.obstacles import disc_clearance
from unifg.models.odometry import OdometryNoise
from unifg.models.potential import potential
from unifg.models.vehicle import Vehicle
from unifg.solvers import SQP, AugmentedLagrangian, InteriorPoint
from unifg.typing import Array

BACKENDS = [InteriorPoint(tolerance=1e-6), SQP(tolerance=1e-6), AugmentedLagrangian(tolerance=1e-6)]
UNEQUAL = Arm((1.3, 0.7), (0.6, 0.4), (0.22, 0.31), (0.05, 0.02))
HEAVY = CartPole(cart=0.8, pole=0.35, length=0.7, gravity=3.7)
Points = Callable[[Array], Array]  # of angles and positions, complex ones too


# ---------------------------------------------------------------- mechanics, from positions and heights alone


def slopes(points: Points, q: Array) -> Array:
    """Derivative of (k,) positions and angles by the coordinates, exact: along the imaginary axis."""
    return np.stack([points(q + 1e-30j * e).imag / 1e-30 for e in np.eye(len(q))], axis=-1)


def mass_matrix(points: Points, inertias: Array, q: Array) -> Array:
    """M of the kinetic energy q'' M q' / 2."""
    J = slopes(points, q)
    return np.asarray(J.T @ (inertias[:, None] * J))


def accelerations(points: Points, inertias: Array, height: Points, q: Array, rates: Array, forces: Array) -> Array:
    """Lagrange's equations, d/dt (M q') = d/dq (q' M q' / 2 - V) + forces, by differences."""
    h = 1e-5

    def moved(direction: Array) -> Array:
        ahead, behind, far, back = (mass_matrix(points, inertias, q + k * h * direction) for k in (1, -1, 2, -2))
        return np.asarray((8.0 * (ahead - behind) - (far - back)) / (12.0 * h))

    pull = np.array([0.5 * rates @ moved(e) @ rates for e in np.eye(len(q))]) - slopes(height, q)[0]
    return np.linalg.solve(mass_matrix(points, inertias, q), forces + pull - moved(rates) @ rates)


def cart_and_pole(robot: CartPole) -> tuple[Points, Array, Points]:
    def points(q: Array) -> Array:
        return np.stack([q[0], q[0] + robot.length * np.sin(q[1]), -robot.length * np.cos(q[1])])

    def potential(q: Array) -> Array:
        return np.stack([robot.pole * robot.gravity * points(q)[2]])

    return points, np.array([robot.cart, robot.pole, robot.pole]), potential


def links(arm: Arm) -> tuple[Points, Array, Points]:
    (m1, m2), (l1, _), (r1, r2) = arm.masses, arm.lengths, arm.centres

    def points(q: Array) -> Array:
        x1, y1, both = r1 * np.cos(q[0]), r1 * np.sin(q[0]), q[0] + q[1]
        x2, y2 = l1 * np.cos(q[0]) + r2 * np.cos(both), l1 * np.sin(q[0]) + r2 * np.sin(both)
        return np.stack([x1, y1, q[0], x2, y2, both])

    def potential(q: Array) -> Array:
        p = points(q)
        return np.stack([arm.gravity * (m1 * p[1] + m2 * p[4])])

    return points, np.array([m1, m1, arm.inertias[0], m2, m2, arm.inertias[1]]), potential


MACHINES: list[tuple[Any, Any, tuple[Points, Array, Points], int]] = [
    (cart_pole.STATE, cart_pole.field(HEAVY), cart_and_pole(HEAVY), 1),
    (cart_pole.STATE, cart_pole.field(CartPole()), cart_and_pole(CartPole()), 1),
    (manipulator.STATE, manipulator.field(UNEQUAL), links(UNEQUAL), 2),
    (manipulator.STATE, manipulator.field(Arm()), links(Arm()), 2),
]
NAMES = ["heavy cart-pole", "cart-pole", "unequal arm", "arm"]


@pytest.mark.parametrize(("group", "field", "machine", "driven"), MACHINES, ids=NAMES)
def test_accelerations_are_lagranges(group: Any, field: Any, machine: Any, driven: int) -> None:
    rng = np.random.default_rng(0)
    for x, force in zip(rng.normal(size=(20, 4)) * 2.0, rng.normal(size=(20, driven)) * 5.0, strict=True):
        points, inertias, potential = machine
        expected = accelerations(points, inertias, potential, x[:2], x[2:], np.pad(force, (0, 2 - driven)))
        found = field(x[None], force[None])[0]
        np.testing.assert_array_equal(found[:2], x[2:])
        np.testing.assert_allclose(found[2:], expected, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize(("group", "field", "machine", "driven"), MACHINES, ids=NAMES)
def test_nothing_is_lost_or_won_when_nobody_pushes(group: Any, field: Any, machine: Any, driven: int) -> None:
    points, inertias, potential = machine
    start = np.array([0.4, 2.2, -0.6, 1.5])
    states = rkmk.rollout(group, field, start, np.zeros(driven), h=0.01, count=80, substeps=10)

    def energy(x: Array) -> float:
        return float(0.5 * x[2:] @ mass_matrix(points, inertias, x[:2]) @ x[2:] + potential(x[:2])[0])

    energies = [energy(x) for x in states]
    assert np.ptp(states[:, 1]) > 0.4
    np.testing.assert_allclose(energies, energies[0], atol=1e-6)


def frequencies(field: Any, rest: Sequence[float], driven: int) -> Array:
    """Squared angular frequencies of small swings about a state of rest [1/s^2]."""
    steps = 1e-5 * np.eye(4)[:2]
    ahead, behind = (field(np.array(rest) + sign * steps, np.zeros((2, driven)))[:, 2:] for sign in (1.0, -1.0))
    return np.sort(-np.linalg.eigvals((ahead - behind).T / 2e-5).real)


@pytest.mark.parametrize("axles", [{"rear": 0.0}, {"rear": -1.0}, {"front": -1.0}, {"front": np.nan}, {"rear": np.inf}])
def test_axles_that_make_no_car_are_refused(axles: dict[str, float]) -> None:
    with pytest.raises(fg.ModelError, match=r"Bicycle: \w+ must be a finite number (above 0|from 0 on), found"):
        Bicycle(**axles)


def drive(start: Array, u: Array, **options: Any) -> Array:
    return rkmk.rollout(fg.SE2, rkmk.unicycle_field, start, u, h=0.1, **options)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: CartPole(cart=0.0), "CartPole: cart must be a finite number above 0, found 0.0"),
        (lambda: CartPole(pole=-1.0), "CartPole: pole must be a finite number from 0 on, found -1.0"),
        (lambda: CartPole(length="long"), "CartPole: length must be a finite number above 0, found 'long'"),  # type: ignore[arg-type]
        (lambda: CartPole(gravity=-np.inf), "CartPole: gravity must be a finite number, found -inf"),
        (lambda: Arm(masses=(1.0,)), r"Arm: masses must be 2 finite numbers above 0, found \(1.0,\)"),  # type: ignore[arg-type]
        (lambda: Arm(lengths=(0.5, 0.0)), r"Arm: lengths must be 2 finite numbers above 0"),
        (lambda: Arm(inertias=(0.5, -0.1)), r"Arm: inertias must be 2 finite numbers from 0 on"),
        (lambda: Vehicle(mass=0.0), "Vehicle: mass must be a finite number above 0, found 0.0"),
        (lambda: Vehicle(drag=np.nan), "Vehicle: drag must be a finite number, found nan"),
        (lambda: OdometryNoise(translation=-1.0), "OdometryNoise: translation must be a finite number from 0 on"),
        (lambda: OdometryNoise(floor=0.1), "OdometryNoise: floor must be 3 finite numbers from 0 on, found 0.1"),  # type: ignore[arg-type]
        (lambda: endpoint_loss(0.0, 0.1), "end-points: sigma must be positive, found 0.0"),
        (lambda: potential(disc_clearance, scale=0.0), "the scale must be positive, .* scale = 0.0"),
        (lambda: headed([[0.0, 0.0]], 0.0), r"headed: two positions or more are expected, .*found \(1, 2\)"),
        (lambda: unicycle.rollout(np.zeros(2), np.zeros((3, 2)), 0.1), r"starts at a pose \(3,\), got \(2,\)"),
        (
            lambda: drive(np.zeros(2), np.zeros((3, 2))),
            r"start \(3,\), inputs \(3, k\).*; found \(2,\), \(3, 2\)",
        ),
        (lambda: drive(np.zeros(3), np.zeros((3, 2)), count=5), r"inputs \(5, k\) or .*; found \(3,\), \(3, 2\)"),
        (lambda: quadrotor.Parameters(drag=1.0), "a quadrotor's parameters are numbers, of drag 3"),  # type: ignore[arg-type]
        (lambda: quadrotor.Parameters(mass="light"), "a quadrotor's parameters are numbers"),  # type: ignore[arg-type]
    ],
)
def test_what_makes_no_robot_is_refused_by_name(make: Callable[[], object], said: str) -> None:
    with pytest.raises(fg.ModelError, match=said):
        make()


def test_wheels_do_not_slip() -> None:
    car = Bicycle(front=1.1, rear=1.7)
    rng = np.random.default_rng(0)
    x, u = bicycle.STATE.random(rng, (50,)), rng.uniform(-0.6, 0.6, (50, 2))
    ahead, left, turn, faster = bicycle.field(car)(x, u).T
    np.testing.assert_allclose(left - car.rear * turn, 0.0, atol=1e-15)  # the rear wheel rolls along the car
    np.testing.assert_allclose(np.arctan((left + car.front * turn) / ahead), u[:, 1], atol=1e-14)  # the front one ahead
    np.testing.assert_allclose(np.hypot(ahead, left), np.abs(x[:, 3]))
    np.testing.assert_array_equal(faster, u[:, 0])


@pytest.mark.parametrize("method", ["rk4", "full trapezoid", "hermite-simpson"])
def test_a_car_with_its_wheels_held_drives_a_circle(method: Any) -> None:
    car, speed, steer = Bicycle(), 3.0, 0.4
    u = np.tile([0.0, steer], (40, 1))
    poses = rkmk.rollout(bicycle.STATE, bicycle.field(car), [1.0, -2.0, 0.3, speed], u, h=0.1, method=method)
    radius = (car.front + car.rear) / np.tan(steer)  # of the rear axle, about a point on its line
    heading = poses[0, 2]
    centre = poses[0, :2] - car.rear * np.array([np.cos(heading), np.sin(heading)])
    centre = centre + radius * np.array([-np.sin(heading), np.cos(heading)])
    np.testing.assert_allclose(np.hypot(*(poses[:, :2] - centre).T), np.hypot(radius, car.rear), rtol=1e-12)


# ---------------------------------------------------------------- control


def parked() -> tuple[fg.Graph, dict[Any, Array]]:
    """A car changes lanes past a disc and stops."""
    n, h = 16, 0.3
    graph, x, u = graph_of(("x", bicycle.STATE, n + 1), ("u", bicycle.CONTROL, n))
    graph.fix(x[0], bicycle.STATE.pack(pose=[0.0, 0.0, 0.0], speed=[3.0]))
    graph.fix(x[-1], bicycle.STATE.pack(pose=[12.0, 1.5, 0.0], speed=[0.0]))
    graph.minimize(fg.prior, u, np.zeros(2), sigma=[1.0, 0.2])
    graph.constrain(bicycle.dynamics(Bicycle()), x[:-1], u, x[1:], h, lower=0.0, upper=0.0, name="motion")
    graph.constrain(clear_of_a_post, x[1:], lower=0.0, name="post")
    graph.bound(u, lower=[-3.0, -0.5], upper=[3.0, 0.5])
    start = np.linspace([0.0, 0.0, 0.0, 3.0], [12.0, 1.5, 0.0, 0.0], n + 1)
    return graph, {x: start, u: np.zeros((n, 2))}


def clear_of_a_post(x: Array) -> Array:
    """Distance of the car's centre to a post, less both radii [m]."""
    return np.asarray(np.sqrt((x[:, :1] - 5.0) ** 2 + (x[:, 1:2] - 0.1) ** 2)) - 1.2


def swung_up() -> tuple[fg.Graph, dict[Any, Array]]:
    """Kelly's swing-up: one metre in two seconds, with at most 20 N."""
    n, h = 24, 2.0 / 24
    graph, x, f = graph_of(("x", cart_pole.STATE, n + 1), ("f", cart_pole.FORCE, n))
    graph.fix(x[0], np.zeros(4))
    graph.fix(x[-1], [1.0, np.pi - 1e-12, 0.0, 0.0])
    graph.minimize(fg.prior, f, np.zeros(1), sigma=1.0)
    graph.constrain(cart_pole.dynamics(CartPole()), x[:-1], f, x[1:], h, lower=0.0, upper=0.0, name="motion")
    graph.bound(f, lower=-20.0, upper=20.0)
    return graph, {x: np.linspace([0.0, 0.0, 0.0, 0.0], [1.0, 3.1, 0.0, 0.0], n + 1), f: np.zeros((n, 1))}


def lifted() -> tuple[fg.Graph, dict[Any, Array]]:
    """An arm that hangs is lifted to hold its forearm level, by an elbow that is at its limit on the way."""
    n, h = 16, 0.04
    graph, x, tau = graph_of(("x", manipulator.STATE, n + 1), ("tau", manipulator.TORQUES, n))
    graph.fix(x[0], [-np.pi / 2, 0.0, 0.0, 0.0])
    graph.fix(x[-1], [-np.pi / 4, np.pi / 4, 0.0, 0.0])
    graph.minimize(fg.prior, tau, np.zeros(2), sigma=5.0)
    graph.constrain(manipulator.dynamics(Arm()), x[:-1], tau, x[1:], h, lower=0.0, upper=0.0, name="motion")
    graph.bound(tau, lower=[-12.0, -1.6], upper=[12.0, 1.6])
    start = np.linspace([-np.pi / 2, 0.0, 0.0, 0.0], [-np.pi / 4, np.pi / 4, 0.0, 0.0], n + 1)
    return graph, {x: start, tau: np.tile([4.0, 1.0], (n, 1))}


@pytest.mark.parametrize("problem", [parked, swung_up, lifted])
def test_backends_agree_on_a_plan(problem: Callable[[], tuple[fg.Graph, dict[Any, Array]]]) -> None:
    costs = []
    for backend in BACKENDS:
        graph, guess = problem()
        solution = backend.solve(graph, guess, check=True)
        costs.append(solution.cost)
        if backend is BACKENDS[0]:
            assert judge(graph, solution).worst() < 1e-5
    np.testing.assert_allclose(costs, costs[0], rtol=1e-5)
