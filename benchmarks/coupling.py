"""Sequential against joint coupling, paired over seeds, with the control weight swept.

Every variant drives the same seeds: same building, same unforeseen obstacles, same sensor noise. Differences are
taken seed by seed; intervals are 95 % bootstrap intervals of the mean difference. Needs the department's map for
the first route (``$UNIFG_DATA`` or ``../shared/data``); the building ships with the package.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import product

from benchmarks.comparison import Read, Row, comparison, metric, where
from benchmarks.navigation import DEPARTMENT, Case, drive
from benchmarks.runner import Cell, Study

VARIANTS = {
    "sequential": ("sequential", 1.0),
    "joint, weight 0.1": ("joint", 0.1),
    "joint": ("joint", 1.0),
    "joint, weight 10": ("joint", 10.0),
}  # coupling and control weight
BASE = "sequential"
SOLVERS = ("sqp", "alm")
ROUTES = {
    "department": Case(DEPARTMENT, (2.3, 24.0, -1.57), ((2.1, 10.0, -1.57),), 2),
    "building": Case(None, (13.9, 20.0, -1.6), ((21.5, 8.6, -0.6),), 2),
}

MEASURES: dict[str, Read] = {
    "localisation, mean [mm]": metric(1e3, "localisation_error_m", "mean"),
    "localisation, max [mm]": metric(1e3, "localisation_error_m", "max"),
    "heading, mean [mrad]": metric(1e3, "localisation_error_rad", "mean"),
    "collisions": metric(1.0, "collisions"),
    "duration [s]": metric(1.0, "duration_s"),
    "least clearance [mm]": metric(1e3, "min_clearance_m"),
    "localise + plan, median [ms]": metric(1.0, "solve_ms", "p50"),
    "localise + plan, p99 [ms]": metric(1.0, "solve_ms", "p99"),
}


def variants_of(rows: list[Row], route: str, solver: str) -> dict[str, list[Row]]:
    """The rows of one table, by variant."""
    chosen = where(rows, case=route, solver=solver)
    return {name: where(chosen, coupling=how, weight=weight) for name, (how, weight) in VARIANTS.items()}


def render(rows: list[Row]) -> str:
    """Markdown of all routes and backends."""
    parts = list[str]()
    for route, solver in product(ROUTES, SOLVERS):
        of = variants_of(rows, route, solver)
        if of[BASE]:
            reached = ", ".join(f"{v} {sum(r['metrics']['reached'] for r in of[v])}/{len(of[v])}" for v in VARIANTS)
            parts.append(f"### {route}, {solver}, {len(of[BASE])} seeds\n\nGoal reached: {reached}.")
            parts.append(comparison(MEASURES, of, BASE))
    refused = sum("refused" in row for row in rows)
    parts.append(f"In brackets: 95 % interval of the paired difference to sequential. Episodes refused: {refused}.")
    return "\n\n".join(parts)


def cells(seeds: Sequence[int]) -> list[Cell]:
    """Every variant on every route."""
    routes = [name for name, case in ROUTES.items() if case.available]
    variants = product(seeds, SOLVERS, routes, VARIANTS.values())
    return [
        {"case": route, "solver": solver, "coupling": coupling, "seed": seed, "weight": weight}
        for seed, solver, route, (coupling, weight) in variants
    ]


STUDY = Study(cells, partial(drive, cases=ROUTES), render, range(50))
