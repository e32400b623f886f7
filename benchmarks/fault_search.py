"""Search for the least faults that harm: a contact before the robot has named a cause, by kind of fault.

For every kind a cross-entropy search (Rubinstein 1999) over size, sign and begin: a round of draws from all that is
allowed, then rounds of draws about the best ones so far. A drive or flight without a contact before a name counts by
the least clearance until then; one with a contact by the size of its fault, as the least one is wanted.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from benchmarks.comparison import Row
from benchmarks.faults import first_named, run
from benchmarks.report import table
from benchmarks.runner import Cell, Study
from unifg.scenarios.simulation.faults import Fault

SPANS = {
    "lidar-turned": (0.02, 0.5, "rad"), "range-bias": (0.03, 0.8, "m"), "wheel-scale": (1.05, 2.0, "times"),
    "odometry-slip": (1.05, 3.0, "times"), "actuator-lag": (0.05, 1.0, "s"), "actuator-stuck": (1.0, 1.0, ""),
    "payload": (0.05, 0.8, "of the mass"), "thrust-loss": (0.02, 0.4, "of the thrust"), "gust": (0.5, 8.0, "m/s^2"),
}  # fmt: skip
"""Least and greatest size by kind, and its unit."""
FLOWN = ("payload", "thrust-loss", "gust")
SIGNED = ("lidar-turned", "range-bias")
BEGINS = {"drive": (0.0, 6.0), "flight": (1.0, 12.0)}  # [s]
ROUNDS, DRAWS, BEST = 3, 4, 2
NARROW = 0.25  # of the span; standard deviation of draws about the best, half as much in each round that follows


def search(kind: str, seed: int) -> Row:
    """Evaluations of one kind, each with its fault, least clearance before a name, contacts and time to the name."""
    rng = np.random.default_rng([57, seed, list(SPANS).index(kind)])
    robot = "flight" if kind in FLOWN else "drive"
    low, high, _ = SPANS[kind]
    tried, costs, found = list[np.ndarray](), list[float](), list[Row]()
    for number in range(ROUNDS):
        best = [tried[k] for k in np.argsort(costs)[:BEST]]
        for draw in range(DRAWS):
            share = rng.random(3)
            if best:
                share[:2] = np.clip(best[draw % BEST][:2] + NARROW / 2.0**number * rng.standard_normal(2), 0.0, 1.0)
                share[2] = best[draw % BEST][2]
            size = low * (high / low) ** float(share[0])
            signed = -size if kind in SIGNED and share[2] < 0.5 else size
            first, last = BEGINS[robot]
            begin = first + float(share[1]) * (last - first)
            found.append(evaluated(robot, Fault(kind, begin, size=None if low == high else signed), seed))
            tried.append(share)
            clear = found[-1]["unnamed"]
            costs.append(1.0 + clear if clear > 0.0 else size / high)
    return {"evaluations": found}


def evaluated(robot: str, fault: Fault, seed: int) -> Row:
    """Harm of one fault."""
    log = run(robot, fault, seed)
    named = first_named(log)
    touched = log.clearance <= 0.0
    before = log.time <= (math.inf if named is None else named)
    return {
        "size": fault.size, "begin": fault.begin, "after": None if named is None else named - fault.begin,
        "unnamed": float(log.clearance[before].min()),
        "contact": bool(touched.any() or log.collisions),
    }  # fmt: skip


def cells(seeds: Iterable[int]) -> list[Cell]:
    """All kinds."""
    return [{"kind": kind, "seed": seed} for seed in seeds for kind in SPANS]


def render(rows: list[Row]) -> str:
    """The table of the least faults that harm, and the sums above it."""
    lines, tried = [], list[Row]()
    for kind, (low, high, unit) in SPANS.items():
        mine = [one for row in rows if row["kind"] == kind for one in row["evaluations"]]
        contacts, harmful = contacts_of(mine)
        after = [one["after"] for one in mine if one["after"] is not None]
        clearance = min(one["unnamed"] for one in mine)
        sizes = f"{low:g} to {high:g} {unit}" if unit else "-"
        latest = f"{max(after):.2f}" if after else "-"
        found = kind, sizes, len(mine), len(contacts), len(harmful), least(contacts, unit), least(harmful, unit)
        lines.append([*map(str, found), f"{clearance:.2f}", str(len(mine) - len(after)), latest])
        tried += mine
    touching, unseen = map(len, contacts_of(tried))
    sums = f"{len(tried)} evaluations: {touching} with a contact, {unseen} of them before a cause was named."
    head = (
        "fault", "sizes", "evaluations", "contacts", "before a name", "least that touches",
        "least that touches before a name", "least clearance before a name [m]", "never named",
        "named after at most [s]",
    )  # fmt: skip
    return f"{sums}\n\n{table(head, lines, text=2)}"


def contacts_of(evaluations: list[Row]) -> tuple[list[Row], list[Row]]:
    """Evaluations with a contact, and those with one before a name."""
    return [one for one in evaluations if one["contact"]], [one for one in evaluations if one["unnamed"] <= 0.0]


def least(harmful: list[Row], unit: str) -> str:
    """Smallest size of some evaluations, and when it began."""
    if not harmful:
        return "none"
    smallest = min(harmful, key=lambda one: abs(one["size"] or 1.0))
    size = "" if smallest["size"] is None else f"{smallest['size']:.2f} {unit} "
    return f"{size}at {smallest['begin']:.1f} s"


STUDY = Study(cells, search, render, (10,))
