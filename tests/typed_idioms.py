"""Idioms of users, for type checkers: `make types` finds no fault in it, and no test runs it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

import unifg as fg
from unifg.models import obstacles, unicycle
from unifg.pose_graphs import PoseGraph
from unifg.solvers import SQP, GraduatedNonConvexity, InteriorPoint, LevenbergMarquardt
from unifg.view import Scene

Floats = npt.NDArray[np.float64]


def guesses_of_every_kind() -> None:
    graph = fg.Graph()
    x, tree = graph.variables("x", fg.SE2, 2), graph.variables("tree", fg.Rn(2), 1)
    u = graph.variables("u", fg.Rn(1), 2)
    states = np.zeros((2, 3))
    solver = LevenbergMarquardt()
    solver.solve(graph, {x: states, tree: [[1.0, 2.0]], u: [[0.0], [1]]})
    solver.solve(graph, {x: states, tree: [[1, 2]], u: states[:, :1].astype(np.float32)})
    solver.solve(graph, {x: [[0, 0, 0], [1.0, 0.0, 0.0]], tree: ((1.0, 2.0),), u: np.zeros((2, 1), dtype=int)})
    guess = {x: states, tree: [[1.0, 2.0]], u: np.zeros((2, 1))}
    fg.solve(graph, guess)
    named: dict[fg.Family, Floats] = {x: states}
    found = fg.solve(graph, {**named, tree: [[1.0, 2.0]], u: [[0.0], [0.0]]}, check=True)
    fg.solve(graph, found)
    fg.solve(graph, found.shifted(x, u))
    fg.solve(graph, fg.Guess({x: states, tree: np.zeros((1, 2)), u: np.zeros((2, 1))}))
    graph.check({x: states, tree: [[1.0, 2.0]], u: [[0.0], [0.0]]})
    graph.check(found)


def data_of_every_kind() -> None:
    graph = fg.Graph()
    x = graph.variables("x", fg.SE2, 3)
    here, weight = graph.data("here", [0, 0, 0]), graph.data("w", 1.0)
    each = graph.data("z", np.ones((3, 3)), each=True)
    graph.fix(x[0], here)
    graph.minimize(fg.prior, x, each, sigma=0.1)
    graph.minimize(fg.between, x[:-1], x[1:], [1.0, 0, 0.1], sigma=[0.1, 0.1, 0.05], robust=fg.Huber(1.345))
    run = InteriorPoint(tolerance=1e-4, time_limit=0.01).prepare(graph)
    now = {here: np.array([0.1, 0.0, 0.0]), weight: 2, each: [[0, 0, 0]] * 3}
    plan = run.solve({x: np.zeros((3, 3))}, data=now)
    first: Floats = plan[x[0]][0]
    heading: float = float(first[2])
    cov: Floats = plan.marginals(x[1:])
    both: Floats = plan.covariance(x[-1], "x")
    status: fg.Status = plan.status
    print(heading, cov, both, status.converged, plan.report(), plan["x"], plan.worst, plan.dual("limits"))


def residuals_of_ones_own() -> None:
    def ranged(pose: Floats, beacon: Floats, seen: Floats) -> Floats:
        return np.asarray(np.linalg.norm(pose[:, :2] - beacon, axis=1, keepdims=True) - seen)

    @fg.residual
    def squared(p: Floats) -> Floats:
        return np.asarray((p**2).sum(axis=1, keepdims=True))

    graph = fg.Graph()
    x, m = graph.variables("x", fg.SE2, 4), graph.variables("m", fg.Rn(2), 2)
    graph.minimize(ranged, x[[0, 1, 2, 3]], m[np.array([0, 0, 1, 1])], np.ones((4, 1)), sigma=0.1, name="ranges")
    graph.minimize(lambda p, z: p[:, :2] - z, x[1:3], np.zeros((2, 2)), sigma=0.1)
    graph.constrain(squared, m, lower=1, upper=1.0, name="circle")
    graph.constrain(lambda p: np.hypot(p[:, 0], p[:, 1])[:, None], x, lower=0.4, name="disc")
    graph.minimize_scalar(lambda p: p[:, 0] ** 4, m, name="quartic")
    graph.bound(m, lower=-1, upper=[1.0, np.inf])
    graph.bound(m[0], upper=2)
    rows: list[fg.Iteration] = []
    solver = SQP(hessian="exact", keep_values=True)
    solver.solve(graph, {x: np.zeros((4, 3)), m: [[1, 1], [0, 1]]}, callback=rows.append)


def products_and_their_components() -> None:
    state = fg.Product(pose=fg.SE2, speed=fg.Rn(1))
    graph = fg.Graph()
    x = graph.variables("x", state, 3)
    graph.minimize(fg.prior, x.speed, [0.0], sigma=1.0)
    graph.minimize(fg.between, x.pose[:-1], x.pose[1:], [1.0, 0.0, 0.0], sigma=0.1)
    graph.bound(x[1:].speed, lower=-1.0, upper=1.0)
    start = state.pack(pose=[0, 0, 0], speed=0.5)
    solution = fg.solve(graph, {x: np.tile(start, (3, 1))})
    pose: Floats = solution[x.pose]
    print(pose, solution[x.speed][-1], solution[x[1].pose])


def control_loops() -> None:
    nodes, dt = 10, 0.1
    graph = fg.Graph()
    x, u = graph.variables("x", fg.SE2, nodes + 1), graph.variables("u", fg.Rn(2), nodes)
    here = graph.data("here", [0.0, 0.0, 0.0])
    graph.fix(x[0], here)
    graph.minimize(fg.prior, x[-1], [1, 0, 0], sigma=0.1, name="goal")
    graph.constrain(unicycle.dynamics, x[:-1], u, x[1:], dt, lower=0, upper=0, name="motion")
    graph.constrain(obstacles.disc_clearance, x[1:], [[0.5, 0.3]], [0.2], lower=0, name="disc")
    run = InteriorPoint(step_tolerance=np.inf, time_limit=0.005).prepare(graph)
    guess: fg.Guess | dict[fg.Family, Floats] = {x: np.zeros((nodes + 1, 3)), u: np.zeros((nodes, 2))}
    pose = np.zeros(3)
    plan = run.solve(guess)
    for _ in range(3):
        plan = run.solve(guess, data={here: pose})
        guess, pose = plan.shifted(x, u), fg.SE2.retract(pose, [0.1, 0.0, 0.0])
    Scene.of(plan, x, over="members", dt=dt, body="car", size=0.3).save("drive.html")


def estimates_that_grow(found: PoseGraph) -> None:
    smoother = fg.Incremental()
    x = smoother.variables("x", fg.SE2)
    smoother.minimize(fg.prior, x[0], [0, 0, 0], sigma=0.1)
    smoother.update({x: [0.0, 0.0, 0.0]})
    smoother.update({x: [[1, 0, 0], [2.0, 0.0, 0.0]]})
    last: Floats = smoother.estimate(x[-1])
    graph, poses, guess = found.graph(robust=fg.TruncatedLeastSquares(3.0))
    solution = GraduatedNonConvexity().solve(graph, guess)
    assert solution.verdict is not None
    print(last, solution[poses], solution.verdict.left_out["edges"])
