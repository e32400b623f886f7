"""The unicycle's problems for our backends and for casadi's, and a hundred closed-loop steps by each of them.

Every solver is warm-started with its own shifted answer. Driven by :mod:`benchmarks.reference_problems`.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import Any, Protocol

import numpy as np

import unifg as fg
from benchmarks.report import table
from benchmarks.unicycle_problems import Problem
from unifg.lie import wrap_angle
from unifg.models import obstacles, unicycle
from unifg.solvers.names import backends
from unifg.typing import Array

STEPS = 100
TOLERANCE = 1e-4  # of every solver in the loop
WARM_IPOPT: dict[str, Any] = {
    "warm_start_init_point": "yes",
    "warm_start_bound_push": 1e-6,
    "warm_start_bound_frac": 1e-6,
    "warm_start_slack_bound_push": 1e-6,
    "warm_start_slack_bound_frac": 1e-6,
    "warm_start_mult_bound_push": 1e-6,
}


class Formulation:
    """The problem as a factor graph whose start and references are data.

    Attributes:
        graph: the problem.
        x, u: poses and controls.
        guess: the cold guess.
    """

    def __init__(self, problem: Problem) -> None:
        """Build the graph."""
        n, dt = problem.horizon, problem.dt
        weights, effort_weights = problem.weights
        reference, cruise = problem.reference()
        self.problem = problem
        self.graph = graph = fg.Graph()
        self.x = x = graph.variables("pose", fg.SE2, n + 1)
        self.u = u = graph.variables("control", fg.Rn(2), n)
        self._start = graph.data("start", problem.start)
        self._stages = graph.data("stages", reference[:-1], each=True)
        self._end = graph.data("end", reference[-1])
        effort = graph.data("effort", cruise, each=True)
        graph.fix(x[0], self._start)
        graph.minimize(unicycle.tracking, x[:-1], self._stages, sigma=weights[0] ** -0.5, name="tracking")
        graph.minimize(unicycle.tracking, x[-1], self._end, sigma=weights[-1] ** -0.5, name="terminal")
        graph.minimize(fg.prior, u, effort, sigma=effort_weights**-0.5, name="effort")
        graph.constrain(unicycle.dynamics, x[:-1], u, x[1:], dt, lower=0.0, upper=0.0, name="dynamics")
        graph.bound(u, lower=-problem.limit, upper=problem.limit, name="limits")
        if problem.blocked:
            discs = problem.discs
            graph.constrain(obstacles.disc_clearance, x[1:], discs[:, :2], discs[:, 2], lower=0.0, name="discs")
        states, controls = problem.guess()
        self.guess = fg.Guess({x: states, u: controls})

    def data(self, pose: Array, first: int) -> dict[fg.Data, Array]:
        """The data of closed-loop step ``first``, begun at ``pose``."""
        reference, _ = self.problem.reference(first)
        start = np.array([pose[0], pose[1], wrap_angle(pose[2])])
        return {self._start: start, self._stages: reference[:-1], self._end: reference[-1]}


class Peer:
    """The same problem for a solver of casadi, in the order x_0, u_0, x_1, ... from which fatrop sees the stages.

    Attributes:
        problem: what it solves.
        answer: of the last solve, with multipliers.
    """

    def __init__(self, problem: Problem, plugin: str, **options: Any) -> None:
        """Build and differentiate the expressions; start and reference states are parameters."""
        import casadi as ca

        n, dt = problem.horizon, problem.dt
        weights, effort = problem.weights
        x, u = [ca.SX.sym("x", 3) for _ in range(n + 1)], [ca.SX.sym("u", 2) for _ in range(n)]
        start, reference = ca.SX.sym("start", 3), ca.SX.sym("reference", 3, n + 1)
        _, cruise = problem.reference()
        cost: Any = 0.0
        rows: list[Any] = []
        equality: list[bool] = []
        for k in range(n + 1):
            error = x[k] - reference[:, k]
            cost += 0.5 * ca.dot(ca.DM(weights[k]) * error, error)
            if k < n:
                deviation = u[k] - cruise[k]
                cost += 0.5 * ca.dot(ca.DM(effort) * deviation, deviation)
                heading = x[k][2] + 0.5 * dt * u[k][1]
                moved = ca.vertcat(dt * u[k][0] * ca.cos(heading), dt * u[k][0] * ca.sin(heading), dt * u[k][1])
                rows.append(x[k + 1] - (x[k] + moved))
                equality += [True] * 3
            if k == 0:
                rows.append(x[0] - start)
                equality += [True] * 3
            else:
                # Squared distances: the plain ones have no derivative at a centre.
                rows += [ca.sumsqr(x[k][:2] - disc[:2]) - disc[2] ** 2 for disc in problem.discs]
                equality += [False] * len(problem.discs)
        unknowns = ca.vertcat(*(part for pair in zip(x[:-1], u, strict=True) for part in pair), x[-1])
        program = {"x": unknowns, "p": ca.vertcat(start, ca.vec(reference)), "f": cost, "g": ca.vertcat(*rows)}
        chosen: dict[str, Any] = {"print_time": False, plugin: {"print_level": 0, "tol": 1e-6, **options}}
        if plugin == "fatrop":
            chosen |= {"structure_detection": "auto", "equality": equality}
        else:
            chosen[plugin]["sb"] = "yes"
        self.problem = problem
        self._solver: Any = ca.nlpsol("solver", plugin, program, chosen)
        self._made = plugin, chosen
        bound = np.append(np.tile([np.inf] * 3 + [problem.limit] * 2, n), [np.inf] * 3)
        upper = np.where(equality, 0.0, np.inf)
        self._limits = {"lbx": -bound, "ubx": bound, "lbg": 0.0, "ubg": upper}
        self.answer: dict[str, Any] = {}

    def compile(self) -> None:
        """Evaluate its functions in machine code from now on."""
        from benchmarks.compiled_peers import compiled

        self._solver = compiled(self._solver, *self._made)

    def solve(self, states: Array, controls: Array, pose: Array | None = None, first: int = 0, **duals: Any) -> float:
        """Solve from a guess; returns the processor time of the call [ms]: a shared machine makes clocks run late."""
        reference, _ = self.problem.reference(first)
        start = self.problem.start if pose is None else pose
        unknowns = np.append(np.hstack([states[:-1], controls]).ravel(), states[-1])
        parameters = np.append(start, reference.ravel())
        begin = time.thread_time()
        self.answer = self._solver(x0=unknowns, p=parameters, **self._limits, **duals)
        return 1e3 * (time.thread_time() - begin)

    @property
    def status(self) -> str:
        """In words."""
        statistics = self._solver.stats()
        return "converged" if statistics["success"] else str(statistics.get("return_status", "failed"))

    @property
    def iterations(self) -> int:
        """Of the last solve."""
        return int(self._solver.stats()["iter_count"])

    @property
    def cost(self) -> float:
        """Of the last answer."""
        return float(self.answer["f"])

    @property
    def trajectory(self) -> tuple[Array, Array]:
        """States (N + 1, 3) and controls (N, 2) of the last answer."""
        unknowns = np.append(np.asarray(self.answer["x"]).ravel(), np.zeros(2)).reshape(-1, 5)
        return unknowns[:, :3], unknowns[:-1, 3:]


class Driver(Protocol):
    """A solver that keeps its last answer for the next step."""

    def control(self, pose: Array, index: int) -> tuple[Array, float, int, str]:
        """First control (2,), processor time of the solve [ms], iterations, and the status in words."""
        ...


class Ours:
    """A backend of ours: structure and workspaces kept, start and references given as data."""

    def __init__(self, solver: fg.Solver, formulation: Formulation) -> None:
        """Prepare the graph."""
        self._formulation = formulation
        self._run = solver.prepare(formulation.graph)
        self._last: fg.Solution | None = None

    def control(self, pose: Array, index: int) -> tuple[Array, float, int, str]:
        """Cold the first time, then from the shifted primal-dual answer."""
        x, u = self._formulation.x, self._formulation.u
        start = self._formulation.guess if self._last is None else self._last.shifted(x, u, by=1)
        data = self._formulation.data(pose, index)
        begin = time.thread_time()
        solution = self._run.solve(start, data=data)
        elapsed = 1e3 * (time.thread_time() - begin)
        self._last = solution
        return solution[u][0], elapsed, solution.iterations, solution.status.name.lower().replace("_", " ")


class Warm:
    """A solver of casadi with the same shift."""

    def __init__(self, peer: Peer) -> None:
        """Take a peer whose options suit a warm start."""
        self._peer = peer
        discs = len(peer.problem.discs)
        # Rows of g as the peer lists them: 3 gaps and 3 of the start, then 3 gaps and the discs, at last the discs.
        stages = np.arange(peer.problem.horizon - 1)
        self._gaps = np.concatenate([[0], 6 + (3 + discs) * stages])
        self._discs = np.append(6 + (3 + discs) * stages + 3, 6 + (3 + discs) * len(stages))

    def control(self, pose: Array, index: int) -> tuple[Array, float, int, str]:
        """Cold the first time, then shifted."""
        peer = self._peer
        if not peer.answer:
            elapsed = peer.solve(*peer.problem.guess(), pose, index)
        else:
            states, controls = (np.vstack([part[1:], part[-1:]]) for part in peer.trajectory)
            states[0] = pose
            elapsed = peer.solve(states, controls, pose, index, lam_g0=self._rows(), lam_x0=self._bounds())
        return peer.trajectory[1][0], elapsed, peer.iterations, peer.status

    def _rows(self) -> Array:
        old = np.asarray(self._peer.answer["lam_g"]).ravel()
        new = old.copy()
        for first, size in ((self._gaps, 3), (self._discs, len(self._peer.problem.discs))):
            rows = first[:, None] + np.arange(size)
            new[rows[:-1]] = old[rows[1:]]
        return new

    def _bounds(self) -> Array:
        new = np.asarray(self._peer.answer["lam_x"]).ravel().copy()
        new[: -3 - 5] = new[5:-3].copy()
        return new


@dataclass
class Loop:
    """What one solver made of one drive.

    Attributes:
        times: of the solves after the first [ms].
        iterations: of the same.
        failures: solves that did not converge, by status, the first included.
        cost: sum of the stage costs.
        penetration: deepest of the poses in a disc [m]; negative is a clearance.
    """

    times: list[float] = field(default_factory=list)
    iterations: list[int] = field(default_factory=list)
    failures: Counter[str] = field(default_factory=Counter)
    cost: float = 0.0
    penetration: float = -np.inf


def drive(problem: Problem) -> dict[str, Loop]:
    """Drive every robot one step in turn: a slow moment of the machine meets all of them."""
    ours = backends("ipm", "alm", "sqp", tolerance=TOLERANCE)
    drivers: dict[str, Driver] = {name: Ours(solver, Formulation(problem)) for name, solver in ours.items()}
    if find_spec("casadi") is not None:
        drivers["ipopt"] = Warm(Peer(problem, "ipopt", tol=TOLERANCE, mu_init=1e-3, **WARM_IPOPT))
        drivers["fatrop"] = Warm(Peer(problem, "fatrop", tol=TOLERANCE, mu_init=1e-3))
    loops = {name: Loop() for name in drivers}
    poses = dict.fromkeys(drivers, problem.start)
    controls: dict[str, Array] = {}
    for index in range(STEPS + 1):
        for name, driver in drivers.items():
            loop = loops[name]
            if index:
                loop.cost += problem.stage_cost(poses[name], controls[name], index - 1)
                poses[name] = problem.plant(poses[name], controls[name], index - 1)
                for *centre, radius in problem.discs:
                    depth = radius - float(np.linalg.norm(poses[name][:2] - centre))
                    loop.penetration = max(loop.penetration, depth)
            controls[name], elapsed, iterations, status = driver.control(poses[name], index)
            if status != "converged":
                loop.failures[status] += 1
            if index:  # the cold solve is no step of the loop
                loop.times.append(elapsed)
                loop.iterations.append(iterations)
    return loops


def render(results: Mapping[Problem, Mapping[str, Loop]]) -> str:
    """A table and what it means."""
    head = (
        "closed loop", "solver", "median [ms]", "p99 [ms]", "iterations, median", "iterations, most", "failures",
        "cost", "penetration [mm]", "times ipopt", "times fatrop",
    )  # fmt: skip
    lines = []
    for problem, loops in results.items():
        for name, loop in loops.items():
            median = float(np.median(loop.times))
            ratios = [
                f"{median / float(np.median(loops[peer].times)):.2f}"
                if peer in loops and name not in ("ipopt", "fatrop")
                else "-"
                for peer in ("ipopt", "fatrop")
            ]
            failures = ", ".join(f"{count} {status}" for status, count in loop.failures.items())
            depth = f"{1e3 * loop.penetration:.4f}" if np.isfinite(loop.penetration) else "-"
            lines.append(
                (
                    problem.name, name, f"{median:.1f}", f"{np.percentile(loop.times, 99):.1f}",
                    f"{np.median(loop.iterations):.0f}", str(max(loop.iterations)), failures or "0",
                    f"{loop.cost:.4f}", depth, *ratios,
                )
            )  # fmt: skip
    notes = (
        f"{STEPS} steps, tolerance {TOLERANCE:.0e}, interleaved; the time is the processor time of the solve call, "
        "after a cold solve that is not counted. Warm start: values and multipliers moved by one stage, the last "
        "ones repeated (fatrop takes no multipliers). Without discs the plant is disturbed by d(i) = 0.01 (sin 1.7"
        " i, cos 2.3 i, sin 3.1 i). Cost: sum of the stage costs of the poses and controls that happened. "
        "Penetration: deepest pose of the plant in a disc, negative is a clearance. Failures are driven on."
    )
    return "\n\n".join([table(head, lines, text=2), notes])
