"""Maps of a million poses and more, whole and in submaps: time and memory."""

from __future__ import annotations

import resource
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from benchmarks.report import table
from benchmarks.runner import Timing
from benchmarks.timing import number
from unifg.lie import SE2
from unifg.pose_graphs import Edges, PoseGraph, Submaps
from unifg.solvers import GaussNewton

CASES = ((1_000_000, 0), (1_000_000, 50_000), (3_000_000, 50_000))
"""Poses, and those of a submap at most; 0 for the whole graph in memory."""
WIDTH = 250
SIGMA, BEGUN, TOLERANCE = np.array([0.05, 0.05, 0.01]), np.array([0.05, 0.05, 0.002]), 1e-3


def city(count: int) -> PoseGraph:
    """Streets up and down a city of 250 m, every second pose measured from the street before; poses near the truth."""
    rng, k = np.random.default_rng(0), np.arange(count)
    row, at = np.divmod(k, WIDTH)
    back = row % 2 == 1
    truth = np.column_stack([np.where(back, WIDTH - 1 - at, at), row, np.where(back, np.pi, 0.0)]).astype(float)
    beside = k + 2 * (WIDTH - 1 - at) + 1
    seen = (beside < count) & (at < WIDTH - 1) & (rng.random(count) < 0.5)
    first, second = np.append(k[:-1], k[seen]), np.append(k[1:], beside[seen])
    relative = SE2.compose(SE2.inverse(truth[first]), truth[second])
    measured = SE2.retract(relative, SIGMA * rng.standard_normal((len(first), 3)))
    information = np.broadcast_to(np.diag(SIGMA**-2.0), (len(first), 3, 3))
    begun = SE2.retract(truth, BEGUN * rng.standard_normal((count, 3)))
    return PoseGraph(k, begun, Edges(first, second, measured, information))


def whole(count: int) -> list[float]:
    """Steps, chi2, seconds and the peak of memory [GB] of the graph in memory."""
    graph, _, guess = city(count).graph()
    began = time.process_time()
    solution = GaussNewton(tolerance=TOLERANCE).solve(graph, guess, check=True)
    return [solution.iterations, 2.0 * solution.cost, time.process_time() - began, peak()]


def split(count: int, folder: str, largest: int) -> list[float]:
    """Submaps, poses of the separator, seconds and the peak of memory [GB] of writing them."""
    made, began = city(count), time.process_time()
    parted = Submaps.split(made, folder, largest)
    return [parted.count, len(parted._shared), time.process_time() - began, peak()]


def optimized(folder: str) -> list[float]:
    """The same as of :func:`whole` in submaps."""
    began = time.process_time()
    found = Submaps(folder).optimize(tolerance=TOLERANCE)
    return [found.iterations, found.chi2, time.process_time() - began, peak()]


def peak() -> float:
    """Largest memory of this process so far [GB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def measure(count: int, largest: int) -> tuple[str, ...]:
    """A row of the table; each part in a process of its own."""
    new = get_context("spawn")
    with ProcessPoolExecutor(1, new, max_tasks_per_child=1) as pool, tempfile.TemporaryDirectory() as folder:
        if not largest:
            steps, chi2, seconds, memory = pool.submit(whole, count).result()
            return f"{count:,}", "whole", "", "", number(steps), f"{chi2:.9g}", number(seconds), number(memory), ""
        parts, shared, writing, before = pool.submit(split, count, folder, largest).result()
        steps, chi2, seconds, memory = pool.submit(optimized, folder).result()
        disk = sum(file.stat().st_size for file in Path(folder).iterdir()) / 1e9
        made = f"{parts:.0f} submaps", f"{shared:.0f}", f"{number(writing)} s, {number(before)} GB"
        return f"{count:,}", *made, number(steps), f"{chi2:.9g}", number(seconds), number(memory), number(disk)


def tables(rounds: int) -> str:
    """All cases."""
    head = "poses", "map", "separator", "written in", "steps", "chi2", "seconds", "peak of memory, GB", "on disk, GB"
    notes = (
        f"A city of {WIDTH} streets: half of all poses are measured from the street beside. Poses begin within "
        "0.05 m and 0.002 rad (standard deviations) of the truth, as in an earlier map. Processor "
        "time of one core, tolerance 1e-3; while it is written, memory holds the arrays of the whole graph."
    )
    return f"{table(head, [measure(*case) for case in CASES], 2)}\n\n{notes}"


STUDY = Timing(tables, 1)
