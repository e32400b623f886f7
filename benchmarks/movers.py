"""Drives among movers as fast as the robot, and how much later they arrive than a disc that knows the future.

Routes through the building that nobody chose, three seeds each, with six discs on the path of which two go to and fro
without regard for the robot, at three speeds and on two bases. A drive counts where the clairvoyant one arrives within
a minute.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from benchmarks.comparison import Row, share
from benchmarks.report import table
from benchmarks.routes import drawn
from benchmarks.runner import Cell, Study
from unifg.scenarios.episode import silent
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
    return [{"speed": speed, "base": base, "seed": seed} for speed, base, seed in product(SPEEDS, BASES, seeds)]


def settings(speed: float, base: float, seed: int) -> NavigationSettings:
    """One drive; ``seed`` draws the discs and, with its tens, the route."""
    start, goal = drawn(FIRST + seed // (3 * ROUTES) * ROUTES + seed % ROUTES)
    plant = replace(Drivetrain(), acceleration=base, turning=TURNING[base])
    return NavigationSettings(start=start, goals=(goal,), obstacles=6, mover_speed=speed, seed=seed, drivetrain=plant)


def measured(speed: float, base: float, seed: int) -> Row:
    """Drive once."""
    episode = Episode(settings(speed, base, seed))
    s = episode.controller
    way = quickest(
        episode.occupancy, episode.distance_map, episode.start, episode.goals[-1], s.robot_radius,
        future(episode.world.obstacles), s.speed, LATEST,
    )  # fmt: skip
    log = episode.run(silent)
    return {
        "reached": all(log.reached), "touched": touched(log), "outcome": log.outcomes[-1],
        "arrival": math.inf if way is None else (len(way) - 1) * CELL / s.speed,
        "time": log.ticks * log.dt, "clearance": float(log.clearance.min()),
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
        "mover [m/s]", "base [m/s^2]", "drives", "without contact at the goal", "95 %", "contacts", "run over at rest",
        "not reached", "arrival / clairvoyant", "in reverse", "99 % of ticks [ms]",
    )  # fmt: skip
    lines = []
    for speed, base in product(SPEEDS, BASES):
        mine = [r for r in rows if (r["speed"], r["base"]) == (speed, base) and r.get("arrival", np.inf) <= LATEST]
        if not mine:
            continue
        good = [r for r in mine if r["reached"] and not r["touched"]]
        low, high = share(len(good), len(mine))
        regret = f"{np.median([r['time'] / r['arrival'] for r in good]):.2f}" if good else "-"
        lines.append((
            f"{speed:g}", f"{base:g}", str(len(mine)), str(len(good)), f"{100 * low:.0f} .. {100 * high:.0f} %",
            *(str(sum(r["touched"] == kind for r in mine)) for kind in ("moving", "at rest")),
            str(sum(not r["reached"] for r in mine)), regret,
            f"{100 * np.mean([r['reverse'] for r in mine]):.0f} %", f"{np.median([r['tick'] for r in mine]):.1f}",
        ))  # fmt: skip
    words = (
        "A contact is a hull nearer than 0; *run over at rest* are those before which the robot was slower than "
        f"{REST:g} m/s for {RESTING:g} s, *contacts* the others. Arrivals are medians over drives at the goal without "
        "contact, divided by the earliest arrival of a disc of 1 m/s without accelerations that knows the future."
    )
    return f"{table(head, lines, text=0)}\n\n{words}"


STUDY = Study(meetings, measured, render, range(3 * ROUTES))
