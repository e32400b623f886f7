"""Experiments of FactorMPC (Yang et al. 2025): distances, times and errors of a quadrotor with control barriers."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from unifg.scenarios.papers.barrier_flights import EIGHTS, Job, fly
from unifg.scenarios.papers.comparison import Comparison, Effort, Line, counted, measured, paired, stated
from unifg.scenarios.papers.printed import numbers, texts
from unifg.typing import Array

DESCRIBED = -1  # seed of the flight as the paper describes it


def _flown(effort: Effort, jobs: Sequence[Job]) -> list[dict[str, Any]]:
    """Records of flights."""
    rows = []
    for number, job in enumerate(jobs):
        effort.progress(number / len(jobs), f"flight {number + 1} of {len(jobs)}")
        rows.append(fly(**vars(job)))
    return rows


def _least(rows: Iterable[dict[str, Any]]) -> Array:
    """(n,) least distances of the hull's margin from an obstacle [mm]."""
    return np.array([1e3 * row["boundary"] for row in rows])


def _farther(effort: Effort, what: str, text: str, jobs: Sequence[tuple[str, Job]]) -> Comparison:
    """Least distances with each of some settings, and the paired difference of the last to the first."""
    seeds = [DESCRIBED, *range(1, effort.of(5, 20))]
    rows = _flown(effort, [replace(job, seed=seed) for _, job in jobs for seed in seeds])
    found = [_least(rows[k * len(seeds) : (k + 1) * len(seeds)]) for k in range(len(jobs))]
    lines = [measured(f"{what}, {name} [mm]", [], near, 0) for (name, _), near in zip(jobs, found, strict=True)]
    beside = f"{what}, {jobs[-1][0]} less {jobs[0][0]} [mm]"
    lines.append(paired(beside, text, found[-1] - found[0], 1.0, 0))
    return Comparison(lines, f"The paper's flight and {len(seeds) - 1} random ones (full: 19); differences are paired.")


def figure_5(effort: Effort) -> Comparison:
    """Distance from a cylinder with two values of alpha."""
    near, far = (numbers("factormpc", "Fig. 5", name)[0] for name in ("near", "far"))
    jobs = [(f"alpha {alpha:g}", Job("static", "static", alpha=alpha)) for alpha in (near, far)]
    return _farther(effort, "least distance", texts("factormpc", "Fig. 5")["farther"], jobs)


def figure_6(effort: Effort) -> Comparison:
    """Distance from a sphere on an ellipse without and with its velocity in the barrier."""
    (largest,) = numbers("factormpc", "Fig. 6", "largest")
    jobs = [(f"gamma {gamma:g}", Job("ellipse", "ellipse", gamma=gamma)) for gamma in (0.0, largest)]
    return _farther(effort, "least distance", texts("factormpc", "Fig. 6")["farther"], jobs)


def figure_7(effort: Effort) -> Comparison:
    """Times of a decision past a sphere, with barriers and without, at 100 Hz."""
    (most,), (mean,) = numbers("factormpc", "Fig. 7", "most"), numbers("factormpc", "section IV-B", "mean_time")
    within, limit = numbers("factormpc", "section IV-B", "within_10_ms")
    seeds = [DESCRIBED, *range(1, effort.of(3, 10))]
    rows = _flown(effort, [Job("times", "ellipse", slots=slots, seed=seed) for slots in (5, 0) for seed in seeds])
    barriers, none = ([np.array(row["decide_ms"]) for row in some] for some in (rows[: len(seeds)], rows[len(seeds) :]))
    worst = max(float(one.max()) for one in barriers)
    text = texts("factormpc", "Fig. 7")["most"]
    lines = [
        measured("with barriers, mean of a flight [ms]", [], [one.mean() for one in barriers]),
        stated("with barriers, most [ms]", text, f"{worst:.2f}", worst < most),
        measured("without barriers, mean of a flight [ms]", [mean], [one.mean() for one in none]),
        measured(f"without barriers, below {limit:g} ms [%]", [within], [100 * (one < limit).mean() for one in none]),
    ]
    ticks = sum(map(len, barriers))
    return Comparison(lines, f"{len(seeds)} flights each, {ticks} ticks with barriers; processor times, this machine.")


def figure_8(effort: Effort) -> Comparison:
    """Flights among fourteen obstacles at rest and ten that move."""
    rows = _flown(effort, [Job("campaign", "cluttered", seed=seed) for seed in range(1, effort.of(6, 101))])
    kept = sum(row["margin_kept"] and row["arrived"] for row in rows)
    lines = [
        counted("arrived with the margin kept", texts("factormpc", "Fig. 8")["cluttered"], kept, len(rows)),
        measured("least distance [mm]", [], _least(rows), 0),
        measured("decision, median of a flight [ms]", [], [float(np.median(row["decide_ms"])) for row in rows]),
    ]
    return Comparison(lines, f"{len(rows)} random flights (page: 100).")


def figure_10(effort: Effort) -> Comparison:
    """Errors of figure eights with a plan, beside control by differential flatness."""
    seeds, lines = EIGHTS[: effort.of(2, len(EIGHTS))], list[Line]()
    text = texts("factormpc", "Fig. 10")["smaller"].partition(" compared")[0]
    for speed in (1.0, 2.0, 3.0):
        jobs = [
            Job("eights", "figure8", who, speed=speed, seed=seed, duration=12.0)
            for who in ("barrier", "flatness")
            for seed in seeds
        ]
        plan, flatness = np.array([1e3 * row["error"] for row in _flown(effort, jobs)]).reshape(2, -1)
        lines += [
            measured(f"plan, {speed:g} m/s [mm rms]", [], plan),
            measured(f"flatness, {speed:g} m/s [mm rms]", [], flatness),
            paired(f"plan less flatness, {speed:g} m/s [mm]", text, plan - flatness, -1.0),
        ]
    return Comparison(lines, f"{len(seeds)} flights of 12 s each (page: {len(EIGHTS)}); differences are paired.")


def figure_11(effort: Effort) -> Comparison:
    """Throws of a ball at a quadrotor that hovers."""
    seeds = [DESCRIBED, *range(1, effort.of(4, 11))]
    rows = _flown(effort, [Job("ball", "ball", alpha=3.0, speed=3.2, seed=seed) for seed in seeds])
    kept = sum(row["margin_kept"] and row["arrived"] for row in rows)
    lines = [
        counted("margin kept and back in place", texts("factormpc", "Fig. 11")["ball"], kept, len(rows)),
        measured("least distance [mm]", [], _least(rows), 0),
    ]
    return Comparison(lines, f"The throw of the paper and {len(rows) - 1} others (page: 10).")
