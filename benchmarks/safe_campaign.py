"""Flights past obstacles with a margin: campaigns with an oracle, the figures of the paper, a Pareto curve, times.

The study "campaign" flies random situations; the others are those of the paper's figures.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import product

import numpy as np

from benchmarks.comparison import Row, difference, where
from benchmarks.report import table
from benchmarks.runner import Cell, Study
from unifg.scenarios.papers.barrier_flights import BASE, EIGHTS, Job, fly
from unifg.scenarios.quadrotor.situations import Kind

STUDIES = ("campaign", "static", "ellipse", "eights", "times", "sight", "ball")
RANDOM: tuple[Kind, ...] = ("static", "ellipse", "cluttered")
MARGINS = (0.05, 0.1, 0.2, 0.3, 0.4, 0.55, 0.7)
SPLINES = (0.05, 0.1, 0.2, 0.3, 0.4, 0.6, 0.8, 1.0)
STEPS = (0.05, 0.1)


def cells(seeds: Sequence[int]) -> list[Cell]:
    """All flights."""
    many: dict[str, list[Job]] = {
        "campaign": [Job("campaign", case, seed=seed) for case in RANDOM for seed in seeds],
        "static": [Job("static", "static", alpha=alpha) for alpha in (0.1, 0.3, 1.2, 3.0)],
        "ellipse": [Job("ellipse", "ellipse", gamma=gamma) for gamma in (0.0, 0.1, 0.3, 1.3)],
        "eights": [
            Job("eights", "figure8", who, speed=speed, seed=seed, knowledge=known, duration=12.0)
            for known, speed, seed, who in product(
                ("estimated", "books"), (1.0, 2.0, 3.0), EIGHTS, ("barrier", "flatness")
            )
            if known == "estimated" or seed < EIGHTS[4]
        ],
        "times": [Job("times", "ellipse", slots=slots) for slots in (0, 5)],
        "sight": [
            *(Job("sight", "static", alpha=6.0, margin=margin, step=step) for step in STEPS for margin in MARGINS),
            *(Job("sight", "static", "spline", margin=margin) for margin in SPLINES),
        ],
        "ball": [Job("ball", "ball", alpha=3.0, speed=3.2, seed=seed) for seed in (-1, *range(1, 11))],
    }
    return [vars(job) for jobs in many.values() for job in jobs]


def times_of(rows: list[Row]) -> list[str]:
    """Median, p99, p99.9 and the most of all ticks, and how many of them took more than 10 ms."""
    every = np.concatenate([row["decide_ms"] for row in rows])
    marks = [f"{np.percentile(every, q):.2f}" for q in (50.0, 99.0, 99.9, 100.0)]
    return [str(len(every)), *marks, f"{np.mean(every < 10.0):.2%}"]


TIMES = ["ticks", "median [ms]", "p99", "p99.9", "most", "below 10 ms"]


def campaign(rows: list[Row]) -> str:
    """The hundred flights of each case."""
    lines = []
    for case in RANDOM:
        found = where(rows, study="campaign", case=case)
        if not found:
            continue
        lost = [row for row in found if not row["margin_kept"]]
        answers = [row["oracle"] for row in found]
        near = np.array([row["boundary"] for row in found])
        counts = sum((Counter(row["statuses"]) for row in found), Counter[str]())
        ends = [str(counts[word]) for word in ("last plan", "braking", "too near")]
        lines.append(
            [
                case, str(len(found)), "/".join(str(answers.count(word)) for word in ("yes", "unknown", "no")),
                str(len(lost)), str(sum(row["charged"] for row in lost)), str(sum(row["told"] for row in lost)),
                f"{1e3 * near.min():.0f}", f"{1e3 * np.median(near):.0f}", str(sum(row["arrived"] for row in found)),
                *ends, *times_of(found),
            ]
        )  # fmt: skip
    head = [
        "case", "flights", "oracle: yes/unknown/no", "margin lost", "with a way out", "told", "least boundary [mm]",
        "median", "arrived", "ticks on the last plan", "braking", "too near", *TIMES,
    ]  # fmt: skip
    return table(head, lines)


def worst(rows: list[Row]) -> str:
    """Flights whose margin was lost, one by one."""
    lost = [row for row in where(rows, study="campaign") if not row["margin_kept"] or not row["arrived"]]
    if not lost:
        return "Every flight kept its margin and arrived."
    lines = [
        [
            row["case"], str(row["seed"]), f"{1e3 * row['boundary']:.1f}", row["oracle"],
            "-" if row["margin_kept"] else "yes" if row["charged"] else "no", "yes" if row["arrived"] else "no",
            f"{1e3 * row['slack']:.0f}",
        ]
        for row in lost
    ]  # fmt: skip
    head = ["case", "seed", "boundary [mm]", "oracle at first", "a way out later", "arrived", "most slack [mm]"]
    return table(head, lines)


def swept(rows: list[Row], study: str, by: str) -> str:
    """The flights of the description, by one number."""
    lines = [
        [
            f"{row[by]:g}", f"{1e3 * row['boundary']:.0f}", f"{row['error']:.3f}", f"{row['top']:.2f}",
            "yes" if row["arrived"] else "no", *times_of([row])[1:4],
        ]
        for row in sorted(where(rows, study=study), key=lambda row: float(row[by]))
    ]  # fmt: skip
    return table([by, "boundary [mm]", "from the path [m rms]", "top speed [m/s]", "arrived", *TIMES[1:4]], lines)


def eights(rows: list[Row]) -> str:
    """Fig. 10: who is nearer to the path."""
    lines = []
    for known, speed in product(("estimated", "books"), (1.0, 2.0, 3.0)):
        plans, flat = (
            {
                row["seed"]: 1e3 * row["error"]
                for row in where(rows, study="eights", knowledge=known, speed=speed, controller=who)
            }
            for who in ("barrier", "flatness")
        )
        seeds = sorted(set(plans) & set(flat))
        if not seeds:
            continue
        apart = np.array([plans[seed] - flat[seed] for seed in seeds])
        means = [f"{np.mean([side[seed] for seed in seeds]):.2f}" for side in (plans, flat)]
        lines.append([known, f"{speed:g}", str(len(seeds)), *means, difference(apart)])
    head = ["knowledge", "peak speed [m/s]", "seeds", "plan [mm rms]", "flatness [mm rms]", "difference, paired [mm]"]
    return table(head, lines)


def sight(rows: list[Row]) -> str:
    """Pareto curves of the plan with two looks ahead, and of the spline, which sees everything."""
    found = where(rows, study="sight")
    curve = {
        who: sorted((row["error"], 1e3 * (row["clearance"] - BASE), row["margin"]) for row in some)
        for who, some in (
            *(
                (f"plan, {0.01 + 19 * step:.2f} s ahead", where(found, controller="barrier", step=step))
                for step in STEPS
            ),
            ("spline, everything", where(found, controller="spline")),
        )
        if some
    }
    spline = np.array([point[:2] for point in curve.get("spline, everything", [])])
    lines = []
    for who, points in curve.items():
        for error, boundary, margin in points:
            at = error if len(spline) and spline[0, 0] <= error <= spline[-1, 0] else np.nan
            beside = "-" if who.startswith("spline") or np.isnan(at) else f"{boundary - np.interp(at, *spline.T):+.0f}"
            lines.append([who, f"{margin:g}", f"{error:.3f}", f"{boundary:.0f}", beside])
    head = ["who, and how far it sees", "margin [m]", "from the path [m rms]", "boundary [mm]", "above the spline [mm]"]
    return table(head, lines)


def barriers_cost(rows: list[Row]) -> str:
    """Fig. 7: the same flight with and without barriers in the plan."""
    names = {0: "none", 5: "one sphere"}
    lines = [[names[row["slots"]], *times_of([row])] for row in where(rows, study="times")]
    return table(["barriers in the plan", *TIMES], lines)


def balls(rows: list[Row]) -> str:
    """Fig. 11 b, as it is described and from ten hands."""
    found = where(rows, study="ball")
    lines = [
        [
            "described" if row["seed"] < 0 else str(row["seed"]), f"{1e3 * row['boundary']:.0f}", row["oracle"],
            "yes" if row["margin_kept"] else "no", "yes" if row["arrived"] else "no",
        ]
        for row in found
    ]  # fmt: skip
    return table(["throw", "boundary [mm]", "oracle", "margin kept", "back in place"], lines)


def render(rows: list[Row]) -> str:
    """Markdown of all tables."""
    parts = [
        ("Random flights", campaign(rows) + "\n\n" + worst(rows)),
        ("Fig. 5: alpha", swept(rows, "static", "alpha")),
        ("Fig. 6: gamma", swept(rows, "ellipse", "gamma")),
        ("Fig. 7: times with and without barriers", barriers_cost(rows)),
        ("Fig. 10: figure eights", eights(rows)),
        ("Fig. 11 b: a ball", balls(rows)),
        ("What sight and margin cost", sight(rows)),
    ]
    workers = sorted({row["workers"] for row in rows})
    told = f"Flown {' and '.join(map(str, workers))} at a time; processor times of the thread that decides."
    text = "\n\n".join(f"### {title}\n\n{body}" for title, body in parts)
    return f"{text}\n\n{told}"


STUDY = Study(cells, fly, render, range(1, 101))
