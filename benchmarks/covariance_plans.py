"""Covariance in a plan against a fixed margin: time, clearance and collisions, paired over layouts.

On each random layout of discs and beacons a unicycle plans the fastest way to a goal. One plan keeps a fixed margin
along the way; a third keeps k deviations of its previous plan, over and over, without a variable for them. All are
driven with a filter, feedback and noise, on the same random numbers. Layouts are the random effect: intervals are
bootstrapped over them.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

import unifg as fg
from benchmarks.comparison import Row, difference, interval, where
from benchmarks.report import table
from benchmarks.runner import Study, every
from benchmarks.timing import clocked
from problems import belief_plans
from problems.belief_plans import Guess, Plan

RESERVE = 0.05  # margin of those plans that keep standard deviations [m]: the robot cuts corners between nodes
DEVIATIONS = (1.0, 2.0, 2.5, 3.0, 3.5)
WAYS = {
    "margin": (0.05, 0.1, 0.2, 0.3, 0.4, 0.6, 0.8, 1.0, 1.3, 1.6),
    "lagging": DEVIATIONS,
    "in the graph": DEVIATIONS,
}
UNITS = {"margin": "m", "lagging": "sigma", "in the graph": "sigma"}
DRIVES = 400  # of each plan
TARGETS = (0.1, 0.05, 0.02)  # shares of drives that may touch something


def attempt(seed: int, way: str) -> Row:
    """Plan with every setting, and drive; NaN where there is no plan."""
    world = belief_plans.layout(seed)
    planner = belief_plans.Planner(world, foresees=way == "in the graph")

    def solve(guess: Guess | fg.Solution, value: float) -> tuple[fg.Solution, Plan | None]:
        if way == "margin":
            return planner.solve(guess, value)
        if way == "lagging":
            return belief_plans.lagging(planner, guess, value, RESERVE)
        return planner.solve(guess, RESERVE, k=value)

    plans, spent = clocked(belief_plans.sweep, planner, solve, WAYS[way], by=time.process_time)
    seconds = spent / len(plans) / len(belief_plans.SIDES)
    plans_found = []
    for setting, plan in zip(WAYS[way], plans, strict=True):
        measured: Row = {"setting": setting, "seconds": seconds}
        if plan is not None:
            drives = belief_plans.drive(plan, world, DRIVES, seed)
            measured |= {
                "time": plan.duration,
                "collisions": drives.collisions,
                "clearance": float(np.quantile(drives.clearance, 0.05)),
                "sigma": float(plan.deviation.max()),
            }
        plans_found.append(measured)
    return {"plans": plans_found}


def plans_of(rows: Sequence[Row]) -> pd.DataFrame:
    """Plans by way, setting and layout, of the layouts that all ways have met; NaN where there is no plan."""
    found = pd.DataFrame(
        [{"way": row["way"], "seed": row["seed"], **plan} for row in where(rows) for plan in row["plans"]]
    )
    ways = found.groupby("seed")["way"].transform("nunique")
    return found[ways == found["way"].nunique()].set_index(["way", "setting", "seed"])


def mean(values: Any, scale: float = 1.0) -> str:
    """Mean and, in brackets, its bootstrap interval over layouts."""
    known = scale * np.asarray(values, dtype=np.float64)
    known = known[np.isfinite(known)]
    if not len(known):
        return "-"
    low, high = interval(known)
    return f"{known.mean():.3g} ({low:.3g} .. {high:.3g})"


def by_setting(plans: pd.DataFrame) -> dict[tuple[str, Any], pd.DataFrame]:
    """Plans of all layouts by way and setting."""
    groups = plans.groupby(["way", "setting"], sort=False)
    return {(str(way), setting): found.droplevel(["way", "setting"]) for (way, setting), found in groups}


def counted(mine: pd.Series[float], base: pd.Series[float]) -> str:
    """Mean of the paired difference over layouts, its interval, and the number of pairs."""
    pairs = (mine - base).dropna()
    return f"{difference(pairs)}, n={len(pairs)}" if len(pairs) else "-"


def render(rows: Sequence[Row]) -> str:
    """Markdown of the sweep and of the comparisons at equal risk."""
    plans = plans_of(rows)
    of, seeds = by_setting(plans), plans.index.unique("seed")
    lines = [
        [
            f"{way} {setting:g} {UNITS[way]}", f"{found['time'].notna().sum()} / {len(seeds)}", mean(found["time"]),
            mean(found["collisions"], 100.0), mean(found["clearance"], 100.0), mean(found["sigma"], 100.0),
        ]
        for (way, setting), found in of.items()
    ]  # fmt: skip
    head = ["setting", "plans", "time [s]", "collisions [%]", "clearance of 95 % [cm]", "greatest deviation [cm]"]
    once, each, none = [], [], pd.Series(dtype=float)
    for target in TARGETS:
        settings, best = chosen(plans, target), hindsight(plans, target)
        for way in WAYS:
            if way in settings:
                times = of[way, settings[way]]["time"]
                base = of["margin", settings["margin"]]["time"] if "margin" in settings else none
                against = "" if way == "margin" else counted(times, base)
                once.append([f"{target:.0%}", way, f"{settings[way]:g} {UNITS[way]}", mean(times), against])
            kept = best.get(way, none)
            against = "" if way == "margin" else counted(kept, best.get("margin", none))
            each.append([f"{target:.0%}", way, f"{len(kept)} / {len(seeds)}", against])
    seconds = plans.groupby("way", sort=False)["seconds"].mean()
    return "\n\n".join(
        [
            f"{len(seeds)} layouts, {DRIVES} drives of each plan; in brackets 95 % intervals over layouts.",
            "### Every setting",
            table(head, lines),
            "### One setting for all layouts, chosen afterwards",
            table(["collisions at most", "way", "setting", "time [s]", "difference to the margin [s]"], once, 2),
            "### The best setting of each layout, chosen afterwards",
            table(["collisions at most", "way", "layouts kept", "difference to the margin [s]"], each, 2),
            "Processor time of a plan from one guess, mean: "
            + ", ".join(f"{way} {1e3 * took:.0f} ms" for way, took in seconds.items())
            + ".",
        ]
    )


def chosen(plans: pd.DataFrame, target: float) -> dict[str, float]:
    """Fastest setting of each way whose mean share of collisions is no more than a target."""
    means = plans.groupby(["way", "setting"])[["time", "collisions"]].mean()
    kept = means[means["collisions"] <= target]["time"]
    return dict(kept.groupby("way").idxmin().to_list())


def hindsight(plans: pd.DataFrame, target: float) -> dict[str, pd.Series[float]]:
    """Least time of each layout by way, among all settings that keep to the target there."""
    times = plans[plans["collisions"] <= target].groupby(["way", "seed"])["time"].min()
    return {str(way): found.droplevel("way") for way, found in times.groupby("way")}


STUDY = Study(every(way=WAYS), attempt, render, range(12))
