"""Plans that go where they learn: the error at the goal against the time it costs, paired over layouts.

On each random layout of discs and of beacons beside the way a unicycle drives to a goal in the dark. One plan has the
predicted deviation at the goal in its cost, with the weight swept; another counts on near sightings only; the rule of
thumb is the fastest way that passes one of the beacons within a distance, of which the best beacon and distance are
taken. All are driven with a filter, feedback and noise, on the same random numbers. Layouts are the random effect:
intervals are bootstrapped over them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

import unifg as fg
from benchmarks.comparison import Row
from benchmarks.covariance_plans import by_setting, counted, mean, plans_of
from benchmarks.report import table
from benchmarks.runner import Study, every
from problems import belief_plans
from problems.belief_plans import SENSOR, Guess, Layout, Plan, Planner

MARGIN = 0.3  # from discs, of all plans [m]
WEIGHTS = (3.0, 10.0, 30.0)  # of the deviation at the goal [s/m]
PASSES = (2.0, 1.2, 0.6)  # distances at which a rule passes a beacon [m]
DISCS = 3
DRIVES = 300  # of each plan
WAYS = {
    "rule": tuple(f"{distance:g}" for distance in PASSES),
    "in the cost": tuple(f"{weight:g}" for weight in WEIGHTS),
    "cautious": tuple(f"{weight:g}" for weight in WEIGHTS),
}
UNITS = {"rule": "m", "in the cost": "s/m", "cautious": "s/m"}
CAUTIOUS = replace(SENSOR, reach=1.5)
"""What a cautious plan counts on: sightings a metre within the reach, since it will not be where it plans to be."""
COLUMNS = {
    "time [s]": ("time", 1.0),
    "error at the goal, rms [cm]": ("error", 100.0),
    "foreseen [cm]": ("foreseen", 100.0),
    "distance from the goal, rms [cm]": ("miss", 100.0),
    "collisions [%]": ("collisions", 100.0),
}
TARGETS = (0.7, 0.5, 0.35)  # errors at the goal, rms [m]
LONGER = (0.3, 1.0, 3.0)  # than the fastest plan [s]


def dark(seed: int) -> Layout:
    """A way in the dark: few discs on it, and two beacons so far beside it that it hardly meets their light."""
    rng, among = np.random.default_rng(seed), belief_plans.layout(seed, DISCS)
    beacons = np.stack([rng.uniform(3.0, 7.5, 2), rng.choice([-1.0, 1.0], 2) * rng.uniform(2.8, 4.5, 2)], axis=1)
    return Layout(among.discs, among.radii, beacons)


def planned(seed: int, way: str) -> list[tuple[str, Plan | None]]:
    """Plans of one way, by the words that name their settings."""
    world = dark(seed)
    if way != "rule":
        planner = Planner(world, sensor=SENSOR if way == "in the cost" else CAUTIOUS)

        def solve(guess: Guess | fg.Solution, weight: float) -> tuple[fg.Solution, Plan | None]:
            return planner.solve(guess, MARGIN, arrival=weight)

        starts = [planner.guess(side) for side in (-2.0, 2.0)]
        starts += [planner.past(beacon)[0] for beacon in world.beacons]
        found = belief_plans.sweep(planner, solve, WEIGHTS, starts)
        return [(f"{weight:g}", plan) for weight, plan in zip(WEIGHTS, found, strict=True)]
    planner, plans = Planner(world, foresees=False, via=True), list[tuple[str, Plan | None]]()
    free = planner.within.value
    for beacon in world.beacons:
        guess, node = planner.past(beacon)
        for distance in PASSES:
            within = free.copy()
            within[node - 1] = distance
            _, plan = planner.solve(guess, MARGIN, place=beacon, within=within)
            plans.append((f"{distance:g}", plan))
    return plans


def attempt(seed: int, way: str) -> Row:
    """Plan in one way, and drive all plans."""
    world = dark(seed)
    plans: list[Row] = []
    for words, plan in planned(seed, way):
        if plan is None:
            continue
        drives = belief_plans.drive(plan, world, DRIVES, seed)
        plans.append(
            {
                "setting": words,
                "time": plan.duration,
                "foreseen": float(plan.deviation[-1]),
                "error": float(np.sqrt(np.mean(drives.arrival**2))),
                "miss": float(np.sqrt(np.mean(drives.miss**2))),
                "collisions": drives.collisions,
            }
        )
    return {"plans": plans}


def fastest(plans: pd.DataFrame, target: float) -> dict[str, pd.Series[float]]:
    """Least time of each layout by way, among all plans whose drives end with no more than a target's error."""
    return by_way(plans[plans["error"] <= target].groupby(["way", "seed"])["time"].min())


def surest(plans: pd.DataFrame, longer: float) -> dict[str, pd.Series[float]]:
    """Least error of each layout by way, among all plans that take no more than this beyond the fastest of any way."""
    least = plans.groupby("seed")["time"].transform("min")
    return by_way(plans[plans["time"] <= least + longer].groupby(["way", "seed"])["error"].min())


def by_way(values: pd.Series[float]) -> dict[str, pd.Series[float]]:
    """Values of the layouts, by way; none for a way without plans."""
    return {way: values.xs(way) if way in values.index else pd.Series(dtype=float) for way in WAYS}


def render(rows: Sequence[Row]) -> str:
    """Markdown of all settings, and of both ways at equal error and at equal time."""
    plans = plans_of(rows)
    count, base = len(plans.index.unique("seed")), "rule"
    quickest = by_setting(plans.sort_values("time").groupby(["way", "setting", "seed"], sort=False).first())
    lines = [
        [
            f"{way}, {setting} {UNITS[way]}",
            *(mean(quickest[way, setting][what], scale) for what, scale in COLUMNS.values()),
        ]
        for way, settings in WAYS.items() for setting in settings if (way, setting) in quickest
    ]  # fmt: skip
    error, late, beside = [], [], [f"{way}, to the rule" for way in WAYS if way != base]
    for target in TARGETS:
        times = fastest(plans, target)
        reached = [f"{len(times[way])} / {count}" for way in WAYS]
        error.append([f"{100.0 * target:g} cm", *reached, *(counted(times[w], times[base]) for w in WAYS if w != base)])
    for longer in LONGER:
        errors = {way: 100.0 * found for way, found in surest(plans, longer).items()}
        against = [counted(errors[way], errors[base]) for way in WAYS if way != base]
        late.append([f"{longer:g} s", *(mean(errors[way]) for way in WAYS), *against])
    return "\n\n".join(
        [
            f"{count} layouts, {DRIVES} drives of each plan; in brackets 95 % intervals over layouts. The rule's lines "
            "are those of the beacon that takes the least time.",
            "### Every setting",
            table(["plan", *COLUMNS], lines),
            "### The fastest plan of each layout that ends with no more error",
            table(["error, rms", *(f"reached, {way}" for way in WAYS), *beside], error),
            "### The surest plan of each layout in a time",
            table(["beyond the fastest", *(f"error, {way} [cm]" for way in WAYS), *beside], late),
        ]
    )


STUDY = Study(every(way=WAYS), attempt, render, range(100, 110))
