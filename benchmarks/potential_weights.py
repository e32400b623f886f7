"""Ta's cost 1/d with its weight swept, against a hard clearance, paired over corridors.

    python -m benchmarks.potential_weights [--seeds 1000:1010] [--workers K] [--fresh] [--report]

A quadrotor flies through unknown corridors (:mod:`benchmarks.quadrotor_flights`), sequential coupling, interior point.
Every weight of a seed meets the same corridor, parameters, disturbances and noise; intervals are bootstrapped over
corridors, on seeds that are open to tuning. Writes docs/potential-weights.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks import runs
from benchmarks.comparison import Row, against, where
from benchmarks.report import command, listing, machine, publish
from unifg.scenarios.flight import FlightSettings, run_flight
from unifg.scenarios.log.flight_metrics import flight_metrics

HARD = 0.0  # stands for a clearance that is a constraint
WEIGHTS = (HARD, 0.03, 0.1, 0.3, 1.0, 3.0)
FLIGHT = 25.0  # [s]; who has not arrived by then hangs


@dataclass(frozen=True)
class Job:
    """One flight; a weight of zero is a hard clearance."""

    seed: int
    weight: float


def fly(job: Job) -> Row:
    """Fly once."""
    plain = FlightSettings("ipm", "sequential", job.seed)
    if job.weight != HARD:
        own = replace(plain.controller, avoidance="potential", potential_weight=job.weight)
        plain = replace(plain, controller=own)
    log = run_flight(replace(plain, time_limit=FLIGHT))
    metrics = dict(flight_metrics(log))
    return {
        "reached": bool(metrics["reached"]),
        "collisions": int(log.collisions),
        "time": float(log.time[-1]),
        "clearance": float(np.min(log.clearance)),
        "emergencies": int(np.count_nonzero(log.emergency)),
    }


def render(rows: Sequence[Row]) -> str:
    """Markdown: one line for each weight."""
    base = where(rows, weight=HARD)
    groups = {
        ("hard clearance" if weight == HARD else f"{weight:g}",): some
        for weight in WEIGHTS
        if (some := where(rows, weight=weight))
    }
    columns = {
        "arrived": lambda some: f"{sum(row['reached'] for row in some)} of {len(some)}",
        "touched something": lambda some: str(sum(row["collisions"] > 0 for row in some)),
        "time of those who arrive [s]": lambda some: against(some, base, lambda r: r["time"] if r["reached"] else None),
        "least clearance [cm]": lambda some: against(some, base, lambda r: 100.0 * r["clearance"]),
        "of any flight [cm]": lambda some: f"{100.0 * min(row['clearance'] for row in some):.0f}",
        "emergencies": lambda some: str(sum(row["emergencies"] for row in some)),
    }
    said = "In brackets the 95 % interval, over corridors, of the paired difference to the hard clearance."
    return "\n\n".join(
        [machine("numpy", "scipy", "numba", "pymunk"), said, listing(["weight of 1/d [m]"], groups, columns)]
    )


def main(arguments: list[str] | None = None) -> int:
    """Fly what is missing and rewrite docs/potential-weights.md."""
    parser = command(__doc__)
    runs.options(parser)
    parser.add_argument("--seeds", type=runs.seeds, default=range(1000, 1010), metavar="FIRST:END")
    options = parser.parse_args(arguments)
    jobs = [Job(seed, weight) for seed in options.seeds for weight in WEIGHTS]
    rows = runs.episodes("potential_weights", fly, jobs, options)
    asked = [row for row in rows if row["seed"] in options.seeds]
    publish("potential-weights", render(asked), {row["code"] for row in asked})
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
