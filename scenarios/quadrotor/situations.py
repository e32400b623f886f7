"""The five situations of the paper (FactorMPC, section IV): a path to follow, and what is in its way.

Without a seed they stand as they are described; a seed moves sizes, places and phases.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Literal, TypeAlias, get_args

import numpy as np

from unifg.scenarios.planning.flat_path import FigureEight, FlatPath, Hover, Line
from unifg.scenarios.simulation.bodies import Bodies, Body, Ellipse, Shuttle, Still, Thrown

__all__ = ["SITUATIONS", "Kind", "Situation", "situation"]

logger = logging.getLogger("unifg")

Kind: TypeAlias = Literal["static", "ellipse", "cluttered", "figure8", "ball"]
SITUATIONS: tuple[Kind, ...] = get_args(Kind)

HEIGHT = 1.5  # of all paths [m]
_TAG = 71  # keeps these numbers apart from those of others with the same seed


@dataclass(frozen=True)
class Situation:
    """Path, obstacles and end of a flight.

    Attributes:
        kind: its name.
        path: to be followed.
        bodies: in the way.
        duration: of the flight [s].
        end: (x, y, z) where the vehicle is to be at the end, at rest; None where it goes on.
    """

    kind: Kind
    path: FlatPath
    bodies: Bodies
    duration: float
    end: tuple[float, float, float] | None


def situation(kind: Kind, speed: float | None = None, seed: int | None = None) -> Situation:
    """One of the five.

    Args:
        kind: its name.
        speed: of the path at its fastest [m/s]; None for 2.
        seed: of sizes, places and phases; None for those of the description.
    """
    rng = None if seed is None else np.random.default_rng([_TAG, seed])
    made = {"static": _static, "ellipse": _ellipse, "cluttered": _cluttered, "figure8": _figure8, "ball": _ball}
    return made[kind](2.0 if speed is None else speed, rng)


def _static(speed: float, rng: np.random.Generator | None) -> Situation:
    """A cylinder almost on the line: it says on which side to pass, and no more."""
    radius, beside, along = 0.45, -0.02, 0.0
    if rng is not None:
        radius, along = rng.uniform(0.3, 0.6), rng.uniform(-1.0, 1.0)
        beside = rng.choice([-1.0, 1.0]) * rng.uniform(0.01, 0.4)
    return _along_line("static", speed, [Body(radius, Still((along, beside, 0.0)), upright=True)], 4.0)


def _ellipse(speed: float, rng: np.random.Generator | None) -> Situation:
    """A sphere that runs round an ellipse across the line at 2.4 m/s."""
    phase = 0.3 if rng is None else rng.uniform()
    clockwise = bool(rng is not None and rng.uniform() < 0.5)
    around = Ellipse((0.0, 0.0, HEIGHT), (2.5, 2.0), 2.4, phase, clockwise)
    return _along_line("ellipse", speed, [Body(0.4, around)], 5.0)


def _cluttered(speed: float, rng: np.random.Generator | None) -> Situation:
    """Fourteen pillars and balls at rest, ten that go to and fro."""
    rng = rng or np.random.default_rng([_TAG, 0])
    bodies: list[Body] = []
    taken: list[tuple[float, float, float]] = []
    while len(bodies) < 14:
        x, y, radius = rng.uniform(-7.0, 7.0), rng.uniform(-2.0, 2.0), rng.uniform(0.2, 0.4)
        # Between any two at rest there is room for a vehicle of radius 0.25 with 0.3 m to spare on either side.
        if any(np.hypot(x - a, y - b) < radius + r + 1.1 for a, b, r in taken):
            continue
        taken.append((x, y, radius))
        upright = len(bodies) % 2 == 0
        bodies.append(Body(radius, Still((x, y, 0.0 if upright else HEIGHT + rng.uniform(-0.3, 0.3))), upright=upright))
    for k in range(10):
        x, z = -6.0 + 1.3 * k, HEIGHT + rng.uniform(-0.8, 0.8)
        way = Shuttle((x, -3.0, z), (x, 3.0, z), rng.uniform(0.4, 1.0), rng.uniform())
        bodies.append(Body(0.2, way))
    return _along_line("cluttered", speed, bodies, 9.0)


def _figure8(speed: float, rng: np.random.Generator | None) -> Situation:
    """Nothing in the way."""
    path = FigureEight(speed, HEIGHT)
    return Situation("figure8", path, Bodies([]), 3.0 + 2.0 * path.period, None)


def _ball(speed: float, rng: np.random.Generator | None) -> Situation:
    """A pillar beside a vehicle that hovers, and a ball that is thrown at it."""
    place, release, duration, aim = (4.0, 1.0, 1.2), 2.0, 0.8, (0.0, 0.0, HEIGHT)
    if rng is not None:
        heading, far = rng.uniform(-0.8, 0.8), rng.uniform(3.5, 5.0)
        place = (far * float(np.cos(heading)), far * float(np.sin(heading)), rng.uniform(0.8, 1.6))
        duration = rng.uniform(0.7, 1.0)
        x, y, z = (rng.uniform(-0.1, 0.1, 3) + np.array(aim)).tolist()
        aim = (x, y, z)
    ball = Body(0.12, Thrown.at_target(place, aim, duration, release))
    pillar = Body(0.2, Still((0.0, -1.2, 0.0)), upright=True)
    hover = (0.0, 0.0, HEIGHT)
    return Situation("ball", Hover(hover), Bodies([pillar, ball]), 6.0, hover)


def _along_line(kind: Kind, speed: float, bodies: list[Body], half: float) -> Situation:
    line = Line((-half, 0.0, HEIGHT), (half, 0.0, HEIGHT), speed, 1.5)
    if (top := line.acceleration * line.ramp) < 0.999 * speed:
        logger.warning("the path of %g m is too short for %g m/s: it reaches %.2f m/s", line.length, speed, top)
    return Situation(kind, line, Bodies(bodies), line.duration + 3.0, line.end)
