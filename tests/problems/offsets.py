"""The same problems with their worlds moved by up to 5000 km: same status, same iterations, same optimum.

Map coordinates such as UTM have northings of 5e6 m, whose spacing is 1e-9 m. Small problems on Rn, SE(2), SE(3) and
{p, R, v}, with residuals in NumPy, compiled for one factor (without a Jacobian, so that they are differenced), and
shipped, are solved by every backend that takes them, at each offset from the guess moved with the world.
Coordinates lie on a grid that every offset represents: it is exactly the same problem. Own residuals subtract positions
before they do anything else; "rounded" ones compare the next position with the sum of the last one and what happens in
the step, which far out is rounded to the spacing of the position: they need not be the same at 5e6 m.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np

import unifg as fg
from unifg.models import avoidance, obstacles, quadrotor, unicycle
from unifg.solution.solver import Solver
from unifg.solvers import (
    KKT,
    SQP,
    AugmentedLagrangian,
    DogLeg,
    GaussNewton,
    InteriorPoint,
    LevenbergMarquardt,
    Penalty,
)
from unifg.typing import Array

OFFSETS = (0.0, 1e3, 1e5, 5e6)  # [m]
GRID = 2.0**-20  # [m]; a multiple of the spacing of every offset
ITERATIONS = 2  # by which a solve may differ from that at the origin
SAME = 1e-5  # by which a value may
STEPS, DT, GRAVITY = 8, 0.25, 9.81
AHEAD = 3.0  # from start to goal [m]
CENTRE, RADIUS = np.array([[1.5, 0.125]]), np.array([0.5])  # of the disc, cylinder or sphere in between [m]
STATE = quadrotor.STATE
VEHICLE = quadrotor.Parameters(1.0)

LEAST_SQUARES: dict[str, Callable[[], Solver]] = {
    "GaussNewton": GaussNewton,
    "LevenbergMarquardt": LevenbergMarquardt,
    "DogLeg": DogLeg,
}
EQUALITIES: dict[str, Callable[[], Solver]] = {
    "KKT": KKT,
    "Penalty": Penalty,
    "AugmentedLagrangian": AugmentedLagrangian,
    "InteriorPoint": InteriorPoint,
    "SQP": SQP,
    "SQP exact": lambda: SQP(hessian="exact"),
    "SQP graph": lambda: SQP(qp="graph"),
}
INEQUALITIES = {name: solver for name, solver in EQUALITIES.items() if name != "KKT"}


@dataclass
class Case:
    """One problem that can be moved.

    Attributes:
        name: space, residuals, and what is asked.
        graph: with the positions of its world as data.
        guess: at the origin.
        places: data that move with the world, and their values at the origin.
        axes: of each family of states, how many of its numbers are positions.
        backends: that take it.
    """

    name: str
    graph: fg.Graph
    guess: dict[fg.Family, Array]
    places: dict[fg.Data, Array]
    axes: dict[fg.Family, int]
    backends: dict[str, Callable[[], Solver]]


@dataclass
class Row:
    """One backend on one case at all offsets.

    Attributes:
        case, backend: which.
        status: at each offset.
        iterations: at each offset.
        apart: largest difference of a value from the origin's, at each offset.
    """

    case: str
    backend: str
    status: list[str]
    iterations: list[int]
    apart: list[float]

    @property
    def same(self) -> bool:
        """True if moving the world changed nothing."""
        asked = len(self.status) - ("rounded" in self.case)
        counts = max(abs(count - self.iterations[0]) for count in self.iterations[:asked])
        return len(set(self.status[:asked])) == 1 and counts <= ITERATIONS and max(self.apart) <= SAME


# ---------------------------------------------------------------- own residuals, one factor and batched


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def drive(x: Array, u: Array, y: Array, r: Array) -> None:
    """Unicycle, (x, y, heading)."""
    r[0] = y[0] - x[0] - DT * u[0] * np.cos(x[2])
    r[1] = y[1] - x[1] - DT * u[0] * np.sin(x[2])
    r[2] = y[2] - x[2] - DT * u[1]


def drive_batch(x: Array, u: Array, y: Array) -> Array:
    """The same for all factors."""
    d = y - x
    turned = np.stack([np.cos(x[:, 2]), np.sin(x[:, 2])], axis=1)
    return np.concatenate([d[:, :2] - DT * u[:, :1] * turned, d[:, 2:] - DT * u[:, 1:]], axis=1)


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def drive_rounded(x: Array, u: Array, y: Array, r: Array) -> None:
    """Unicycle, the sum first."""
    r[0] = y[0] - (x[0] + DT * u[0] * np.cos(x[2]))
    r[1] = y[1] - (x[1] + DT * u[0] * np.sin(x[2]))
    r[2] = y[2] - (x[2] + DT * u[1])


def drive_rounded_batch(x: Array, u: Array, y: Array) -> Array:
    """The same for all factors."""
    turned = np.stack([np.cos(x[:, 2]), np.sin(x[:, 2]), np.zeros(len(x))], axis=1)
    return np.asarray(y - (x + DT * u[:, :1] * turned + DT * u[:, 1:] * np.array([0.0, 0.0, 1.0])))


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def swim(x: Array, u: Array, y: Array, r: Array) -> None:
    """A body that moves along its axes (u[:3]) and turns (u[3:]), on SE(3)."""
    w, a, b, c = x[3], -x[4], -x[5], -x[6]
    px, py, pz = y[0] - x[0], y[1] - x[1], y[2] - x[2]
    cx, cy, cz = 2.0 * (b * pz - c * py), 2.0 * (c * px - a * pz), 2.0 * (a * py - b * px)
    r[0] = px + w * cx + (b * cz - c * cy) - DT * u[0]
    r[1] = py + w * cy + (c * cx - a * cz) - DT * u[1]
    r[2] = pz + w * cz + (a * cy - b * cx) - DT * u[2]
    turn(x, u, y, r)


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def turn(x: Array, u: Array, y: Array, r: Array) -> None:
    """Twice the vector of the turn from x to y, less the rate u[3:]."""
    w, a, b, c = x[3], -x[4], -x[5], -x[6]
    v, e, f, g = y[3], y[4], y[5], y[6]
    sign = 2.0 if w * v - a * e - b * f - c * g >= 0.0 else -2.0
    r[3] = sign * (w * e + a * v + b * g - c * f) - DT * u[3]
    r[4] = sign * (w * f + b * v + c * e - a * g) - DT * u[4]
    r[5] = sign * (w * g + c * v + a * f - b * e) - DT * u[5]


def turn_batch(x: Array, y: Array) -> Array:
    """Twice the vector of the turn from one quaternion to another."""
    relative = fg.SO3.between(x, y)
    return np.asarray(2.0 * relative[:, 1:])


def swim_batch(x: Array, u: Array, y: Array) -> Array:
    """The same for all factors."""
    moved = np.einsum("nki,nk->ni", fg.SO3.matrix(x[:, 3:7]), y[:, :3] - x[:, :3])
    return np.concatenate([moved, turn_batch(x[:, 3:7], y[:, 3:7])], axis=1) - DT * u


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def fly(x: Array, u: Array, y: Array, r: Array) -> None:
    """A vehicle with a thrust along its third axis (u[2]) and rates u[3:], on {p, R, v}."""
    w, a, b, c = x[3], x[4], x[5], x[6]
    for k in range(3):
        r[k] = y[k] - x[k] - 0.5 * DT * (x[7 + k] + y[7 + k])
    turn(x, u, y, r)
    r[6] = y[7] - x[7] - DT * u[2] * 2.0 * (a * c + w * b)
    r[7] = y[8] - x[8] - DT * u[2] * 2.0 * (b * c - w * a)
    r[8] = y[9] - x[9] - DT * (u[2] * (1.0 - 2.0 * (a * a + b * b)) - GRAVITY)


def fly_batch(x: Array, u: Array, y: Array) -> Array:
    """The same for all factors."""
    lift = u[:, 2:3] * fg.SO3.matrix(x[:, 3:7])[:, :, 2] - np.array([0.0, 0.0, GRAVITY])
    position = y[:, :3] - x[:, :3] - 0.5 * DT * (x[:, 7:] + y[:, 7:])
    rotation = turn_batch(x[:, 3:7], y[:, 3:7]) - DT * u[:, 3:]
    return np.concatenate([position, rotation, y[:, 7:] - x[:, 7:] - DT * lift], axis=1)


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def clear(x: Array, centre: Array, radius: Array, r: Array) -> None:
    """Clearance in the plane."""
    r[0] = np.sqrt((x[0] - centre[0, 0]) ** 2 + (x[1] - centre[0, 1]) ** 2) - radius[0]


def clear_batch(x: Array, centre: Array, radius: Array) -> Array:
    """The same for all factors."""
    d = x[:, :2] - centre[0]
    return np.asarray(np.sqrt((d**2).sum(axis=1, keepdims=True)) - radius[0])


# ---------------------------------------------------------------- problems


@dataclass(frozen=True)
class Space:
    """State space of a vehicle, with its motion and its clearance.

    Attributes:
        manifold: of a state.
        axes: how many of its numbers are its position.
        controls: numbers of a control, and what keeps the vehicle where it is.
        motion: defects of a step, by kind of residual; with further arguments.
        clearance: from the obstacle, by kind.
        component: of a product that the shipped clearance takes.
    """

    manifold: fg.Manifold
    axes: int
    controls: Array
    motion: dict[str, tuple[Any, ...]]
    clearance: dict[str, Any]
    component: str = ""


def own(function: Any, rows: int) -> fg.Residual:
    """A compiled function without a Jacobian."""
    return fg.residual(function, rows=rows)


CLEAR: dict[str, Any] = {"NumPy": clear_batch, "njit": own(clear, 1)}
SPACES: dict[str, Space] = {
    "Rn": Space(
        fg.Rn(3),
        2,
        np.zeros(2),
        {
            "NumPy": (drive_batch,),
            "njit": (own(drive, 3),),
            "NumPy rounded": (drive_rounded_batch,),
            "njit rounded": (own(drive_rounded, 3),),
        },
        {**CLEAR, "NumPy rounded": clear_batch, "njit rounded": own(clear, 1)},
    ),
    "SE(2)": Space(
        fg.SE2,
        2,
        np.zeros(2),
        {"NumPy": (drive_batch,), "njit": (own(drive, 3),), "shipped": (unicycle.dynamics, DT)},
        {**CLEAR, "shipped": obstacles.disc_clearance},
    ),
    "SE(3)": Space(fg.SE3, 3, np.zeros(6), {"NumPy": (swim_batch,), "njit": (own(swim, 6),)}, CLEAR),
    "{p, R, v}": Space(
        STATE,
        3,
        np.array([0.0, 0.0, GRAVITY, 0.0, 0.0, 0.0]),
        {"NumPy": (fly_batch,), "njit": (own(fly, 9),), "shipped": (quadrotor.dynamics, VEHICLE.packed, DT)},
        {**CLEAR, "shipped": avoidance.cylinder_clearance},
        "p",
    ),
}


def drives(names: tuple[str, ...] = tuple(SPACES)) -> Iterator[Case]:
    """From rest or a pose to a goal: free (soft motion), to a hard goal, and past an obstacle."""
    for name in names:
        space = SPACES[name]
        for kind in space.motion:
            for asked in ("soft", "hard goal", "obstacle"):
                yield drive_case(name, space, kind, asked)


def drive_case(name: str, space: Space, kind: str, asked: str) -> Case:
    """One problem of :func:`drives`."""
    graph = fg.Graph()
    neutral = quadrotor.hover(VEHICLE) if kind == "shipped" and space.manifold == STATE else space.controls
    x, u = graph.variables("x", space.manifold, STEPS + 1), graph.variables("u", fg.Rn(len(neutral)), STEPS)
    states = np.tile(space.manifold.identity(), (STEPS + 1, 1))
    states[:, 0] = np.round(AHEAD * np.linspace(0.0, 1.0, STEPS + 1) / GRID) * GRID
    states[:, 1] = np.round(-0.25 * np.sin(np.linspace(0.0, np.pi, STEPS + 1)) / GRID) * GRID
    goal_state = states[-1].copy()
    goal_state[1] = 0.25
    start, goal = graph.data("start", states[0]), graph.data("goal", goal_state)
    places = {start: states[0], goal: goal_state}
    motion, *rest = space.motion[kind]
    graph.fix(x[0], start)
    graph.minimize(fg.prior, u, neutral, sigma=1.0)
    if asked == "soft":
        graph.minimize(motion, x[:-1], u, x[1:], *rest, sigma=0.1, name="motion")
        graph.minimize(fg.prior, x[-1], goal, sigma=0.3)
    else:
        graph.constrain(motion, x[:-1], u, x[1:], *rest, lower=0.0, upper=0.0, name="motion")
    if asked == "hard goal":
        graph.constrain(fg.prior, x[-1], goal, lower=0.0, upper=0.0, name="goal")
    if asked == "obstacle":
        graph.minimize(fg.prior, x[-1], goal, sigma=0.3)
        centre = graph.data("centre", CENTRE)
        places[centre] = CENTRE
        seen = x[1:]
        if kind == "shipped" and space.component:
            seen = getattr(seen, space.component)
        graph.constrain(space.clearance[kind], seen, centre, RADIUS, lower=0.0, name="keep-out")
    backends = {"soft": LEAST_SQUARES, "hard goal": EQUALITIES, "obstacle": INEQUALITIES}[asked]
    guess = {x: states, u: np.tile(neutral, (STEPS, 1))}
    return Case(f"{name}, {kind}, {asked}", graph, guess, places, {x: space.axes, u: 0}, backends)


def moved(values: Array, axes: int, offset: float) -> Array:
    """With its positions elsewhere; one row or several."""
    result = np.array(values, dtype=np.float64)
    result[..., :axes] += offset
    return result


def run(case: Case, offsets: tuple[float, ...] = OFFSETS) -> Iterator[Row]:
    """Every backend at every offset."""
    axes = next(iter(case.axes.values()))
    for name, make in case.backends.items():
        prepared = make().prepare(case.graph)
        row = Row(case.name, name, [], [], [])
        first: dict[fg.Family, Array] = {}
        for offset in offsets:
            guess = {family: moved(values, case.axes[family], offset) for family, values in case.guess.items()}
            data = {handle: moved(value, axes, offset) for handle, value in case.places.items()}
            solution = prepared.solve(guess, data=data)
            values = {family: moved(solution[family], case.axes[family], -offset) for family in guess}
            first = first or values
            row.status.append(solution.status.name)
            row.iterations.append(solution.iterations)
            row.apart.append(max(float(np.abs(values[family] - first[family]).max()) for family in values))
        yield row
