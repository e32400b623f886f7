"""Two manoeuvres that are not programmed: reversing out of a wrong heading, and deflecting around a disc.

Each is one control graph solved once, cold, from a guess that the robot cannot drive (Bazzana et al. 2022, section
VII-B and Fig. 7). In ``behind`` the path to follow leaves behind the robot's back; in ``obstacle`` it leads straight
through an unforeseen disc. Every iterate is kept for the picture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

import unifg as fg
from unifg.models import obstacles, unicycle
from unifg.scenarios.logs import metrics
from unifg.solution.solve_state import Callback
from unifg.solvers import names
from unifg.typing import Array

__all__ = [
    "CASES",
    "Case",
    "Manoeuvre",
    "ManoeuvreSettings",
    "case_metrics",
    "run_manoeuvre",
    "state_problem",
    "table",
]

AT_REST = 1e-3  # [m/s] and [rad/s]; smaller controls have no sign worth counting
ROUNDING = 1e-6  # by which a limit may seem exceeded
SUBSTEPS = 10  # looks at the way between two nodes


@dataclass(frozen=True)
class ManoeuvreSettings:
    """Numbers shared by the manoeuvres. Weights multiply half the square of an error.

    Attributes:
        horizon: steps N.
        dt: sampling time Ts [s].
        limits: greatest |v| [m/s] and |omega| [rad/s].
        robot_radius: [m].
        clearance: least distance of the hull to discs at the nodes [m]; between nodes the hull may come nearer by
            the sagitta of one step, 3 mm at most here.
        path: weights of the deviation (x, y, theta) at each node [1/m^2, 1/m^2, 1/rad^2].
        end: the same at the last node.
        effort: weights of the deviation of (v, omega) from the reference control [s^2/m^2, s^2/rad^2].
        change: weights of the change of (v, omega) from one sample to the next.
        tolerance: of the KKT test.
        max_iterations: of the backend.
    """

    horizon: int = 50
    dt: float = 0.1
    limits: tuple[float, float] = (1.0, 1.0)
    robot_radius: float = 0.17
    clearance: float = 0.03
    path: tuple[float, float, float] = (10.0, 10.0, 1.0)
    end: tuple[float, float, float] = (50.0, 50.0, 5.0)
    effort: tuple[float, float] = (0.1, 0.1)
    change: tuple[float, float] = (2.0, 2.0)
    tolerance: float = 1e-6
    max_iterations: int = 300


@dataclass(frozen=True)
class Case:
    """Difficulty of one manoeuvre.

    Attributes:
        name: on the command line and in file names.
        title: what is asked of the robot.
        start: pose of the robot [m, m, rad].
        heading: direction in which the straight path leaves the origin [rad].
        speed: along the path [m/s].
        discs: x, y, radius of each disc [m].
    """

    name: str
    title: str
    start: tuple[float, float, float]
    heading: float
    speed: float
    discs: tuple[tuple[float, float, float], ...] = ()

    def reference(self, settings: ManoeuvreSettings) -> Array:
        """(N + 1, 3) poses along the path, a step's travel apart [m, m, rad]."""
        way = self.speed * settings.dt * np.arange(settings.horizon + 1)
        heading = np.full_like(way, self.heading)
        return np.column_stack([way * np.cos(self.heading), way * np.sin(self.heading), heading])


CASES = {
    "behind": Case(
        "behind", "the path leads away behind the robot's back", start=(0.0, 0.0, 0.3), heading=np.pi, speed=0.5
    ),
    "obstacle": Case(
        "obstacle",
        "the path leads straight through an unforeseen disc",
        start=(0.0, 0.0, 0.0),
        heading=0.0,
        speed=0.7,
        discs=((1.75, -0.05, 0.35),),
    ),
}
"""The manoeuvres by name."""


def state_problem(case: Case, settings: ManoeuvreSettings) -> tuple[fg.Graph, fg.Family, fg.Family, fg.Guess]:
    """The control graph of a case.

    Returns:
        The graph, its poses, its controls, and the cold guess: the reference itself after the true start.
    """
    s = settings
    reference = case.reference(s)
    cruise = np.array([case.speed, 0.0])
    graph = fg.Graph()
    x = graph.variables("pose", fg.SE2, s.horizon + 1)
    u = graph.variables("control", fg.Rn(2), s.horizon)
    graph.fix(x[0], case.start)
    graph.minimize(unicycle.tracking, x[:-1], reference[:-1], information=np.diag(s.path), name="path")
    graph.minimize(unicycle.tracking, x[-1], reference[-1], information=np.diag(s.end), name="end of path")
    graph.minimize(fg.prior, u, cruise, information=np.diag(s.effort), name="effort")
    graph.minimize(unicycle.rate, u[:-1], u[1:], information=np.diag(s.change), name="change")
    graph.constrain(unicycle.dynamics, x[:-1], u, x[1:], s.dt, lower=0.0, upper=0.0, name="dynamics")
    graph.bound(u, lower=[-limit for limit in s.limits], upper=s.limits, name="limits")
    if case.discs:
        discs = np.array(case.discs)
        kept = s.robot_radius + s.clearance
        graph.constrain(obstacles.disc_clearance, x[1:], discs[:, :2], discs[:, 2], lower=kept, name="discs")
    states = reference.copy()
    states[0] = case.start
    return graph, x, u, fg.Guess({x: states, u: np.tile(cruise, (s.horizon, 1))})


@dataclass(frozen=True)
class Manoeuvre:
    """One solved case.

    Attributes:
        case: what was asked.
        settings: the numbers.
        solver: one of `unifg.solvers.names.CONSTRAINED`.
        solution: with its history.
        states: (N + 1, 3) poses of the solution [m, m, rad].
        controls: (N, 2) controls of the solution [m/s, rad/s].
        iterates: (iterations + 1, N + 1, 3) poses of every iterate, the guess first.
    """

    case: Case
    settings: ManoeuvreSettings
    solver: str
    solution: fg.Solution
    states: Array
    controls: Array
    iterates: Array

    @property
    def time(self) -> Array:
        """(N + 1,) time of each node [s]."""
        return self.settings.dt * np.arange(self.settings.horizon + 1, dtype=np.float64)

    @property
    def cusps(self) -> list[int]:
        """Nodes at which the robot passes from driving backward to driving forward, or the other way."""
        return _reversals(self.controls[:, 0])

    @property
    def inflections(self) -> list[int]:
        """Nodes at which the turning speed changes sign."""
        return _reversals(self.controls[:, 1])

    @property
    def clearance(self) -> Array:
        """(N + 1,) distance of the hull to the nearest disc at each node [m]; infinite without discs."""
        return self.gaps(self.states)

    @property
    def clearance_between(self) -> float:
        """Least distance of the hull to the discs on the whole way, also between nodes [m]."""
        parts = np.arange(SUBSTEPS) / SUBSTEPS * self.settings.dt
        way = [unicycle.step(self.states[:-1], self.controls, part) for part in parts]
        return float(self.gaps(np.concatenate([*way, self.states[-1:]])).min())

    @property
    def within_limits(self) -> bool:
        """True if speeds and clearance keep their limits at every node."""
        s = self.settings
        slow = bool((np.abs(self.controls) <= np.array(s.limits) + ROUNDING).all())
        return slow and bool((self.clearance[1:] >= s.clearance - ROUNDING).all())

    @property
    def succeeded(self) -> bool:
        """True if the solver converged and every limit is kept."""
        return self.solution.converged and self.within_limits

    def gaps(self, states: Array) -> Array:
        """(n,) distances of the hull at states (n, 2 or 3) from the nearest disc [m]; infinite without discs."""
        if not self.case.discs:
            return np.full(len(states), np.inf)
        discs = np.array(self.case.discs)
        gaps = np.linalg.norm(states[:, None, :2] - discs[None, :, :2], axis=2) - discs[:, 2]
        nearest: Array = gaps.min(axis=1) - self.settings.robot_radius
        return nearest


def run_manoeuvre(
    case: Case, solver: str = "sqp", settings: ManoeuvreSettings | None = None, progress: Callback | None = None
) -> Manoeuvre:
    """Solve one case from its cold guess.

    Args:
        case: one of `CASES`, or another.
        solver: one of `unifg.solvers.names.CONSTRAINED`.
        settings: None for the defaults.
        progress: called with every row of the history; returning True ends the solve.

    Raises:
        BackendError: for an unknown solver.
    """
    settings = settings or ManoeuvreSettings()
    options = {"tolerance": settings.tolerance, "max_iterations": settings.max_iterations, "keep_values": True}
    backend = names.backend(solver, **options)
    graph, x, u, guess = state_problem(case, settings)
    solution = backend.solve(graph, guess, callback=progress)
    iterates = np.stack([row.values[x] for row in solution.history if row.values is not None])
    return Manoeuvre(case, settings, solver, solution, solution[x], solution[u], iterates)


def case_metrics(manoeuvre: Manoeuvre) -> dict[str, Any]:
    """Numbers of one manoeuvre; clearances are None without discs; only ``solve_ms`` depends on the clock."""
    m, solution = manoeuvre, manoeuvre.solution
    speed, turning = np.abs(m.controls).max(axis=0).tolist()
    end = m.states[-1] - m.case.reference(m.settings)[-1]
    blocked = bool(m.case.discs)
    return {
        **metrics.of_solution(solution),
        "within_limits": m.within_limits,
        "cusps": len(m.cusps),
        "cusp_times_s": m.time[m.cusps].round(9).tolist(),
        "inflection_times_s": m.time[m.inflections].round(9).tolist(),
        "max_speed_m_s": speed,
        "max_turn_rate_rad_s": turning,
        "min_clearance_m": float(m.clearance.min()) if blocked else None,
        "min_clearance_between_nodes_m": m.clearance_between if blocked else None,
        "end_error_m": float(np.hypot(end[0], end[1])),
        "end_error_rad": float(abs(fg.wrap_angle(end[2]))),
    }


def metrics_of(manoeuvres: Sequence[Manoeuvre]) -> dict[str, Any]:
    """The numbers of all cases."""
    return {
        "scenario": "manoeuvres",
        "solver": manoeuvres[0].solver,
        "cases": {m.case.name: case_metrics(m) for m in manoeuvres},
    }


def table(manoeuvres: Sequence[Manoeuvre]) -> str:
    """The outcome for people, one column per case."""
    columns = [_column(m) for m in manoeuvres]
    return metrics.table((name, *(column[name] for column in columns)) for name in columns[0])


def _column(manoeuvre: Manoeuvre) -> dict[str, str]:
    numbers, limits = case_metrics(manoeuvre), manoeuvre.settings.limits
    return {
        "case": manoeuvre.case.name,
        "solver": manoeuvre.solver,
        "status": numbers["status"].replace("_", " "),
        "iterations": f"{numbers['iterations']} in {numbers['solve_ms']:.0f} ms",
        "cost": f"{numbers['cost']:.5f}",
        "stationarity, violation": f"{numbers['stationarity']:.1e}, {numbers['violation']:.1e}",
        "cusps (v changes sign)": _at(numbers["cusp_times_s"]),
        "omega changes sign": _at(numbers["inflection_times_s"]),
        "greatest |v|": f"{numbers['max_speed_m_s']:.6f} of {limits[0]:g} m/s",
        "greatest |omega|": f"{numbers['max_turn_rate_rad_s']:.6f} of {limits[1]:g} rad/s",
        "least clearance of hull": _metres(numbers["min_clearance_m"]),
        "  also between nodes": _metres(numbers["min_clearance_between_nodes_m"]),
        "end of path missed by": f"{numbers['end_error_m']:.3f} m, {numbers['end_error_rad']:.3f} rad",
        "all limits kept": "yes" if numbers["within_limits"] else "NO",
    }


def _reversals(values: Array) -> list[int]:
    """Indices of the first samples of a new sign; those too small to have one count for neither."""
    signed = np.flatnonzero(np.abs(values) > AT_REST)
    changes = np.flatnonzero(np.diff(np.sign(values[signed])) != 0.0)
    return [int(k) for k in signed[changes + 1]]


def _at(times: list[float]) -> str:
    return f"{len(times)}, at " + ", ".join(f"{t:.1f}" for t in times) + " s" if times else "0"


def _metres(value: float | None) -> str:
    return "no discs" if value is None else f"{value:.4f} m"
