"""Covariance in a plan against a fixed margin: time, clearance and collisions, paired over layouts.

    python -m benchmarks.covariance_plans [--seeds 0:12] [--drives 400] [--workers K] [--fresh] [--report]

On each random layout of discs and beacons a unicycle plans the fastest way to a goal. One plan keeps a fixed margin
from the discs, swept over its range; another keeps k standard deviations of where it will be, which its graph predicts
along the way; a third keeps k deviations of its previous plan, over and over, without a variable for them. All are
driven with a filter, feedback and noise, on the same random numbers. Layouts are the random effect: intervals are
bootstrapped over them. Writes docs/covariance-plans.md.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

import unifg as fg
from benchmarks import runs
from benchmarks.comparison import Row, digits, interval, where
from benchmarks.report import command, machine, publish, table
from problems import belief_plans
from problems.belief_plans import Guess, Plan

RESERVE = 0.05  # margin of those plans that keep standard deviations [m]: the robot cuts corners between nodes
DEVIATIONS = (1.0, 2.0, 2.5, 3.0, 3.5)
WAYS: dict[str, tuple[float, ...]] = {
    "margin": (0.05, 0.1, 0.2, 0.3, 0.4, 0.6, 0.8, 1.0, 1.3, 1.6),
    "lagging": DEVIATIONS,
    "in the graph": DEVIATIONS,
}
UNITS = {"margin": "m", "lagging": "sigma", "in the graph": "sigma"}
TARGETS = (0.1, 0.05, 0.02)  # shares of drives that may touch something


@dataclass(frozen=True)
class Job:
    """One layout, all settings of one way, and how often each plan is driven."""

    seed: int
    way: str
    drives: int


def attempt(job: Job) -> Row:
    """Plan with every setting, and drive."""
    world = belief_plans.layout(job.seed)
    planner = belief_plans.Planner(world, foresees=job.way == "in the graph")

    def solve(guess: Guess | fg.Solution, value: float) -> tuple[fg.Solution, Plan | None]:
        if job.way == "margin":
            return planner.solve(guess, value)
        if job.way == "lagging":
            return belief_plans.lagging(planner, guess, value, RESERVE)
        return planner.solve(guess, RESERVE, k=value)

    begin = time.process_time()
    plans = belief_plans.sweep(planner, solve, WAYS[job.way])
    seconds = (time.process_time() - begin) / len(plans) / len(belief_plans.SIDES)
    found: list[Row | None] = []
    for plan in plans:
        if plan is None:
            found.append(None)
            continue
        drives = belief_plans.drive(plan, world, job.drives, job.seed)
        found.append(
            {
                "time": plan.duration,
                "collisions": drives.collisions,
                "clearance": float(np.quantile(drives.clearance, 0.05)),
                "miss": float(np.sqrt(np.mean(drives.miss**2))),
                "sigma": float(plan.deviation.max()),
            }
        )
    return {"found": found, "seconds": seconds}


class Campaign:
    """What was found, by way, setting and layout.

    Attributes:
        seeds: layouts that all ways have met.
        seconds: processor time of a plan from one guess, by way.
    """

    def __init__(self, rows: list[Row], drives: int) -> None:
        """Sort the rows of some drives per plan."""
        ways = {way: {row["seed"]: row for row in where(rows, way=way, drives=drives)} for way in WAYS}
        self.seeds = sorted(set[int].intersection(*(set(found) for found in ways.values())))
        self._found = {way: [found[seed]["found"] for seed in self.seeds] for way, found in ways.items()}
        self.seconds = {
            way: float(np.mean([found[seed]["seconds"] for seed in self.seeds])) for way, found in ways.items()
        }

    def of(self, way: str, index: int, what: str) -> list[float]:
        """A number of each layout, not a number where there was no plan."""
        return [np.nan if row[index] is None else row[index][what] for row in self._found[way]]

    def collisions(self, way: str, index: int) -> float:
        """Mean share over the layouts with a plan."""
        return float(np.nanmean(self.of(way, index, "collisions")))

    def setting(self, way: str, target: float) -> int | None:
        """The fastest setting for all layouts whose mean share of collisions is no more than a target."""
        kept = [i for i in range(len(WAYS[way])) if self.collisions(way, i) <= target]
        return min(kept, key=lambda i: float(np.nanmean(self.of(way, i, "time"))), default=None)

    def best(self, way: str, target: float) -> list[float]:
        """The least time of each layout among all settings that keep to the target there: the choice of hindsight."""
        times = []
        for row in self._found[way]:
            kept = [found["time"] for found in row if found is not None and found["collisions"] <= target]
            times.append(min(kept, default=np.nan))
        return times


def mean(values: Sequence[float], scale: float = 1.0) -> str:
    """Mean and, in brackets, its bootstrap interval over layouts."""
    known = scale * np.array(values)[np.isfinite(values)]
    if not len(known):
        return "-"
    low, high = interval(known)
    return f"{known.mean():.3g} ({low:.3g} .. {high:.3g})"


def difference(mine: Sequence[float], base: Sequence[float]) -> str:
    """Mean of the paired difference, its interval, and the number of pairs."""
    pairs = np.array(mine) - np.array(base)
    pairs = pairs[np.isfinite(pairs)]
    if not len(pairs):
        return "-"
    low, high = interval(pairs)
    return f"{digits(pairs.mean(), '+')} ({digits(low, '+')} .. {digits(high, '+')}), n={len(pairs)}"


def render(found: Campaign, drives: int) -> str:
    """Markdown of the sweep and of the comparisons at equal risk."""
    count = len(found.seeds)
    lines = [
        [
            f"{way} {value:g} {UNITS[way]}",
            f"{np.isfinite(found.of(way, i, 'time')).sum()} / {count}",
            mean(found.of(way, i, "time")),
            mean(found.of(way, i, "collisions"), 100.0),
            mean(found.of(way, i, "clearance"), 100.0),
            mean(found.of(way, i, "sigma"), 100.0),
        ]
        for way, values in WAYS.items()
        for i, value in enumerate(values)
    ]
    head = ["setting", "plans", "time [s]", "collisions [%]", "clearance of 95 % [cm]", "greatest deviation [cm]"]
    once, each = [], []
    for target in TARGETS:
        base, hindsight = [np.nan] * count, found.best("margin", target)
        for way, values in WAYS.items():
            index = found.setting(way, target)
            times = [np.nan] * count if index is None else found.of(way, index, "time")
            base = times if way == "margin" else base
            words = "none" if index is None else f"{values[index]:g} {UNITS[way]}"
            against = "" if way == "margin" else difference(times, base)
            once.append([f"{target:.0%}", way, words, mean(times), against])
            best = found.best(way, target)
            against = "" if way == "margin" else difference(best, hindsight)
            each.append([f"{target:.0%}", way, f"{np.isfinite(best).sum()} / {count}", against])
    return "\n\n".join(
        [
            machine("numpy", "scipy", "osqp", "piqp", "numba"),
            f"{count} layouts, {drives} drives of each plan; in brackets 95 % intervals over layouts.",
            "### Every setting",
            table(head, lines),
            "### One setting for all layouts, chosen afterwards",
            table(["collisions at most", "way", "setting", "time [s]", "difference to the margin [s]"], once, 2),
            "### The best setting of each layout, chosen afterwards",
            table(["collisions at most", "way", "layouts kept", "difference to the margin [s]"], each, 2),
            "Processor time of a plan from one guess, mean: "
            + ", ".join(f"{way} {1e3 * found.seconds[way]:.0f} ms" for way in WAYS)
            + ".",
        ]
    )


def main(arguments: list[str] | None = None) -> int:
    """Run what is missing and rewrite docs/covariance-plans.md."""
    parser = command(__doc__)
    runs.options(parser)
    parser.add_argument("--seeds", type=runs.seeds, default=range(12), metavar="FIRST:END")
    parser.add_argument("--drives", type=int, default=400, help="of each plan")
    options = parser.parse_args(arguments)
    jobs = [Job(seed, way, options.drives) for seed in options.seeds for way in WAYS]
    rows = runs.episodes("covariance_plans", attempt, jobs, options)
    asked = [row for row in rows if row["seed"] in options.seeds]
    found = Campaign(asked, options.drives)
    publish("covariance-plans", render(found, options.drives), {row["code"] for row in asked})
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
