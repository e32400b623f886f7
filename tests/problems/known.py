"""Problems with known answers that every backend of the right class must solve."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import numpy as np

import unifg as fg
from problems.graphs import drawn_to, graph_of, graph_with
from unifg.models import obstacles, unicycle
from unifg.scenarios.papers import ecg2o as study
from unifg.typing import Array

Guess = dict[fg.Family, Array]
ecg2o, STARTS = study.small, study.STARTS


@dataclass(frozen=True)
class Problem:
    """A graph, a guess, and what the answer must be.

    Attributes:
        name: for the test report.
        build: returns graph and guess.
        cost: objective at the solution, with its 1/2; several when several minima are accepted.
        constrained: whether it has constraints or bounds.
        scalar: whether it has a cost that is not a square.
        answer: expected values by family name.
        duals: expected multipliers by term name.
    """

    name: str
    build: Callable[[], tuple[fg.Graph, Guess]]
    cost: float
    constrained: bool = True
    scalar: bool = False
    answer: dict[str, list[list[float]]] = field(default_factory=dict)
    duals: dict[str, list[list[float]]] = field(default_factory=dict)


def line(count: int = 4) -> tuple[fg.Graph, fg.Family]:
    """An empty graph over ``count`` points of the plane."""
    graph = fg.Graph()
    return graph, graph.variables("x", fg.Rn(2), count)


def ecg2o_inequality() -> tuple[fg.Graph, Guess]:
    """A circle cut by an ellipse."""
    graph, x = drawn_to([1.0, 1.0])
    graph.constrain(lambda p: (p**2).sum(axis=1, keepdims=True), x, lower=1.0, upper=1.0, name="circle")
    graph.constrain(lambda p: p**2 @ np.array([[4.0], [0.25]]), x, upper=1.0, name="ellipse")
    return graph, {x: np.array([[-1.0, 2.0]])}


def three_variable_qp() -> tuple[fg.Graph, Guess]:
    """Linear equalities over three scalars in three families."""
    graph = fg.Graph()
    x, y, z = (graph.variables(name, fg.Rn(1), 1) for name in "xyz")
    for variable, target in ((x, 2.0), (y, 9.0), (z, 50.0)):
        graph.minimize(fg.prior, variable, [target], sigma=0.5**0.5)
    graph.constrain(lambda a, b: a + b, y, z, lower=3.0, upper=3.0, name="first")
    graph.constrain(lambda a, b: a + b, x, y, lower=2.5, upper=2.5, name="second")
    return graph, {x: np.zeros((1, 1)), y: np.zeros((1, 1)), z: np.zeros((1, 1))}


def inactive_inequality() -> tuple[fg.Graph, Guess]:
    """Read literally, Bazzana's eq. 19 answers 0.867 here."""
    graph, x = drawn_to([0.2], sigma=0.5**0.5)
    graph.bound(x, upper=1.0, name="limit")
    return graph, {x: np.array([[5.0]])}


def active_bounds() -> tuple[fg.Graph, Guess]:
    """One bound active above, one below, one not: the signs of the multipliers."""
    graph, x = drawn_to([3.0, -3.0, 0.5])
    graph.bound(x, lower=-1.0, upper=1.0, name="box")
    return graph, {x: np.zeros((1, 3))}


def rosenbrock() -> tuple[fg.Graph, Guess]:
    """The banana valley as least squares."""
    graph, x = graph_with(fg.Rn(2))
    graph.minimize(lambda p: np.stack([10.0 * (p[:, 1] - p[:, 0] ** 2), 1.0 - p[:, 0]], axis=1), x)
    return graph, {x: np.array([[-1.2, 1.0]])}


def hs6() -> tuple[fg.Graph, Guess]:
    """Hock-Schittkowski 6."""
    graph, x = graph_with(fg.Rn(2))
    graph.minimize(lambda p: 1.0 - p[:, :1], x)
    graph.constrain(lambda p: 10.0 * (p[:, 1:] - p[:, :1] ** 2), x, lower=0.0, upper=0.0)
    return graph, {x: np.array([[-1.2, 1.0]])}


def hs65() -> tuple[fg.Graph, Guess]:
    """Hock-Schittkowski 65: least squares, a ball and bounds."""
    graph, x = graph_with(fg.Rn(3))

    def residual(p: Array) -> Array:
        a, b, c = p.T
        return np.stack([a - b, (a + b - 10.0) / 3.0, c - 5.0], axis=1)

    graph.minimize(residual, x)
    graph.constrain(lambda p: (p**2).sum(axis=1, keepdims=True), x, upper=48.0)
    graph.bound(x, lower=[-4.5, -4.5, -5.0], upper=[4.5, 4.5, 5.0])
    return graph, {x: np.array([[-5.0, 5.0, 0.0]])}


def hs48() -> tuple[fg.Graph, Guess]:
    """Hock-Schittkowski 48: two linear equalities, singular Hessian."""
    graph, x = graph_with(fg.Rn(5))
    graph.minimize(lambda p: np.stack([p[:, 0] - 1.0, p[:, 1] - p[:, 2], p[:, 3] - p[:, 4]], axis=1), x)
    graph.constrain(
        lambda p: np.stack([p.sum(axis=1), p[:, 2] - 2.0 * (p[:, 3] + p[:, 4])], axis=1),
        x,
        lower=[5, -3],
        upper=[5, -3],
    )
    return graph, {x: np.array([[3.0, 5.0, -3.0, 2.0, -2.0]])}


def square_of_poses(anchored: bool = False) -> tuple[fg.Graph, Guess]:
    """Four exact relative poses around a square, closed: cost zero there; the first is fixed, or a constraint."""
    graph, x = graph_with(fg.SE2, 4)
    quarter = [1.0, 0.0, np.pi / 2.0]
    if anchored:  # which the guess keeps
        graph.constrain(fg.prior, x[0], [0.0, 0.0, 0.0], lower=0.0, upper=0.0, name="anchor")
    else:
        graph.fix(x[0], [0.0, 0.0, 0.0])
    graph.minimize(fg.between, x, x[[1, 2, 3, 0]], quarter, information=np.diag([4.0, 4.0, 25.0]))
    return graph, {x: np.array([[0.0, 0.0, 0.0], [1.3, -0.2, 1.2], [0.7, 1.2, 2.8], [-0.3, 0.8, -1.2]])}


def huber_line() -> tuple[fg.Graph, Guess]:
    """Median-like mean of one scalar with an outlier: optimum by hand at the Huber stationarity condition."""
    graph, x = graph_with(fg.Rn(1))
    measured = graph.data("measured", np.array([[0.0], [0.2], [0.1], [8.0]]), each=True)
    graph.minimize(lambda p, z: p - z, x, measured, robust=fg.Huber(0.5))
    return graph, {x: np.array([[4.0]])}


def pose_beside_disc() -> tuple[fg.Graph, Guess]:
    """A pose pulled into a disc comes to rest on its rim, 0.5 m from the centre."""
    graph, x = graph_with(fg.SE2)
    graph.minimize(fg.prior, x, [0.1, 0.0, 0.3], sigma=0.5)
    graph.constrain(obstacles.disc_clearance, x, np.array([[0.0, 0.0]]), np.array([0.5]), lower=0.0, name="keep-out")
    return graph, {x: np.array([[1.0, 0.4, 0.0]])}


def rotation_within_limits() -> tuple[fg.Graph, Guess]:
    """An angle on SO(2) held beyond half a turn by a chord constraint."""
    graph, r = graph_with(fg.SO2, 1, "r")
    graph.minimize(fg.prior, r, [3.0])
    graph.constrain(lambda a: np.cos(a), r, lower=-0.5, name="chord")
    return graph, {r: np.array([[1.0]])}


def product_state() -> tuple[fg.Graph, Guess]:
    """A product of a pose and a velocity; the velocity component is bounded."""
    graph, x = graph_with(fg.Product(pose=fg.SE2, v=fg.Rn(1)), 2)
    graph.fix(x[0], [0.0, 0.0, 0.0, 1.0])
    graph.minimize(fg.prior, x.pose, [2.0, 0.0, 0.0])
    graph.constrain(lambda a, v, b: b[:, :1] - a[:, :1] - v, x.pose[:-1], x.v[:-1], x.pose[1:], lower=0.0, upper=0.0)
    graph.minimize(fg.prior, x.v[1], [3.0])
    graph.bound(x.v, upper=2.0, name="speed")
    return graph, {x: np.array([[0.0, 0.0, 0.0, 1.0], [0.2, 0.1, 0.1, 0.5]])}


def short_drive(disc: bool = True) -> tuple[fg.Graph, Guess]:
    """Twelve steps of a unicycle, past a disc if wanted, with hard dynamics and limits."""
    count, dt = 12, 0.2
    graph, x, u = graph_of(("x", fg.SE2, count + 1), ("u", fg.Rn(2), count))
    graph.fix(x[0], [0.0, 0.0, 0.0])
    graph.minimize(unicycle.tracking, x[-1], [2.0, 0.1, 0.0], sigma=0.1)
    graph.minimize(fg.prior, u, [0.0, 0.0], sigma=2.0)
    graph.minimize(unicycle.rate, u[:-1], u[1:], sigma=1.0)
    graph.constrain(unicycle.dynamics, x[:-1], u, x[1:], dt, lower=0.0, upper=0.0, name="dynamics")
    graph.bound(u, lower=[-1.0, -1.0], upper=[1.0, 1.0], name="limits")
    if disc:
        graph.constrain(obstacles.disc_clearance, x[1:], np.array([[1.0, -0.1]]), np.array([0.3]), lower=0.0)
    ahead = np.linspace(0.0, 2.0, count + 1)
    return graph, {x: np.stack([ahead, 0.0 * ahead, 0.0 * ahead], axis=1), u: np.tile([0.8, 0.0], (count, 1))}


def pose_chain(
    manifold: fg.Manifold, count: int, seed: int, pinned: tuple[int, ...], unit: float = 1.0, information: float = 1.0
) -> tuple[fg.Graph, Guess]:
    """Poses along noisy odometry; those pinned are held by hard priors, which the guess keeps.

    Args:
        manifold: SE2 or SE3.
        count: poses.
        seed: of the way, of its measurements and of the guess.
        pinned: poses with a hard prior.
        unit: of length [m].
        information: of odometry of 0.1 units and 0.1 rad.
    """
    rng, size = np.random.default_rng(seed), manifold.dim
    scale = np.where(np.arange(size) < (2 if size == 3 else 3), unit, 1.0)
    steps = scale * (0.3 * rng.normal(size=(count - 1, size)) + np.eye(size)[0])
    poses = [manifold.identity()]
    for step in steps:
        poses.append(manifold.retract(poses[-1], step))
    graph, x = graph_with(manifold, count)
    moves = steps + 0.05 * scale * rng.normal(size=steps.shape)
    measured = np.stack([manifold.retract(manifold.identity(), move) for move in moves])
    graph.minimize(fg.between, x[:-1], x[1:], measured, sigma=0.1 * scale / information**0.5)
    for k in pinned:
        graph.constrain(fg.prior, x[k], poses[k], lower=0.0, upper=0.0, name=f"pin {k}")
    guess = np.stack([manifold.retract(pose, 0.1 * scale * rng.normal(size=size)) for pose in poses])
    for k in pinned:
        guess[k] = poses[k]
    return graph, {x: guess}


def rolled_out_drive() -> tuple[fg.Graph, Guess]:
    """A drive whose guess keeps its dynamics, its start, stated as a constraint, and its limits."""
    count, dt = 12, 0.2
    graph, x, u = graph_of(("x", fg.SE2, count + 1), ("u", fg.Rn(2), count))
    graph.constrain(fg.prior, x[0], [0.0, 0.0, 0.0], lower=0.0, upper=0.0, name="start")
    graph.minimize(unicycle.tracking, x[-1], [1.5, 0.6, 0.4], sigma=0.1)
    graph.minimize(fg.prior, u, [0.0, 0.0], sigma=2.0)
    graph.minimize(unicycle.rate, u[:-1], u[1:], sigma=1.0)
    graph.constrain(unicycle.dynamics, x[:-1], u, x[1:], dt, lower=0.0, upper=0.0, name="dynamics")
    controls, poses = np.tile([0.6, 0.3], (count, 1)), [np.zeros(3)]
    for speed, turn in controls:
        poses.append(fg.SE2.retract(poses[-1], dt * np.array([speed, 0.0, turn])))
    return graph, {x: np.stack(poses), u: controls}


def inverse_distance() -> tuple[fg.Graph, Guess]:
    """A scalar cost 1/d that pushes away from the origin against a quadratic pull: d^3 = 1 by hand."""
    graph, x = drawn_to([0.0])
    graph.minimize_scalar(lambda p: 1.0 / p[:, 0], x, name="push")
    graph.bound(x, lower=0.1, name="positive")
    return graph, {x: np.array([[3.0]])}


ROOT5 = 5.0**-0.5
INLIERS = (0.8 / 3.0) ** 2 + (0.2 / 3.0) ** 2 + (0.5 / 3.0) ** 2
HUBER = 0.5 * (INLIERS + 2.0 * 0.5 * (8.0 - 0.8 / 3.0) - 0.25)

PROBLEMS = [
    *[
        Problem(f"ecg2o{start}", partial(ecg2o, start), 1.0, answer={"x": [[0, 0]]}, duals={"curve": [[-1]]})
        for start in STARTS
    ],
    Problem(
        "ecg2o inequality",
        ecg2o_inequality,
        0.5 * ((ROOT5 - 1) ** 2 + (2 * ROOT5 - 1) ** 2),
        answer={"x": [[ROOT5, 2 * ROOT5]]},
    ),
    Problem(
        "three-variable qp",
        three_variable_qp,
        13.0**2 + 21.5**2 + 34.5**2,
        answer={"x": [[15.0]], "y": [[-12.5]], "z": [[15.5]]},
        duals={"first": [[69.0]], "second": [[-26.0]]},
    ),
    Problem("inactive inequality", inactive_inequality, 0.0, answer={"x": [[0.2]]}, duals={"limit": [[0.0]]}),
    Problem(
        "active bounds",
        active_bounds,
        4.0,
        answer={"x": [[1.0, -1.0, 0.5]]},
        duals={"box": [[2.0, -2.0, 0.0]]},
    ),
    Problem("rosenbrock", rosenbrock, 0.0, constrained=False, answer={"x": [[1.0, 1.0]]}),
    Problem("hs6", hs6, 0.0, answer={"x": [[1.0, 1.0]]}),
    Problem("hs65", hs65, 0.5 * 0.9535288567, answer={"x": [[3.650461821, 3.650461821, 4.6204170507]]}),
    Problem("hs48", hs48, 0.0, answer={"x": [[1.0] * 5]}),
    Problem(
        "square of poses",
        square_of_poses,
        0.0,
        constrained=False,
        answer={"x": [[0, 0, 0], [1, 0, np.pi / 2], [1, 1, np.pi], [0, 1, -np.pi / 2]]},
    ),
    Problem("huber line", huber_line, HUBER, constrained=False, answer={"x": [[0.8 / 3.0]]}),
    Problem("pose beside disc", pose_beside_disc, 0.32, duals={"keep-out": [[-1.6]]}),
    Problem(
        "rotation within limits",
        rotation_within_limits,
        0.5 * (3.0 - 2 * np.pi / 3) ** 2,
        answer={"r": [[2 * np.pi / 3]]},
    ),
    Problem("product state", product_state, 3.0, duals={"speed": [[0.0], [1.0]]}),
    Problem("short drive", short_drive, np.nan),
    Problem(
        "anchored square",
        partial(square_of_poses, anchored=True),
        0.0,
        answer={"x": [[0, 0, 0], [1, 0, np.pi / 2], [1, 1, np.pi], [0, 1, -np.pi / 2]]},
        duals={"anchor": [[0.0, 0.0, 0.0]]},
    ),
    Problem("pinned ends, SE(2)", partial(pose_chain, fg.SE2, 12, 0, (0, 11)), np.nan),
    Problem("pinned ends, SE(3)", partial(pose_chain, fg.SE3, 12, 0, (0, 11)), np.nan),
    Problem("anchored chain, SE(3)", partial(pose_chain, fg.SE3, 12, 1, (0,)), 0.0, duals={"pin 0": [[0.0] * 6]}),
    Problem("every pose pinned", partial(pose_chain, fg.SE2, 6, 2, tuple(range(6))), np.nan),
    Problem("rolled-out drive", rolled_out_drive, np.nan),
    Problem("inverse distance", inverse_distance, 1.5, scalar=True, answer={"x": [[1.0]]}),
]
