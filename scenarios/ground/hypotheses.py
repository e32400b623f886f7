"""Several hypotheses of one pose: drawn from what was predicted, weighed by a scan, gathered into a mixture.

Draws have the tails of a t-distribution, as wheels slip more often than a normal distribution says; a scan weighs them
by a likelihood field (Thrun, Burgard, Fox, *Probabilistic Robotics*, table 6.3). Draws that lie together become one
hypothesis with their weight, mean and covariance: a Gaussian sum (Alspach, Sorenson, *IEEE Transactions on Automatic
Control* 17 (1972)). What a scan does not tell, such as the place along a corridor, stays as wide as it was drawn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from unifg.lie import SE2, wrap_angle
from unifg.models import lidar
from unifg.models.distance_map import DistanceMap
from unifg.scenarios.perception.readings import Scan
from unifg.typing import Array

__all__ = ["Hypothesis", "gathered", "mixed", "weighed"]

DRAWS = 600
REACH = 30.0  # [m] of beams; the end of a corridor says where in it the robot is
BEAMS = 90  # of the scan that draws are held against
FREEDOM = 4.0  # of the t-distribution
HIT, RANDOM = 0.5, 0.05  # weights of a beam that ends at a surface, and of one that may end anywhere
WIDTH = 0.15  # [m] standard deviation of the former
TOGETHER = np.array([0.4, 0.4, 0.25])  # draws nearer to each other are one hypothesis [m, m, rad]
MOST = 8  # hypotheses
LEAST = 0.01  # weight of one that is kept
FLOOR = np.diag([0.02, 0.02, 0.005]) ** 2  # of a hypothesis, as draws are so far apart [m, m, rad]


@dataclass(frozen=True)
class Hypothesis:
    """A pose that may be the right one.

    Attributes:
        pose: (3,) [m, m, rad].
        covariance: (3, 3) in the tangent space there.
        weight: share of belief.
    """

    pose: Array
    covariance: Array
    weight: float = 1.0


def weighed(
    distance_map: DistanceMap, scan: Scan, believed: Sequence[Hypothesis], rng: np.random.Generator
) -> tuple[Array, Array]:
    """Draws (DRAWS, 3) from hypotheses, and their weights (DRAWS,) by a scan."""
    weights = np.array([one.weight for one in believed])
    which = rng.choice(len(believed), DRAWS, p=weights / weights.sum())
    tails = np.sqrt(FREEDOM / rng.chisquare(FREEDOM, DRAWS))[:, None]
    roots = np.stack([np.linalg.cholesky(one.covariance) for one in believed])
    off = np.einsum("nij,nj->ni", roots[which], tails * rng.standard_normal((DRAWS, 3)))
    draws = SE2.compose(np.stack([one.pose for one in believed])[which], SE2.exp(off))
    beams = np.flatnonzero(lidar.usable(scan.ranges, REACH))
    beams = beams[np.linspace(0, len(beams) - 1, min(BEAMS, len(beams))).round().astype(np.intp)]
    ends = lidar.beam_endpoints(scan.ranges[beams], scan.angles[beams], REACH)
    places = SE2.act(np.repeat(draws, len(ends), axis=0), np.tile(ends, (DRAWS, 1)))
    distance = distance_map.distance(places).reshape(DRAWS, -1)
    log = np.log(HIT * np.exp(-0.5 * (distance / WIDTH) ** 2) + RANDOM).sum(axis=1)
    found = np.exp(log - log.max())
    return draws, found / found.sum()


def gathered(draws: Array, weights: Array) -> list[Hypothesis]:
    """Hypotheses of draws (n, 3) with weights (n,), the heaviest first."""
    found: list[Hypothesis] = []
    left = weights.copy()
    while len(found) < MOST and left.max() > 0.0:
        middle = draws[int(np.argmax(left))]
        away = draws - middle
        away[:, 2] = wrap_angle(away[:, 2])
        near = (np.abs(away) <= TOGETHER).all(axis=1) & (left > 0.0)
        share = left[near] / left[near].sum()
        pose = middle + share @ away[near]
        apart = SE2.local(np.tile(pose, (int(near.sum()), 1)), draws[near])
        found.append(Hypothesis(pose, (share[:, None] * apart).T @ apart + FLOOR, float(left[near].sum())))
        left[near] = 0.0
    found.sort(key=lambda one: -one.weight)
    return [one for one in found if one.weight >= LEAST * found[0].weight]


def mixed(believed: Sequence[Hypothesis]) -> Array:
    """Covariance (3, 3) of a mixture about the first of its hypotheses."""
    weights = np.array([one.weight for one in believed])
    apart = SE2.local(np.tile(believed[0].pose, (len(believed), 1)), np.stack([one.pose for one in believed]))
    within = np.stack([one.covariance for one in believed]) + apart[:, :, None] * apart[:, None, :]
    found: Array = np.einsum("n,nij->ij", weights / weights.sum(), within)
    return found
