"""The same pilots on the own plants and on those of MuJoCo: flights through the corridor, drives through the building.

Both plants of a seed meet the same layout or route, conditions, disturbances, obstacles and noise of sensors, as far as
these are drawn by seed. The tracking error is the distance between the place that a plan foresees half a second ahead
and the true one then; plans in between are free to differ.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from importlib.util import find_spec
from itertools import product
from operator import itemgetter

import numpy as np

from benchmarks.comparison import Row, difference, paired, portion, where
from benchmarks.report import table
from benchmarks.routes import drawn
from benchmarks.runner import Cell, Study, Unavailable
from unifg.scenarios import flight, navigation
from unifg.scenarios.logs.drive_metrics import episode_metrics
from unifg.scenarios.logs.flight_metrics import flight_metrics
from unifg.typing import Array

AHEAD = 0.5  # [s]
LENGTHS = (8.0, 16.0)  # of routes [m]
SPEEDS = {"flight": None, "fast flight": 4.0}  # [m/s]; None for the guide's own
WORLDS = {**dict.fromkeys(SPEEDS, tuple(flight.WORLDS)), "drive": tuple(navigation.WORLDS)}
FEWER = {"fast flight": 15}  # seeds at most
MEASURES = {
    "tracking_mm": "tracking, rms [mm]", "estimate_mm": "estimate, rms [mm]", "duration_s": "time [s]",
    "clearance_m": "least clearance [m]", "tick_p99_ms": "tick, p99 [ms]",
}  # fmt: skip


def episode(robot: str, world: str, seed: int) -> Row:
    """Fly or drive once."""
    if robot in SPEEDS:
        flown = flight.run_flight(flight.FlightSettings(seed=seed, speed=SPEEDS[robot], world=world))
        dt, plans, outcome = flown.dt, flown.plans, flown.outcome
        m = flight_metrics(flown)
        true = flown.truth[:, :3]
        believed = flown.believed[:, :3]
        tick = flown.estimate_ms + flown.plan_ms
    else:
        start, goal = drawn(seed, LENGTHS)
        log = navigation.run_navigation(
            navigation.NavigationSettings(start=start, goals=(goal,), obstacles=3, seed=seed, world=world)
        )
        dt, plans, outcome = log.dt, log.horizon, log.outcomes[0]
        m = episode_metrics(log)
        true = log.true_pose[:, :2]
        believed = log.estimate[:, :2]
        tick = log.tick_ms
    return {
        "outcome": outcome, "contacts": m["collisions"], "duration_s": m["duration_s"], "causes": m["causes"],
        "emergency": m["emergency_ticks"], "clearance_m": m["min_clearance_m"],
        "tracking_mm": 1e3 * tracking(true, plans[:, :, : true.shape[1]], round(AHEAD / dt)),
        "estimate_mm": 1e3 * rms(believed - true), "tick_p99_ms": float(np.percentile(tick, 99.0)),
    }  # fmt: skip


def tracking(true: Array, plans: Array, ahead: int) -> float:
    """Rms distance of places (T, m) from where plans (T, N + 1, m) of ``ahead`` ticks before put them [m]."""
    return rms(true[ahead:] - plans[: len(plans) - ahead, ahead])


def rms(errors: Array) -> float:
    """Root of the mean square of the lengths of rows."""
    return float(np.sqrt(np.square(errors).sum(axis=-1).mean()))


def cells(seeds: Sequence[int]) -> list[Cell]:
    """Both plants of both robots.

    Raises:
        Unavailable: MuJoCo is not installed.
    """
    if find_spec("mujoco") is None:
        raise Unavailable("MuJoCo is not installed: pip install 'unifg[mujoco]'")
    return [
        {"robot": robot, "world": world, "seed": seed}
        for robot in WORLDS
        for seed, world in product(seeds[: FEWER.get(robot)], WORLDS[robot])
    ]


def render(rows: list[Row]) -> str:
    """The table, paired differences, and what was not reached."""
    lines = []
    apart = []
    failed = []
    for robot, worlds in WORLDS.items():
        own = where(rows, robot=robot, world=worlds[0])
        for world in worlds:
            mine = where(rows, robot=robot, world=world)
            reached = [row for row in mine if row["outcome"] == "reached"]
            lines.append((
                robot, world, str(len(mine)), str(len(reached)), portion(len(reached), len(mine)),
                str(sum(row["contacts"] for row in mine)), str(sum(row["emergency"] for row in mine)),
                *(_spread([row[name] for row in mine]) for name in MEASURES),
            ))  # fmt: skip
            names = Counter(cause for row in mine for cause in row["causes"])
            run = f"- {robot}, {world}"
            for row in mine:
                if row["outcome"] != "reached" or row["contacts"]:
                    failed.append(f"{run}, seed {row['seed']}: {row['outcome']}, {row['contacts']} contacts")
            for cause, count in names.most_common():
                failed.append(f"{run}: *{cause}* in {count} of {len(mine)}")
        other = where(rows, robot=robot, world=worlds[1])
        for name, words in MEASURES.items():
            there, here = paired(other, own, itemgetter(name))
            apart.append((robot, words, difference(there - here)))
    head = (
        "robot", "plant", "runs", "reached", "95 %", "contacts", "ticks without a plan", *MEASURES.values(),
    )  # fmt: skip
    words = (
        "Medians over runs, with least and greatest. The tracking error is the distance between the place that a plan "
        f"foresees {AHEAD:g} s ahead and the true one then. Fast flights are asked for {SPEEDS['fast flight']:g} m/s "
        "instead of 2. Other work on the machine makes ticks longer."
    )
    listed = "\n".join(failed) or "Every run reached its goal without a contact, and health was ok throughout."
    return "\n\n".join([
        table(head, lines, 2), words, "MuJoCo less the own plant, mean over pairs of seeds:",
        table(("robot", "measure", "difference"), apart, 2), listed,
    ])  # fmt: skip


def _spread(values: list[float]) -> str:
    """Median, least and greatest."""
    low, middle, high = np.percentile(values, [0.0, 50.0, 100.0])
    return f"{middle:.3g} ({low:.3g} .. {high:.3g})"


STUDY = Study(cells, episode, render, range(30))
