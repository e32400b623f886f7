"""A barrier filter of one step on top of a controller that does not look (Ames et al. 2019, section III; no horizon).

The controller by flatness wants an acceleration; the filter gives the nearest one that keeps, for every obstacle with
clearance h = |r| - keep, r from the obstacle, n = r / |r|, w the relative velocity,

    h'' + (alpha + beta) h' + alpha beta h >= -s,    h' = n . w,    h'' = n . (a - a_o) + (|w|^2 - h'^2) / |r|

which is a barrier condition twice in a row, because an acceleration reaches h by way of h' only. The vehicle can give
accelerations in a box. s >= 0 is dear. A quadratic program of a few unknowns.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import qpsolvers
import scipy.sparse

from unifg.scenarios.options import AtLeastOne, Positive, Settings
from unifg.scenarios.quadrotor.cbf_mpc import Obstacles
from unifg.typing import Array

__all__ = ["FilterSettings", "filtered"]


@dataclass(frozen=True)
class FilterSettings(Settings):
    """Numbers of the filter.

    Attributes:
        alpha: rate at which a clearance may shrink [1/s].
        beta: rate at which what is left of that may shrink [1/s].
        slots: obstacles that are looked at, the nearest first.
        level: greatest acceleration along each axis of the plane [m/s^2].
        vertical: greatest acceleration upwards and downwards [m/s^2].
        price: of the squared slack.
    """

    alpha: Positive[float] = 1.2
    beta: Positive[float] = 4.0
    slots: AtLeastOne = 3
    level: Positive[float] = 6.0
    vertical: Positive[float] = 4.0
    price: Positive[float] = 1e4


def filtered(
    wanted: Array, state: Array, obstacles: Obstacles, later: float, settings: FilterSettings
) -> tuple[Array, float]:
    """The acceleration (3,) nearest to one that is wanted, and the greatest slack [m/s^2].

    Args:
        wanted: (3,) [m/s^2].
        state: (10,) in which it acts.
        obstacles: as they were seen.
        later: how much later it acts [s].
        settings: the numbers.
    """
    s = settings
    near = obstacles.nearest(state[:3], s.slots, later)
    count = len(near.keep)
    flat = np.where(near.upright[:, None], [1.0, 1.0, 0.0], 1.0)
    away = (state[:3] - near.at(np.array([later]))[0]) * flat
    speed = (state[7:] - near.velocity - near.fall * later) * flat
    distance = np.maximum(np.linalg.norm(away, axis=1), 1e-6)
    normal = away / distance[:, None]
    rate = np.sum(normal * speed, axis=1)
    bend = (np.sum(speed * speed, axis=1) - rate * rate) / distance - np.sum(normal * near.fall, axis=1)
    least = -(bend + (s.alpha + s.beta) * rate + s.alpha * s.beta * (distance - near.off(np.array([later]))[0]))
    weights = np.concatenate([np.ones(3), np.full(count, s.price)])
    box = np.array([s.level, s.level, s.vertical])
    answer = qpsolvers.solve_qp(
        P=scipy.sparse.diags(weights, format="csc"), q=np.concatenate([-wanted, np.zeros(count)]),
        G=scipy.sparse.csc_matrix(-np.hstack([normal, np.eye(count)])), h=-least,
        lb=np.concatenate([-box, np.zeros(count)]), ub=np.concatenate([box, np.full(count, np.inf)]), solver="piqp",
    )  # fmt: skip
    if answer is None or not np.isfinite(answer).all():
        return np.clip(wanted, -box, box), float("inf")
    acceleration: Array = answer[:3]
    return acceleration, float(answer[3:].max(initial=0.0))
