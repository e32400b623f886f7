"""Robots that drive in one building at once, each on its own: success, contacts, and what a tick of all of them takes.

    python -m benchmarks.fleet [--seeds 600:603] [--robots 1 2 5 10] [--processes 1 2] [--workers K] [--fresh]
        [--report] [--any-code]

Every seed draws as many routes through the building that ships with the package as there are robots, no two of which
begin or end in one place; fewer robots drive the first of the same routes. Nobody tells anybody anything: the others
are movers of unknown speed that wait for nobody. Writes docs/fleet.md.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import count

import numpy as np

from benchmarks import runs
from benchmarks.comparison import Row, share, where
from benchmarks.report import command, listing, machine, publish
from benchmarks.routes import Place, drawn
from unifg.scenarios.driving.drive_pilot import COUPLINGS
from unifg.scenarios.fleet import run_fleet
from unifg.scenarios.log.drive_metrics import episode_metrics
from unifg.scenarios.navigation import NavigationSettings

SEEDS, ROBOTS, PROCESSES = range(600, 603), (1, 2, 5, 10), (1, 2)
PROCESS = resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN
APART = 1.5  # [m] between starts, and between goals


@dataclass(frozen=True)
class Together:
    """Robots in one building."""

    robots: int
    processes: int
    coupling: str
    seed: int


@cache
def routes(seed: int, number: int) -> list[tuple[Place, Place]]:
    """So many routes of a seed; more of them begin with the same ones."""
    return [route for route, _ in zip(_apart(seed), range(number), strict=False)]


def _apart(seed: int) -> Iterator[tuple[Place, Place]]:
    chosen: list[tuple[Place, Place]] = []
    for k in count():
        route = drawn(1000 * seed + k)
        gaps = [np.hypot(a[0] - b[0], a[1] - b[1]) for other in chosen for a, b in zip(route, other, strict=True)]
        if min(gaps, default=np.inf) >= APART:
            chosen.append(route)
            yield route


def drive(job: Together) -> Row:
    """Run once."""
    robots = [
        NavigationSettings(start=start, goals=(goal,), coupling=job.coupling, seed=job.seed + 100 * k)
        for k, (start, goal) in enumerate(routes(job.seed, job.robots))
    ]
    told = list[float]()
    logs = run_fleet(robots, lambda done, text: told.append(time.perf_counter()), workers=job.processes)
    metrics = [episode_metrics(log) for log in logs]
    ticks = np.zeros((len(logs), max(log.ticks for log in logs)))
    for row, log in zip(ticks, logs, strict=True):
        row[: log.ticks] = log.tick_ms
    parts = [ticks[first :: job.processes].sum(axis=0) for first in range(job.processes)]
    together, under_way = np.max(parts, axis=0), min(log.ticks for log in logs)
    return {
        "succeeded": sum(bool(m["succeeded"]) for m in metrics),
        "reached": sum(bool(m["reached"]) for m in metrics),
        "contacts": sum(int(m["collisions"]) for m in metrics),
        "clearance": min(float(m["min_clearance_m"]) for m in metrics),
        "duration": float(np.mean([m["duration_s"] for m in metrics])),
        "detour": float(np.mean([m["path_length_m"] / m["planned_length_m"] for m in metrics])),
        "outcomes": [outcome for m in metrics for outcome in m["outcomes"] if outcome != "reached"],
        "tick": float(np.median(np.concatenate([log.tick_ms for log in logs]))),
        "all": float(np.median(together[:under_way])),
        "worst": float(np.percentile(together, 99.0)),
        "whole": 1e3 * float(np.median(np.diff(told)[: under_way - 1])),
        "memory": max(resource.getrusage(who).ru_maxrss for who in PROCESS) / 1e6,
    }


def render(rows: Sequence[Row]) -> str:
    """Markdown."""
    sizes = sorted({row["robots"] for row in where(rows)})
    groups = {
        (str(size), str(processes), coupling): found
        for size in sizes
        for processes in sorted({row["processes"] for row in rows})
        for coupling in COUPLINGS
        if (found := where(rows, robots=size, processes=processes, coupling=coupling))
    }

    def rate(some: list[Row]) -> str:
        drives = sum(row["robots"] for row in some)
        low, high = share(sum(row["succeeded"] for row in some), drives)
        return f"{100.0 * low:.0f} .. {100.0 * high:.0f} %"

    def of(name: str, form: str) -> Callable[[list[Row]], str]:
        return lambda some: format(float(np.mean([row[name] for row in some])), form)

    columns: dict[str, Callable[[list[Row]], str]] = {
        "drives": lambda some: str(sum(row["robots"] for row in some)),
        "goal reached": lambda some: str(sum(row["reached"] for row in some)),
        "and no contact": lambda some: str(sum(row["succeeded"] for row in some)),
        "95 %": rate,
        "contacts": lambda some: str(sum(row["contacts"] for row in some)),
        "least clearance [mm]": lambda some: f"{1e3 * min(row['clearance'] for row in some):.0f}",
        "duration [s]": of("duration", ".1f"),
        "driven / planned": of("detour", ".3f"),
        "tick of one [ms]": of("tick", ".1f"),
        "tick of all [ms]": of("all", ".1f"),
        "its 99 % [ms]": of("worst", ".1f"),
        "with worlds and lidars [ms]": of("whole", ".1f"),
        "largest process [GB]": lambda some: f"{max(row['memory'] for row in some):.2f}",
    }
    ended = [outcome for row in where(rows) for outcome in row["outcomes"]]
    refused = [f"{row['robots']} robots, seed {row['seed']}: {row['error']}" for row in rows if "error" in row]
    parts = [
        machine("numpy", "scipy", "pymunk"),
        listing(["robots", "processes", "coupling"], groups, columns),
        "A contact of two robots counts for both. The tick of all is what all decisions of a tick take while all "
        "robots are under way, one after the other in each process; the controllers have 100 ms. With worlds and "
        "lidars it is the time between two ticks.",
        f"Goals that were not reached: {'; '.join(ended)}." if ended else "",
        f"Refused: {'; '.join(refused)}." if refused else "",
    ]
    return "\n\n".join(part for part in parts if part)


def main(arguments: list[str] | None = None) -> int:
    """Drive and write."""
    parser = command(__doc__)
    parser.add_argument("--seeds", type=runs.seeds, default=SEEDS, help="sets of routes (default: 600:603)")
    parser.add_argument("--robots", type=int, nargs="+", default=ROBOTS, help="at once (default: 1 2 5 10)")
    parser.add_argument("--processes", type=int, nargs="+", default=PROCESSES, help="that decide (default: 1 2)")
    parser.add_argument("--couplings", nargs="+", choices=COUPLINGS, default=COUPLINGS, help="of estimate and control")
    runs.options(parser)
    chosen = parser.parse_args(arguments)
    jobs = [
        Together(n, processes, coupling, seed)
        for seed in chosen.seeds
        for coupling in chosen.couplings
        for n in chosen.robots
        for processes in chosen.processes
        if processes <= n
    ]
    rows = runs.episodes("fleet", drive, jobs, chosen)
    publish("fleet", render(rows), {row["code"] for row in rows})
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
