"""Every shipped residual's Jacobian against numerical differentiation, found by looking through the packages."""

from __future__ import annotations

import importlib
import pkgutil
from itertools import combinations, product
from typing import Any

import numpy as np
import pytest

import unifg as fg
import unifg.models
from unifg.factors.autodiff.stated import StatedKernel
from unifg.factors.differences import jacobian
from unifg.factors.residuals import Residual
from unifg.models import (
    avoidance,
    barriers,
    bicycle,
    cart_pole,
    clearances,
    inertial,
    landmarks,
    lidar,
    manipulator,
    obstacles,
    preintegration,
    quadrotor,
    rkmk,
    space_landmarks,
    terminal,
    unicycle,
    universal,
    vehicle,
)
from unifg.models.distance_map import DistanceMap, SmoothField
from unifg.models.footprint import Body
from unifg.models.potential import potential
from unifg.pose_graphs import bearing, bearing_range, distance, sighting
from unifg.pose_graphs.residuals import chart_between
from unifg.typing import Array

RNG = np.random.default_rng(7)
COUNT = 9


def poses(count: int = COUNT) -> Array:
    """Poses all over the plane, headings up to the cut at pi."""
    x = fg.SE2.random(RNG, (count,))
    x[0, 2] = -np.pi
    return x


def vectors(size: int) -> Array:
    return RNG.normal(size=(COUNT, size))


# name -> (residual, variable arguments, their manifolds, constants)
CASES: dict[str, tuple[Residual, list[Array], list[fg.Manifold], list[object]]] = {
    "unicycle.dynamics": (
        unicycle.dynamics, [poses(), vectors(2), poses()], [fg.SE2, fg.Rn(2), fg.SE2], [0.13],
    ),
    "unicycle.ramped": (
        unicycle.ramped, [poses(), vectors(2), vectors(2), poses()], [fg.SE2, fg.Rn(2), fg.Rn(2), fg.SE2], [0.13],
    ),
    "unicycle.tracking": (unicycle.tracking, [poses()], [fg.SE2], [poses()]),
    "unicycle.rate": (unicycle.rate, [vectors(2), vectors(2)], [fg.Rn(2), fg.Rn(2)], []),
    "obstacles.disc_clearance": (
        obstacles.disc_clearance, [poses()], [fg.SE2], [RNG.normal(size=(4, 2)), np.full(4, 0.3)],
    ),
}  # fmt: skip
GRID = DistanceMap(np.add.outer(np.sin(np.arange(30.0)), np.cos(0.7 * np.arange(40.0))), 0.25, (-5.0, -4.0, 0.3))
INSIDE = np.concatenate([RNG.uniform(-1.5, 1.5, (COUNT, 2)), poses()[:, 2:]], axis=1)
WALLS = obstacles.wall_distance(SmoothField(GRID))
CASES["lidar.endpoint"] = (lidar.endpoint(GRID), [INSIDE], [fg.SE2], [RNG.uniform(-1.0, 1.0, (COUNT, 2))])
CASES["obstacles.wall_distance"] = (WALLS, [INSIDE], [fg.SE2], [])
BOX = Body.polygon([[0.3, 0.2], [-0.3, 0.2], [-0.3, -0.2], [0.3, -0.2]])
CASES["obstacles.clearance_of"] = (
    obstacles.clearance_of(BOX), [poses()], [fg.SE2], [RNG.normal(size=(4, 2)), np.full(4, 0.3)],
)  # fmt: skip
CASES["obstacles.shortfall"] = (obstacles.shortfall(WALLS, 0.3), [INSIDE], [fg.SE2], [])
group: fg.LieGroup
for group in (fg.Rn(3), fg.SO2, fg.SE2, fg.Product(pose=fg.SE2, v=fg.Rn(2))):
    x, y, z = (group.random(RNG, (COUNT,)) for _ in range(3))
    CASES[f"prior on {group.name}"] = (fg.prior.on(group), [x], [group], [y])
    CASES[f"between on {group.name}"] = (fg.between.on(group), [x, y], [group, group], [z])
    CASES[f"difference on {group.name}"] = (fg.difference.on(group), [x, y], [group, group], [])
for group, size in ((fg.SE2, 2), (fg.SE3, 3)):
    x, y, z, points = *(group.random(RNG, (COUNT,)) for _ in range(3)), RNG.normal(size=(COUNT, size))
    CASES[f"chart_between on {group.name}"] = (chart_between.on(group), [x, y], [group, group], [z])
    CASES[f"sighting on {group.name}"] = (sighting.on(group), [x, points], [group, fg.Rn(size)], [points[::-1]])
for case, size in ((bearing, 1), (distance, 1), (bearing_range, 2)):
    CASES[case.name] = (case, [poses(), vectors(2)], [fg.SE2, fg.Rn(2)], [RNG.normal(size=(COUNT, size))])


def current(x: Array, u: Array) -> Array:
    """A field on SE(2) that depends on the pose."""
    return np.stack([u[:, 0] * (1.2 + np.sin(x[:, 1])), 0.4 * np.cos(x[:, 2]), u[:, 1] + 0.2 * x[:, 0]], axis=1)


def accelerated(x: Array, u: Array) -> Array:
    """A field on a pose with its velocities (v, omega), driven by their rates."""
    return np.concatenate([rkmk.unicycle_field(x, x[:, 3:]), u - 0.3 * x[:, 3:] ** 2], axis=1)


NEARBY = fg.SE2.retract(poses(), RNG.normal(size=(COUNT, 3)))
STEP = [poses(), vectors(2), NEARBY]
MOVING = fg.Product(pose=fg.SE2, v=fg.Rn(2))
MOTION = [MOVING.random(RNG, (COUNT,)), vectors(2), MOVING.random(RNG, (COUNT,))]
CASES["rkmk.trapezoid"] = (rkmk.integrator(fg.SE2, current), STEP, [fg.SE2, fg.Rn(2), fg.SE2], [0.3])
CASES["rkmk.trapezoid, simplified"] = (
    rkmk.integrator(fg.SE2, current, "simplified trapezoid"), STEP, [fg.SE2, fg.Rn(2), fg.SE2], [0.3],
)  # fmt: skip
CASES["rkmk.trapezoid, pose and velocity"] = (
    rkmk.integrator(MOVING, accelerated), MOTION, [MOVING, fg.Rn(2), MOVING], [0.3],
)  # fmt: skip


CASES["rkmk.integrator"] = (rkmk.integrator(fg.SE2, current, "rk4"), STEP, [fg.SE2, fg.Rn(2), fg.SE2], [0.3])
DISCS: list[object] = [RNG.normal(size=(4, 2)), np.full(4, 0.3)]
CASES["potential.potential"] = (potential(obstacles.disc_clearance), [poses()], [fg.SE2], DISCS)
CASES["potential.potential, walls"] = (potential(WALLS), [INSIDE], [fg.SE2], [])
CASES["potential.potential, vortex"] = (potential(obstacles.disc_clearance, vortex=0.7), [poses()], [fg.SE2], DISCS)

# Drag of three kinds at once, on slopes; forces large enough to matter beside the speeds.
CAR = vehicle.Vehicle(drag_constant=3.0, drag_linear=20.0)
CASES["vehicle.dynamics"] = (
    vehicle.dynamics(CAR),
    [RNG.uniform(0.0, 30.0, (COUNT, 1)), RNG.normal(0.0, 2000.0, (COUNT, 1)), RNG.uniform(0.0, 30.0, (COUNT, 1))],
    [vehicle.SPEED, vehicle.FORCE, vehicle.SPEED], [0.7, RNG.uniform(-0.1, 0.1, COUNT)],
)  # fmt: skip

# A quadrotor far off its dynamics, any attitude, with drag, wind and a parameter set for every step.
FLIGHT = [quadrotor.STATE.random(RNG, (COUNT,)), vectors(4) + np.array([0.0, 0.0, 0.0, 12.0])]
LANDED = quadrotor.STATE.retract(quadrotor.step(FLIGHT[0], FLIGHT[1], 0.3, quadrotor.Parameters()), vectors(9))
VEHICLE = quadrotor.Parameters(1.3, (0.3, 0.2, 0.5), (0.4, -0.3), 0.2).packed
UNKNOWN = [vectors(6), RNG.uniform(0.5, 2.0, (COUNT, 1)), RNG.uniform(0.0, 1.0, (COUNT, 3)), vectors(2), vectors(1)]
MANIFOLDS: list[fg.Manifold] = [
    quadrotor.STATE, quadrotor.CONTROL, quadrotor.NOISE, quadrotor.MASS, quadrotor.DRAG, quadrotor.WIND,
    quadrotor.UPDRAFT, quadrotor.STATE,
]  # fmt: skip
CASES["quadrotor.dynamics"] = (
    quadrotor.dynamics, [*FLIGHT, LANDED], [quadrotor.STATE, quadrotor.CONTROL, quadrotor.STATE], [VEHICLE, 0.3],
)  # fmt: skip
CASES["quadrotor.disturbed_dynamics"] = (
    quadrotor.disturbed_dynamics, [*FLIGHT, *UNKNOWN, LANDED], MANIFOLDS, [0.3],
)  # fmt: skip
CASES["rkmk.trapezoid, quadrotor"] = (
    rkmk.integrator(quadrotor.STATE, quadrotor.field), [*FLIGHT, *UNKNOWN, LANDED], MANIFOLDS, [0.3],
)  # fmt: skip
CASES["bicycle.dynamics"] = (
    bicycle.dynamics(bicycle.Bicycle()),
    [bicycle.STATE.random(RNG, (COUNT,)), 0.3 * vectors(2), bicycle.STATE.random(RNG, (COUNT,))],
    [bicycle.STATE, bicycle.CONTROL, bicycle.STATE], [0.3],
)  # fmt: skip
CASES["cart_pole.dynamics"] = (
    cart_pole.dynamics(cart_pole.CartPole()),
    [cart_pole.STATE.random(RNG, (COUNT,)), vectors(1), cart_pole.STATE.random(RNG, (COUNT,))],
    [cart_pole.STATE, cart_pole.FORCE, cart_pole.STATE], [0.1],
)  # fmt: skip
CASES["manipulator.dynamics"] = (
    manipulator.dynamics(manipulator.Arm()),
    [manipulator.STATE.random(RNG, (COUNT,)), vectors(2), manipulator.STATE.random(RNG, (COUNT,))],
    [manipulator.STATE, manipulator.TORQUES, manipulator.STATE], [0.1],
)  # fmt: skip
MARKS = 3.0 * vectors(2)
CASES["landmarks.bearing_range"] = (
    landmarks.bearing_range, [FLIGHT[0], MARKS], [quadrotor.STATE, fg.Rn(2)], [vectors(2)],
)  # fmt: skip
CASES["landmarks.height"] = (landmarks.height, [vectors(3)], [fg.Rn(3)], [RNG.normal(size=COUNT)])
CASES["landmarks.tilt"] = (landmarks.tilt, [FLIGHT[0][:, 3:7]], [fg.SO3], [vectors(3)])
INCREMENTS: list[object] = [
    fg.SE23.random(RNG, (COUNT,)), 0.1 * RNG.normal(size=(COUNT, 9, 6)), vectors(6), np.linspace(0.1, 0.5, COUNT),
]  # fmt: skip
for inertial_case, states in (("inertial.motion", fg.SE23), ("inertial.motion, in parts", quadrotor.STATE)):
    CASES[inertial_case] = (
        inertial.motion(states), [states.random(RNG, (COUNT,)), states.random(RNG, (COUNT,)), vectors(6)],
        [states, states, preintegration.BIAS], INCREMENTS,
    )  # fmt: skip
CASES["inertial.specific_force"] = (
    inertial.specific_force(quadrotor.STATE), [quadrotor.STATE.random(RNG, (COUNT,)) for _ in range(2)],
    [quadrotor.STATE, quadrotor.STATE], [vectors(3), np.linspace(5.0, 50.0, COUNT)],
)  # fmt: skip
MOUNT = fg.SE3.from_parts([0.3, -0.2, 0.1], fg.SO3.from_rpy(0.4, -1.2, 2.0))
SEEN = np.concatenate([vectors(3), RNG.uniform(1.0, 5.0, (COUNT, 1))], axis=1)
CASES["space_landmarks.bearing_range_3d"] = (
    space_landmarks.bearing_range_3d(fg.SE3, MOUNT), [fg.SE3.random(RNG, (COUNT,)), 3.0 * vectors(3)],
    [fg.SE3, fg.Rn(3)], [SEEN],
)  # fmt: skip
CASES["space_landmarks.bearing_3d"] = (
    space_landmarks.bearing_3d(quadrotor.STATE), [quadrotor.STATE.random(RNG, (COUNT,)), 3.0 * vectors(3)],
    [quadrotor.STATE, fg.Rn(3)], [SEEN[:, :3]],
)  # fmt: skip
PLACES, WALL = vectors(3), RNG.normal(size=(5, 2, 2))
CASES["avoidance.cylinder_clearance"] = (avoidance.cylinder_clearance, [PLACES], [fg.Rn(3)], DISCS)
CASES["avoidance.landmark_clearance"] = (
    avoidance.landmark_clearance, [PLACES, MARKS], [fg.Rn(3), fg.Rn(2)], [np.linspace(0.1, 0.9, COUNT)],
)  # fmt: skip
CASES["avoidance.segment_clearance"] = (avoidance.segment_clearance, [PLACES], [fg.Rn(3)], [WALL, np.full(5, 0.2)])
CASES["avoidance.sphere_clearance"] = (
    avoidance.sphere_clearance, [PLACES], [fg.Rn(3)], [RNG.normal(size=(4, 3)), np.full(4, 0.3)],
)  # fmt: skip
CASES["avoidance.inverse_distance_root"] = (
    avoidance.inverse_distance_root(avoidance.cylinder_clearance, 0.8), [PLACES], [fg.Rn(3)], DISCS,
)  # fmt: skip
CASES["avoidance.inverse_distance_root, landmark"] = (
    avoidance.inverse_distance_root(avoidance.landmark_clearance, 0.2), [PLACES, MARKS], [fg.Rn(3), fg.Rn(2)], [0.3],
)  # fmt: skip

# Barriers of four spheres that move, and of one that is estimated, on positions and on whole states.
SPHERES: list[object] = [RNG.normal(size=(4, 3)), RNG.normal(size=(4, 3)), np.full(4, 0.3)]
SHAPES: list[Any] = [(), (), (4, 3), (4, 3), (4,)]
BALLS = barriers.moving(avoidance.sphere_clearance)
EXTENDED = barriers.velocity_extended(barriers.inverse(BALLS, 0.3), BALLS, 0.7)

THROWN = barriers.decay(barriers.thrown(clearances.to_point), 1.3)


def stated(function: Any, arguments: list[Any], rows: int) -> Residual:
    return fg.residual(StatedKernel(function, tuple(arguments), rows))


CASES["universal.dynamics"] = (
    universal.dynamics, [FLIGHT[0], vectors(6), LANDED], [quadrotor.STATE, fg.Rn(6), quadrotor.STATE], [0.3],
)  # fmt: skip
CASES["universal.increments"] = (
    universal.increments, [FLIGHT[0], vectors(6), LANDED], [quadrotor.STATE, fg.Rn(6), quadrotor.STATE], [0.3],
)  # fmt: skip
CASES["universal.consistency"] = (
    universal.consistency, [FLIGHT[0], LANDED], [quadrotor.STATE, quadrotor.STATE], [0.3],
)  # fmt: skip
CASES["terminal.resting"] = (terminal.resting, [FLIGHT[0]], [quadrotor.STATE], [])
CASES["barriers.decay"] = (
    stated(barriers.decay(BALLS, 1.3), [fg.Rn(3), fg.Rn(3), *SHAPES], 4),
    [PLACES, vectors(3)], [fg.Rn(3), fg.Rn(3)], [0.4, 0.1, *SPHERES],
)  # fmt: skip
CASES["barriers.condition"] = (
    stated(barriers.condition(BALLS, 1.3, fg.Rn(3), lambda p, v: v), [fg.Rn(3), fg.Rn(3), *SHAPES[1:]], 4),
    [PLACES, vectors(3)], [fg.Rn(3), fg.Rn(3)], [0.4, *SPHERES],
)  # fmt: skip
CASES["barriers.condition, velocity"] = (
    stated(
        barriers.condition(EXTENDED, 1.3, quadrotor.STATE, universal.field),
        [quadrotor.STATE, fg.Rn(6), *SHAPES[1:]], 4,
    ),
    [FLIGHT[0], vectors(6)], [quadrotor.STATE, fg.Rn(6)], [0.4, *SPHERES],
)  # fmt: skip
CASES["barriers.condition, published"] = (
    stated(
        barriers.condition(
            EXTENDED, 1.3, quadrotor.STATE, universal.field, as_published=True,
            lost=lambda x, t, *o: barriers.inverse(BALLS, 0.3)(x[:, :3], t, *o),
        ),
        [quadrotor.STATE, fg.Rn(6), *SHAPES[1:]], 4,
    ),
    [FLIGHT[0], vectors(6)], [quadrotor.STATE, fg.Rn(6)], [0.4, *SPHERES],
)  # fmt: skip
CASES["barriers.decay, thrown and estimated"] = (
    stated(
        lambda p, after, centre, velocity, *rest: THROWN(p, after, *rest[:2], centre, velocity, rest[2]),
        [fg.Rn(3)] * 4 + [()] * 3, 1,
    ),
    [PLACES, vectors(3), vectors(3), vectors(3)], [fg.Rn(3)] * 4, [0.4, 0.1, 0.3],
)  # fmt: skip
CASES["barriers.uncertain"] = (
    stated(
        barriers.uncertain(barriers.still(avoidance.cylinder_clearance), 2.0), [fg.Rn(3), (), (3, 2), (4, 2), (4,)], 4
    ),
    [PLACES], [fg.Rn(3)], [0.0, RNG.normal(size=(3, 2)), *DISCS],
)  # fmt: skip

# Their search Jacobians are the derivative of nothing; everything else about them is tested like the rest.
EXEMPT_SEARCH = {"potential.potential, vortex"}


def shipped() -> set[str]:
    """Every module-level residual of unifg.models that attaches a Jacobian."""
    names = set()
    for module in pkgutil.iter_modules(unifg.models.__path__):
        loaded = importlib.import_module(f"unifg.models.{module.name}")
        for name, value in vars(loaded).items():
            if isinstance(value, Residual) and value.jacobian is not None and not name.startswith("_"):
                names.add(f"{module.name}.{name}")
            if callable(value) and getattr(value, "__annotations__", {}).get("return") == "Residual":
                names.add(f"{module.name}.{name}")  # a function that makes residuals
    general = (".residual", ".complete", ".of_distance")  # of any function, or of any function of a distance
    return {name for name in names if not name.endswith(general)}


def test_every_shipped_residual_has_a_case() -> None:
    assert shipped() <= set(CASES), shipped() - set(CASES)


@pytest.mark.parametrize("name", CASES)
def test_jacobian(name: str) -> None:
    case, points, manifolds, constants = CASES[name]
    numerical = jacobian(lambda *p: case.function(*p, *constants), points, manifolds)
    for block, reference in zip(slopes_of(name), numerical, strict=True):
        np.testing.assert_allclose(block, reference, atol=2e-8, rtol=1e-7)


def test_only_named_search_jacobians_are_exempt() -> None:
    assert {name for name, (case, *_) in CASES.items() if case.search is not None} == EXEMPT_SEARCH
    for name in EXEMPT_SEARCH:
        case, points, manifolds, constants = CASES[name]
        assert case.search is not None
        blocks = case.search(*points, *constants)
        numerical = jacobian(lambda *p, c=case, k=constants: c.function(*p, *k), points, manifolds)
        assert max(np.abs(b - n).max() for b, n in zip(blocks, numerical, strict=True)) > 1e-2, f"{name}: not needed"


# ---------------------------------------------------------------- the same in the compiled loop of a graph

KERNELS = [name for name, (case, *_) in CASES.items() if case.kernel is not None]
ACTIVE = np.arange(COUNT) % 4 != 1


def in_graph(
    case: Residual, arguments: list[Any], families: dict[int, fg.Manifold], active: Any = ACTIVE
) -> tuple[Array, Array]:
    """(n, m) residuals and (n, m, D) derivatives of a term whose arguments at the given places are variables."""
    graph = fg.Graph()
    guess: dict[fg.Family, Array] = {}
    for place, manifold in families.items():
        family = graph.variables(f"x{place}", manifold, COUNT)
        guess[family], arguments[place] = arguments[place], family
    graph.minimize(case, *arguments, active=active)
    lin = graph.compile().linearize(guess)
    residual = lin.residual.reshape(COUNT, -1)
    return residual, lin.jacobian.reshape(*residual.shape, -1)


def slopes_of(name: str) -> list[Array]:
    """(n, m, d_k) derivatives of a case along every variable: its own, or those a graph traces."""
    case, points, manifolds, constants = CASES[name]
    if case.jacobian is not None:
        return list(case.jacobian(*points, *constants))
    _, together = in_graph(case, [*points, *constants], dict(enumerate(manifolds)), None)
    return np.split(together, np.cumsum([manifold.dim for manifold in manifolds])[:-1], axis=2)


def parameter(constant: object, axes: int, each: bool) -> Array:
    """One row for each factor, all different, or the first of them."""
    array = np.asarray(constant, dtype=np.float64)
    if array.ndim == axes:
        array = array + 0.01 * np.arange(COUNT).reshape(-1, *[1] * axes)
    return array if each else array[0]


def test_models_are_kernels_unless_their_functions_are_batched() -> None:
    models = {
        name
        for name in CASES
        if name.partition(".")[0] in {module.name for module in pkgutil.iter_modules(unifg.models.__path__)}
    }
    batched = {"rkmk.trapezoid", "rkmk.trapezoid, simplified", "rkmk.trapezoid, pose and velocity"}
    batched |= {"rkmk.integrator", "rkmk.trapezoid, quadrotor"}
    batched |= {f"{robot}.dynamics" for robot in ("bicycle", "cart_pole", "manipulator")}
    assert models - set(KERNELS) == batched


@pytest.mark.parametrize("name", KERNELS)
@pytest.mark.product(20)
def test_in_a_graph(name: str) -> None:
    """Some of the variables are constants, shared or one for each factor; so are parameters; factors are inactive."""
    case, points, manifolds, constants = CASES[name]
    assert case.kernel is not None and case.jacobian is not None
    kinds = [kind for kind in case.kernel.arguments if not isinstance(kind, fg.Manifold)]
    axes = [kind if isinstance(kind, int) else len(kind) for kind in kinds]
    places = range(len(points))
    sizes = range(1, len(points) + 1) if len(points) < 5 else (1, 2, len(points))
    subsets = [subset for size in sizes for subset in combinations(places, size)]
    for chosen, shared, each in product(subsets, (False, True), (False, True)):
        arguments: list[Any] = [p[:1] if shared and k not in chosen else p for k, p in enumerate(points)]
        arguments += [parameter(constant, n, each) for constant, n in zip(constants, axes, strict=True)]
        residual, derivative = in_graph(case, list(arguments), {k: manifolds[k] for k in chosen})
        expected, blocks = case.function(*arguments), case.jacobian(*arguments)
        wanted = np.concatenate([blocks[k] for k in chosen], axis=2)
        np.testing.assert_allclose(residual, expected * ACTIVE[:, None], rtol=1e-13, atol=1e-14)
        np.testing.assert_allclose(derivative, wanted * ACTIVE[:, None, None], rtol=1e-12, atol=1e-13)
