"""Pull of the plan on the estimate of a joint graph: the plan's costs against what the past alone gives, tick by tick.

The first seconds of flights through corridors on seeds that are open to tuning, with the weight of the future's costs,
the bound on the pull and what the window carries on swept. Every variant of a seed meets the same corridor, mass,
wind, disturbances and noise; differences are taken seed by seed.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.comparison import Row, against, digits, total, where
from benchmarks.quadrotor_flights import SOLVERS
from benchmarks.report import Columns, listing
from benchmarks.runner import Cell, Study
from benchmarks.timing import clocked
from unifg.models import quadrotor
from unifg.scenarios.flight import Flight, FlightSettings
from unifg.scenarios.perception.belief import Belief, Landmarks
from unifg.scenarios.quadrotor.flight_joint import JointSettings
from unifg.scenarios.quadrotor.flight_pilot import make_pilot
from unifg.scenarios.quadrotor.flight_settings import Avoidance
from unifg.scenarios.simulation.layouts import TUNING_SEEDS
from unifg.typing import Array

WEIGHTS = (0.01, 0.1, 1.0, 10.0)
PULLS = (np.inf, 0.5)
WARMING_UP = 5  # ticks whose times do not count
SECONDS = 6.0  # of each flight


PLAIN: Cell = {"coupling": "joint", "solver": "ipm", "weight": 1.0, "pull": 0.5, "avoidance": "clearance"}
"""Beginning of a flight of which everything but the seed is varied."""


def jobs_of(seeds: Sequence[int]) -> list[Cell]:
    """All variants on some seeds."""
    changes: list[Cell] = [{"coupling": "sequential"}, {"coupling": "sequential", "avoidance": "potential"}]
    changes += [{"weight": weight, "pull": pull} for pull, weight in product(PULLS, WEIGHTS)]
    changes += [{"pull": pull, "avoidance": "potential"} for pull in PULLS]
    changes += [{"solver": solver} for solver in SOLVERS if solver != PLAIN["solver"]]
    return [{"seed": seed, **PLAIN, **change} for seed in seeds for change in changes]


def flight_of(seed: int, coupling: str, solver: str, weight: float, pull: float, avoidance: Avoidance) -> Flight:
    """World and pilot."""
    plain = FlightSettings(solver, coupling, seed)
    controller = replace(plain.controller, control_weight=weight, avoidance=avoidance)
    flight = Flight(replace(plain, controller=controller))
    if coupling == "joint":
        found, believed = flight.conditions, flight.pilot.belief.state
        common = (found.layout, believed, found.nominal, plain.estimator, controller)
        flight.pilot = make_pilot("joint", solver, *common, JointSettings(pull))
    return flight


def fly(**cell: Any) -> Row:
    """Fly for some seconds and measure, at every tick, the pull and the errors."""
    flight = flight_of(**cell)
    world, pilot, dt = flight.world, flight.pilot, flight.settings.controller.dt
    control: Array | None = None
    ticks: list[dict[str, float]] = []
    cylinders = world.layout.cylinders[:, :2]
    clearance, emergencies = np.inf, 0
    for _ in range(round(SECONDS / dt)):
        reading = world.sense()
        plan, spent = clocked(pilot.tick, reading, control, by=time.process_time)
        belief = pilot.belief
        off = errors(belief, world.state, flight, cylinders)
        ticks.append({**pulled(belief, pilot.alone), **off, "tick": 1e3 * spent})
        emergencies += plan.emergency
        control = plan.controls[0]
        world.step(control, dt)
        clearance = min(clearance, world.clearance())
        if world.collisions:
            break
    numbers = pd.DataFrame(ticks).replace([np.inf, -np.inf], np.nan)
    return {
        "collisions": world.collisions,
        "emergencies": emergencies,
        "clearance": clearance,
        "distance": float(world.state[0] - world.layout.start[0]),
        "mean": numbers.mean().dropna().to_dict(),
        "max": numbers.max().dropna().to_dict(),
        "tick": numbers["tick"][WARMING_UP:].tolist(),
    }


def pulled(belief: Belief, alone: Belief) -> dict[str, float]:
    """Distance of a belief from the estimate of the past alone."""
    step = quadrotor.STATE.local(alone.state[None], belief.state[None])[0]
    rho, without = belief.parameters, alone.parameters
    moved = belief.landmarks.positions - alone.landmarks.positions
    sigma = np.sqrt(np.diagonal(alone.landmarks.covariances, axis1=1, axis2=2))
    unsure = alone.parameters_sigma > 0.0
    about = np.abs(rho.packed - without.packed)[unsure] / alone.parameters_sigma[unsure]
    return {
        "position": float(np.linalg.norm(step[:3])),
        "velocity": float(np.linalg.norm(step[6:])),
        "mass": abs(rho.mass / without.mass - 1.0),
        "wind": float(np.hypot(*np.subtract(rho.wind, without.wind))),
        "landmarks": float(np.hypot(*moved.T).max(initial=0.0)),
        "sigma": float(max(np.abs(step / alone.sigma).max(), about.max(), np.abs(moved / sigma).max(initial=0.0))),
    }


def errors(belief: Belief, truth: Array, flight: Flight, cylinders: Array) -> dict[str, float]:
    """Distance of a belief from the truth."""
    step = quadrotor.STATE.local(truth[None], belief.state[None])[0]
    true, found = flight.conditions.true, belief.parameters
    marks = belief.landmarks
    body = marks.kinds == Landmarks.CYLINDER
    wrong = np.hypot(*(marks.positions[body] - cylinders[marks.ids[body]]).T)
    return {
        "position error": float(np.linalg.norm(step[:3])),
        "velocity error": float(np.linalg.norm(step[6:])),
        "mass error": abs(found.mass / true.mass - 1.0),
        "wind error": float(np.hypot(*np.subtract(found.wind, true.wind))),
        "cylinder error": float(wrong.mean()) if len(wrong) else np.nan,
    }


# ---------------------------------------------------------------- the page

# Columns of a table: what is measured at each tick, and its unit.
PULLED = {
    "position [mm]": ("position", 1e3),
    "velocity [mm/s]": ("velocity", 1e3),
    "mass [%]": ("mass", 1e2),
    "wind [mm/s^2]": ("wind", 1e3),
    "landmark [mm]": ("landmarks", 1e3),
    "most of all [sigma]": ("sigma", 1.0),
}
ERRORS = {
    "position [mm]": ("position error", 1e3),
    "velocity [mm/s]": ("velocity error", 1e3),
    "mass [%]": ("mass error", 1e2),
    "wind [mm/s^2]": ("wind error", 1e3),
    "cylinders [mm]": ("cylinder error", 1e3),
}
FLOWN: Columns[Sequence[Row]] = {
    "flown [m]": lambda rows: f"{np.mean([row['distance'] for row in rows]):.2f}",
    "least clearance [cm]": lambda rows: f"{100 * min(row['clearance'] for row in rows):.0f}",
    "emergencies": total("emergencies"),
    "collisions": total("collisions"),
    "tick [ms]": lambda rows: "{:.1f} ({:.1f})".format(
        *np.quantile(np.concatenate([row["tick"] for row in rows]), [0.5, 0.99])
    ),
}
Groups = Mapping[tuple[str, ...], Sequence[Row]]
"""The rows of each line of a table, by the words the line begins with."""


def pull_table(groups: Groups, head: Sequence[str]) -> str:
    """Mean over all ticks and greatest of any tick."""

    def cell(rows: Sequence[Row], what: tuple[str, float]) -> str:
        name, scale = what
        mean = scale * float(np.mean([row["mean"][name] for row in rows]))
        return f"{digits(mean)} ({digits(scale * max(row['max'][name] for row in rows))})"

    return listing(head, groups, {name: partial(cell, what=what) for name, what in PULLED.items()})


def error_table(groups: Groups, head: Sequence[str]) -> str:
    """Errors, the first row's as they are, the others' with their paired difference to it."""

    def cell(rows: Sequence[Row], what: tuple[str, float]) -> str:
        name, scale = what
        return against(rows, base, lambda row: scale * row["mean"][name] if name in row["mean"] else None)

    base = next(iter(groups.values()))
    return listing(head, groups, {**{name: partial(cell, what=what) for name, what in ERRORS.items()}, **FLOWN})


def bound(pull: float) -> str:
    """A bound on the pull in words."""
    return "none" if np.isinf(pull) else f"{pull:g}"


def render(rows: list[Row]) -> str:
    """Markdown of all variants."""

    def of(**changes: object) -> list[Row]:
        return where(rows, **{**PLAIN, **changes})

    base, start = of(coupling="sequential"), of(coupling="sequential", avoidance="potential")
    sweep: Groups = {
        (bound(pull), f"{weight:g}"): of(pull=pull, weight=weight) for pull, weight in product(PULLS, WEIGHTS)
    }
    potential: Groups = {(bound(pull),): of(pull=pull, avoidance="potential") for pull in PULLS}
    backends: Groups = {(solver,): of(solver=solver) for solver in SOLVERS}
    return "\n\n".join(
        [
            f"Flights on {len({row['seed'] for row in rows})} seeds, the first {SECONDS:g} s of each.",
            "### How far the plan pulls",
            pull_table(sweep, ["pull", "control weight"]),
            "Distance from what the past alone says: mean over ticks, in brackets the greatest of any tick.",
            "### What that does to estimates and flights",
            error_table({("sequential", "-"): base, **sweep}, ["pull", "control weight"]),
            "Errors are means over ticks and seeds; in brackets the 95 % interval of the paired difference to "
            "sequential. Emergencies are ticks whose solve gave nothing that may be flown. Ticks are process times, "
            "median and, in brackets, 99th percentile.",
            "### Ta's own costs",
            pull_table(potential, ["pull"]),
            error_table({("sequential",): start, **potential}, ["pull"]),
            "### Backends, weight 1, pull 0.5",
            pull_table(backends, ["backend"]),
            error_table({("sequential, ipm",): base, **backends}, ["backend"]),
        ]
    )


STUDY = Study(jobs_of, fly, render, TUNING_SEEDS[:8])
