"""Four ways of avoiding things, in closed loop: success against the speed of movers, over routes.

    python -m benchmarks.crossing [--seeds 400:405] [--speeds 0.3 1.0] [--workers K] [--fresh] [--report]

Every seed is a route of its own through the building (:mod:`benchmarks.routes`), with six unforeseen discs of which two
go to and fro on or across the path and wait for nobody. The four meet the same route, discs and noise. A drive succeeds
that reaches its goal without a contact. Intervals are over routes, which count as drawn at random. Writes
docs/avoidance.md.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks import runs
from benchmarks.comparison import Row, where
from benchmarks.comparison import interval as bootstrap
from benchmarks.comparison import share as rate
from benchmarks.report import command, listing, machine, publish
from benchmarks.routes import drawn
from unifg.scenarios.ground.drive_settings import AVOIDANCES, ControllerSettings
from unifg.scenarios.log.drive_metrics import episode_metrics
from unifg.scenarios.navigation import NavigationSettings, run_navigation

SEEDS, SPEEDS, OBSTACLES = range(400, 405), (0.3, 1.0), 6
BASE = "clearance"


@dataclass(frozen=True)
class Crossing:
    """One drive."""

    avoidance: str
    speed: float
    seed: int


def drive(job: Crossing) -> Row:
    """Run once."""
    start, goal = drawn(job.seed)
    controller = replace(ControllerSettings(), avoidance=job.avoidance)
    log = run_navigation(
        NavigationSettings(
            start=start, goals=(goal,), obstacles=OBSTACLES, seed=job.seed, controller=controller, mover_speed=job.speed
        )
    )
    metrics = episode_metrics(log)
    return {
        "success": bool(metrics["succeeded"]),
        "reached": bool(metrics["reached"]),
        "contacts": int(metrics["collisions"]),
        "duration": float(metrics["duration_s"]),
        "clearance": float(metrics["min_clearance_m"]),
        "emergencies": int(metrics["emergency_ticks"]),
        "plan": float(np.median(log.plan_ms)),
    }


def render(rows: Sequence[Row]) -> str:
    """Markdown."""
    speeds = sorted({row["speed"] for row in where(rows)})
    groups = {(f"{speed:g}", how): where(rows, speed=speed, avoidance=how) for speed in speeds for how in AVOIDANCES}

    def interval(some: list[Row]) -> str:
        low, high = rate(sum(row["success"] for row in some), len(some))
        return f"{100.0 * low:.0f} .. {100.0 * high:.0f} %"

    def of(name: str, scale: float = 1.0, digits: int = 1) -> Callable[[list[Row]], str]:
        return lambda some: f"{scale * np.median([row[name] for row in some]):.{digits}f}"

    columns: dict[str, Callable[[list[Row]], str]] = {
        "routes": lambda some: str(len(some)),
        "succeeded": lambda some: str(sum(row["success"] for row in some)),
        "95 %": interval,
        "goal reached": lambda some: str(sum(row["reached"] for row in some)),
        "contacts": lambda some: str(sum(row["contacts"] for row in some)),
        "duration [s]": of("duration"),
        "least clearance [mm]": of("clearance", 1e3, 0),
        "emergency ticks": of("emergencies", 1.0, 0),
        "plan [ms]": of("plan", 1.0, 1),
    }
    told = "; ".join(
        f"{how} {difference(rows, how)}" for how in AVOIDANCES if how != BASE and where(rows, avoidance=how)
    )
    refused = [row for row in rows if "error" in row]
    parts = [
        machine("numpy", "scipy", "pymunk"),
        listing(["speed [m/s]", "avoidance"], groups, columns),
        "Durations, clearances, ticks and times are medians over routes, the interval of the rate is Wilson's.",
        f"Success less that of `{BASE}`, a mean over routes of what both drove, with a bootstrap interval over routes: "
        f"{told}.",
        f"Refused: {len(refused)}." if refused else "",
    ]
    return "\n\n".join(part for part in parts if part)


def difference(rows: Sequence[Row], how: str) -> str:
    """Success less that of the base: a route's mean over the speeds that both drove, then the mean over routes."""
    both = {(row["seed"], row["speed"]): row["success"] for row in where(rows, avoidance=BASE)}
    apart: dict[int, list[float]] = {}
    for row in where(rows, avoidance=how):
        if (row["seed"], row["speed"]) in both:
            change = float(row["success"]) - float(both[row["seed"], row["speed"]])
            apart.setdefault(row["seed"], []).append(change)
    means = np.array([np.mean(changes) for changes in apart.values()])
    low, high = bootstrap(means)
    return f"{means.mean():+.2f} ({low:+.2f} .. {high:+.2f})"


def main(arguments: list[str] | None = None) -> int:
    """Drive and write."""
    parser = command(__doc__)
    parser.add_argument("--seeds", type=runs.seeds, default=SEEDS, help="routes (default: 400:405)")
    parser.add_argument("--speeds", type=float, nargs="+", default=SPEEDS, help="of movers [m/s] (default: 0.3 1.0)")
    runs.options(parser)
    chosen = parser.parse_args(arguments)
    jobs = [Crossing(how, speed, seed) for seed in chosen.seeds for speed in chosen.speeds for how in AVOIDANCES]
    rows = runs.episodes("crossing", drive, jobs, chosen)
    publish("avoidance", render(rows), {row["code"] for row in rows})
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
