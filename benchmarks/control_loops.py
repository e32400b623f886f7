"""The control cases in closed loop: a hundred steps, converged and with one iteration a step."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from importlib.util import find_spec

import numpy as np

import unifg as fg
from benchmarks import compiled_peers
from benchmarks.closed_loop import WARM_IPOPT, Driver, Loop
from benchmarks.control_problems import Problem, Quadrotor, Unicycle
from benchmarks.report import table
from unifg.solvers import SQP, AugmentedLagrangian, InteriorPoint
from unifg.typing import Array

STEPS = 100
TOLERANCE = 1e-4
SINGLE = ("ipm, 1 iteration", "sqp, 1 iteration")
# Time of a step of acados (one SQP iteration, default options) over that of a converged step of IPOPT, measured
# elsewhere, both on one machine.
ACADOS = {
    "unicycle straight, N = 50": 0.124,
    "unicycle straight, discs, N = 50": 0.100,
    "unicycle behind, N = 50": 0.124,
    "unicycle behind, discs, N = 50": 0.088,
    "quadrotor figure8, N = 20": 0.040,
    "quadrotor figure8, spheres, N = 20": 0.068,
    "quadrotor goto, N = 20": 0.044,
    "quadrotor goto, spheres, N = 20": 0.050,
    "quadrotor figure8, N = 50": 0.051,
    "quadrotor figure8, spheres, N = 50": 0.090,
}
WORSE = 0.01  # cost of one iteration a step above the converged one by which a loop is named
CONTACT = 1e-4  # and depth in an obstacle [m]


class Ours:
    """A backend of ours, warm-started with its own shifted answers."""

    def __init__(self, solver: fg.Solver, problem: Problem, penalties: bool = True) -> None:
        """Prepare the graph; the first answer of a one-iteration driver is a converged one, as of every other.

        Args:
            solver: ours.
            problem: one of :func:`cases`.
            penalties: whether those of an augmented Lagrangian go from step to step, as multipliers do.
        """
        self._stated = problem.formulation()
        self._first = type(solver)(tolerance=TOLERANCE).prepare(self._stated.graph)
        self._run = solver.prepare(self._stated.graph)
        self._last: fg.Solution | None = None
        self._penalties = penalties

    def control(self, pose: Array, index: int) -> tuple[Array, float, int, str]:
        """First control, processor time of the solve [ms], iterations, and the status in words."""
        x, u = self._stated.x, self._stated.u
        start = self._stated.guess if self._last is None else self._last.shifted(x, u, by=1)
        if not self._penalties:
            start = replace(start, penalties={})
        data = self._stated.data(pose, index)
        run = self._first if self._last is None else self._run
        begin = time.thread_time()
        solution = run.solve(start, data=data)
        elapsed = 1e3 * (time.thread_time() - begin)
        self._last = solution
        self._call = run, start, data
        return solution[u][0], elapsed, solution.iterations, solution.status.name.lower().replace("_", " ")

    def again(self) -> float:
        """Processor time of the same solve, when everything it needs is in the caches [ms]."""
        run, start, data = self._call
        begin = time.thread_time()
        run.solve(start, data=data)
        return 1e3 * (time.thread_time() - begin)


def cases() -> list[Problem]:
    """Those the targets speak of, and the long horizon of the quadrotor."""
    problems: list[Problem] = [Unicycle(i, b, 50) for i in ("straight", "behind") for b in (False, True)]
    return (
        problems
        + [Quadrotor(i, b, 20) for i in ("figure8", "goto") for b in (False, True)]
        + [Quadrotor("figure8", b, 50) for b in (False, True)]
    )


@dataclass
class Drive(Loop):
    """What one solver made of one drive, and the times of every solve repeated at once.

    Attributes:
        repeated: [ms].
    """

    repeated: list[float] = field(default_factory=list)


def drivers(problem: Problem) -> dict[str, tuple[Driver, Callable[[], float]]]:
    """Ours, and casadi's where it is installed; each with what repeats its last solve."""
    ours = {
        "ipm": Ours(InteriorPoint(tolerance=TOLERANCE), problem),
        "ipm, 1 iteration": Ours(InteriorPoint(tolerance=TOLERANCE, max_iterations=1), problem),
        "sqp": Ours(SQP(tolerance=TOLERANCE), problem),
        "sqp, 1 iteration": Ours(SQP(tolerance=TOLERANCE, max_iterations=1), problem),
        "alm": Ours(AugmentedLagrangian(tolerance=TOLERANCE), problem),
        "alm, new penalties": Ours(AugmentedLagrangian(tolerance=TOLERANCE), problem, penalties=False),
    }
    found: dict[str, tuple[Driver, Callable[[], float]]] = {name: (o, o.again) for name, o in ours.items()}
    if find_spec("casadi") is not None:
        from benchmarks.control_peers import warm

        found["ipopt"] = warm(problem, "ipopt", tol=TOLERANCE, mu_init=1e-3, **WARM_IPOPT)
        found["fatrop"] = warm(problem, "fatrop", tol=TOLERANCE, mu_init=1e-3)
        if compiled_peers.COMPILER:
            found["fatrop, compiled"] = warm(problem, "fatrop", compiled=True, tol=TOLERANCE, mu_init=1e-3)
    return found


def drive(problem: Problem) -> dict[str, Drive]:
    """Drive every robot one step in turn: a slow moment of the machine meets all of them."""
    who = drivers(problem)
    loops, states = {name: Drive() for name in who}, dict.fromkeys(who, problem.start)
    controls: dict[str, Array] = {}
    for index in range(STEPS + 1):
        for name, (driver, again) in who.items():
            loop = loops[name]
            if index:
                loop.cost += problem.stage_cost(states[name], controls[name], index - 1)
                states[name] = problem.plant(states[name], controls[name], index - 1)
                for *centre, radius in problem.discs:
                    distance = float(np.linalg.norm(states[name][: len(centre)] - centre))
                    loop.penetration = max(loop.penetration, radius - distance)
            controls[name], elapsed, iterations, status = driver.control(states[name], index)
            if status != "converged" and name not in SINGLE:
                loop.failures[status] += 1
            if index:  # the cold solve is no step of the loop
                loop.times.append(elapsed)
                loop.iterations.append(iterations)
                loop.repeated.append(again())
    return loops


def render(results: Mapping[Problem, Mapping[str, Drive]]) -> str:
    """A table and what it means."""
    head = (
        "closed loop", "solver", "median [ms]", "p99 [ms]", "iterations, median", "mean", "most", "failures",
        "cost", "penetration [mm]", "times ipopt", "times fatrop", "times fatrop, compiled", "repeated [ms]",
        "times fatrop, repeated",
    )  # fmt: skip
    lines = []
    for problem, loops in results.items():
        for name, loop in loops.items():
            median = float(np.median(loop.times))
            ratios = [
                f"{median / float(np.median(loops[peer].times)):.2f}"
                if peer in loops and name not in (peer, "ipopt", "fatrop")
                else "-"
                for peer in ("ipopt", "fatrop", "fatrop, compiled")
            ]
            repeated = float(np.median(loop.repeated))
            peer = "fatrop" in loops and name not in ("ipopt", "fatrop")
            again = f"{repeated / float(np.median(loops['fatrop'].repeated)):.2f}" if peer else "-"
            failures = ", ".join(f"{count} {status}" for status, count in loop.failures.items())
            depth = f"{1e3 * loop.penetration:.4f}" if np.isfinite(loop.penetration) else "-"
            lines.append(
                (
                    f"{problem.robot} {problem.name}", name, f"{median:.3f}", f"{np.percentile(loop.times, 99):.3f}",
                    f"{np.median(loop.iterations):.0f}", f"{np.mean(loop.iterations):.1f}",
                    str(max(loop.iterations)), failures or "0",
                    f"{loop.cost:.4f}", depth, *ratios, f"{repeated:.3f}", again,
                )
            )  # fmt: skip
    notes = (
        f"{STEPS} steps, tolerance {TOLERANCE:.0e}, interleaved; the time is the processor time of the solve call, "
        "after a cold solve that is not counted. Warm start: values and multipliers moved by one stage, the last ones "
        "repeated (fatrop takes no multipliers); the augmented Lagrangian's penalties too, unless it chooses new ones. "
        "Where nothing can be hit the plant is disturbed. Cost: sum of the stage costs of the states and controls that "
        "happened. Penetration: deepest state of the plant in an obstacle, negative is a clearance. Repeated: the same "
        "solve once more, at once; the first time the other solvers have just used the caches. One iteration: the "
        "solver is stopped after a single one in every step."
    )
    return "\n\n".join([table(head, lines, text=2), notes])


def render_single(results: Mapping[Problem, Mapping[str, Drive]]) -> str:
    """One iteration a step, beside acados: a table and sentences computed from it."""
    lines, slower, named = [], {robot: 0.0 for robot in ("unicycle", "quadrotor")}, []
    for problem, loops in results.items():
        name = f"{problem.robot} {problem.name}"
        if "ipopt" not in loops or name not in ACADOS:
            continue
        yardstick, converged = float(np.median(loops["ipopt"].times)), loops["ipm"].cost
        times = [float(np.median(loops[single].times)) / yardstick for single in SINGLE]
        slower[problem.robot] = max(slower[problem.robot], times[0] / ACADOS[name])
        depths = [1e3 * loops[single].penetration for single in SINGLE]
        for single, depth in zip(SINGLE, depths, strict=True):
            above = loops[single].cost / converged - 1.0
            if above > WORSE or depth > 1e3 * CONTACT:
                deep = f", {depth:.2g} mm deep in an obstacle" if depth > 1e3 * CONTACT else ""
                named.append(f"`{single}` in {name} ({100.0 * above:+.1f} % cost{deep})")
        shown = " / ".join("clear" if depth <= 0.0 else f"{depth:.4f} mm" for depth in depths)
        lines.append(
            (
                name, f"{ACADOS[name]:.3f}", f"{times[0]:.2f}", f"{times[0] / ACADOS[name]:.1f}", f"{times[1]:.2f}",
                " / ".join(f"{loops[single].cost:.5g}" for single in SINGLE), f"{converged:.5g}",
                shown if len(problem.discs) else "none to hit",
            )
        )  # fmt: skip
    if not lines:
        return "One iteration a step is compared with acados through IPOPT, which is not installed."
    head = (
        "closed loop", "acados, times IPOPT", "ipm, times IPOPT", "ipm / acados", "sqp, times IPOPT",
        "cost: ipm / sqp", "converged", "deepest in an obstacle: ipm / sqp",
    )  # fmt: skip
    most = " and ".join(f"{value:.1f} times as long on the {robot}" for robot, value in slower.items())
    said = (
        f"One iteration of the interior point takes at most {most} as acados' SQP iteration. Loops in which one "
        f"iteration a step costs more than {100.0 * WORSE:.0f} % above the converged one, or ends deeper than "
        f"{1e3 * CONTACT:g} mm in an obstacle: {'; '.join(named) or 'none'}."
    )
    return "\n\n".join([table(head, lines), said])
