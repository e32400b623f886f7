"""Cost of functions of one's own: control problems stated with plain functions, beside shipped kernels and fatrop.

The same problems with the same solver, the interior point, with their dynamics, costs and clearances as they ship, as
batched NumPy functions, as functions of one factor under ``numba.njit``, and as NumPy functions that are differenced in
batches. Each way is stated in a new process, which measures the time from the first statement to the first answer
where compiled functions are in the cache.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
import time
from typing import Any, Literal

import numba
import numpy as np
from tqdm import tqdm

import unifg as fg
from benchmarks.cold import TOLERANCE, Contestant, Ours, outcomes, peer, runnable
from benchmarks.report import CHECKOUT, table
from benchmarks.runner import Timing
from benchmarks.timing import number, ratio, shown
from problems.cart_pole import CartPole, CartPoleGraph, cart_pole_dynamics, cart_pole_dynamics_of_one
from problems.control import Problem, Quadrotor, QuadrotorGraph, Stated, Unicycle, UnicycleGraph
from unifg.lie import wrap_angle
from unifg.models.quadrotor import GRAVITY
from unifg.solvers import InteriorPoint
from unifg.typing import Array

WAYS = ("shipped", "numpy", "njit", "differences")
NAMES = {
    "shipped": "shipped",
    "numpy": "NumPy function",
    "njit": "`@njit` function",
    "differences": 'NumPy function, `derivatives="differences"`',
    "fatrop": "fatrop",
    "fatrop, compiled": "fatrop, compiled",
}


# ---------------------------------------------------------------- the unicycle


def tracking(x: Array, reference: Array) -> Array:
    """(n, 3) deviation from reference poses in world axes."""
    return np.concatenate([x[:, :2] - reference[..., :2], wrap_angle(x[:, 2:] - reference[..., 2:])], axis=1)


def dynamics(x: Array, u: Array, after: Array, dt: float) -> Array:
    """(n, 3) defect of the midpoint rule in world axes."""
    middle = x[:, 2] + 0.5 * dt * u[:, 1]
    moved = dt * u[:, :1] * np.stack([np.cos(middle), np.sin(middle)], axis=1)
    turned = wrap_angle(after[:, 2] - x[:, 2] - dt * u[:, 1])
    return np.concatenate([after[:, :2] - x[:, :2] - moved, turned[:, None]], axis=1)


def clearance(x: Array, centres: Array, radii: Array) -> Array:
    """(n, M) distance to discs."""
    distance: Array = np.linalg.norm(x[:, None, :2] - centres, axis=2)
    return distance - radii


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def tracking_of_one(x: Array, reference: Array, r: Array) -> None:
    """The same for one factor."""
    r[0], r[1] = x[0] - reference[0], x[1] - reference[1]
    turn = x[2] - reference[2]
    r[2] = math.atan2(math.sin(turn), math.cos(turn))


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def dynamics_of_one(x: Array, u: Array, after: Array, dt: float, r: Array) -> None:
    """The same for one factor."""
    middle = x[2] + 0.5 * dt * u[1]
    r[0] = after[0] - x[0] - dt * u[0] * math.cos(middle)
    r[1] = after[1] - x[1] - dt * u[0] * math.sin(middle)
    turn = after[2] - x[2] - dt * u[1]
    r[2] = math.atan2(math.sin(turn), math.cos(turn))


# ---------------------------------------------------------------- the quadrotor


def quadrotor_dynamics(x: Array, u: Array, after: Array, parameters: Array, dt: float) -> Array:
    """(n, 9) defect of the trapezoid; drag and wind of the shipped one are zero here, the mass is one."""

    def force(state: Array) -> Array:
        w, a, b, c = state[:, 3], state[:, 4], state[:, 5], state[:, 6]
        up = np.stack([2.0 * (a * c + w * b), 2.0 * (b * c - w * a), 1.0 - 2.0 * (a * a + b * b)], axis=1)
        return np.asarray(u[:, 3:] * up - np.array([0.0, 0.0, GRAVITY]))

    turned = fg.SO3.log(fg.SO3.between(x[:, 3:7], after[:, 3:7])) - dt * u[:, :3]
    moved = after[:, :3] - x[:, :3] - 0.5 * dt * (x[:, 7:] + after[:, 7:])
    pushed = after[:, 7:] - x[:, 7:] - 0.5 * dt * (force(x) + force(after))
    return np.concatenate([moved, turned, pushed], axis=1)


# ---------------------------------------------------------------- ways


def _residuals(way: str, functions: dict[str, tuple[Any, Any, int]]) -> dict[str, Any]:
    """Class attributes of a graph."""
    if way == "shipped":
        return {}
    if way == "njit":
        return {name: fg.residual(one, rows=rows) for name, (_, one, rows) in functions.items() if rows}
    forced: Literal["differences"] | None = "differences" if way == "differences" else None
    return {name: fg.residual(batched, derivatives=forced) for name, (batched, _, _) in functions.items()}


OWN: dict[type[Problem], tuple[type[Stated], dict[str, tuple[Any, Any, int]]]] = {
    Quadrotor: (QuadrotorGraph, {"dynamics": (quadrotor_dynamics, None, 9)}),
    CartPole: (CartPoleGraph, {"dynamics": (cart_pole_dynamics, cart_pole_dynamics_of_one, 4)}),
    Unicycle: (UnicycleGraph, {
        "tracking": (tracking, tracking_of_one, 3), "dynamics": (dynamics, dynamics_of_one, 3),
        "clearance": (clearance, None, 0),
    }),
}  # fmt: skip
"""Graph of each robot and, by attribute, the NumPy function, the one of one factor, and its rows."""


def stated(problem: Problem, way: str) -> Stated:
    """A problem with its functions stated in one of the ways of :data:`NAMES`."""
    kind, functions = next(own for robot, own in OWN.items() if isinstance(problem, robot))
    graph: Stated = type("Own", (kind,), _residuals(way, functions))(problem)
    return graph


def problems() -> dict[str, Problem]:
    """Problems by title."""
    found: list[Problem] = [
        Unicycle("straight", False, 50),
        Unicycle("straight", True, 50),
        Unicycle("ahead", True, 50),
    ]
    found += [Quadrotor("figure8", False, 20), Quadrotor("figure8", True, 20), CartPole("upright", False, 30)]
    return {problem.title: problem for problem in found}


def ways(problem: Problem) -> list[str]:
    """The ways a problem can be stated."""
    shipped, compiled = type(problem) is not CartPole, type(problem) is not Quadrotor and not problem.blocked
    return [way for way, there in zip(WAYS, (shipped, True, compiled, True), strict=True) if there]


# ---------------------------------------------------------------- what is measured


def first_answer(title: str, way: str) -> tuple[float, float]:
    """Processor time [s] to state and prepare a problem, and to solve it the first time; for a process of its own."""
    problem = problems()[title]
    begin = time.process_time()
    built = stated(problem, way)
    run = InteriorPoint(tolerance=TOLERANCE).prepare(built.graph)
    ready = time.process_time()
    run.solve(built.guess)
    return ready - begin, time.process_time() - ready


def _in_a_process(title: str, way: str) -> tuple[float, float]:
    code = (
        f"import json; from benchmarks import own_functions as o; print(json.dumps(o.first_answer({title!r}, {way!r})))"
    )
    run = subprocess.run([sys.executable, "-c", code], cwd=CHECKOUT, capture_output=True, text=True, check=True)
    first, second = json.loads(run.stdout.splitlines()[-1])
    return first, second


def cold(title: str, problem: Problem, rounds: int) -> list[tuple[str, ...]]:
    """Rows of every way, and of fatrop, interleaved."""
    contestants: dict[str, Contestant] = {}
    for way in ways(problem):
        own = stated(problem, way)
        contestants[way] = Ours(InteriorPoint(tolerance=TOLERANCE), own.graph, own.guess)
    contestants |= {name: peer(problem, name) for name in runnable(("fatrop", "fatrop, compiled"))}
    found, rows = outcomes(problem, contestants, rounds, slow=0.1), []
    for way, one in found.items():
        first = _in_a_process(title, way) if way in ways(problem) else (math.nan, math.nan)
        beside = ratio(one.times, found["fatrop"].times) if "fatrop" in found else None
        told = *map(number, (*first, one.median)), shown(beside)
        rows.append((title, NAMES[way], one.status, str(one.iterations), *told))
    return rows


def tables(rounds: int) -> str:
    """Every way of every problem."""
    rows = [row for title, one in tqdm(problems().items(), unit="problem") for row in cold(title, one, rounds)]
    head = ("problem", "functions", "status", "iterations", "to prepared [s]", "first solve [s]", "solve [ms]")
    notes = (
        f"Tolerance {TOLERANCE:.0e}, median processor time of {rounds} interleaved solves; ratios with 95 % intervals. "
        "To prepared and first solve: processor time in a new process whose compiled functions are in the cache."
    )
    return f"{table((*head, 'times fatrop'), rows, 3)}\n\n{notes}"


STUDY = Timing(tables, 20)
