"""Log of a flight among obstacles, tick by tick."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from unifg.scenarios.logs.columns import column, words
from unifg.scenarios.logs.metrics import errors, iterations, timing
from unifg.typing import Array, BoolArray, IntArray

__all__ = ["SafeLog", "safe_metrics"]

TOUCH = 1e-3  # deeper than this is more than what rounding and the last iterate leave [m]


@dataclass(kw_only=True)
class SafeLog:
    """One flight of T ticks past M bodies with a plan of N steps.

    Row k holds what was true at ``time[k]`` and what was decided then; ``near[k]`` is the least distance on the way to
    the next row.

    Attributes:
        label: what tells this flight from those beside it.
        settings: everything that says how the flight was made; JSON values.
        dt: length of a tick [s].
        hull: radius of the vehicle [m].
        margin: that is to be kept between hull and bodies [m].
        radii: (M,) of the bodies [m].
        upright: (M,) which of them are cylinders without an end.
        end: (3,) where it was to be at the end [m]; None where it went on.
        interrupted: the user stopped the flight.
    """

    label: str
    settings: dict[str, Any]
    dt: float
    hull: float
    margin: float
    radii: Array
    upright: BoolArray
    end: Array | None
    interrupted: bool = False

    time: Array = column("s")
    states: Array = column("m, 1, m/s", 10)
    wanted: Array = column("m, m/s", 6)
    """Position and velocity of the path, had it not waited."""
    late: Array = column("s")
    """By which the path has waited at the end of the tick."""
    controls: Array = column("rad/s, N", 4)
    plans: Array = column("m", None, 3)
    bodies: Array = column("m", None, 3)
    near: Array = column("m", None)
    """From the vehicle's centre to each surface."""
    slack: Array = column("m")
    mass: Array = column("kg")
    drag: Array = column("kg/s", 3)
    decide_ms: Array = column("ms")
    steps: IntArray = column("iterations", dtype=np.intp)
    statuses: list[str] = words()

    @property
    def ticks(self) -> int:
        """T."""
        return len(self.time)

    @property
    def clearance(self) -> Array:
        """(T,) least distance from the hull to any surface in each tick [m]; infinite where there is none."""
        found: Array = self.near.min(axis=1, initial=np.inf) - self.hull
        return found

    @property
    def boundary(self) -> Array:
        """(T,) the same beyond the margin: the paper's boundary distance [m]."""
        return self.clearance - self.margin

    @property
    def error(self) -> Array:
        """(T, 3) from the path [m]."""
        return self.states[:, :3] - self.wanted[:, :3]

    @property
    def arrived(self) -> bool:
        """True if the flight ended where it was to end."""
        return self.end is None or (self.ticks > 0 and bool(np.linalg.norm(self.states[-1, :3] - self.end) < 0.3))

    @property
    def touched(self) -> bool:
        """True if the hull met anything."""
        return bool((self.clearance < 0.0).any())

    @property
    def violated(self) -> bool:
        """True if the margin was not kept."""
        return bool((self.boundary < -TOUCH).any())

    @property
    def succeeded(self) -> bool:
        """True if it kept its distance and arrived."""
        return self.arrived and not self.violated


def safe_metrics(log: SafeLog) -> dict[str, Any]:
    """The numbers of a flight; only ``decide_ms`` depends on the clock, and errors of tracking are those after 2 s."""
    late = log.error[log.time >= 2.0] if log.time[-1] > 2.0 else log.error
    free = not len(log.radii)
    return {
        "label": log.label,
        **log.settings,
        "succeeded": log.succeeded,
        "arrived": log.arrived,
        "touched": log.touched,
        "margin_kept": not log.violated,
        "min_clearance_m": None if free else float(log.clearance.min()),
        "min_boundary_distance_m": None if free else float(log.boundary.min()),
        "tracking_error_m": errors(late),
        "late_s": float(log.late[-1]),
        "max_speed_m_per_s": float(np.linalg.norm(log.states[:, 7:], axis=1).max()),
        "greatest_slack_m": float(log.slack.max()),
        "mass_kg": float(log.mass[-1]),
        "drag_kg_per_s": log.drag[-1].tolist(),
        "ticks": log.ticks,
        "statuses": {word: log.statuses.count(word) for word in sorted(set(log.statuses))},
        "iterations": iterations(log.steps),
        "decide_ms": timing(log.decide_ms),
    }
