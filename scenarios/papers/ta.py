"""Experiments of Ta et al. 2014: optimal control past obstacles, and estimation with control in one flight."""

from __future__ import annotations

import numpy as np

from unifg.scenarios.course import GUESSES, CourseSettings, run_course
from unifg.scenarios.papers import corridor_flights
from unifg.scenarios.papers.comparison import Comparison, Effort, counted, measured
from unifg.scenarios.papers.courses import Method, attempted
from unifg.scenarios.papers.printed import texts
from unifg.scenarios.simulation.layouts import CORRIDOR_SEEDS, COURSE_SEEDS

OFTEN = 0.5  # share from which on a flight often succeeds


def figure_3(effort: Effort) -> Comparison:
    """Flights past three walls and a cylinder with the paper's cost 1/d: costs of the iterates, and successes."""
    text = texts("ta", "section V-A, Fig. 3")
    seeds = COURSE_SEEDS[: effort.of(25, len(COURSE_SEEDS))]
    history = run_course(CourseSettings(guess="hover")).solution.history
    costs = np.array([row.cost for row in history])
    lines = [counted("iterations that lower the cost", text["decreasing"], int((np.diff(costs) < 0.0).sum()),
                     len(costs) - 1)]  # fmt: skip
    for number, guess in enumerate(GUESSES):
        outcomes = []
        for k, seed in enumerate(seeds):
            effort.progress((number + k / len(seeds)) / 3.0, f"guess {guess}, layout {seed}")
            outcomes.append(attempted(Method("potential", guess, "sqp", "exact"), seed))
        safe = sum(outcome.safe for outcome in outcomes)
        lines.append(counted(f"target without a collision, guess {guess}", text["often"], safe, len(seeds), OFTEN))
    return Comparison(lines, f"{len(seeds)} random layouts (page: {len(COURSE_SEEDS)}), SQP with the exact Hessian.")


def figure_5(effort: Effort) -> Comparison:
    """Flights through cylinders that are not on the map."""
    text = texts("ta", "section V-B, Fig. 5")
    seeds = CORRIDOR_SEEDS[: effort.of(8, 50)]
    metrics, masses = [], []
    for k, seed in enumerate(seeds):
        effort.progress(k / len(seeds), f"flight {seed}")
        row = corridor_flights.fly(**vars(corridor_flights.Job("flights", "ipm", "sequential", seed)))
        metrics.append(row["metrics"])
        masses.append(100.0 * abs(row["mass"]["5"][0]) if "5" in row["mass"] else np.nan)
    lines = [
        counted("target without a collision", text["target"], sum(m["succeeded"] for m in metrics), len(seeds)),
        measured("position error [mm rms]", [], [1e3 * m["position_error_m"]["rms"] for m in metrics], 1),
        measured("velocity error [mm/s rms]", [], [1e3 * m["velocity_error_m_per_s"]["rms"] for m in metrics], 1),
        measured("mass error after 5 s [%]", [], masses),
        measured("least clearance [mm]", [], [1e3 * m["min_clearance_m"] for m in metrics], 0),
        measured("estimate and plan [ms]", [], [m["tick_ms"]["p50"] for m in metrics], 1),
    ]
    runs = f"{len(seeds)} flights (page: 50), sequential coupling, interior point; the paper draws one."
    return Comparison(lines, runs)
