"""Horizon beside a filter of one step, and velocity in the barrier at equal tracking error.

A sphere runs round an ellipse across the line of a quadrotor (:mod:`unifg.scenarios.safe_flight`). Of random phases
those count in which the path itself would come nearer than :data:`MEETS`: in the others there is nothing to avoid.
alpha is set for each gamma so that the distance from the path, on phases of their own, is the same for all. Then
plans, filters and both together fly past cylinder and sphere. All fly the same phases, and the difference in each
phase is compared: the scatter from phase to phase, which is far larger, drops out.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Literal

import numpy as np

from benchmarks.comparison import difference
from benchmarks.report import table
from benchmarks.runner import Timing
from unifg.scenarios.quadrotor.cascade import CascadeSettings
from unifg.scenarios.quadrotor.cbf_mpc import KeeperSettings
from unifg.scenarios.quadrotor.situations import Kind, Situation, situation
from unifg.scenarios.safe_flight import SafeSettings, flights

GAMMAS = (0.0, 0.1, 0.3, 1.0, 1.3)
MEETS = 0.3  # boundary distance of the path itself, below which a phase counts [m]
PASSES = 6.4  # duration of a flight: the ellipse lies behind [s]
SETTLED = 1.0  # from when on the distance from the path counts [s]
MARGIN = 0.3  # hull and margin around the vehicle's centre [m]
TUNING = range(10_000, 10_060)  # seeds that appear in no table
TUNED_ON = 3  # of them, those that count, up to this many
SPAN = (0.4, 30.0)  # of alpha that is searched [1/s]


@dataclass(frozen=True)
class Flown:
    """One flight: distance from the path, rms; least boundary distance [m]; mean processor time of a decision [ms]."""

    error: float
    least: float
    spent: float
    arrived: bool


def near_miss(about: Situation) -> float:
    """Least boundary distance of the path itself [m]."""
    times = np.arange(0.0, PASSES, 0.01)
    return float(about.bodies.nearest(about.path.at(times).position, times).min()) - MARGIN


def meeting(seeds: Iterable[int], count: int) -> list[int]:
    """Of the seeds those, up to so many, in which the path leads into the sphere's way."""
    found: list[int] = []
    for seed in seeds:
        if near_miss(situation("ellipse", 2.0, seed)) < MEETS:
            found.append(seed)
        if len(found) == count:
            break
    return found


def fly(settings: SafeSettings, seconds: float | None = None) -> Flown:
    """Fly once."""
    (flight,) = flights(settings)
    if seconds is not None:
        flight.situation = replace(flight.situation, duration=seconds)
    log = flight.run()
    error = np.linalg.norm(log.error[log.time >= SETTLED], axis=1)
    spent = float(log.decide_ms.mean())
    return Flown(float(np.sqrt(np.mean(error**2))), float(log.boundary.min()), spent, log.arrived)


@cache
def past_the_sphere(seed: int, gamma: float, alpha: float, reading: Any = "decay") -> Flown:
    """One crossing."""
    return fly(SafeSettings(case="ellipse", seed=seed, gamma=(gamma,), alpha=(alpha,), reading=reading), PASSES)


def off(flown: Sequence[Flown]) -> float:
    """Distance from the path, rms of a flight, mean of flights [m]."""
    return float(np.mean([one.error for one in flown]))


def alpha_for(gamma: float, target: float, seeds: Sequence[int], steps: int) -> float:
    """The alpha at which the distance from the path is the target.

    Its logarithm is bisected; between the last two on either side, where there are two, distances are interpolated.
    """
    low, high = np.log(SPAN).tolist()
    wide = narrow = np.nan  # distances at the two ends
    for _ in range(steps):
        middle = 0.5 * (low + high)
        found = off([past_the_sphere(seed, gamma, float(np.exp(middle))) for seed in seeds])
        low, high, wide, narrow = (middle, high, found, narrow) if found > target else (low, middle, wide, found)
    share = (wide - target) / (wide - narrow)
    return float(np.exp(low + (high - low) * (share if np.isfinite(share) else 0.5)))


def paired(flown: Sequence[Flown], others: Sequence[Flown], part: Literal["error", "least"]) -> str:
    """Mean of the differences, seed by seed [mm], and the bootstrap's 95 % interval; of two or fewer the span."""
    if flown is others:
        return "-"
    apart = [getattr(one, part) - getattr(two, part) for one, two in zip(flown, others, strict=True)]
    return difference(np.array(apart), 1e3)


def summed_up(name: str, alpha: float, flown: Sequence[Flown], without: Sequence[Flown]) -> list[str]:
    """A row of the table of gammas, beside the flights of the same phases without a velocity in the barrier."""
    least = 1e3 * np.array([one.least for one in flown])
    numbers = [least.min(), *np.percentile(least, [5.0, 50.0])]
    kept = f"{int((least < -1.0).sum())} of {len(least)}"
    beside = paired(flown, without, "least"), paired(flown, without, "error")
    return [name, f"{alpha:.2f}", f"{off(flown):.3f}", *(f"{number:.0f}" for number in numbers), *beside, kept]


def velocities(phases: int, steps: int) -> str:
    """Distances for each gamma, at equal and at the same alpha."""
    tuning, seeds = meeting(TUNING, TUNED_ON), meeting(range(1, 10_000), phases)
    target = 1.1 * off([past_the_sphere(seed, max(GAMMAS), 3.0) for seed in tuning])
    rows: list[list[str]] = []
    without: list[Flown] = []
    for gamma in GAMMAS:
        alpha = alpha_for(gamma, target, tuning, steps)
        flown = [past_the_sphere(seed, gamma, alpha) for seed in seeds]
        without = without or flown
        rows.append(summed_up(f"{gamma:g}", alpha, flown, without))
    some, without = seeds[: max(len(seeds) // 3, 1)], []
    for gamma in (0.0, 1.3):
        flown = [past_the_sphere(seed, gamma, 1.2, "published") for seed in some]
        without = without or flown
        rows.append(summed_up(f"{gamma:g}, as published", 1.2, flown, without))
    head = [
        "gamma", "alpha [1/s]", "from the path [m]", "least boundary [mm]", "5 %", "median",
        "boundary beside gamma 0, paired [mm]", "distance from the path beside gamma 0, paired [mm]", "margin not kept",
    ]  # fmt: skip
    drawn = seeds[-1]
    return (
        f"Of {drawn} random phases {len(seeds)} lead the path nearer than {MEETS:g} m to the sphere's margin. alpha is "
        f"that which brings the distance from the path to {target:.2f} m in {len(tuning)} other phases.\n\n"
        + table(head, rows)
    )


CONTROLLERS: dict[str, dict[str, Any]] = {
    "plan with barriers, 20 steps": {},
    "filter of one step": {"controller": ("filter",)},
    "filter below a plan without barriers, every 5th tick": {"controller": ("cascade",)},
    "filter below a plan with barriers, every 5th tick": {
        "controller": ("cascade",), "cascade": CascadeSettings(5, True)
    },
    "plan with barriers, 5 steps": {"keeper": KeeperSettings(horizon=5)},
    "plan with barriers, 10 steps": {"keeper": KeeperSettings(horizon=10)},
}  # fmt: skip


def horizons(seeds: int) -> str:
    """Distances and times of each controller past cylinder and sphere."""
    chosen: dict[Kind, list[int]] = {"static": list(range(1, seeds + 1)), "ellipse": meeting(range(1, 10_000), seeds)}
    rows = []
    longest: dict[Kind, list[Flown]] = {}
    for name, how in CONTROLLERS.items():
        for case, which in chosen.items():
            flown = [fly(SafeSettings(case=case, seed=seed, alpha=(3.0,), gamma=(0.0,), **how)) for seed in which]
            least, first = 1e3 * np.array([one.least for one in flown]), longest.setdefault(case, flown)
            rows.append([
                name, case, f"{np.mean([one.spent for one in flown]):.2f}", f"{off(flown):.3f}", f"{least.min():.0f}",
                f"{np.median(least):.0f}", f"{int((least < -1.0).sum())}",
                f"{sum(one.arrived for one in flown)} of {len(flown)}",
                paired(flown, first, "error"),
            ])  # fmt: skip
    head = [
        "controller", "case", "decided in, mean [ms]", "from the path [m]", "least boundary [mm]", "median [mm]",
        "margin not kept", "arrived", "farther from the path than 20 steps, paired [mm]",
    ]  # fmt: skip
    return table(head, rows)


def tables(phases: int) -> str:
    """Velocity and horizon."""
    return "\n\n".join([
        "### Velocity", velocities(phases, 4), "### Horizon", horizons(max(phases // 5, 1)),
        "Processor time of a decision, everything in it.",
    ])  # fmt: skip


STUDY = Timing(tables, 16)
