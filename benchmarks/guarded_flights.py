"""Figure eight past three spheres at 100 Hz: time of a tick by the form of its barriers and by backend.

The flight of tests/problems/guarded_flight.py in closed loop, under gusts; processor time of the solve of each tick,
warm.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import TypeAlias

import numpy as np
import pandas as pd

import unifg as fg
from benchmarks.comparison import Key, Row
from benchmarks.report import Columns, listing, words
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
Column: TypeAlias = "Callable[[pd.DataFrame], str]"
"""A measure of the ticks of a flight or of cold starts."""
KEPT = 1e-3  # violation of constraints up to which an iterate is a plan


def record(case: GuardedFlight, solution: fg.Solution, seconds: float) -> Row:
    """Time of a solve [ms], its iterations and status, and the most slack in its plan [m]."""
    row: Row = {"ms": 1e3 * seconds, "iterations": solution.iterations, "status": words(solution.status)}
    if case.kept is not None and case.kept.slack is not None:
        row["slack"] = float(solution[case.kept.slack].max())
    return row


def fly(case: GuardedFlight, solver: fg.Solver, ticks: int) -> pd.DataFrame:
    """Ticks of a flight; where a solve ends without a plan the last one is flown on, and the next begins there."""
    run, rows = solver.prepare(case.graph), list[Row]()
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
            off = state[:3] - figure_eight(np.array([now + case.tick]))[0][0, :3]
            rows.append(record(case, solution, taken) | {
                "without": age > 0, "clearance": after, "lost": np.exp(-case.alpha * case.tick) * before - after,
                "error": float(np.linalg.norm(off)),
            })  # fmt: skip
    return pd.DataFrame(rows)


def cold(case: GuardedFlight) -> fg.Solution:
    """The answer of the first tick, by a backend without limit."""
    return InteriorPoint(tolerance=TOLERANCE).solve(case.graph, case.guess(), data=case.data(START, 0.0))


def flights(ticks: int) -> dict[Key, Callable[[], pd.DataFrame]]:
    """All of them."""
    found: dict[Key, Callable[[], pd.DataFrame]] = {}
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


def started(form: keeping.Form, weight: float | None, count: int) -> pd.DataFrame:
    """Solves from random states about the reference, some of them inside spheres, from the reference as a guess."""
    case, rng, rows = GuardedFlight(form, weight=weight), np.random.default_rng(0), list[Row]()
    run = InteriorPoint(tolerance=TOLERANCE).prepare(case.graph)
    for _ in range(count + 1):
        now = float(rng.uniform(0.0, 2.0 * np.pi / PACE))
        states, controls = figure_eight(now + case.times)
        states[0] = quadrotor.STATE.retract(states[:1], AWAY * rng.normal(size=(1, 9)))[0]
        guess = {**case.guess(), case.x: states, case.u: controls[:-1]}
        rows.append(record(case, *clocked(run.solve, guess, data=case.data(states[0], now))))
    return pd.DataFrame(rows[1:])  # the first is to warm up


def worst(solves: pd.DataFrame) -> str:
    """Endings of solves that did not converge."""
    ends = [f"{count} {name}" for name, count in Counter(solves["status"]).most_common() if name != "converged"]
    return ", ".join(ends) or "none"


def within(percent: float) -> Column:
    """Time that so many of the solves keep [ms]."""
    return lambda solves: f"{np.percentile(solves['ms'], percent):.2f}"


def slack(of: Callable[[pd.Series[float]], str]) -> Column:
    """Sentence on slacks, where there are some."""
    return lambda solves: of(solves["slack"]) if "slack" in solves else "-"


COLUMNS: Columns[pd.DataFrame] = {
    "ticks": lambda f: str(len(f)),
    "median [ms]": within(50.0),
    "p99": within(99.0),
    "p99.9": within(99.9),
    "most": within(100.0),
    "below 10 ms": lambda f: f"{100.0 * (f['ms'] < 1e3 * LIMIT).mean():.2f} %",
    "iterations": lambda f: f"{f['iterations'].mean():.1f}",
    "not converged": worst,
    "without a plan": lambda f: str(f["without"].sum()),
    "least clearance [mm]": lambda f: f"{1e3 * f['clearance'].min():.1f}",
    "lost in a tick beyond its share [mm]": lambda f: f"{1e3 * max(0.0, *f['lost']):.2f}",
    "ticks with slack": slack(lambda some: str((some > MATTERS).sum())),
    "most slack [mm]": slack(lambda some: f"{1e3 * some.max():.2f}"),
    "error, mean [mm]": lambda f: f"{1e3 * f['error'].mean():.1f}",
}


COLD: dict[Key, tuple[keeping.Form, float | None]] = {
    ("hinge", "1e4"): ("hinge", 1e4), ("hinge", "1e6"): ("hinge", None), ("hard", "-"): ("hard", None),
    ("slack, squared", "1e4"): ("slack", 1e4), ("slack, squared", "1e6"): ("slack", None),
    ("slack, squared", "1e8"): ("slack", 1e8), ("slack, exact", "1e3"): ("exact slack", 1e3),
    ("slack, exact", "1e4"): ("exact slack", None), ("slack, exact", "1e5"): ("exact slack", 1e5),
}  # fmt: skip
COLD_COLUMNS: Columns[pd.DataFrame] = {
    "starts": lambda f: str(len(f)),
    "not converged": worst,
    "iterations": lambda f: f"{f['iterations'].mean():.1f}",
    "median [ms]": within(50.0),
    "p90": within(90.0),
    "most": within(100.0),
    "plans with slack": slack(lambda some: str((some > MATTERS).sum())),
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
