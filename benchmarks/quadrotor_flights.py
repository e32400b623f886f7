"""Flights through unknown corridors: success, accuracy and times.

The study "timing" runs one flight at a time, whatever ``--workers`` says. All variants of a seed meet the same
corridor, mass, drag, wind, disturbances and sensor noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

from benchmarks.quadrotor_tables import HEADLINE, render
from benchmarks.runner import Cell, Study
from unifg.scenarios.papers.corridor_flights import Job, fly
from unifg.scenarios.quadrotor.flight_pilot import COUPLINGS
from unifg.scenarios.simulation.layouts import CORRIDOR_SEEDS

STUDIES = ("flights", "potential", "association", "movers", "timing")
SOLVERS = ("ipm", "sqp", "alm")
FEWER = {"timing": 20}  # seeds at most; 20 flights are some 6000 ticks
TIMED_RUNS = 3


def cells(seeds: Sequence[int]) -> list[Cell]:
    """All flights.

    Backends other than the headline's fly sequential and joint; potential costs, unknown association and movers are
    flown sequential.
    """
    jobs: list[Cell] = []
    for study, solver in product(STUDIES, SOLVERS):
        first, plain = solver == HEADLINE, Job(study, solver, "sequential", 0)
        variants = {
            "flights": [replace(plain, coupling=c) for c in COUPLINGS if first or c != "separate"],
            "potential": [replace(plain, avoidance="potential")],
            "association": [replace(plain, association="unknown")] if first else [],
            "movers": [replace(plain, movers=2)] if first else [],
            "timing": [
                replace(plain, coupling=c, run=r)
                for r in range(TIMED_RUNS if first else 1) for c in COUPLINGS if c != "separate"
            ],
        }[study]  # fmt: skip
        some = seeds[: FEWER.get(study)]
        jobs += [vars(replace(job, seed=seed)) for job in variants for seed in some]
    return jobs


STUDY = Study(cells, fly, render, CORRIDOR_SEEDS, alone=lambda job: job["study"] == "timing")
