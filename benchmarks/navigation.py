"""Closed-loop drives of all backends with both couplings, judged against fixed limits.

The maps of the department and of the TurtleBot arena are looked for in ``$UNIFG_DATA`` or ``../shared/data`` beside the
checkout; without them only the building that ships with the package is driven.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.comparison import Row, where
from benchmarks.report import Columns, shared, table, told
from benchmarks.runner import Cell, Study
from unifg.scenarios.ground.drive_pilot import COUPLINGS
from unifg.scenarios.ground.drive_settings import ControllerSettings
from unifg.scenarios.logs.drive_metrics import episode_metrics
from unifg.scenarios.navigation import NavigationSettings, run_navigation
from unifg.typing import Array

SOLVERS = ("ipm", "sqp", "alm")
DEPARTMENT, ARENA = "dis-B1-2011-09-27.yaml", "turtlebot3_world.yaml"

# Limits of the campaign: what a drive has to keep, and what all ticks of one backend have to keep together.
LOCALISATION_M, LOCALISATION_RAD = 0.05, 0.015
LEAST_SPEED = 0.6  # [m/s]; of the shorter of planned and driven path
BOUND_VIOLATION = 1e-3
MEDIAN_MS, P99_MS, LEAST_TICKS, LEAST_HORIZON = 20.0, 60.0, 2000, 30


@dataclass(frozen=True)
class Case:
    """Map, start and goals of a drive.

    Attributes:
        map: file among the shared maps, None for the shipped building.
        start: pose [m, m, rad], None for the building's own.
        goals: poses [m, m, rad], None for the building's own.
        obstacles: number of unforeseen obstacles.
    """

    map: str | None
    start: tuple[float, float, float] | None
    goals: tuple[tuple[float, float, float], ...] | None
    obstacles: int

    @property
    def path(self) -> Path | None:
        """Of the map, if it is here."""
        folder = shared("maps")
        return None if folder is None or self.map is None else folder / self.map

    @property
    def available(self) -> bool:
        """True if its map is here."""
        return self.map is None or (self.path is not None and self.path.is_file())


CASES = {
    "department": Case(DEPARTMENT, (2.3, 30.0, -1.57), ((10.0, 1.7, 0.0), (26.0, 1.7, 0.0)), 3),
    "arena, across": Case(ARENA, (-2.0, -0.5, 0.0), ((2.0, -0.5, 0.0),), 0),
    "arena, narrow": Case(ARENA, (-2.0, -0.5, 0.0), ((0.5, 0.5, 1.57),), 0),
    "building": Case(None, None, None, 3),
}


def settings_of(case: Case, solver: str, coupling: str, seed: int, weight: float = 1.0) -> NavigationSettings:
    """The episode to run; ``weight`` is that of the control costs."""
    controller = replace(ControllerSettings(), control_weight=weight)
    return NavigationSettings(
        case.path, case.start, case.goals, solver, coupling, case.obstacles, seed=seed, controller=controller
    )


def drive(case: str, cases: Mapping[str, Case] = CASES, **how: Any) -> Row:
    """Run one episode: its metrics, and the times and status of every tick."""
    settings = settings_of(cases[case], **how)
    log = run_navigation(settings)
    ticks = {
        "solve_ms": log.solve_ms,
        "whole_ms": log.solve_ms + log.perceive_ms + log.route_ms,
        "localise_ms": log.localise_ms,
        "plan_ms": log.plan_ms,
    }
    rounded = {name: np.round(values, 3).tolist() for name, values in ticks.items()}
    return {
        "metrics": episode_metrics(log), "ticks": rounded, "status": log.status, "horizon": settings.controller.horizon,
    }  # fmt: skip


def limit(metrics: Row) -> float:
    """Longest permitted duration [s]."""
    return float(min(metrics["path_length_m"], metrics["planned_length_m"])) / LEAST_SPEED


# What a drive has to keep, in words and of its metrics.
LIMITS: dict[str, Callable[[Row], bool]] = {
    "every goal reached, no collision": lambda m: bool(m["succeeded"]),
    f"mean localisation error below {LOCALISATION_M} m and {LOCALISATION_RAD} rad": lambda m: (
        m["localisation_error_m"]["mean"] < LOCALISATION_M and m["localisation_error_rad"]["mean"] < LOCALISATION_RAD
    ),
    f"duration at most path length / ({LEAST_SPEED} m/s)": lambda m: m["duration_s"] <= limit(m),
    f"bounds exceeded by at most {BOUND_VIOLATION:g}": lambda m: m["max_bound_violation"] <= BOUND_VIOLATION,
}
MEASURED: Columns[Row] = {
    "reached": lambda m: f"{m['goals_reached']} / {m['goals']}",
    "collisions": told("collisions"),
    "duration [s]": told("duration_s", "{:.1f}".format),
    "limit [s]": lambda m: f"{limit(m):.1f}",
    "path [m]": told("path_length_m", "{:.1f}".format),
    "clearance [m]": told("min_clearance_m", "{:.3f}".format),
    "localisation [m]": lambda m: f"{m['localisation_error_m']['mean']:.4f}",
    "localisation [rad]": lambda m: f"{m['localisation_error_rad']['mean']:.4f}",
    "odometry [m]": lambda m: f"{m['odometry_error_m']['mean']:.2f}",
    "bounds": told("max_bound_violation", "{:.0e}".format),
    "failed": told("solver_failures"),
}
TIMED = {
    "solve_ms": "localise + plan",
    "localise_ms": "localise",
    "plan_ms": "plan",
    "whole_ms": "the same with perception and repair of the route",
}


def kept(row: Row, sentence: str) -> bool:
    """True for a drive that kept a limit; a refused one keeps none."""
    return "metrics" in row and LIMITS[sentence](row["metrics"])


def render(rows: list[Row]) -> str:
    """The results as Markdown: the verdicts, the drives, the times."""
    rows = sorted(rows, key=lambda row: ([*CASES].index(row["case"]), row["solver"], row["seed"]))
    workers = max(row["workers"] for row in rows)
    at_once = "One drive at a time." if workers == 1 else f"{workers} drives at once, which lengthens the times."
    parts = [
        "Verdicts, computed from the drives below:", verdicts(rows),
        "Drives. Lengths and clearances are those of the true motion; *odometry* is the error of dead reckoning in the "
        f"same drive; *limit* is the shorter of planned and driven path at {LEAST_SPEED} m/s; *bounds* is the largest "
        "excess over a control bound in the solver's output before clipping; *failed* counts ticks whose solve was "
        "rejected, so that the robot braked along its stored plan.",
        table(("case", "backend", "seed", *MEASURED), map(_drive_line, rows), text=2),
        "Time per tick, pooled over all drives of a backend.", times(rows),
        "Outcome of the control solve, share of ticks.", statuses(rows),
        at_once,
    ]  # fmt: skip
    return "\n\n".join(parts)


def _drive_line(row: Row) -> list[str]:
    first = [row["case"], row["solver"], str(row["seed"])]
    if "refused" in row:
        return [*first, f"refused: {row['refused']}", *["-"] * (len(MEASURED) - 1)]
    return [*first, *(read(row["metrics"]) for read in MEASURED.values())]


def verdicts(rows: list[Row]) -> str:
    """Limits that were kept: of each drive by case, of the times by backend."""
    lines = []
    for case in CASES:
        mine = [row for row in rows if row["case"] == case]
        if not mine:
            lines.append((case, "drives", "-", "not driven"))
            continue
        for sentence in LIMITS:
            good = sum(kept(row, sentence) for row in mine)
            lines.append((case, sentence, f"{good} / {len(mine)}", "pass" if good == len(mine) else "**fail**"))
    for solver in SOLVERS:
        ticks = _pool(rows, solver, "solve_ms")
        if not len(ticks):
            continue
        horizon = min(row["horizon"] for row in where(rows, solver=solver))
        median, p99 = np.percentile(ticks, [50.0, 99.0])
        ready = len(ticks) >= LEAST_TICKS and horizon >= LEAST_HORIZON
        for name, value, most in (("median", median, MEDIAN_MS), ("99th percentile", p99, P99_MS)):
            sentence = f"{name} of localise + plan below {most:g} ms, N = {horizon}, {len(ticks)} ticks"
            verdict = ("pass" if value < most else "**fail**") if ready else "too few ticks"
            lines.append((solver, sentence, f"{value:.1f} ms", verdict))
    return table(("where", "what", "found", "verdict"), lines, text=2)


def _pool(rows: list[Row], solver: str, name: str) -> Array:
    """All ticks of a backend [ms]."""
    return np.concatenate([np.zeros(0), *(row["ticks"][name] for row in where(rows, solver=solver))])


def times(rows: list[Row]) -> str:
    """Percentiles of all ticks of a backend."""
    lines = []
    for solver, (name, words) in product(SOLVERS, TIMED.items()):
        ticks = _pool(rows, solver, name)
        if len(ticks):
            numbers = (f"{value:.1f}" for value in (*np.percentile(ticks, [50.0, 99.0]), ticks.max()))
            lines.append((words, solver, str(len(ticks)), *numbers))
    return table(("what", "backend", "ticks", "median [ms]", "99 % [ms]", "max [ms]"), lines, text=2)


def statuses(rows: list[Row]) -> str:
    """Endings of the control solves."""
    words = {s: Counter(w for row in where(rows, solver=s) for w in row["status"]) for s in SOLVERS}
    names = sorted({name for counts in words.values() for name in counts})
    lines = [
        (solver, *(f"{100.0 * counts[name] / counts.total():.2f} %" for name in names))
        for solver, counts in words.items()
        if counts
    ]
    return table(("backend", *(name.replace("_", " ") for name in names)), lines)


def tables(rows: list[Row]) -> str:
    """Tables of both couplings."""
    parts = []
    for coupling in COUPLINGS:
        mine = [row for row in rows if row["coupling"] == coupling]
        parts += [f"### Coupling: {coupling}", render(mine)] if mine else []
    return "\n\n".join(parts)


def cells(seeds: Sequence[int]) -> list[Cell]:
    """Every case that can be driven here, by every backend with every coupling."""
    chosen = [name for name, case in CASES.items() if case.available]
    variants = product(chosen, SOLVERS, COUPLINGS, seeds, [1.0])
    return [dict(zip(("case", "solver", "coupling", "seed", "weight"), one, strict=True)) for one in variants]


STUDY = Study(cells, drive, tables, range(5))
