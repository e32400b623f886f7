"""Lidar end-points on a distance map: localisation as registration (Bazzana et al. 2022, sections IV and VII-A).

A beam's end-point, carried into the world by the estimated pose, should lie on an occupied surface: its signed
distance on the map is the residual (eq. 5, signed so that it stays smooth across the surface). The paper's rules
for outliers - a quarter of the information below one cell, nothing beyond 0.3 m, no beams beyond 10 m - are a loss
whose weights are held during one linearisation and its line search.
"""

from __future__ import annotations

import math

import numpy as np

from unifg.codegen.jit import compiled
from unifg.errors import ModelError, require_positive
from unifg.factors.kernel import Kernel
from unifg.factors.residuals import Residual, residual
from unifg.factors.robust import Reweighted
from unifg.lie import SE2
from unifg.models.distance_map import DistanceMap, bilinear
from unifg.models.planar import POSE
from unifg.typing import Array, BoolArray

__all__ = ["endpoint", "endpoint_loss"]

DISCARD_BEYOND = 0.3  # [m] to the nearest surface
DROP_BEYOND = 10.0  # [m] range
NEAR_WEIGHT = 0.25


@compiled
def _endpoint(v: Array, p: Array, table: Array, r: Array, J: Array) -> None:
    """Distance of one end-point."""
    cosine, sine = math.cos(v[2]), math.sin(v[2])
    x, y = v[0] + cosine * p[0] - sine * p[1], v[1] + sine * p[0] + cosine * p[1]
    r[0], slope_x, slope_y = bilinear(table, x, y)
    if len(J):
        along, across = cosine * slope_x + sine * slope_y, cosine * slope_y - sine * slope_x
        J[0, 0] = along
        J[0, 1] = across
        J[0, 2] = across * p[0] - along * p[1]


def endpoint(distance_map: DistanceMap) -> Residual:
    """``endpoint(map)(x, beams)``: distance of each end-point to the nearest surface, (n, 1) [m].

    Args:
        distance_map: signed distance of the map.

    Returns:
        A residual of SE(2) poses x (n, 3) and end-points (n, 2) [m] in the sensor frame.
    """
    return residual(Kernel(_endpoint, (SE2, (2,)), 1, distance_map.table, "lidar end-points"), takes=(POSE, "m in B"))


def in_world(x: Array, points: Array) -> Array:
    """Carry (n, 2) points of the body frame into the world with (n, 3) or (1, 3) poses."""
    return SE2.act(x, points)


class _Rule:
    """The paper's weights as a function of the squared whitened residual."""

    def __init__(self, sigma: float, resolution: float) -> None:
        self.near = (resolution / sigma) ** 2
        self.far = (DISCARD_BEYOND / sigma) ** 2

    def __call__(self, squared: Array) -> Array:
        return np.where(squared < self.near, NEAR_WEIGHT, np.where(squared < self.far, 1.0, 0.0))


def endpoint_loss(sigma: float, resolution: float) -> Reweighted:
    """Weights of section VII-A for beams of standard deviation ``sigma`` [m] on cells of ``resolution`` [m].

    Raises:
        ModelError: unless both are positive.
    """
    require_positive("end-points", ModelError, sigma=sigma, resolution=resolution)
    return Reweighted(_Rule(sigma, resolution))


def usable(ranges: Array, reach: float = DROP_BEYOND) -> BoolArray:
    """(n,) beams that take part: a return was measured, and not beyond a distance [m]."""
    with np.errstate(invalid="ignore"):
        return np.isfinite(ranges) & (ranges <= reach)


def beam_endpoints(ranges: Array, angles: Array, reach: float = DROP_BEYOND) -> Array:
    """(n, 2) end-points in the sensor frame [m]; unusable beams end at the origin."""
    lengths = np.where(usable(ranges, reach), ranges, 0.0)
    return np.stack([lengths * np.cos(angles), lengths * np.sin(angles)], axis=1)
