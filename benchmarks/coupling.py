"""What one graph buys: sequential against joint coupling, paired over seeds, with the control weight swept.

    python -m benchmarks.coupling [--seeds 50] [--workers K] [--fresh] [--report]

Every variant drives the same seeds: same building, same unforeseen obstacles, same sensor noise. Differences are
taken seed by seed; intervals are 95 % bootstrap intervals of the mean difference. Needs the department's map for
the first route (``$UNIFG_DATA`` or ``../shared/data``); the building ships with the package.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from benchmarks.campaign import campaign, interval
from benchmarks.navigation import DEPARTMENT, data_folder
from benchmarks.report import CHECKOUT, OUT, code_digest, machine, put_results, table
from unifg.errors import UnifgError
from unifg.scenarios.driving.controller import ControllerSettings
from unifg.scenarios.log.drive_metrics import episode_metrics
from unifg.scenarios.navigation import NavigationSettings, run_navigation
from unifg.typing import Array

Row = dict[str, Any]
Pose = tuple[float, float, float]

VARIANTS = {
    "sequential": ("sequential", 1.0),
    "joint, weight 0.1": ("joint", 0.1),
    "joint": ("joint", 1.0),
    "joint, weight 10": ("joint", 10.0),
}
ROUTES: dict[str, tuple[str | None, Pose, tuple[Pose, ...]]] = {
    "department": (DEPARTMENT, (2.3, 24.0, -1.57), ((2.1, 10.0, -1.57),)),
    "building": (None, (13.9, 20.0, -1.6), ((21.5, 8.6, -0.6),)),
}
OBSTACLES = 2

# Name, unit, and how to read each measure from the metrics.
MEASURES: dict[str, Callable[[Any], float]] = {
    "localisation, mean [mm]": lambda m: 1e3 * m["localisation_error_m"]["mean"],
    "localisation, max [mm]": lambda m: 1e3 * m["localisation_error_m"]["max"],
    "heading, mean [mrad]": lambda m: 1e3 * m["localisation_error_rad"]["mean"],
    "collisions": lambda m: float(m["collisions"]),
    "duration [s]": lambda m: m["duration_s"],
    "least clearance [mm]": lambda m: 1e3 * m["min_clearance_m"],
    "localise + plan, median [ms]": lambda m: m["solve_ms"]["p50"],
    "localise + plan, p99 [ms]": lambda m: m["solve_ms"]["p99"],
}


@dataclass(frozen=True)
class Drive:
    """One episode of one variant."""

    route: str
    variant: str
    solver: str
    seed: int
    folder: Path | None
    code: str

    @property
    def key(self) -> tuple[str, str, str, int, str]:
        """What makes two drives the same."""
        return self.route, self.variant, self.solver, self.seed, self.code


def drive(job: Drive) -> Row:
    """Run one episode and keep its metrics; a refused one is kept as an error."""
    path, start, goals = ROUTES[job.route]
    coupling, weight = VARIANTS[job.variant]
    settings = NavigationSettings(
        None if path is None or job.folder is None else job.folder / path,
        start,
        goals,
        job.solver,
        coupling,
        OBSTACLES,
        job.seed,
        replace(ControllerSettings(), control_weight=weight),
    )
    row: Row = {"key": list(job.key)}
    try:
        return {**row, "metrics": episode_metrics(run_navigation(settings))}
    except UnifgError as error:
        return {**row, "error": str(error)}


def paired(rows: list[Row], route: str, solver: str, variant: str, measure: str) -> tuple[Array, Array]:
    """Values of a variant and of the sequential one for the seeds both have run."""

    def values(name: str) -> dict[int, float]:
        chosen = [r for r in rows if r["key"][:3] == [route, name, solver] and "metrics" in r]
        return {row["key"][3]: MEASURES[measure](row["metrics"]) for row in chosen}

    mine, base = values(variant), values("sequential")
    seeds = sorted(set(mine) & set(base))
    return np.array([mine[seed] for seed in seeds]), np.array([base[seed] for seed in seeds])


def render(rows: list[Row]) -> str:
    """Markdown of all routes and backends."""
    parts = [f"{machine('numpy', 'scipy', 'osqp', 'piqp', 'pymunk')}\n"]
    for route in ROUTES:
        for solver in ("sqp", "alm"):
            lines = []
            for measure in MEASURES:
                line = [measure]
                for variant in VARIANTS:
                    mine, base = paired(rows, route, solver, variant, measure)
                    if not len(mine):
                        line.append("-")
                    elif variant == "sequential":
                        line.append(f"{base.mean():.3g}")
                    else:
                        low, high = interval(mine - base)
                        line.append(f"{mine.mean():.3g} ({low:+.2g} .. {high:+.2g})")
                lines.append(line)
            count = len(paired(rows, route, solver, "sequential", "collisions")[0])
            if count:
                reached = ", ".join(f"{v} {_reached(rows, route, solver, v)}" for v in VARIANTS)
                parts.append(f"\n### {route}, {solver}, {count} seeds\n\nGoal reached: {reached}.\n")
                parts.append(table(["", *VARIANTS], lines))
    refused = sum("error" in row for row in rows)
    parts.append(f"\nIn brackets: 95 % interval of the paired difference to sequential. Episodes refused: {refused}.\n")
    return "\n".join([*parts, "", sayings(rows)])


def sayings(rows: list[Row]) -> str:
    """What the tables say, in sentences that are computed from them."""
    lines = []
    for route in ROUTES:
        for solver in ("sqp", "alm"):
            words = []
            for name, variant in (("the joint graph", "joint"), ("ten times the control weight", "joint, weight 10")):
                mine, base = paired(rows, route, solver, variant, "localisation, mean [mm]")
                if len(mine):
                    low, high = interval(mine - base)
                    words.append(
                        f"{name} localises {(mine - base).mean():+.2g} mm ({low:+.2g} to {high:+.2g}, "
                        f"{(mine - base).max():+.2g} at most) beside the sequential coupling"
                    )
            for what in ("median", "p99"):
                mine, base = paired(rows, route, solver, "joint", f"localise + plan, {what} [ms]")
                if len(mine):
                    words.append(f"its {what} of the time is {100.0 * (mine.mean() / base.mean() - 1.0):+.0f} %")
            if words:
                lines.append(f"- {route}, {solver}: {'; '.join(words)}.")
    driven = [row["metrics"] for row in rows if "metrics" in row]
    lines.append(
        f"- {len(driven)} drives, {sum(m['collisions'] for m in driven)} collisions, "
        f"{sum(not m['reached'] for m in driven)} goals missed; both obstacles stand still in this campaign."
    )
    return "\n".join(lines)


def _reached(rows: list[Row], route: str, solver: str, variant: str) -> str:
    chosen = [r for r in rows if r["key"][:3] == [route, variant, solver] and "metrics" in r]
    return f"{sum(bool(r['metrics']['reached']) for r in chosen)}/{len(chosen)}"


def main(arguments: list[str] | None = None) -> int:
    """Run what is missing and rewrite docs/joint.md."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.coupling", description=__doc__)
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--solver", action="append", choices=("sqp", "alm"))
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--fresh", action="store_true", help="forget earlier episodes")
    parser.add_argument("--report", action="store_true", help="only rewrite the page from what has been run")
    options = parser.parse_args(arguments)
    store = OUT / "coupling.jsonl"
    store.parent.mkdir(parents=True, exist_ok=True)
    if options.fresh:
        store.unlink(missing_ok=True)
    rows = [json.loads(line) for line in store.read_text().splitlines()] if store.exists() else []
    code, folder = code_digest("benchmarks.coupling"), data_folder()
    rows = rows if options.report else [row for row in rows if row["key"][4] == code]
    done = {tuple(row["key"]) for row in rows}
    jobs = [
        Drive(route, variant, solver, seed, folder, code)
        for seed in range(options.seeds)
        for solver in options.solver or ("sqp", "alm")
        for route in ROUTES
        for variant in VARIANTS
        if ROUTES[route][0] is None or folder is not None
    ]
    todo = [] if options.report else [job for job in jobs if job.key not in done]
    spawn = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(options.workers, mp_context=spawn) if options.workers > 1 else None
    with store.open("a") as file:
        for row in tqdm(campaign(drive, todo, pool), total=len(todo), desc="coupling"):
            rows.append(row)
            file.write(json.dumps(row) + "\n")
            file.flush()
    codes = {row["key"][4] for row in rows}
    put_results(CHECKOUT / "docs" / "joint.md", "What the joint graph buys", render(rows), codes)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
