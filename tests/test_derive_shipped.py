"""Every shipped residual, written as its definition says and traced: the derivatives of what ships, and differences."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import unifg as fg
from test_derive import bends, compared, evaluated, packed
from test_jacobians import BOX, CAR, CASES, COUNT, GRID, MOUNT, slopes_of
from unifg.factors.autodiff.lookup import Lookup
from unifg.factors.autodiff.rows import traced
from unifg.factors.kernel import Argument
from unifg.lie import SE2, SE3, SO2, SO3, Rn, wrap_angle
from unifg.models import bicycle, cart_pole, manipulator, quadrotor
from unifg.models.distance_map import HEADER, RING
from unifg.models.tableau import METHODS, Tableau
from unifg.typing import Array

Function = Callable[..., Any]

# ---------------------------------------------------------------- definitions


def prior(group: Any) -> Function:
    return lambda x, z: group.log(group.compose(group.inverse(z), x))


def between(group: Any) -> Function:
    return lambda x, y, z: group.log(group.compose(group.inverse(z), group.compose(group.inverse(x), y)))


def difference(group: Any) -> Function:
    return lambda x, y: group.log(group.compose(group.inverse(x), y))


def unicycle_ramped(x: Array, before: Array, u: Array, y: Array, dt: Array) -> Any:
    return unicycle_dynamics(x, 0.5 * (before + u), y, dt)


def unicycle_dynamics(x: Array, u: Array, y: Array, dt: Array) -> Any:
    middle = x[:, 2] + 0.5 * dt * u[:, 1]
    return np.stack(
        [
            y[:, 0] - x[:, 0] - dt * u[:, 0] * np.cos(middle),
            y[:, 1] - x[:, 1] - dt * u[:, 0] * np.sin(middle),
            wrap_angle(y[:, 2] - x[:, 2] - dt * u[:, 1]),
        ],
        axis=1,
    )


def tracking(x: Array, z: Array) -> Any:
    return np.concatenate([x[:, :2] - z[:, :2], wrap_angle(x[:, 2:] - z[:, 2:])], axis=1)


def discs(x: Array, centre: Array, radius: Array) -> Any:
    return np.linalg.norm(x[:, None, :2] - centre, axis=2) - radius


def box(x: Array, centre: Array, radius: Array) -> Any:
    """Clearance of every disc that covers the body of the cases, largest radius everywhere."""
    rows = []
    for (along, beside, _), less in zip(BOX.discs, BOX.smaller, strict=True):
        cosine, sine = np.cos(x[:, 2]), np.sin(x[:, 2])
        place = x[:, :2] + np.stack([cosine * along - sine * beside, sine * along + cosine * beside], axis=1)
        rows.append(discs(np.concatenate([place, x[:, 2:]], axis=1), centre, radius) + less)
    return np.concatenate(rows, axis=1)


def spheres(x: Array, centre: Array, radius: Array) -> Any:
    return np.linalg.norm(x[:, None, :] - centre, axis=2) - radius


def landmark_clearance(p: Array, mark: Array, radius: Array) -> Any:
    return (np.linalg.norm(p[:, :2] - mark, axis=1) - radius)[:, None]


def segments(x: Array, ends: Array, margin: Array) -> Any:
    along, to = ends[:, :, 1] - ends[:, :, 0], x[:, None, :2] - ends[:, :, 0]
    part = np.clip(np.sum(along * to, axis=2) / np.sum(along * along, axis=2), 0.0, 1.0)
    return np.linalg.norm(to - part[:, :, None] * along, axis=2) - margin


def root_of_inverse(distance: Function, nearest: float) -> Function:
    def root(*arguments: Array) -> Any:
        d = distance(*arguments)
        depth = d / nearest - 1.0
        phi = np.where(d >= nearest, 1.0 / d, (1.0 - depth + depth * depth) / nearest)
        return np.sqrt(2.0 * phi)

    return root


def repulsion(distance: Function) -> Function:
    scale, near, far = 0.075, 0.05, 0.8
    return lambda *arguments: scale * (1.0 / np.clip(distance(*arguments), near, far) - 1.0 / far)


def shortfall(distance: Function) -> Function:
    return lambda x: np.maximum(0.0, 0.3 - distance(x))


class Splines(Lookup):
    """Quadratic B-splines over the cells of a map, or their bilinear interpolant."""

    def place(self, p: Array) -> tuple[Any, Any]:
        t = self.table
        return t[0] * p[:, 0] + t[1] * p[:, 1] + t[2], t[3] * p[:, 0] + t[4] * p[:, 1] + t[5]

    def entry(self, row: Any, column: Any) -> Any:
        stride = self.table[6] + 2 * RING
        return self.take(HEADER + (row + RING - 1) * stride + column + RING - 1)

    def quadratic(self, p: Array) -> Any:
        u, v = self.place(p)
        column, row = np.floor(u), np.floor(v)

        def weights(t: Any) -> list[Any]:
            return [0.5 * (1.0 - t) ** 2, 0.75 - (t - 0.5) ** 2, 0.5 * t * t]

        across, along = weights(u - column), weights(v - row)
        total: Any = 0.0
        for i in range(3):
            total = total + along[i] * sum(across[k] * self.entry(row + i, column + k) for k in range(3))
        return total

    def bilinear(self, p: Array) -> Any:
        u, v = self.place(p)
        column, row = np.floor(u + 0.5), np.floor(v + 0.5)
        s, t = u + 0.5 - column, v + 0.5 - row
        low = self.entry(row, column) * (1.0 - s) + self.entry(row, column + 1) * s
        high = self.entry(row + 1, column) * (1.0 - s) + self.entry(row + 1, column + 1) * s
        return low * (1.0 - t) + high * t


TABLE = Splines(GRID.table)


def wall_distance(x: Array) -> Any:
    return TABLE.quadratic(x[:, :2])[:, None]


def endpoint(x: Array, beam: Array) -> Any:
    return TABLE.bilinear(SE2.act(x, beam))[:, None]


def vehicle(v: Array, force: Array, after: Array, dt: Array, slope: Array) -> Any:
    road = CAR.mass * CAR.gravity * (np.sin(slope) + CAR.rolling * np.cos(slope))
    drag = CAR.drag_constant + CAR.drag_linear * v[:, 0] + CAR.drag * v[:, 0] ** 2
    return (after[:, 0] - v[:, 0] - dt / CAR.equivalent_mass * (force[:, 0] - road - drag))[:, None]


def quadrotor_field(x: Array, u: Array, w: Array, mass: Array, drag: Array, wind: Array, updraft: Array) -> Any:
    R, v = SO3.matrix(x[:, 3:7]), x[:, 7:]
    force = u[:, 3:] * np.array([0.0, 0.0, 1.0]) - drag * np.einsum("nij,ni->nj", R, v)
    lift = np.concatenate([wind, updraft - 9.81], axis=1)
    a = np.einsum("nij,nj->ni", R, force) / mass + lift + w[:, 3:]
    return np.concatenate([v, u[:, :3] + w[:, :3], a], axis=1)


def disturbed(x: Array, u: Array, w: Array, m: Array, d: Array, wind: Array, up: Array, y: Array, h: Array) -> Any:
    first, second = quadrotor_field(x, u, w, m, d, wind, up), quadrotor_field(y, u, w, m, d, wind, up)
    turn = SO3.log(SO3.compose(SO3.inverse(x[:, 3:7]), y[:, 3:7]))
    moved = np.concatenate([y[:, :3] - x[:, :3], turn, y[:, 7:] - x[:, 7:]], axis=1)
    return moved - 0.5 * h[:, None] * (first + second)


def undisturbed(x: Array, u: Array, y: Array, rho: Array, h: Array) -> Any:
    calm = 0.0 * np.concatenate([u, u[:, :2]], axis=1)
    return disturbed(x, u, calm, rho[:, :1], rho[:, 1:4], rho[:, 4:6], rho[:, 6:], y, h)


def bearing_range(x: Array, mark: Array, z: Array) -> Any:
    R, d = SO3.matrix(x[:, 3:7]), mark - x[:, :2]
    bearing = np.arctan2(d[:, 1], d[:, 0]) - np.arctan2(R[:, 1, 0], R[:, 0, 0])
    return np.stack([wrap_angle(bearing - z[:, 0]), np.hypot(d[:, 0], d[:, 1]) - z[:, 1]], axis=1)


def height(p: Array, z: Array) -> Any:
    return (p[:, 2] - z)[:, None]


def tilt(R: Array, z: Array) -> Any:
    return SO3.matrix(R)[:, 2] - z


def planar(x: Array, mark: Array) -> Any:
    return SE2.act(SE2.inverse(x), mark)


def planar_bearing(x: Array, mark: Array, z: Array) -> Any:
    local = planar(x, mark)
    return wrap_angle(np.arctan2(local[:, 1], local[:, 0]) - z[:, 0])[:, None]


def planar_distance(x: Array, mark: Array, z: Array) -> Any:
    return (np.hypot(mark[:, 0] - x[:, 0], mark[:, 1] - x[:, 1]) - z[:, 0])[:, None]


def planar_both(x: Array, mark: Array, z: Array) -> Any:
    return np.concatenate([planar_bearing(x, mark, z), planar_distance(x, mark, z[:, 1:])], axis=1)


def sighting(group: Any) -> Function:
    return lambda x, mark, z: group.act(group.inverse(x), mark) - z


def planar_chart(x: Array, y: Array, z: Array) -> Any:
    return SE2.compose(SE2.inverse(z), SE2.compose(SE2.inverse(x), y))


def spatial_chart(x: Array, y: Array, z: Array) -> Any:
    error = SE3.compose(SE3.inverse(z), SE3.compose(SE3.inverse(x), y))
    return np.concatenate([error[:, :3], error[:, 4:] * np.where(error[:, 3:4] < 0.0, -1.0, 1.0)], axis=1)


def crossed(a: Array, b: Array) -> Any:
    pairs = ((1, 2), (2, 0), (0, 1))
    return np.stack([a[:, i] * b[:, j] - a[:, j] * b[:, i] for i, j in pairs], axis=1)


def swung(w: Array, p: Array) -> Any:
    """The integral of Exp(s w) p over s in [0, 1]."""
    angle = np.linalg.norm(w, axis=1)[:, None]
    once = crossed(w, p)
    return p + (1.0 - np.cos(angle)) / angle**2 * once + (angle - np.sin(angle)) / angle**3 * crossed(w, once)


def felt(x: Array, y: Array, force: Array, per_second: Array) -> Array:
    """Acceleration less gravity's and the mean of the forces, seen in the world."""
    turned = [SO3.act(part[:, 3:7], force) for part in (x, y)]
    speed = (y[:, 7:10] - x[:, 7:10]) * per_second[:, None]
    return np.concatenate([speed[:, :2], speed[:, 2:] + 9.81], axis=1) - (turned[0] + turned[1]) / 2.0


def inertial_motion(at: tuple[slice, slice, slice]) -> Function:
    """Of states whose position, velocity and orientation stand there."""
    p, v, q = at

    def motion(x: Array, y: Array, b: Array, seen: Array, by_bias: Array, reference: Array, h: Array) -> Any:
        h, back = h[:, None], SO3.inverse(x[:, q])
        fall = np.stack([0.0 * h[:, 0], 0.0 * h[:, 0], -9.81 * h[:, 0]], axis=1)
        moved = SO3.act(back, y[:, p] - x[:, p] - h * x[:, v] - 0.5 * h * fall)
        sped, turned = SO3.act(back, y[:, v] - x[:, v] - fall), SO3.compose(back, y[:, q])
        back = SO3.inverse(seen[:, 6:])
        moved, sped = SO3.act(back, moved - seen[:, :3]), SO3.act(back, sped - seen[:, 3:6])
        shift = -np.einsum("nij,nj->ni", by_bias, b - reference)
        w, turned = shift[:, 6:], SO3.compose(back, turned)
        moved = swung(w, shift[:, :3]) + SO3.act(SO3.exp(w), moved)
        sped = swung(w, shift[:, 3:6]) + SO3.act(SO3.exp(w), sped)
        left = SO3.log(SO3.compose(SO3.exp(w), turned))
        straight = SO3.right_jacobian_inverse(-left)
        rows = [np.einsum("nij,nj->ni", straight, part) for part in (moved, sped)]
        return np.concatenate([*rows, left], axis=1)

    return motion


def bearing_in_space(position: slice, orientation: slice, mount: Array | None = None) -> Function:
    """The angle between two directions, along axes across the measured one."""

    def seen_from(x: Array, mark: Array) -> Any:
        seen = SO3.act(SO3.inverse(x[:, orientation]), mark - x[:, position])
        return seen if mount is None else SO3.act(SO3.inverse(mount[None, 3:]), seen - mount[:3])

    def bearing(x: Array, mark: Array, z: Array) -> Any:
        m, seen = z[:, :3] / np.linalg.norm(z[:, :3], axis=1)[:, None], seen_from(x, mark)
        distance = np.linalg.norm(seen, axis=1)
        unit = seen / distance[:, None]
        sign = np.where(m[:, 2] >= 0.0, 1.0, -1.0)
        a, zero = -1.0 / (sign + m[:, 2]), 0.0 * sign
        axes = [np.stack([1.0 + zero, zero, -sign * m[:, 0]], axis=1), np.stack([zero, sign, -m[:, 1]], axis=1)]
        in_plane = m[:, 0] * a, m[:, 1] * a
        first = np.sum(axes[0] * unit, axis=1) + sign * in_plane[0] * (m[:, 0] * unit[:, 0] + m[:, 1] * unit[:, 1])
        second = np.sum(axes[1] * unit, axis=1) + in_plane[1] * (m[:, 0] * unit[:, 0] + m[:, 1] * unit[:, 1])
        sine = np.hypot(first, second)
        scale = np.arctan2(sine, np.sum(m * unit, axis=1)) / sine
        rows = [scale * first, scale * second]
        return np.stack([*rows, distance - z[:, 3]] if z.shape[1] == 4 else rows, axis=1)

    return bearing


def step(group: Any, F: Function, tableau: Tableau) -> Function:
    """The defect of a step, as the tableau says."""
    weights, matrix, ends, flat = tableau.weights, tableau.matrix, tableau.ends, tableau.flat

    def defect(x: Array, *rest: Array) -> Any:
        *inputs, y, h = rest
        h = h[:, None]
        xi = group.log(group.compose(group.inverse(x), y))
        total, speeds = xi, list[Any]()
        for s, weight in enumerate(weights):
            sigma = (ends[s] if ends else 0.0) * xi
            for t, speed in enumerate(speeds):
                if matrix[s][t] != 0.0:
                    sigma = sigma + h * matrix[s][t] * speed
            still = not (ends and ends[s]) and not any(matrix[s])
            speed = F(x if still else group.compose(x, group.exp(sigma)), *inputs)
            if not still and s not in flat:
                speed = np.einsum("nij,nj->ni", group.right_jacobian_inverse(sigma), speed)
            speeds.append(speed)
            total = total - weight * h * speed
        return total

    return defect


def swept(x: Array, u: Array) -> Any:
    return np.stack([u[:, 0] * (1.2 + np.sin(x[:, 1])), 0.4 * np.cos(x[:, 2]), u[:, 1] + 0.2 * x[:, 0]], axis=1)


def unicycle_field(x: Array, u: Array) -> Any:
    return np.stack([u[:, 0], 0.0 * u[:, 0], u[:, 1]], axis=1)


def accelerated(x: Array, u: Array) -> Any:
    return np.concatenate([unicycle_field(x, x[:, 3:]), u - 0.3 * x[:, 3:] ** 2], axis=1)


MOVING = fg.Product(pose=fg.SE2, v=fg.Rn(2))
FULL, SIMPLE, HERMITE = METHODS["full trapezoid"], METHODS["simplified trapezoid"], METHODS["hermite-simpson"]


def universal_field(x: Array, a: Array) -> Any:
    up = np.array([0.0, 0.0, 9.81])
    return SO3.act(x[:, 3:7], a) - up


def universal_dynamics(x: Array, u: Array, y: Array, h: Array) -> Any:
    h, up, back = h[:, None], np.array([0.0, 0.0, 9.81]), SO3.inverse(x[:, 3:7])
    moved = SO3.act(back, y[:, :3] - x[:, :3] - h * x[:, 7:] + 0.5 * h**2 * up) - 0.5 * h**2 * u[:, 3:]
    turned = SO3.log(SO3.compose(back, y[:, 3:7])) - h * u[:, :3]
    return np.concatenate([moved, turned, SO3.act(back, y[:, 7:] - x[:, 7:] + h * up) - h * u[:, 3:]], axis=1)


def increments(x: Array, u: Array, y: Array, h: Array) -> Any:
    return universal_dynamics(x, u, y, h)[:, 3:] / h[:, None]


def consistency(x: Array, y: Array, h: Array) -> Any:
    return y[:, :3] - x[:, :3] - 0.5 * h[:, None] * (x[:, 7:] + y[:, 7:])


def resting(x: Array) -> Any:
    up = SO3.act(x[:, 3:7], np.array([0.0, 0.0, 1.0]))
    return np.concatenate([x[:, 7:], up[:, :2]], axis=1)


def moving_spheres(p: Array, t: Array, centre: Array, velocity: Array, radius: Array) -> Any:
    return np.linalg.norm(p[:, None, :] - centre - t[:, None, None] * velocity, axis=2) - radius


def decay(x: Array, y: Array, t: Array, dt: Array, *spheres: Array) -> Any:
    return moving_spheres(y, t + dt, *spheres) - np.exp(-1.3 * dt)[:, None] * moving_spheres(x, t, *spheres)


def apart(p: Array, v: Array, t: Array, centre: Array, velocity: Array, radius: Array) -> Any:
    """Positions relative to spheres, relative velocities, distances from their centres, and the rates of the latter."""
    to, by = p[:, None, :] - centre - t[:, None, None] * velocity, v[:, None, :] - velocity
    d = np.linalg.norm(to, axis=2)
    return to, by, d, np.sum(to * by, axis=2) / d


def distance_condition(p: Array, v: Array, t: Array, *spheres: Array) -> Any:
    _, _, d, growing = apart(p, v, t, *spheres)
    return growing + 1.3 * (d - spheres[2])


def velocity_condition(x: Array, u: Array, t: Array, *spheres: Array) -> Any:
    to, by, d, growing = apart(x[:, :3], x[:, 7:], t, *spheres)
    pushed = np.sum(by * by + to * universal_field(x, u[:, 3:])[:, None, :], axis=2) / d - growing**2 / d
    whole = d - spheres[2] + 0.3
    return growing / whole**2 + 0.7 * pushed + 1.3 * (1.0 / 0.3 - 1.0 / whole + 0.7 * growing)


def published_condition(x: Array, u: Array, t: Array, *spheres: Array) -> Any:
    """Eq. 22: in h' the obstacle rests, and what is spent is the barrier of the distance."""
    to, by, d, growing = apart(x[:, :3], x[:, 7:], t, *spheres)
    own, push = x[:, None, 7:], universal_field(x, u[:, 3:])[:, None, :]
    nearing = np.sum(to * own, axis=2) / d
    pushed = np.sum(own * by + to * push, axis=2) / d - growing * nearing / d
    whole = d - spheres[2] + 0.3
    return nearing / whole**2 + 0.7 * pushed + 1.3 * (1.0 / 0.3 - 1.0 / whole)


def thrown(p: Array, q: Array, c: Array, v: Array, t: Array, dt: Array, radius: Array) -> Any:
    def away(x: Array, s: Array) -> Any:
        s = s[:, None]
        ball = c + s * v - s**2 * np.array([0.0, 0.0, 0.5 * 9.81])
        return np.linalg.norm(x - ball, axis=1)[:, None] - radius[:, None]

    return away(q, t + dt) - np.exp(-1.3 * dt)[:, None] * away(p, t)


def uncertain(p: Array, t: Array, root: Array, centre: Array, radius: Array) -> Any:
    to = p[:, None, :2] - centre
    d = np.linalg.norm(to, axis=2)
    along = (
        np.sum(to[:, :, None, :] * np.stack([root[:, :2, 0], root[:, :2, 1]], axis=1)[:, None], axis=3) / d[:, :, None]
    )
    return d - radius - 2.0 * np.linalg.norm(along, axis=2)


DEFINED: dict[str, Function] = {
    "unicycle.dynamics": unicycle_dynamics, "unicycle.ramped": unicycle_ramped,
    "unicycle.tracking": tracking, "unicycle.rate": difference(Rn(2)),
    "obstacles.disc_clearance": discs, "obstacles.clearance_of": box,
    "obstacles.wall_distance": wall_distance, "lidar.endpoint": endpoint,
    "obstacles.shortfall": shortfall(wall_distance), "potential.potential": repulsion(discs),
    "potential.potential, walls": repulsion(wall_distance), "potential.potential, vortex": repulsion(discs),
    "vehicle.dynamics": vehicle, "quadrotor.dynamics": undisturbed, "quadrotor.disturbed_dynamics": disturbed,
    "inertial.motion": inertial_motion((slice(0, 3), slice(3, 6), slice(6, 10))),
    "inertial.motion, in parts": inertial_motion((slice(0, 3), slice(7, 10), slice(3, 7))),
    "inertial.specific_force": felt,
    "space_landmarks.bearing_range_3d": bearing_in_space(slice(0, 3), slice(3, 7), MOUNT),
    "space_landmarks.bearing_3d": bearing_in_space(slice(0, 3), slice(3, 7)),
    "landmarks.bearing_range": bearing_range, "landmarks.height": height, "landmarks.tilt": tilt,
    "avoidance.cylinder_clearance": discs, "avoidance.landmark_clearance": landmark_clearance,
    "avoidance.segment_clearance": segments, "avoidance.sphere_clearance": spheres,
    "avoidance.inverse_distance_root": root_of_inverse(discs, 0.8),
    "avoidance.inverse_distance_root, landmark": root_of_inverse(landmark_clearance, 0.2),
    "bearing": planar_bearing, "distance": planar_distance, "bearing and range": planar_both,
    "chart_between on SE2": planar_chart, "chart_between on SE3": spatial_chart,
    "sighting on SE2": sighting(SE2), "sighting on SE3": sighting(SE3),
    "rkmk.trapezoid": step(SE2, swept, FULL), "rkmk.trapezoid, simplified": step(SE2, swept, SIMPLE),
    "rkmk.trapezoid, pose and velocity": step(MOVING, accelerated, FULL),
    "rkmk.integrator": step(SE2, swept, METHODS["rk4"]),
    "rkmk.trapezoid, quadrotor": step(quadrotor.STATE, quadrotor_field, FULL),
    "bicycle.dynamics": step(bicycle.STATE, bicycle.field(bicycle.Bicycle()), HERMITE),
    "cart_pole.dynamics": step(cart_pole.STATE, cart_pole.field(cart_pole.CartPole()), HERMITE),
    "manipulator.dynamics": step(manipulator.STATE, manipulator.field(manipulator.Arm()), HERMITE),
    "universal.dynamics": universal_dynamics, "universal.increments": increments,
    "universal.consistency": consistency, "terminal.resting": resting,
    "barriers.decay": decay, "barriers.condition": distance_condition,
    "barriers.condition, velocity": velocity_condition, "barriers.condition, published": published_condition,
    "barriers.decay, thrown and estimated": thrown, "barriers.uncertain": uncertain,
}  # fmt: skip
for group in (Rn(3), SO2, SE2, MOVING):
    DEFINED[f"prior on {group.name}"] = prior(group)
    DEFINED[f"between on {group.name}"] = between(group)
    DEFINED[f"difference on {group.name}"] = difference(group)


def test_every_shipped_residual_has_a_definition() -> None:
    assert set(CASES) == set(DEFINED)
    assert len(DEFINED) > 50


# ---------------------------------------------------------------- definitions against what ships


def shape_of(constant: Any) -> tuple[int, ...]:
    shape: tuple[int, ...] = np.shape(constant)
    return shape[1:] if shape[:1] == (COUNT,) else shape


@pytest.mark.parametrize("name", DEFINED)
@pytest.mark.product(16)
def test_shipped_residuals_are_their_definitions_with_their_derivatives(name: str) -> None:
    case, points, manifolds, constants = CASES[name]
    arguments: tuple[Argument, ...] = (*manifolds, *(shape_of(c) for c in constants))
    expression = traced(DEFINED[name], arguments, name=name)
    shared = [np.broadcast_to(np.asarray(c, dtype=np.float64), (COUNT, *shape_of(c))) for c in constants]
    values = [*points, *shared]
    r, J = evaluated(expression, *packed(arguments, values))
    weights = np.random.default_rng(1).normal(size=r.shape)

    compared(r, case.function(*points, *constants))
    compared(J, np.concatenate(slopes_of(name), axis=2))
    H, differenced = bends(expression, arguments, values, weights)
    np.testing.assert_allclose(H, differenced, rtol=0, atol=1e-6 * (1.0 + np.abs(differenced).max()))
    if case.kernel is not None and case.kernel.derived:
        compared(H, case.kernel.second_derivatives(weights, *points, *constants))
