"""The campaign behind docs/navigation.md: closed-loop drives of both backends, judged against fixed limits.

    python -m benchmarks.navigation [--coupling joint] [--fresh] [--workers K] [--only CASE ...] [--report]

The maps of the department and of the TurtleBot arena are looked for in ``$UNIFG_DATA`` or ``../shared/data`` beside the
checkout; without them only the building that ships with the package is driven, and the page in docs/ is left alone.
Every finished drive is a line of out/benchmarks/navigation.jsonl, and is not repeated until the code changes. The joint
coupling has a file and a page of its own, docs/joint-drives.md.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from benchmarks.campaign import campaign
from benchmarks.report import CHECKOUT, OUT, code_digest, machine, put_results, table
from unifg.errors import UnifgError
from unifg.scenarios.driving.controller import ControllerSettings
from unifg.scenarios.driving.pilot import COUPLINGS
from unifg.scenarios.log.drive_metrics import episode_metrics
from unifg.scenarios.navigation import NavigationSettings, run_navigation

Row = dict[str, Any]

SOLVERS = ("alm", "sqp")
SEEDS = range(5)
DEPARTMENT, ARENA = "maps/dis-B1-2011-09-27.yaml", "maps/turtlebot3_world.yaml"

# Limits of the campaign: what a drive has to keep, and what all ticks of one backend have to keep together.
LOCALISATION_M, LOCALISATION_RAD = 0.05, 0.015
LEAST_SPEED = 0.6  # [m/s]; of the shorter of planned and driven path
BOUND_VIOLATION = 1e-3
MEDIAN_MS, P99_MS, LEAST_TICKS, LEAST_HORIZON = 20.0, 60.0, 2000, 30


@dataclass(frozen=True)
class Case:
    """One drive, to be repeated for every seed and backend.

    Attributes:
        name: for the tables.
        map: file below the data folder, None for the shipped building.
        start: pose [m, m, rad], None for the building's own.
        goals: poses [m, m, rad], None for the building's own.
        obstacles: number of unforeseen obstacles.
    """

    name: str
    map: str | None
    start: tuple[float, float, float] | None
    goals: tuple[tuple[float, float, float], ...] | None
    obstacles: int


CASES = (
    Case("department", DEPARTMENT, (2.3, 30.0, -1.57), ((10.0, 1.7, 0.0), (26.0, 1.7, 0.0)), 3),
    Case("arena, across", ARENA, (-2.0, -0.5, 0.0), ((2.0, -0.5, 0.0),), 0),
    Case("arena, narrow", ARENA, (-2.0, -0.5, 0.0), ((0.5, 0.5, 1.57),), 0),
    Case("building", None, None, None, 3),
)


def data_folder() -> Path | None:
    """The folder with the maps, if there is one."""
    folder = Path(os.environ.get("UNIFG_DATA", CHECKOUT.parent / "shared" / "data"))
    return folder if (folder / DEPARTMENT).is_file() else None


@dataclass(frozen=True)
class Drive:
    """One drive of the campaign and the conditions it is made under."""

    case: Case
    solver: str
    seed: int
    folder: Path | None
    code: str
    workers: int
    coupling: str = "sequential"

    @property
    def key(self) -> tuple[str, str, int, str]:
        """What makes two drives the same."""
        return self.case.name, self.solver, self.seed, self.code

    def settings(self) -> NavigationSettings:
        """The episode to run."""
        case = self.case
        path = None if case.map is None or self.folder is None else self.folder / case.map
        return NavigationSettings(
            path, case.start, case.goals, self.solver, self.coupling, obstacles=case.obstacles, seed=self.seed
        )


def drive(job: Drive) -> Row:
    """Run one episode: its metrics, and the times and status of every tick. A refused episode is a failed one."""
    row: Row = {
        "case": job.case.name, "solver": job.solver, "seed": job.seed, "code": job.code, "workers": job.workers,
        "horizon": ControllerSettings().horizon,
    }  # fmt: skip
    try:
        log = run_navigation(job.settings())
    except UnifgError as error:
        return {**row, "error": str(error)}
    ticks = {
        "solve_ms": log.solve_ms,
        "whole_ms": log.solve_ms + log.perceive_ms + log.route_ms,
        "localise_ms": log.localise_ms,
        "plan_ms": log.plan_ms,
    }
    rounded = {name: np.round(values, 3).tolist() for name, values in ticks.items()}
    return {**row, "metrics": episode_metrics(log), "ticks": rounded, "status": log.status}


def passes(row: Row) -> dict[str, bool]:
    """Which limits of a single drive were kept."""
    if "error" in row:
        return dict.fromkeys(("arrival", "localisation", "duration", "bounds"), False)
    m = row["metrics"]
    return {
        "arrival": bool(m["succeeded"]),
        "localisation": m["localisation_error_m"]["mean"] < LOCALISATION_M
        and m["localisation_error_rad"]["mean"] < LOCALISATION_RAD,
        "duration": m["duration_s"] <= _limit(m),
        "bounds": m["max_bound_violation"] <= BOUND_VIOLATION,
    }


def _limit(metrics: Row) -> float:
    """Longest permitted duration [s]."""
    return float(min(metrics["path_length_m"], metrics["planned_length_m"])) / LEAST_SPEED


def read_rows(path: Path, code: str) -> list[Row]:
    """Finished drives of this state of the code; a line that was cut off does not count."""
    rows = []
    for text in path.read_text(encoding="utf-8").splitlines() if path.is_file() else []:
        try:
            row = json.loads(text)
        except json.JSONDecodeError:
            continue
        if row["code"] == code:
            rows.append(row)
    return rows


def render(rows: list[Row]) -> str:
    """The results as Markdown: the verdicts, the drives, the times."""
    order = {case.name: index for index, case in enumerate(CASES)}
    rows = sorted(rows, key=lambda row: (order[row["case"]], row["solver"], row["seed"]))
    parts = [
        "Verdicts, computed from the drives below:", _verdicts(rows),
        "Drives. Lengths and clearances are those of the true motion; *odometry* is the error of dead reckoning in the "
        f"same drive; *limit* is the shorter of planned and driven path at {LEAST_SPEED} m/s; *bounds* is the largest "
        "excess over a control bound in the solver's output before clipping; *failed* counts ticks whose solve was "
        "rejected, so that the robot braked along its stored plan.",
        _drives(rows),
        "Time per tick, pooled over all drives of a backend.", _times(rows),
        "Outcome of the control solve, share of ticks.", _statuses(rows),
        machine("numpy", "scipy", "osqp", "piqp", "pymunk")
        + f" {_at_once(rows)}",
    ]  # fmt: skip
    return "\n\n".join(parts)


def _at_once(rows: list[Row]) -> str:
    workers = max(row["workers"] for row in rows)
    return "One drive at a time." if workers == 1 else f"{workers} drives at once, which lengthens the times."


def _verdicts(rows: list[Row]) -> str:
    lines = []
    kinds = {
        "arrival": "every goal reached, no collision",
        "localisation": f"mean localisation error below {LOCALISATION_M} m and {LOCALISATION_RAD} rad",
        "duration": f"duration at most path length / ({LEAST_SPEED} m/s)",
        "bounds": f"bounds exceeded by at most {BOUND_VIOLATION:g}",
    }
    for case in CASES:
        mine = [row for row in rows if row["case"] == case.name]
        if not mine:
            lines.append((case.name, "drives", "-", "not driven"))
            continue
        for kind, sentence in kinds.items():
            kept = sum(passes(row)[kind] for row in mine)
            lines.append((case.name, sentence, f"{kept} / {len(mine)}", "pass" if kept == len(mine) else "**fail**"))
    for solver in SOLVERS:
        times = _pool(rows, solver, "solve_ms")
        if not len(times):
            continue
        horizon = min(row["horizon"] for row in rows if row["solver"] == solver)
        median, p99 = np.percentile(times, [50.0, 99.0])
        ready = len(times) >= LEAST_TICKS and horizon >= LEAST_HORIZON
        for name, value, most in (("median", median, MEDIAN_MS), ("99th percentile", p99, P99_MS)):
            sentence = f"{name} of localise + plan below {most:g} ms, N = {horizon}, {len(times)} ticks"
            verdict = ("pass" if value < most else "**fail**") if ready else "too few ticks"
            lines.append((solver, sentence, f"{value:.1f} ms", verdict))
    return table(("where", "what", "found", "verdict"), lines, text=2)


def _drives(rows: list[Row]) -> str:
    head = (
        "case", "backend", "seed", "reached", "collisions", "duration [s]", "limit [s]", "path [m]", "clearance [m]",
        "localisation [m]", "localisation [rad]", "odometry [m]", "bounds", "failed",
    )  # fmt: skip
    return table(head, map(_drive_line, rows), text=2)


def _drive_line(row: Row) -> tuple[str, ...]:
    first = (row["case"], row["solver"], str(row["seed"]))
    if "error" in row:
        return (*first, f"refused: {row['error']}", *["-"] * 10)
    m = row["metrics"]
    return (
        *first,
        f"{m['goals_reached']} / {m['goals']}",
        str(m["collisions"]),
        f"{m['duration_s']:.1f}",
        f"{_limit(m):.1f}",
        f"{m['path_length_m']:.1f}",
        f"{m['min_clearance_m']:.3f}",
        f"{m['localisation_error_m']['mean']:.4f}",
        f"{m['localisation_error_rad']['mean']:.4f}",
        f"{m['odometry_error_m']['mean']:.2f}",
        f"{m['max_bound_violation']:.0e}",
        str(m["solver_failures"]),
    )


def _pool(rows: list[Row], solver: str, name: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    """All ticks of a backend [ms]."""
    mine = [row["ticks"][name] for row in rows if row["solver"] == solver and "error" not in row]
    return np.concatenate(mine) if mine else np.zeros(0)


def _times(rows: list[Row]) -> str:
    names = {
        "solve_ms": "localise + plan", "localise_ms": "localise", "plan_ms": "plan",
        "whole_ms": "the same with perception and repair of the route",
    }  # fmt: skip
    lines = []
    for solver in SOLVERS:
        for name, words in names.items():
            times = _pool(rows, solver, name)
            if len(times):
                p50, p99 = np.percentile(times, [50.0, 99.0])
                lines.append((words, solver, str(len(times)), f"{p50:.1f}", f"{p99:.1f}", f"{times.max():.1f}"))
    return table(("what", "backend", "ticks", "median [ms]", "99 % [ms]", "max [ms]"), lines, text=2)


def _statuses(rows: list[Row]) -> str:
    words = {s: [w for row in rows if row["solver"] == s for w in row.get("status", [])] for s in SOLVERS}
    names = sorted({word for all_words in words.values() for word in all_words})
    lines = [
        (solver, *(f"{100.0 * found.count(name) / len(found):.2f} %" for name in names))
        for solver, found in words.items()
        if found
    ]
    return table(("backend", *(name.replace("_", " ") for name in names)), lines)


def main(arguments: list[str] | None = None) -> int:
    """Drive what is missing, then write the tables; 0 only if every drive keeps its limits."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.navigation", description=__doc__.split("\n")[0])
    parser.add_argument("--fresh", action="store_true", help="repeat drives that are on file")
    parser.add_argument("--workers", type=int, default=1, help="drives at once; times mean something for one alone")
    parser.add_argument("--only", nargs="+", choices=[case.name for case in CASES], metavar="CASE", help="some cases")
    parser.add_argument("--report", action="store_true", help="drive nothing, write the tables from what is on file")
    parser.add_argument("--coupling", choices=COUPLINGS, default=COUPLINGS[0])
    options = parser.parse_args(arguments)
    name = "navigation" if options.coupling == COUPLINGS[0] else f"{options.coupling}-drives"

    folder, code = data_folder(), code_digest("benchmarks.navigation")
    cases = [case for case in CASES if case.map is None or folder is not None]
    if folder is None:
        print("No maps in $UNIFG_DATA or ../shared/data: only the shipped building is driven.")
    store = OUT / f"{name}.jsonl"
    store.parent.mkdir(parents=True, exist_ok=True)
    rows = read_rows(store, code)
    chosen = [case for case in cases if options.only is None or case.name in options.only]
    jobs = [
        Drive(case, solver, seed, folder, code, options.workers, options.coupling)
        for case in chosen for seed in SEEDS for solver in SOLVERS
    ]  # fmt: skip
    if options.fresh:
        again = {job.key for job in jobs}
        rows = [row for row in rows if _key(row) not in again]
    done = set(map(_key, rows))
    jobs = [] if options.report else [job for job in jobs if job.key not in done]
    rows += _drive_all(jobs, store, rows)
    if not rows:
        print(f"Nothing on file in {store} for this state of the code.")
        return 1

    text = render(rows)
    (OUT / f"{name}.md").write_text(text + "\n", encoding="utf-8", newline="\n")
    print(text)
    if {(c.name, s, seed) for c in CASES for s in SOLVERS for seed in SEEDS} <= {_key(row)[:3] for row in rows}:
        codes = {str(row["code"]) for row in rows}
        put_results(CHECKOUT / "docs" / f"{name}.md", f"Drives, {options.coupling} coupling", text, codes)
    else:
        print(f"\nThe campaign is incomplete, so docs/{name}.md is left as it was.")
    return 0 if all(all(passes(row).values()) for row in rows) else 1


def _key(row: Row) -> tuple[str, str, int, str]:
    return row["case"], row["solver"], row["seed"], row["code"]


def _drive_all(jobs: list[Drive], store: Path, kept: list[Row]) -> list[Row]:
    """Run the jobs; the file holds the rows kept and then every new one as soon as it is there."""
    rows: list[Row] = []
    store.write_text("".join(json.dumps(row) + "\n" for row in kept), encoding="utf-8")
    pool = None
    if jobs and jobs[0].workers > 1:
        pool = ProcessPoolExecutor(jobs[0].workers, mp_context=multiprocessing.get_context("spawn"))
    try:
        with store.open("a", encoding="utf-8") as file, tqdm(total=len(jobs), unit="drive") as bar:
            for row in campaign(drive, jobs, pool):
                file.write(json.dumps(row) + "\n")
                file.flush()
                rows.append(row)
                bar.set_postfix_str(f"{row['case']}, {row['solver']}, seed {row['seed']}")
                bar.update()
    finally:
        if pool is not None:
            pool.shutdown(cancel_futures=True)
    return rows


if __name__ == "__main__":
    raise SystemExit(main())
