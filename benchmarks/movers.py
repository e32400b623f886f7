"""Drives among movers as fast as the robot, and how much later they arrive than a disc that knows the future.

Routes through the building that nobody chose, three seeds each, with six discs on the path of which two go to and fro
without regard for the robot, at three speeds and on two bases, each time with plans for the worst that they can do, for
what is likeliest, and for a tree of futures. A drive counts where the clairvoyant one arrives within a minute.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np
import pandas as pd

from benchmarks.comparison import Row, difference, portion, where
from benchmarks.report import table
from benchmarks.routes import drawn
from benchmarks.runner import Cell, Study
from unifg.scenarios.episode import silent
from unifg.scenarios.ground.drive_settings import FUTURES, ControllerSettings
from unifg.scenarios.logs.drive_log import EpisodeLog
from unifg.scenarios.navigation import Episode, NavigationSettings
from unifg.scenarios.perception.tracks import to_and_fro
from unifg.scenarios.planning.space_time import CELL, Future, quickest
from unifg.scenarios.simulation.drivetrain import Drivetrain
from unifg.scenarios.simulation.space import Obstacle
from unifg.typing import Array

SPEEDS, BASES = (0.3, 0.6, 1.0), (2.5, 1.0)  # [m/s], [m/s^2]
TURNING = {2.5: 3.2, 1.0: 2.1}  # [rad/s^2] of the bases
ROUTES = 10  # of thirty numbers
FIRST = 700  # route
REST, RESTING = 0.05, 0.5  # [m/s], [s] for which a robot that was run over at rest was slower
LATEST = 60.0  # clairvoyant arrival of drives that count [s]


def meetings(seeds: Sequence[int]) -> list[Cell]:
    """All drives: of thirty seeds, ten routes three times each."""
    return [
        {"speed": speed, "base": base, "futures": futures, "seed": seed}
        for speed, base, seed, futures in product(SPEEDS, BASES, seeds, FUTURES)
    ]


def settings(speed: float, base: float, seed: int, futures: str = "worst") -> NavigationSettings:
    """One drive; ``seed`` draws the discs and, with its tens, the route."""
    start, goal = drawn(FIRST + seed // (3 * ROUTES) * ROUTES + seed % ROUTES)
    plant = replace(Drivetrain(), acceleration=base, turning=TURNING[base])
    return NavigationSettings(
        start=start, goals=(goal,), obstacles=6, mover_speed=speed, seed=seed, drivetrain=plant,
        controller=ControllerSettings(futures=futures),
    )  # fmt: skip


def measured(speed: float, base: float, futures: str, seed: int) -> Row:
    """Drive once."""
    episode = Episode(settings(speed, base, seed, futures))
    s = episode.controller
    way = quickest(
        episode.occupancy, episode.distance_map, episode.start, episode.goals[-1], s.robot_radius,
        future(episode.world.obstacles), s.speed, LATEST,
    )  # fmt: skip
    log = episode.run(silent)
    return {
        "reached": all(log.reached), "touched": touched(log),
        "arrival": math.inf if way is None else (len(way) - 1) * CELL / s.speed,
        "time": log.ticks * log.dt,
        "reverse": float((log.control[:, 0] < -REST).mean()), "tick": float(np.percentile(log.solve_ms, 99.0)),
    }  # fmt: skip


def future(obstacles: Sequence[Obstacle]) -> Future:
    """True future of obstacles that rest or go to and fro without waiting, from time zero on."""

    def discs(time: float) -> Array:
        rows = np.zeros((len(obstacles), 3))
        for row, disc in zip(rows, obstacles, strict=True):
            end = disc.centre if disc.end is None else disc.end
            length = max(math.dist(disc.centre, end), 1e-9)
            share = float(to_and_fro(0.0, length, 0.0, disc.speed, np.array(time))) / length
            row[:] = *disc.positions(np.array([share]))[0], disc.radius
        return rows

    return discs


def touched(log: EpisodeLog) -> str:
    """Kind of the first contact: "" for none, "at rest" where the robot was slow before, "moving" elsewhere."""
    touching = np.flatnonzero((log.contacts > 0) | (log.clearance < 0.0))
    if not len(touching):
        return "moving" if log.collisions else ""
    before = log.true_pose[max(int(touching[0]) - round(RESTING / log.dt) - 1, 0) : int(touching[0]), :2]
    fastest = np.hypot(*np.diff(before, axis=0).T).max(initial=0.0) / log.dt
    return "at rest" if len(before) > 1 and fastest < REST else "moving"


def render(rows: list[Row]) -> str:
    """The table and what its columns mean."""
    head = (
        "mover [m/s]", "base [m/s^2]", "plans for", "drives", "without contact at the goal", "95 %", "contacts",
        "run over at rest", "not reached", "arrival / clairvoyant", "in reverse", "99 % of ticks [ms]",
    )  # fmt: skip
    counted = pd.DataFrame(where(rows)).query(f"arrival <= {LATEST}")
    good, lines = counted[counted["reached"] & (counted["touched"] == "")], []
    for (speed, base, futures), mine in counted.groupby(["speed", "base", "futures"], sort=False):
        touched, ours = mine["touched"].value_counts(), good.loc[good.index.intersection(mine.index)]
        regret = (ours["time"] / ours["arrival"]).median()
        found = (
            speed, base, futures, len(mine), len(ours), portion(len(ours), len(mine)),
            touched.get("moving", 0), touched.get("at rest", 0), (~mine["reached"]).sum(), f"{regret:.2f}",
            f"{100 * mine['reverse'].mean():.0f} %", f"{mine['tick'].median():.1f}",
        )  # fmt: skip
        lines.append([f"{value:g}" if isinstance(value, float) else str(value) for value in found])
    words = (
        "A contact is a hull nearer than 0; *run over at rest* are those before which the robot was slower than "
        f"{REST:g} m/s for {RESTING:g} s, *contacts* the others. Arrivals are medians over drives at the goal without "
        "contact, divided by the earliest arrival of a disc of 1 m/s without accelerations that knows the future."
    )
    ends = good.pivot_table("time", ["speed", "base", "seed"], "futures").reindex(columns=FUTURES)
    words += "".join(f" {_later(ends, futures)}" for futures in FUTURES[1:])
    return f"{table(head, lines, text=0)}\n\n{words}"


def _later(ends: pd.DataFrame, futures: str) -> str:
    """Sentence about times (drives, futures) at the goal without contact, beside those of plans for the worst."""
    differences = (ends[futures] - ends["worst"]).dropna().to_numpy()
    if not len(differences):
        return f"No drive with plans for the {futures} has a pair."
    return (
        f"With plans for the {futures} the robot arrives {difference(differences)} s later than with those for the "
        f"worst ({len(differences)} pairs)."
    )


STUDY = Study(meetings, measured, render, range(3 * ROUTES))
