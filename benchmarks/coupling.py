"""What one graph buys: sequential against joint coupling, paired over seeds, with the control weight swept.

    python -m benchmarks.coupling [--seeds 0:50] [--solvers sqp] [--workers K] [--fresh] [--report]

Every variant drives the same seeds: same building, same unforeseen obstacles, same sensor noise. Differences are
taken seed by seed; intervals are 95 % bootstrap intervals of the mean difference. Needs the department's map for
the first route (``$UNIFG_DATA`` or ``../shared/data``); the building ships with the package. Writes docs/joint.md.
"""

from __future__ import annotations

from functools import partial
from itertools import product

from benchmarks import runs
from benchmarks.comparison import Read, Row, comparison, digits, interval, paired, where
from benchmarks.navigation import DEPARTMENT, Case, Drive, drive
from benchmarks.report import command, machine, publish

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
    "localisation, mean [mm]": lambda row: 1e3 * row["metrics"]["localisation_error_m"]["mean"],
    "localisation, max [mm]": lambda row: 1e3 * row["metrics"]["localisation_error_m"]["max"],
    "heading, mean [mrad]": lambda row: 1e3 * row["metrics"]["localisation_error_rad"]["mean"],
    "collisions": lambda row: float(row["metrics"]["collisions"]),
    "duration [s]": lambda row: row["metrics"]["duration_s"],
    "least clearance [mm]": lambda row: 1e3 * row["metrics"]["min_clearance_m"],
    "localise + plan, median [ms]": lambda row: row["metrics"]["solve_ms"]["p50"],
    "localise + plan, p99 [ms]": lambda row: row["metrics"]["solve_ms"]["p99"],
}


def variants_of(rows: list[Row], route: str, solver: str) -> dict[str, list[Row]]:
    """The rows of one table, by variant."""
    chosen = where(rows, case=route, solver=solver)
    return {name: where(chosen, coupling=how, weight=weight) for name, (how, weight) in VARIANTS.items()}


def render(rows: list[Row]) -> str:
    """Markdown of all routes and backends."""
    parts = [machine("numpy", "scipy", "osqp", "piqp", "pymunk")]
    for route, solver in product(ROUTES, SOLVERS):
        of = variants_of(rows, route, solver)
        if of[BASE]:
            reached = ", ".join(f"{v} {sum(r['metrics']['reached'] for r in of[v])}/{len(of[v])}" for v in VARIANTS)
            parts.append(f"### {route}, {solver}, {len(of[BASE])} seeds\n\nGoal reached: {reached}.")
            parts.append(comparison(MEASURES, of, BASE))
    refused = sum("error" in row for row in rows)
    parts.append(f"In brackets: 95 % interval of the paired difference to sequential. Episodes refused: {refused}.")
    return "\n\n".join([*parts, sayings(rows)])


def sayings(rows: list[Row]) -> str:
    """What the tables say, in sentences that are computed from them."""
    lines = []
    for route, solver in product(ROUTES, SOLVERS):
        of, words = variants_of(rows, route, solver), []
        for name, variant in (("the joint graph", "joint"), ("ten times the control weight", "joint, weight 10")):
            mine, base = paired(of[variant], of[BASE], MEASURES["localisation, mean [mm]"])
            if len(mine):
                low, high = interval(mine - base)
                words.append(
                    f"{name} localises {digits((mine - base).mean(), '+')} mm ({digits(low, '+')} to "
                    f"{digits(high, '+')}, {digits((mine - base).max(), '+')} at most) beside the sequential coupling"
                )
        for what in ("median", "p99"):
            mine, base = paired(of["joint"], of[BASE], MEASURES[f"localise + plan, {what} [ms]"])
            if len(mine):
                words.append(f"its {what} of the time is {100.0 * (mine.mean() / base.mean() - 1.0):+.0f} %")
        if words:
            lines.append(f"- {route}, {solver}: {'; '.join(words)}.")
    driven = [row["metrics"] for row in where(rows)]
    lines.append(
        f"- {len(driven)} drives, {sum(m['collisions'] for m in driven)} collisions, "
        f"{sum(not m['reached'] for m in driven)} goals missed; both obstacles stand still in this campaign."
    )
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    """Run what is missing and rewrite docs/joint.md."""
    parser = command(__doc__)
    runs.options(parser)
    parser.add_argument("--seeds", type=runs.seeds, default=range(50), metavar="FIRST:END")
    parser.add_argument("--solvers", nargs="+", choices=SOLVERS, default=SOLVERS)
    options = parser.parse_args(arguments)
    routes = [name for name, case in ROUTES.items() if case.available]
    variants = product(options.seeds, options.solvers, routes, VARIANTS.values())
    jobs = [Drive(route, solver, coupling, seed, weight) for seed, solver, route, (coupling, weight) in variants]
    rows = runs.episodes("coupling", partial(drive, cases=ROUTES), jobs, options)
    publish("joint", render(rows), {row["code"] for row in rows})
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
