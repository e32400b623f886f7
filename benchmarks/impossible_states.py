"""Two small pasts with something that cannot have been: through a wall, and air that pushes.

Each is estimated without that knowledge and with it, on the same noise; :mod:`benchmarks.excluded_pasts` tabulates.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np

import unifg as fg
from problems.graphs import graph_of, graph_with
from unifg.lie import SE2
from unifg.modeling.variables import Data
from unifg.solvers import GaussNewton, InteriorPoint
from unifg.typing import Array

Errors: TypeAlias = dict[str, list[float]]
"""Of each drive, by what is known."""
POSES, RADIUS = 16, 0.25  # of a drive along a wall; the robot's [m]
FIX, WHEELS = 0.4, np.array([0.03, 0.03, 0.03])  # deviations of fixes [m] and of a step [m, m, rad]
SPEEDS, H, METER = 20, 0.5, 0.4  # samples of a vehicle that rolls; between them [s]; deviation of a speed [m/s]


def along_a_wall(seed: int, drives: int) -> Errors:
    """Error of the last pose across the wall [m], for drives beside one at y = 0 that touch it once."""
    rng = np.random.default_rng(seed)
    along = 0.3 * np.arange(POSES)
    touched, far = rng.integers(4, POSES), rng.uniform(0.1, 0.8)
    across = RADIUS + far * (1.0 - np.cos(0.5 * (along - along[touched]))) * 0.5
    truth = np.column_stack([along, across, np.gradient(across, along)])
    moved = SE2.compose(SE2.inverse(truth[:-1]), truth[1:])

    def stated(solver: fg.Solver, wall: bool, contact: bool) -> tuple[fg.Prepared, fg.Family, Data, Data]:
        graph, x = graph_with(SE2, POSES)
        fixes = graph.data("fixes", truth[:, :2], each=True)
        steps = graph.data("steps", moved, each=True)
        graph.minimize(fg.prior, x[0], truth[0], sigma=[FIX, FIX, 0.1], name="begin")
        graph.minimize(lambda pose, fix: pose[:, :2] - fix, x, fixes, sigma=FIX, name="fixes")
        graph.minimize(fg.between, x[:-1], x[1:], steps, sigma=WHEELS, name="wheels")
        if wall:
            graph.constrain(lambda pose: pose[:, 1:2] - RADIUS, x, lower=0.0, name="wall")
        if contact:
            graph.constrain(lambda pose: pose[:, 1:2] - RADIUS, x[int(touched)], lower=0.0, upper=0.0, name="contact")
        return solver.prepare(graph), x, fixes, steps

    prepared = {
        "measurements": stated(GaussNewton(), False, False),
        "and no way through the wall": stated(InteriorPoint(), True, False),
        "and where it was touched": stated(InteriorPoint(), True, True),
    }
    errors: Errors = {name: [] for name in prepared}
    for _ in range(drives):
        fixed = truth[:, :2] + FIX * rng.standard_normal((POSES, 2))
        rolled = SE2.retract(moved, WHEELS * rng.standard_normal((POSES - 1, 3)))
        for name, (run, x, fixes, steps) in prepared.items():
            solution = run.solve({x: truth}, data={fixes: fixed, steps: rolled})
            errors[name].append(float(abs(solution[x][-1, 1] - truth[-1, 1])))
    return errors


def rolling(seed: int, drives: int) -> Errors:
    """Error of drag [1/(10 s)], for vehicles that roll with little of it and whose speed is measured."""
    rng = np.random.default_rng(seed)
    drag, speeds = rng.uniform(0.0, 0.03), np.empty(SPEEDS)
    speeds[0] = rng.uniform(1.0, 2.0)
    for k in range(SPEEDS - 1):
        speeds[k + 1] = speeds[k] * np.exp(-drag * H)

    def slower(v: Array, d: Array, after: Array) -> Array:
        return after - v * np.exp(-d * H)

    errors = Errors()
    noise = METER * rng.standard_normal((drives, SPEEDS, 1))
    ways: dict[str, fg.Solver] = {"measurements": GaussNewton(), "and air does not push": InteriorPoint()}
    for name, solver in ways.items():
        graph, v, d = graph_of(("v", fg.Rn(1), SPEEDS), ("d", fg.Rn(1), 1))
        measured = graph.data("measured", speeds[:, None], each=True)
        graph.minimize(fg.prior, v, measured, sigma=METER, name="meter")
        graph.minimize(slower, v[:-1], d, v[1:], sigma=0.02, name="rolling")
        if name != "measurements":
            graph.bound(d, lower=0.0)
        run = solver.prepare(graph)
        guess = {v: speeds[:, None], d: np.array([[0.01]])}
        found = [run.solve(guess, data={measured: speeds[:, None] + some})[d][0, 0] for some in noise]
        errors[name] = [float(10.0 * abs(value - drag)) for value in found]
    return errors


STUDIES: dict[str, Callable[[int, int], Errors]] = {"wall": along_a_wall, "drag": rolling}
UNITS = {"wall": "cm", "drag": "% of the speed lost in 10 s"}
