"""The localisation graph beside an adaptive Monte Carlo localiser, on the same scans and wheels.

A drive through the building (:mod:`benchmarks.routes`) is recorded once per seed; both localisers are given its scans
and its odometry, so they differ in nothing else. Then the same with a wrong start, a start that is not known at all, a
robot that is carried elsewhere, and a map on which furniture has been moved. The real log (``$UNIFG_DATA`` or
``../shared/data``) is localised on a map of the other half of its scans.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import TypeAlias
from unittest import mock

import numpy as np
from scipy import ndimage

from benchmarks.comparison import Row, difference, mean, middle, where
from benchmarks.report import Columns, listing, shared
from benchmarks.routes import drawn
from benchmarks.runner import Cell, Study
from unifg.files.carmen import read_carmen
from unifg.files.ros_map import OccupancyMap
from unifg.lie import SE2, wrap_angle
from unifg.models.distance_map import DistanceMap
from unifg.scenarios.ground.localiser import Localiser
from unifg.scenarios.ground.protocols import Estimator
from unifg.scenarios.navigation import INITIAL_SIGMA, Episode, NavigationSettings
from unifg.scenarios.papers.printed import texts
from unifg.scenarios.perception.monte_carlo import MonteCarlo, MonteCarloSettings
from unifg.scenarios.perception.readings import Scan
from unifg.scenarios.perception.scan_map import mapped
from unifg.typing import Array

DT = 0.1
OBSTACLES = 3
LOG = "intel-corrected.log.gz"
LEAST_WAY = 0.05  # [m]; what is shorter has no direction
FOUND = 0.2  # [m]; who is nearer knows where he is
OFFSETS = {"start 0.5 m, 0.3 rad wrong": (0.5, 0.3), "start 1 m, 0.5 rad wrong": (1.0, 0.5),
           "start 2 m, 1 rad wrong": (2.0, 1.0)}  # fmt: skip
MOVED = {"a quarter of the furniture moved": 0.25, "all furniture moved": 1.0}
UNKNOWN, CARRIED, DRIVEN = "start unknown", "carried elsewhere", "as driven"
INTEL = "real log"
# The package's documentation says so where recovery is wanted; and so large a building takes more particles.
RECOVERING = MonteCarloSettings(slow=0.001, fast=0.1, particles=(2000, 20000))
_ERRORS = {name: text.replace("±", "+-") for name, text in texts("bazzana", "section VII-A, Fig. 6").items()}
PAPER = (
    f"Bazzana et al. report {_ERRORS['translation']} and {_ERRORS['rotation']} for their graph, "
    f"{_ERRORS['translation_amcl']} and {_ERRORS['rotation_amcl']} for AMCL, in ROS stage with a lidar, a map and "
    "wheels that the paper does not state."
)

Tick: TypeAlias = tuple[Scan | None, Array | None, Array]
"""A scan, the odometry (2,) since the one before, and the true pose (3,)."""
VARIANTS = {
    "AMCL, all beams": MonteCarloSettings(),
    "AMCL, 60 beams": MonteCarloSettings(beams=60),
    "AMCL, recovery": RECOVERING,
    "AMCL, wheels trusted": MonteCarloSettings(noise=(0.01, 0.01, 0.01, 0.01)),
}


def distances(occupancy: OccupancyMap) -> DistanceMap:
    """Signed distances of a map."""
    return DistanceMap.from_occupancy(occupancy.occupied, occupancy.resolution, occupancy.origin)


def made(name: str, occupancy: OccupancyMap, pose: Array, sigma: Array, beams: int, seed: int) -> Estimator:
    """A localiser by its name in the tables."""
    if name == "graph":
        return Localiser(distances(occupancy), pose, sigma, beams)
    rng = np.random.default_rng([seed, 11])
    return MonteCarlo(occupancy, distances(occupancy), pose, sigma, rng, VARIANTS[name])


def recorded(seed: int) -> tuple[OccupancyMap, list[Tick]]:
    """A drive of the route of a seed."""
    start, goal = drawn(seed)
    episode = Episode(NavigationSettings(start=start, goals=(goal,), obstacles=OBSTACLES, seed=seed))
    inner, heard = episode.pilot.estimator.update, list[tuple[Scan | None, Array | None]]()

    def noted(scan: Scan | None, odometry: Array | None, dt: float) -> None:
        heard.append((scan, None if odometry is None else np.array(odometry)))
        inner(scan, odometry, dt)

    with mock.patch.object(episode.pilot.estimator, "update", noted):
        log = episode.run(lambda done, text: None)
    return episode.occupancy, [(*given, pose) for given, pose in zip(heard, log.true_pose, strict=True)]


def replayed(estimator: Estimator, ticks: Iterable[Tick]) -> Array:
    """Errors (T, 2) [m, rad]."""
    errors = []
    for scan, odometry, truth in ticks:
        estimator.update(scan, odometry, DT)
        if np.isnan(truth).any():
            continue
        apart = estimator.pose - truth
        errors.append([np.hypot(*apart[:2]), abs(float(wrap_angle(apart[2])))])
    return np.array(errors)


def summary(errors: Array) -> Row:
    """Mean and spread of errors, whether the robot knew in the end where it was, and since when."""
    wrong = np.flatnonzero(errors[:, 0] > FOUND)
    since = 0 if not len(wrong) else int(wrong[-1]) + 1
    return {
        "m": float(errors[:, 0].mean()), "m_std": float(errors[:, 0].std()), "m_max": float(errors[:, 0].max()),
        "rad": float(errors[:, 1].mean()), "rad_std": float(errors[:, 1].std()),
        "found": since < len(errors), "since": DT * since,
    }  # fmt: skip


def rearranged(occupancy: OccupancyMap, share: float, rng: np.random.Generator) -> OccupancyMap:
    """A map on which a share of what stands free of the walls has been moved by 0.2 to 0.6 m."""
    labels, count = ndimage.label(occupancy.occupied, np.ones((3, 3)))
    occupied = occupancy.occupied.copy()
    sizes = np.bincount(labels.ravel())
    for k in range(1, count + 1):
        if sizes[k] * occupancy.resolution**2 > 3.0 or rng.random() > share:
            continue
        rows, columns = np.nonzero(labels == k)
        way, turn = rng.uniform(0.2, 0.6), rng.uniform(-math.pi, math.pi)
        down, right = np.round(way / occupancy.resolution * np.array([math.sin(turn), math.cos(turn)])).astype(int)
        occupied[rows, columns] = False
        height, width = occupied.shape
        occupied[np.clip(rows + down, 0, height - 1), np.clip(columns + right, 0, width - 1)] = True
    return replace(occupancy, occupied=occupied, free=occupancy.free & ~occupied)


def measure(seed: int) -> Row:
    """All conditions of one recording; seed -1 stands for the real log."""
    if seed < 0:
        return {"results": real_log()}
    occupancy, ticks = recorded(seed)
    rng = np.random.default_rng([seed, 3])
    truth, sigma = ticks[0][2], np.array(INITIAL_SIGMA)
    first = ticks[0][0]
    assert first is not None
    beams, results = len(first.angles), {}

    def run(
        condition: str, names: Sequence[str], given: OccupancyMap, pose: Array, how: Array, part: list[Tick]
    ) -> None:
        for name in names:
            estimator = made(name, given, pose, how, beams, seed)
            if condition == UNKNOWN:
                assert isinstance(estimator, MonteCarlo)
                estimator.everywhere()
            results[f"{condition}|{name}"] = summary(replayed(estimator, part))

    usual = ("graph", "AMCL, all beams", "AMCL, 60 beams")
    believed = truth + sigma * rng.standard_normal(3)
    run(DRIVEN, (*usual, "AMCL, wheels trusted"), occupancy, believed, sigma, ticks)
    for condition, (way, turn) in OFFSETS.items():
        aside = rng.uniform(-math.pi, math.pi)
        off = np.array([way * math.cos(aside), way * math.sin(aside), turn * rng.choice([-1.0, 1.0])])
        run(condition, usual, occupancy, truth + off, np.array([way, way, turn]), ticks[:150])
    run(UNKNOWN, (*usual[1:], "AMCL, recovery"), occupancy, truth, sigma, ticks)
    third = len(ticks) // 3
    jump = (ticks[2 * third][0], np.zeros(2), ticks[2 * third][2])
    carried = [*ticks[:third], jump, *ticks[2 * third + 1 :]]
    run(CARRIED, ("graph", "AMCL, all beams", "AMCL, recovery"), occupancy, believed, sigma, carried)
    for condition, share in MOVED.items():
        run(condition, usual, rearranged(occupancy, share, rng), believed, sigma, ticks)
    return {"results": results}


# ---------------------------------------------------------------- the real log


def real_ticks(angles: Array, ranges: Array, poses: Array, rng: np.random.Generator) -> list[Tick]:
    """Scans with the motion between their corrected poses: a turn, a way and a turn, of which only the last has a scan.

    Wheels tell each with 5 % of scale error, drawn once, and 2 % of noise.
    """
    scale = 1.0 + 0.05 * rng.standard_normal(2)
    ticks: list[Tick] = []
    for k, (row, pose) in enumerate(zip(ranges, poses, strict=True)):
        wheels: Array | None = None
        if k:
            x, y, turn = SE2.between(poses[k - 1 : k], pose[None])[0].tolist()
            way = math.hypot(x, y)
            first = math.atan2(y, x) if way > LEAST_WAY else 0.0
            moves = np.array([[0.0, first], [way, 0.0], [0.0, float(wrap_angle(turn - first))]]) / DT
            told = moves * (scale + 0.02 * rng.standard_normal((3, 2)))
            ticks += [(None, part, np.full(3, np.nan)) for part in told[:2]]
            wheels = told[2]
        ticks.append((Scan(angles, row), wheels, pose))
    return ticks


def real_log() -> Row:
    """Every second scan makes the map, the others are localised on it."""
    folder = shared("lidar")
    path = folder and folder / LOG
    if not path or not path.is_file():
        return {}
    scans = read_carmen(path).scans[0]
    angles, poses = scans.angles, scans.pose
    ranges = np.where(scans.ranges >= min(scans.maximum, 79.0), np.inf, scans.ranges)
    occupancy = mapped(angles, ranges[::2], poses[::2])
    ticks = real_ticks(angles, ranges[1::2], poses[1::2], np.random.default_rng(5))
    sigma = np.array(INITIAL_SIGMA)
    return {
        f"{INTEL}|{name}": summary(replayed(made(name, occupancy, poses[1], sigma, len(angles), 0), ticks))
        for name in ("graph", "AMCL, all beams", "AMCL, 60 beams", "AMCL, wheels trusted")
    }


# ---------------------------------------------------------------- the page


def render(rows: Sequence[Row]) -> str:
    """Markdown."""
    drives = [row for row in where(rows) if row["seed"] >= 0]
    keys = list(dict.fromkeys(key for row in where(rows) for key in row["results"]))
    groups = {
        tuple(key.split("|")): [row["results"][key] for row in where(rows) if key in row["results"]] for key in keys
    }

    columns: Columns[list[Row]] = {
        "drives": lambda some: str(len(some)),
        "mean [mm]": mean("m", 1e3),
        "std [mm]": mean("m_std", 1e3),
        "worst [mm]": lambda some: f"{1e3 * max(r['m_max'] for r in some):.0f}",
        "mean [mrad]": mean("rad", 1e3),
        "std [mrad]": mean("rad_std", 1e3),
        "knows at the end": lambda some: f"{sum(r['found'] for r in some)} of {len(some)}",
        "since [s]": lambda some: middle([r["since"] for r in some if r["found"]], 1),
    }
    parts = [
        listing(["condition", "localiser"], groups, columns),
        "Errors are over all ticks of a drive, their mean and standard deviation averaged over drives; *worst* is of "
        f"all of them. A localiser knows where the robot is when it is nearer than {FOUND:g} m, and *since* is the "
        "median, over those that do at the end, of when that began for good, counted from the beginning of the "
        "recording.",
        paired(drives),
        PAPER,
    ]
    return "\n\n".join(part for part in parts if part)


def paired(drives: Sequence[Row]) -> str:
    """The difference of both localisers on the same recordings, with its interval."""
    said = []
    for condition in (DRIVEN, *MOVED):
        both = [
            (row["results"][f"{condition}|graph"], row["results"][f"{condition}|AMCL, all beams"]) for row in drives
        ]
        if not both:
            continue
        for name, unit, scale in (("m", "mm", 1e3), ("rad", "mrad", 1e3)):
            apart = scale * np.array([graph[name] - other[name] for graph, other in both])
            said.append(f"{condition}: graph less AMCL with all beams {difference(apart)} {unit}.")
    return " ".join(said)


def cells(seeds: Sequence[int]) -> list[Cell]:
    """Recordings, and the real log."""
    return [{"seed": seed} for seed in (*seeds, -1)]


STUDY = Study(cells, measure, render, range(200, 204))
