"""Figure eight past three spheres at 100 Hz: time of a tick by the form of its barriers and by backend.

The flight of tests/problems/guarded_flight.py in closed loop, under gusts; processor time of the solve of each tick,
warm.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

import unifg as fg
from benchmarks.report import listing, words
from benchmarks.runner import Timing
from benchmarks.timing import clocked
from problems.guarded_flight import PACE, START, VEHICLE, GuardedFlight, figure_eight, gust
from unifg.models import keeping, quadrotor
from unifg.solvers import SQP, AugmentedLagrangian, InteriorPoint

LIMIT = 0.01  # [s]
TOLERANCE = 1e-4
WARM = 100  # ticks that are flown and not counted
SHORT = 40  # of how many ticks slow backends fly one
AWAY = np.repeat([0.25, 0.2, 0.8], 3)  # standard deviations of cold starts from the reference [m, rad, m/s]
MATTERS = 1e-3  # of a slack [m]
KEPT = 1e-3  # violation of constraints up to which an iterate is a plan


@dataclass
class Flight:
    """Record of the ticks of one flight, or of cold starts, which have no motion.

    Attributes:
        times: of the solves [ms].
        iterations: of the solves.
        statuses: numbers of solves by status.
        without: ticks without a plan of their own.
        clearance: at the ticks [m].
        lost: of the barrier from tick to tick beyond its share [m].
        slack: the most in the plan of a tick [m].
        error: distance from the reference [m].
    """

    times: list[float] = field(default_factory=list)
    iterations: list[int] = field(default_factory=list)
    statuses: Counter[str] = field(default_factory=Counter)
    without: int = 0
    clearance: list[float] = field(default_factory=list)
    lost: list[float] = field(default_factory=list)
    slack: list[float] = field(default_factory=list)
    error: list[float] = field(default_factory=list)

    def add(self, case: GuardedFlight, solution: fg.Solution, milliseconds: float) -> None:
        """Record a solve."""
        self.times.append(milliseconds)
        self.iterations.append(solution.iterations)
        self.statuses[words(solution.status)] += 1
        if case.kept is not None and case.kept.slack is not None:
            self.slack.append(float(solution[case.kept.slack].max()))


def fly(case: GuardedFlight, solver: fg.Solver, ticks: int) -> Flight:
    """Fly for so many ticks; where a solve ends without a plan the last one is flown on, and the next begins there."""
    run, seen = solver.prepare(case.graph), Flight()
    state, plan, age = START.copy(), cold(case), 0
    for tick in range(-WARM, ticks):
        now = (tick + WARM) * case.tick
        data = case.data(state, now)
        solution, taken = clocked(run.solve, plan if age == 0 else plan.values, data=data)
        before = case.clearance(state[None])[0]
        plan, age = (solution, 0) if solution.violation < KEPT else (plan, age + 1)
        interval = min(int(np.searchsorted(case.times, (age + 0.5) * case.tick)), case.intervals) - 1
        state = quadrotor.fly(state, plan[case.u][interval], case.tick, VEHICLE, gust(now), substeps=2)
        after = case.clearance(state[None])[0]
        if tick >= 0:
            seen.add(case, solution, 1e3 * taken)
            seen.without += age > 0
            seen.clearance.append(after)
            seen.lost.append(np.exp(-case.alpha * case.tick) * before - after)
            seen.error.append(float(np.linalg.norm(state[:3] - figure_eight(np.array([now + case.tick]))[0][0, :3])))
    return seen


def cold(case: GuardedFlight) -> fg.Solution:
    """The answer of the first tick, by a backend without limit."""
    return InteriorPoint(tolerance=TOLERANCE).solve(case.graph, case.guess(), data=case.data(START, 0.0))


def flights(ticks: int) -> dict[tuple[str, str], Callable[[], Flight]]:
    """All of them."""
    found: dict[tuple[str, str], Callable[[], Flight]] = {}
    forms: dict[str, keeping.Form | None] = {
        "none": None, "hinge": "hinge", "hard": "hard", "slack, squared": "slack", "slack, exact": "exact slack",
    }  # fmt: skip

    def state(barriers: str, name: str, solver: fg.Solver, count: int) -> None:
        found[barriers, name] = lambda: fly(GuardedFlight(forms[barriers]), solver, count)

    for barriers in forms:
        state(barriers, "InteriorPoint", InteriorPoint(tolerance=TOLERANCE), ticks)
    state("slack, squared", "InteriorPoint, 10 ms", InteriorPoint(tolerance=TOLERANCE, time_limit=LIMIT), ticks)
    others: dict[str, fg.Solver] = {
        "SQP, OSQP": SQP(tolerance=TOLERANCE),
        "SQP, own": SQP(qp="graph", tolerance=TOLERANCE),
        "SQP, exact, own": SQP(qp="graph", hessian="exact", tolerance=TOLERANCE),
        "AugmentedLagrangian": AugmentedLagrangian(tolerance=TOLERANCE),
    }
    for name, solver in others.items():
        state("slack, squared", name, solver, max(ticks // SHORT, 20))
    for name in ("SQP, OSQP", "AugmentedLagrangian"):
        limited = replace(others[name], time_limit=LIMIT)
        state("slack, squared", f"{name}, 10 ms", limited, max(ticks // SHORT, 20))
    return found


def started(form: keeping.Form, weight: float | None, count: int) -> Flight:
    """Solve from random states about the reference, some of them inside spheres, from the reference as a guess."""
    case, rng, seen = GuardedFlight(form, weight=weight), np.random.default_rng(0), Flight()
    run = InteriorPoint(tolerance=TOLERANCE).prepare(case.graph)
    for index in range(-1, count):
        now = float(rng.uniform(0.0, 2.0 * np.pi / PACE))
        states, controls = figure_eight(now + case.times)
        states[0] = quadrotor.STATE.retract(states[:1], AWAY * rng.normal(size=(1, 9)))[0]
        guess = {**case.guess(), case.x: states, case.u: controls[:-1]}
        begin = time.thread_time()
        solution = run.solve(guess, data=case.data(states[0], now))
        if index >= 0:  # the first is to warm up
            seen.add(case, solution, 1e3 * (time.thread_time() - begin))
    return seen


def worst(flight: Flight) -> str:
    """Endings of the ticks that did not converge."""
    ends = [f"{count} {name}" for name, count in flight.statuses.most_common() if name != "converged"]
    return ", ".join(ends) or "none"


COLUMNS: dict[str, Callable[[Flight], str]] = {
    "ticks": lambda f: str(len(f.times)),
    "median [ms]": lambda f: f"{np.median(f.times):.2f}",
    "p99": lambda f: f"{np.percentile(f.times, 99.0):.2f}",
    "p99.9": lambda f: f"{np.percentile(f.times, 99.9):.2f}",
    "most": lambda f: f"{max(f.times):.2f}",
    "below 10 ms": lambda f: f"{100.0 * np.mean(np.array(f.times) < 1e3 * LIMIT):.2f} %",
    "iterations": lambda f: f"{np.mean(f.iterations):.1f}",
    "not converged": worst,
    "without a plan": lambda f: str(f.without),
    "least clearance [mm]": lambda f: f"{1e3 * min(f.clearance):.1f}",
    "lost in a tick beyond its share [mm]": lambda f: f"{1e3 * max(0.0, *f.lost):.2f}",
    "ticks with slack": lambda f: f"{np.sum(np.array(f.slack) > MATTERS)}" if f.slack else "-",
    "most slack [mm]": lambda f: f"{1e3 * max(f.slack):.2f}" if f.slack else "-",
    "error, mean [mm]": lambda f: f"{1e3 * np.mean(f.error):.1f}",
}


COLD: dict[tuple[str, str], tuple[keeping.Form, float | None]] = {
    ("hinge", "1e4"): ("hinge", 1e4), ("hinge", "1e6"): ("hinge", None), ("hard", "-"): ("hard", None),
    ("slack, squared", "1e4"): ("slack", 1e4), ("slack, squared", "1e6"): ("slack", None),
    ("slack, squared", "1e8"): ("slack", 1e8), ("slack, exact", "1e3"): ("exact slack", 1e3),
    ("slack, exact", "1e4"): ("exact slack", None), ("slack, exact", "1e5"): ("exact slack", 1e5),
}  # fmt: skip
COLD_COLUMNS: dict[str, Callable[[Flight], str]] = {
    "starts": lambda s: str(len(s.times)),
    "not converged": worst,
    "iterations": lambda s: f"{np.mean(s.iterations):.1f}",
    "median [ms]": lambda s: f"{np.median(s.times):.2f}",
    "p90": lambda s: f"{np.percentile(s.times, 90.0):.2f}",
    "most": lambda s: f"{max(s.times):.2f}",
    "plans with slack": lambda s: f"{np.sum(np.array(s.slack) > MATTERS)}" if s.slack else "-",
}


def tables(ticks: int) -> str:
    """Flights and cold starts."""
    flown = {names: flight() for names, flight in flights(ticks).items()}
    cold_ones = {names: started(*how, max(ticks // 80, 10)) for names, how in COLD.items()}
    return "\n\n".join(
        [
            listing(["barriers", "backend"], flown, COLUMNS),
            listing(["barriers", "weight"], cold_ones, COLD_COLUMNS),
            f"Laps of {2.0 * np.pi / PACE:.1f} s, 20 intervals, the first of 10 ms and the others of 50 ms, tolerance "
            f"{TOLERANCE:g}. Processor time of the solve, one core of a shared server; a limit of 10 ms is one of the "
            "clock, which runs for others as well. Without barriers the reference leads through the spheres.",
        ]
    )


STUDY = Timing(tables, 12000)
